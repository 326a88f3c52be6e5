"""The report of a comparison, for good and bad results."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.text import Text
from rich.console import Console

from mor_bench.analysis.analyse import analyse
from mor_bench.report.console_tables import Detail, print_tables
from mor_bench.report.details import dataset_details
from mor_bench.report.entries import Entry, best_per_method, entries_of
from mor_bench.report.figures import pictures_of
from mor_bench.report.number_format import bytes_text, number, percent, short_swept
from mor_bench.report.page import render
from mor_bench.report.short_names import renamed, short_names
from mor_bench.report.speed_tables import NOT_REACHED, pairs_at, target_table
from mor_bench.report.summary import discretisation_error, warnings_of
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import ErrorSummary
from tests.report_runs import N_TEST, add_row, data_of, markup_of, page_of, text_of, tiny
from tests.synthetic import (
    a_row,
    synthetic_comparison,
)

HOSTILE = "<script>alert(1)</script> & [bold]$x_1$"
REASON = "OutOfMemoryError: 31 GiB <needed> & 24 GiB there"
SKIPPED = "needs pip install 'mor-bench[learn]'"
NEEDS = {"error": 0.01, "latency_ms": 3.0}

Analysis = dict[str, Any]


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Two sweeps, and rows that failed, were skipped, lack predictions or have a hostile label."""
    folder = tmp_path_factory.mktemp("run")
    made = tiny(folder, processor="<b>fast</b>", versions={"numpy": "2.4"})
    pod = ((5, 0.05, 1.0), (10, 0.02, 1.5), (20, 0.008, 2.5), (25, 0.002, 4.0))
    for rank, error, latency in pod:
        add_row(made, "pod", {"n_modes": rank}, error, latency)
    for rank, error, latency in ((5, 0.06, 0.2), (20, 0.029, 0.5)):
        add_row(made, "hpod", {"n_modes": rank, "cubature_tolerance": 0.01}, error, latency)
    add_row(made, "fem", {}, 0.0, 8.0)
    doubts = {"reason": "SolverError: no equilibrium", "warnings": ["only 12 modes of <25>"]}
    add_row(made, "partial", {}, 0.004, 5.0, n_failed=3, **doubts)
    add_row(made, "broken", {}, 0.001, 0.1, n_failed=N_TEST)
    add_row(made, HOSTILE, {}, 0.2, 2.0)
    made.put(a_row("umesh", {"channels": 64}, status="failed", reason=REASON, n_failed=None))
    made.put(a_row("deim", status="skipped", reason=SKIPPED, n_failed=None))
    return made


@pytest.fixture(scope="module")
def written(comparison: Comparison) -> list[Path]:
    """All files that `render` writes."""
    return render(comparison)


@pytest.fixture(scope="module")
def page(written: list[Path]) -> str:
    return written[-1].read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """A dataset with everything that a run can measure."""
    return synthetic_comparison(tmp_path_factory.mktemp("rich"), per_region=8)


@pytest.fixture(scope="module")
def analysis(rich: Comparison) -> Analysis:
    return analyse(rich, n_resamples=200)


def console_text(
    comparison: Comparison,
    width: int = 200,
    analysis: Analysis | None = None,
    detail: Detail = Detail(verbose=True, wide=True),
) -> str:
    """Return the console output of a comparison."""
    stream = io.StringIO()
    print_tables(comparison, Console(file=stream, width=width), analysis, detail)
    return stream.getvalue()


def test_console_and_page_show_every_row_with_its_reason(comparison: Comparison, page: str) -> None:
    summary = analyse(comparison)["verdicts"][0]
    names = short_names(comparison.rows)
    for text in (console_text(comparison), text_of(page)):
        for row in comparison.rows:
            assert row.label in text or str(names[row.label]) in text
            assert (row.reason or "") in text
        for said in (
            "warning: only 12 modes of <25>",
            f"3 of {N_TEST} test samples without a prediction",
            "not measured",
            NOT_REACHED,
            *summary["beside"],
            *summary["headline"].split(". ", 1),
        ):
            flat = " ".join(text.split())
            assert said in flat or renamed(said, names) in flat


def test_a_legacy_code_page_does_not_stop_the_run(comparison: Comparison) -> None:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="cp1252")
    print_tables(comparison, Console(file=stream, width=120))
    assert b"r20" in raw.getvalue()


