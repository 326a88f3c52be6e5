"""The report of a comparison: what it must say, for good and bad results."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from mor_bench.analysis.analyse import analyse
from mor_bench.measure.error_metrics import sample_errors, summary
from mor_bench.report.console_tables import print_tables
from mor_bench.report.details import dataset_details
from mor_bench.report.entries import Entry, best_per_method, entries_of
from mor_bench.report.number_format import bytes_text, number, percent, short_swept
from mor_bench.report.page import render
from mor_bench.report.paper_tables import PUBLISHED, error_measures, same_error_or_time
from mor_bench.report.speed_tables import NOT_REACHED, pairs_at, target_table
from mor_bench.report.summary import discretisation_error, headline, warnings_of
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import ErrorSummary, Row
from mor_bench.scene.mesh import box_mesh
from mor_bench.specs import load_dataset_spec
from tests.synthetic import a_row, synthetic_comparison

HOSTILE = "<script>alert(1)</script> & [bold]$x_1$"
REASON = "OutOfMemoryError: 31 GiB <needed> & 24 GiB there"
SKIPPED = "needs pip install 'mor-bench[learn]'"
N_TEST = 40
MESH = box_mesh((2.0, 1.0, 1.0), (4, 2, 2))

Analysis = dict[str, Any]


def add_row(
    comparison: Comparison,
    method: str,
    swept: Mapping[str, Any],
    error: float,
    latency_ms: float,
    **fields: Any,
) -> Row:
    """Add a row with raw samples and this median relative L2 error; `n_failed` fails samples."""
    generator = np.random.default_rng(len(comparison.rows))
    size = 0.2 * generator.random((N_TEST, 1, 1))
    reference = size * MESH.points[None, :, [0]] ** 2 * np.array([0.2, 0.1, 1.0])
    prediction = reference * (1 + error * np.linspace(0.5, 1.5, N_TEST + 1)[1:, None, None])
    prediction[: fields.get("n_failed", 0)] = np.nan
    errors = sample_errors(prediction, reference)
    worst = int(np.argmax(np.where(np.isfinite(errors.mean_dof_m), errors.mean_dof_m, -1)))
    forces = np.zeros_like(reference[0])
    forces[-1, 2] = -0.7
    measured = {
        "n_test": N_TEST,
        "error": summary(errors),
        "latency_ms": {"median": latency_ms, "p95": 1.09 * latency_ms, "p99": 1.1 * latency_ms},
        "offline_s": {"data": 3.0, "fit": 0.5},
        "model_bytes": 12345,
    }
    row = a_row(method, swept, **{**measured, **fields})
    samples = {
        "latency_ms": latency_ms * np.linspace(0.9, 1.1, 41),
        "mean_dof_m": errors.mean_dof_m,
        "relative_l2": errors.relative_l2,
        "max_nodal_m": errors.max_nodal_m,
        "amplitude_m": errors.amplitude_m,
        "worst_prediction": prediction[worst],
        "worst_reference": reference[worst],
        "worst_forces": forces,
    }
    comparison.put(row, samples)
    return row


def tiny(out: Path, *names: str, **machine: Any) -> Comparison:
    """A comparison without rows on beam-tiny (needs: 1 %, 3 ms), under one or several names."""
    made = Comparison(out, machine)
    arrays = {"points": MESH.points, "cells": MESH.cells, "singular_values": 0.8 ** np.arange(30.0)}
    for name in names or ("beam-tiny",):
        made.add_dataset(name, load_dataset_spec("beam-tiny").model_dump(mode="json"), arrays)
    return made


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
    """All that `render` writes."""
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


def text_of(page: str) -> str:
    return " ".join(unescape(re.sub(r"<[^>]*>", " ", page)).split())


def console_text(comparison: Comparison, width: int = 200, analysis: Analysis | None = None) -> str:
    """Console output of a comparison."""
    stream = io.StringIO()
    print_tables(comparison, Console(file=stream, width=width), analysis)
    return stream.getvalue()


class Resources(HTMLParser):
    """Tags, sources and links of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.sources: list[str] = []
        self.links: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        loading = ("src", "srcset", "data", "poster", "background")
        self.sources += [value or "" for name, value in attrs if name in loading]
        self.links += [value or "" for name, value in attrs if name == "href"]