def test_needs_and_frontier_are_marked_in_the_right_rows(comparison: Comparison) -> None:
    entries = entries_of(comparison, "beam-tiny", analyse(comparison, n_resamples=200))
    assert [entry.label for entry in entries if entry.qualified] == ["pod [n_modes=20]"]
    assert {entry.label for entry in entries if entry.on_front} == {
        *(f"hpod [n_modes={r}, cubature_tolerance=0.01]" for r in (5, 20)),
        *(f"pod [n_modes={r}]" for r in (10, 20, 25)),
        "fem",
    }


def test_meeting_only_one_need_is_not_enough() -> None:
    made = Comparison(Path(), {}, datasets={"beam-tiny": {"needs": NEEDS}})
    for name, error, latency in (("slow", 0.001, 6.0), ("coarse", 0.03, 0.1)):
        figures = {"error": {"rel_l2_median": error}, "latency_ms": {"median": latency}}
        made.rows.append(a_row(name, **figures))
    found = analyse(made, n_resamples=50)
    assert not any(entry.qualified for entry in entries_of(made, "beam-tiny", found))
    headline = found["verdicts"][0]["headline"]
    assert re.search("No configuration qualifies .* nearest is slow, .* latency 2 times", headline)


def test_targets_out_of_reach_are_labelled_as_such(comparison: Comparison) -> None:
    analysis = analyse(comparison, n_resamples=50)
    table = target_table(comparison, "beam-tiny", "time_at_error", analysis)
    rows = {method: cells for method, *cells in table.rows}
    assert table.headings == ["method", "10 %", "3 %", "1 %", "0.3 %", "0.1 %"]
    assert rows["umesh"] == rows["deim"] == [NOT_REACHED] * 5
    reached = [not cell.startswith(NOT_REACHED) for cell in rows["hpod"]]
    assert reached == [True, False, False, False, False]  # its upper bounds exceed 3 %
    assert rows["pod"][2].split("\n")[1] == "r20"
    table = target_table(comparison, "beam-tiny", "error_at_time", analysis)
    rows = {method: cells for method, *cells in table.rows}
    assert table.headings[1:4] == ["0.1 ms", "1 ms", "3 ms"]
    assert rows["pod"][0] == NOT_REACHED
    assert rows["pod"][-1].startswith("0.2")


def test_the_page_escapes_html_and_needs_no_network(page: str) -> None:
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    markup = markup_of(page)
    assert not re.search(r"<(link|iframe|object)\b|https?://", markup)
    assert not re.search(r"<script[^>]*\bsrc=", page)
    for style in re.findall(r"<style>(.*?)</style>", page, re.DOTALL):
        assert not re.search(r"@import|https?://", style)
    assert "<b>fast</b>" not in markup
    assert "31 GiB <needed>" not in markup
    loaded = re.findall(r'\b(?:src|srcset|data|poster|background)="([^"]*)"', markup)
    assert len(loaded) == 1  # the bodies on paper
    assert all(source.startswith("data:image/png;base64,") for source in loaded)
    assert len(page) < 6_000_000
    links = re.findall(r'\bhref="([^"]*)"', markup)
    assert not any("//" in link or ":" in link for link in links)


def test_the_page_lists_every_configuration_once_and_omits_unmeasured_figures(
    comparison: Comparison, page: str
) -> None:
    table = page.split("<caption>Configurations of beam-tiny</caption>")[1].split("</table>")[0]
    assert table.count("<tr class=") == len(comparison.rows)
    assert [row["label"] for row in data_of(page)[0]["rows"]] == [r.label for r in comparison.rows]
    text = text_of(page)
    for word in ("results.json", "samples/", "x-min", "2.4", "that the verdict's rule selects"):
        assert word in text
    for absent in ("Timing", "Memory and cost", "Named test sets", "Fresh test set", "Tuning"):
        assert f"<caption>{absent}" not in page
    assert "nan" not in text.split()
    assert not re.search(r"<tbody>\s*</tbody>", page)


def test_figures_are_png_and_svg_files_with_content(
    comparison: Comparison, written: list[Path]
) -> None:
    kinds = ["error-against-time", "error-against-deformation", "worst-samples", "distributions"]
    kinds += ["whole-cost", "singular-values"]
    assert [path.name for path in written] == [
        *(f"beam-tiny--{kind}.png" for kind in kinds),
        "report.html",
    ]
    for path in written[:-1]:
        assert path.parent == comparison.out / "figures"
        pixels = imread(path)[..., :3]
        assert pixels.shape[1] == 1410
        svg = path.with_suffix(".svg").read_text(encoding="utf-8")
        assert svg.startswith("<?xml")
        assert "<dc:date>" not in svg
        assert "<script" not in svg
        assert pixels.std() > 0.03
        colours = np.unique(pixels @ np.array([1.0, 7.3, 53.1]))
        assert len(colours) > 50  # more than black on white
    assert not list(comparison.out.rglob("*.tmp"))


def test_the_discretisation_error_is_shown_with_its_evidence() -> None:
    rows = [a_row("pod"), a_row("pod", discretisation_error_m=0.0123)]
    rows.append(rows[1].with_parts(discretisation_rel_l2=0.205))
    unknown, alone, both = (discretisation_error([Entry(row)]) for row in rows)
    assert unknown == "not known"
    assert alone.startswith("1.2e-02 m; an error")
    assert both.startswith("1.2e-02 m, relative L2 error 20.5 % (median); an error")


def test_a_report_without_a_completed_row_says_so(tmp_path: Path) -> None:
    nothing = page_of(Comparison(tmp_path / "nothing", {}))
    assert "nothing to report" in nothing
    made = tiny(tmp_path, "beam-tiny", "other")
    made.put(a_row("pod", status="failed", reason="no memory"))
    made.put(a_row("pod", dataset="other", status="skipped", reason="not supported"))
    page = page_of(made)
    assert page.count('<p class="verdict">No configuration gave a usable result') == 2
    for text in (page, console_text(made)):
        assert "no memory" in text
        assert "not supported" in text
    assert console_text(made).count(NOT_REACHED) >= 22
    assert "Time at error" not in page