def test_console_and_page_show_every_row_with_its_reason(comparison: Comparison, page: str) -> None:
    for text in (console_text(comparison), text_of(page)):
        for row in comparison.rows:
            assert row.label in text
            assert (row.reason or "") in text
        for said in (
            "warning: only 12 modes of <25>",
            f"3 of {N_TEST} test samples without a prediction",
            "not measured",
            NOT_REACHED,
            headline(comparison, "beam-tiny"),
        ):
            assert said in text


@pytest.mark.parametrize("width", [80, 100, 120])
def test_console_fits_its_width_without_squeezed_words(comparison: Comparison, width: int) -> None:
    lines = console_text(comparison, width).splitlines()
    assert max(map(len, lines)) <= width
    end = next(i for i, line in enumerate(lines) if line.startswith("Pareto"))
    start = next(i for i, line in enumerate(lines) if line.startswith("configuration"))
    assert min(len(line.strip()) for line in lines[start:end] if line.strip()) >= 3
    meeting = [line for line in lines[start:end] if line.rstrip().endswith("yes")]
    assert [line.split("]")[0] for line in meeting] == ["pod [n_modes=20"]


def test_a_legacy_code_page_does_not_end_the_run(comparison: Comparison) -> None:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="cp1252")
    print_tables(comparison, Console(file=stream, width=120))
    assert b"pod [n_modes=20]" in raw.getvalue()


def test_needs_and_front_are_marked_where_they_belong(comparison: Comparison) -> None:
    entries = entries_of(comparison, "beam-tiny")
    assert [entry.label for entry in entries if entry.meets_needs] == ["pod [n_modes=20]"]
    assert {entry.label for entry in entries if entry.on_front} == {
        *(f"hpod [n_modes={r}, cubature_tolerance=0.01]" for r in (5, 20)),
        *(f"pod [n_modes={r}]" for r in (10, 20, 25)),
        "fem",
    }


def test_meeting_only_one_need_is_not_enough(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "slow", {}, 0.001, 6.0)
    add_row(made, "coarse", {}, 0.03, 0.1)
    assert not any(entry.meets_needs for entry in entries_of(made, "beam-tiny"))
    assert re.search(
        r"No configuration meets .* Nearest is slow: .* 2 times the allowed latency",
        headline(made, "beam-tiny"),
    )


def test_targets_out_of_reach_are_named_so(comparison: Comparison) -> None:
    analysis = analyse(comparison, n_resamples=50)
    table = target_table(comparison, "beam-tiny", "time_at_error", analysis)
    rows = {method: cells for method, *cells in table.rows}
    assert table.headings == ["method", "10 %", "3 %", "1 %", "0.3 %", "0.1 %"]
    assert rows["umesh"] == rows["deim"] == [NOT_REACHED] * 5
    reached = [not cell.startswith(NOT_REACHED) for cell in rows["hpod"]]
    assert reached == [True, True, False, False, False]
    assert rows["pod"][2].split("\n")[1] == "r=20"
    table = target_table(comparison, "beam-tiny", "error_at_time", analysis)
    rows = {method: cells for method, *cells in table.rows}
    assert table.headings[1:4] == ["0.1 ms", "1 ms", "3 ms"]
    assert rows["pod"][0] == NOT_REACHED
    assert rows["pod"][-1].startswith("0.2")


def test_the_page_escapes_and_needs_no_network(page: str, written: list[Path]) -> None:
    resources = Resources(page)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert not {"script", "link", "iframe", "object"} & resources.tags
    assert "<b>fast</b>" not in page
    assert "31 GiB <needed>" not in page
    assert len(resources.sources) == len(written) - 1
    assert all(source.startswith("data:image/png;base64,") for source in resources.sources)
    assert not any("//" in link or ":" in link for link in resources.links)
    assert not re.search(r"url\(|@import|https?://", page)


def test_the_page_lists_every_configuration_once_and_nothing_unmeasured(
    comparison: Comparison, page: str
) -> None:
    table = page.split("<h3>Configurations</h3>")[1].split("</table>")[0]
    assert table.count("<tr class=") == len(comparison.rows)
    text = text_of(page)
    for word in ("results.json", "samples/", "x-min", "2.4", "never extrapolates", "infinite"):
        assert word in text
    for absent in ("Timing", "Memory and cost", "Named test sets", "Hidden test set", "Tuning"):
        assert f"<h3>{absent}" not in page
    assert "nan" not in text.split()
    assert not re.search(r"<tbody>\s*</tbody>", page)


def test_figures_are_pictures(comparison: Comparison, written: list[Path]) -> None:
    kinds = ["error-against-time", "error-against-deformation", "worst-samples", "singular-values"]
    assert [path.name for path in written] == [
        *(f"beam-tiny--{kind}.png" for kind in kinds),
        "all-datasets--performance-profile.png",
        "report.html",
    ]
    for path in written[:-1]:
        assert path.parent == comparison.out / "figures"
        pixels = imread(path)[..., :3]
        assert pixels.shape[1] == 1410
        assert pixels.std() > 0.03
        colours = np.unique(pixels @ np.array([1.0, 7.3, 53.1]))
        assert len(colours) > 50  # more than black on white
    assert not list(comparison.out.rglob("*.tmp"))


def test_reading_back_gives_the_same_text(comparison: Comparison, written: list[Path]) -> None:
    again = Comparison.read(comparison.out)
    assert again.rows == comparison.rows
    assert console_text(again) == console_text(comparison)


def test_the_discretisation_error_is_stated_with_what_is_known(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "pod", {"n_modes": 5}, 0.005, 1.0, discretisation_error_m=0.0123)
    assert discretisation_error(entries_of(made, "beam-tiny")).startswith("1.2e-02 m; an error")
    made.rows[0] = made.rows[0].with_parts(discretisation_rel_l2=0.205)
    stated = discretisation_error(entries_of(made, "beam-tiny"))
    assert stated.startswith("1.2e-02 m, relative L2 (median) 20.5 %; ")
    assert "1.2e-02 m" in console_text(made)


def test_the_report_of_several_datasets_without_a_row_that_ran(tmp_path: Path) -> None:
    made = tiny(tmp_path, "beam-tiny", "other")
    made.put(a_row("pod", status="failed", reason="no memory"))
    made.put(a_row("pod", dataset="other", status="skipped", reason="not supported"))
    page = render(made)[-1].read_text(encoding="utf-8")
    assert page.count("No configuration gave a usable result") == 2
    for text in (page, console_text(made)):
        assert "no memory" in text
        assert "not supported" in text
        assert text.count(NOT_REACHED) >= 22


def test_the_report_of_no_rows_says_so(tmp_path: Path) -> None:
    assert "nothing to report" in render(Comparison(tmp_path, {}))[-1].read_text(encoding="utf-8")