def test_a_row_without_a_number_is_not_good(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    row = add_row(made, "pod", {"n_modes": 5}, 0.005, 1.0)
    unknown = ErrorSummary(**dict.fromkeys(ErrorSummary.model_fields, float("nan")))
    made.put(row.with_parts(error=unknown))
    assert analyse(made, n_resamples=50)["verdicts"][0]["qualified"] == []
    text = console_text(made)
    assert "No configuration gave a usable result" in text
    assert "nan" in text


def test_the_best_row_of_a_method_has_a_finite_error() -> None:
    errors = {5: 0.01, 20: float("inf")}
    rows = [a_row("pod", {"r": r}, error={"rel_l2_median": errors[r]}) for r in (20, 5)]
    assert [entry.row for entry in best_per_method([Entry(row) for row in rows])] == rows[1:]
    held_out = {5: 0.02, 20: 0.01}
    rows = [
        row.with_parts(validation=ErrorSummary(rel_l2_median=held_out[row.swept["r"]]))
        for row in rows
    ]
    assert [entry.row for entry in best_per_method([Entry(row) for row in rows])] == rows[:1]


def test_numbers_are_printed_with_few_digits() -> None:
    values = (None, float("inf"), 0.0, 0.00064, 0.843, 99.94, 99.96, 1234.4, 123456.0)
    texts = ["–", "inf", "0", "6.4e-04", "0.843", "99.9", "100", "1234", "1.2e+05"]
    assert [number(value) for value in values] == texts
    assert percent(0.008) == "0.8"
    sizes = ["–", "12 B", "1 kB", "12.3 kB", "2.5 GB"]
    assert [bytes_text(value) for value in (None, 12, 999.6, 12345, 2.5e9)] == sizes
    swept = {"n_modes": 20, "cubature_tolerance": 0.01, "n_heads": 4}
    assert short_swept(swept) == "r=20, ctol=0.01, nh=4"


def test_a_warning_of_many_configurations_is_shown_once() -> None:
    warnings = (["it locks"], ["it locks"], ["it locks", "few modes"])
    entries = [Entry(a_row("pod", {"r": i}, warnings=given)) for i, given in enumerate(warnings)]
    expected = [("pod [r=0] and 2 more", "it locks"), ("pod [r=2]", "few modes")]
    assert warnings_of(entries) == expected


@pytest.mark.slow
def test_the_page_has_a_section_for_every_measurement(rich: Comparison, analysis: Analysis) -> None:
    page = page_of(rich, analysis)
    titles = re.findall("<h3>(.*?)</h3>", page)
    assert titles == [
        "Error against time",
        "Configurations",
        "Failures and warnings",
        "Deformed bodies",
        "Error over the position of the load",
        "Error against deformation",
        "Distribution of errors and latencies",
        "Whole cost and break-even",
        "Singular values of the training snapshots",
        "Learning curves",
        "Hard cases",
    ]
    captions = re.findall("<caption>(.*?)</caption>", page)
    assert [title for title in captions if not title.startswith("Who is faster")] == [
        "Configurations of beam-coarse",
        "Named test sets",
        "Fresh test set",
        "Worst test loads of each method",
        "Time at error: median latency at a median relative L2 error",
        "Error at time: median relative L2 error within a median latency",
        "Whole cost",
        "Timing",
        "Memory and cost",
        "Named test sets",
        "Fresh test set",
        "Tuning budget",
        "Error measures of the networks",
        "Against the paper, by slope and relative error",
        "Comparison at the same error",
        "Comparison at the same time",
        "Relative L2 error (%)",
        "Latency of one query (ms)",
        "Error per degree of freedom (m)",
        "Offline cost",
        "Nodal error and error over deformation",
        "Error at the tip, the node that moves most (%)",
        "Size and samples",
        "In its regime",
    ]
    assert not re.search(r"<t[dh][^>]*>\s*n_patches", page)
    text = text_of(page)
    for said in (
        "processes differ by 14 %",
        "To draw them again: --test-seed 7.",
        "Never: the full-order model is as fast. Not reached at ",
        "as large on the fresh test set as on the shipped one",
        "no graphics processor). It is for: 20,000 samples or more, on a GPU",
        "errors over 13 load regions (bootstrap of ",
        "resamples), latencies over 5 processes that differ by",
        "6 of 5 (over)",
        "flagged 41.7 % of 60",
        "Who is faster at 1 %, the required error",
        "configuration told processes queries",
    ):
        assert said in text


OTHER_NAMES = re.compile(r"\brel(?:\.|ative)? ?l2\b", re.IGNORECASE)
"""The relative L2 error in other words, once its own name is taken out of a text."""


@pytest.mark.slow
def test_the_error_has_one_name_on_page_terminal_and_pictures(
    rich: Comparison, analysis: Analysis
) -> None:
    page = page_of(rich, analysis)
    texts = {"page": text_of(page), "data": json.dumps(data_of(page))}
    texts["terminal"] = " ".join(console_text(rich, analysis=analysis).split())
    for picture in pictures_of(rich, "beam-coarse", analysis):
        drawn = [t for t in picture.figure.findobj(Text) if isinstance(t, Text)]
        texts[picture.kind] = " ".join(t.get_text().replace("\n", " ") for t in drawn)
        texts[f"{picture.kind}, caption"] = picture.caption
    assert "relative L2 error" in texts["page"]
    for where, text in texts.items():
        text = re.sub("[Rr]elative L2 (error|difference)", "", text)
        found = OTHER_NAMES.search(text)
        assert found is None, (where, text[found.start() - 40 : found.end() + 40])


def test_the_matrix_of_pairs_shows_factors_and_intervals(
    rich: Comparison, analysis: Analysis
) -> None:
    pairs = pairs_at(rich, "beam-coarse", 0.01, analysis)
    assert pairs.methods == ["fem", "pod", "pca-regression-linear"]
    assert pairs.absent == ["hpod", "linear-fem", "umesh"]
    record = next(
        r
        for r in analysis["pairwise"]
        if (r["target_rel_l2_median"], r["a"], r["b"]) == (0.01, "pod", "fem")
    )
    ratio, low, high = (number(record[name]) for name in ("ratio", "low", "high"))
    matrix = next(
        table
        for table in dataset_details(rich, "beam-coarse", analysis)
        if "1 %, the required error" in table.title
    )
    assert matrix.rows[1][1] == f"-{ratio}\n{low}–{high}"
    assert matrix.rows[0][2] == f"+{ratio}\n{low}–{high}"
    targets = target_table(rich, "beam-coarse", "time_at_error", analysis)
    (cells,) = (cells for method, *cells in targets.rows if method == "pod")
    assert re.fullmatch(r"[\d.]+ ms\nr\d+\n[\d.]+–[\d.]+", cells[1])