def test_a_row_without_a_number_is_not_good(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    row = add_row(made, "pod", {"n_modes": 5}, 0.005, 1.0)
    unknown = ErrorSummary(**dict.fromkeys(ErrorSummary.model_fields, float("nan")))
    made.put(row.with_parts(error=unknown))
    assert not entries_of(made, "beam-tiny")[0].meets_needs
    text = console_text(made)
    assert "No configuration gave a usable result" in text
    assert "nan" in text


def test_the_best_of_a_method_has_a_finite_error(tmp_path: Path) -> None:
    made = tiny(tmp_path)
    add_row(made, "pod", {"n_modes": 20}, 0.001, 1.0, n_failed=2)
    add_row(made, "pod", {"n_modes": 5}, 0.05, 1.0)
    (best,) = best_per_method(entries_of(made, "beam-tiny"))
    assert best.label == "pod [n_modes=5]"


def test_numbers_are_short() -> None:
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


def test_the_page_has_a_section_for_all_that_was_measured(
    rich: Comparison, analysis: Analysis
) -> None:
    page = render(rich, analysis)[-1].read_text(encoding="utf-8")
    titles = re.findall("<h3>(.*?)</h3>", page)
    assert [title for title in titles if not title.startswith("Who is faster")] == [
        "What was run",
        "Configurations",
        "Failures, skips and warnings",
        "Time at error: median latency at a median relative L2 error",
        "Error at time: median relative L2 error within a median latency",
        "Whole cost",
        "Timing",
        "Memory and cost",
        "Named test sets",
        "Hidden test set",
        "Tuning budget",
        "Error measures of the networks",
        "Comparison at the same error",
        "Comparison at the same time",
        "Performance profile",
        "In its regime",
    ]
    assert page.count("<img ") == 6
    text = text_of(page)
    for said in (
        "processes differ by 14 %",
        "as large on the hidden test set as on the shipped one",
        "no graphics processor): 20,000 samples or more, on a GPU",
        "errors over 13 load regions, latencies over 5 processes that differ by",
        "6 of 5 (over)",
        "flagged 41.7 % of 60",
        "Who is faster at 1 %, the error that is needed",
    ):
        assert said in text


@pytest.mark.parametrize("width", [80, 120])
def test_the_console_shows_doubts_and_pairs(
    rich: Comparison, analysis: Analysis, width: int
) -> None:
    text = console_text(rich, width, analysis)
    assert max(map(len, text.splitlines())) <= width
    assert re.search(r"^linear-fem .*\d~ ", text, re.MULTILINE)
    assert "linear-fem: timing not stable: processes differ by 14 %" in text
    assert "pca-regression [n_input_modes=5]: the median error is" in text
    assert "Who is faster at 1 %, the error that is needed" in text
    assert re.search(r"^\(1\) fem +· +\+[\d.]+ +-[\d.]+", text, re.MULTILINE)


def test_the_matrix_of_pairs_carries_factors_and_intervals(
    rich: Comparison, analysis: Analysis
) -> None:
    pairs = pairs_at(rich, "beam-coarse", 0.01, analysis)
    assert pairs.methods == ["fem", "pod", "pca-regression"]
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
        if "1 %, the error" in table.title
    )
    assert matrix.rows[1][1] == f"-{ratio}\n{low}–{high}"
    assert matrix.rows[0][2] == f"+{ratio}\n{low}–{high}"
    targets = target_table(rich, "beam-coarse", "time_at_error", analysis)
    (cells,) = (cells for method, *cells in targets.rows if method == "pod")
    assert re.fullmatch(r"[\d.]+ ms \([\d.]+\)\nr=\d+\n[\d.]+–[\d.]+", cells[1])


def test_the_paper_s_table_of_errors_has_its_networks_beside_ours(rich: Comparison) -> None:
    entries = entries_of(rich, "beam-coarse")
    network = next(entry.row for entry in entries if entry.method == "umesh")
    size = {"channels": 128, "steps": 3}
    large = Entry(network.with_parts(label="large", parameters=size))
    measures = error_measures("beam-coarse", [*entries, large])
    assert measures is not None
    # Both of ours, and of the paper's eight all but the one that has the size of one of ours.
    assert len(measures.rows) == 2 + 8 - 1
    assert measures.rows[0][1:4] == ["16", "2", "64"]
    assert measures.rows[1][:4] == ["large", "128", "3", "1024"]
    assert measures.rows[1][5::2] == ["0.0007", "0.0006", "–", "0.00352", "2.5", "35"]
    assert [row[0] for row in measures.rows[2:]] == ["not run here"] * 7
    others = [entry for entry in entries if entry.method != "umesh"]
    assert error_measures("beam-coarse", others) is None
    assert same_error_or_time("beam-coarse", others) == []


def test_the_paper_s_comparisons_stand_beside_ours_on_its_dataset(rich: Comparison) -> None:
    entries = entries_of(rich, "beam-coarse")
    error, time = same_error_or_time("beam-fine", entries)
    by_method = {method: cells for method, *cells in error.rows}
    assert by_method["pod"][3:] == ["120", "0.006"]
    assert by_method["linear-fem"][0] == NOT_REACHED
    assert by_method["fem"][0] == "fem [tolerance=0.1]"
    assert {method: cells[3:] for method, *cells in time.rows}["hpod"] == ["5", "0.084"]


def test_the_published_figures_are_those_of_the_paper() -> None:
    by_size = {(row.dataset, row.channels, row.steps): row for row in PUBLISHED}
    assert len(by_size) == len(PUBLISHED) == 13
    assert by_size["beam-coarse", 64, 5].train_min == 426
    assert by_size["liver-tet", 128, 3].mean_m == 5.33e-5
