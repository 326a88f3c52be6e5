"""The report of a comparison: what it must say, for results good and bad."""

from __future__ import annotations

import io
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from mor_bench.analysis.analyse import analyse
from mor_bench.measure.error_metrics import SampleErrors, sample_errors, summary
from mor_bench.report.console_tables import NOT_REACHED, pairwise_cells, print_tables, target_cells
from mor_bench.report.details import dataset_details
from mor_bench.report.page import render, write_report
from mor_bench.report.paper import PUBLISHED, error_measures, same_error, same_time
from mor_bench.report.summary import (
    Entry,
    best_per_method,
    discretisation_error,
    entries_of,
    headline,
    number,
    percent,
    short_swept,
    size_of,
    warnings_of,
)
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import ErrorSummary, label_of
from mor_bench.scene.mesh import box_mesh
from mor_bench.specs import load_dataset_spec
from tests.synthetic import synthetic_comparison

HOSTILE = "<script>alert(1)</script> & [bold]$x_1$"
REASON = "OutOfMemoryError: 31 GiB <needed> & 24 GiB there"
N_TEST = 40
UNMEASURED: dict[str, Any] = {
    "n_dofs": 135,
    "all_threads_ms": None,
    "throughput": None,
    "memory_bytes": None,
    "cost": None,
    "sets": {},
    "hidden": None,
}
MESH = box_mesh((2.0, 1.0, 1.0), (4, 2, 2))


def add_row(
    comparison: Comparison,
    method: str,
    swept: dict[str, Any],
    error: float,
    latency_ms: float,
    **more: Any,
) -> dict[str, Any]:
    """Add a row with raw samples whose median relative l2 is `error`; `more` replaces entries, `n_failed` fails samples."""
    generator = np.random.default_rng(len(comparison.rows))
    reference = (
        generator.random((N_TEST, 1, 1))
        * 0.2
        * MESH.points[None, :, [0]] ** 2
        * np.array([0.2, 0.1, 1.0])
    )
    size = error * np.linspace(0.5, 1.5, N_TEST + 1)[1:, None, None]
    prediction = reference * (1 + size)
    prediction[: more.get("n_failed", 0)] = np.nan
    errors: SampleErrors = sample_errors(prediction, reference)
    worst = int(np.argmax(np.where(np.isfinite(errors.mean_dof_m), errors.mean_dof_m, -1)))
    forces = np.zeros_like(reference[0])
    forces[-1, 2] = -0.7
    latencies = latency_ms * np.linspace(0.9, 1.1, 41)
    row = {
        "dataset": "beam-tiny",
        "split": "region",
        "method": method,
        "label": label_of(method, swept),
        "parameters": dict(swept),
        "status": "ok",
        "reason": None,
        "n_train": 200,
        "n_test": N_TEST,
        "n_failed": 0,
        "threads": 1,
        "error": summary(errors),
        **UNMEASURED,
        "latency_ms": {"median": latency_ms, "p95": 1.09 * latency_ms, "p99": 1.1 * latency_ms},
        "offline_s": {"data": 3.0, "fit": 0.5},
        "model_bytes": 12345,
        "discretisation_error_m": None,
        **more,
    }
    samples = {
        "latency_ms": latencies,
        "mean_dof_m": errors.mean_dof_m,
        "relative_l2": errors.relative_l2,
        "max_nodal_m": errors.max_nodal_m,
        "amplitude_m": errors.amplitude_m,
        "worst_prediction": prediction[worst],
        "worst_reference": reference[worst],
        "worst_forces": forces,
    }
    comparison.put(row, samples if row["status"] == "ok" else None)
    return row


def add_failed(
    comparison: Comparison,
    method: str,
    swept: dict[str, Any],
    status: str,
    reason: str,
    dataset: str = "beam-tiny",
) -> None:
    """Add a row without any figure."""
    comparison.put(
        {
            "dataset": dataset,
            "split": "region",
            "method": method,
            "label": label_of(method, swept),
            "parameters": dict(swept),
            "status": status,
            "reason": reason,
            "n_train": 200,
            "n_test": N_TEST,
            "n_failed": None,
            "threads": 1,
            "error": None,
            "latency_ms": None,
            "offline_s": None,
            "model_bytes": None,
            "discretisation_error_m": None,
            **UNMEASURED,
        }
    )


def add_tiny(comparison: Comparison, name: str = "beam-tiny") -> None:
    """Record beam-tiny (needs: 1 %, 3 ms) under a name."""
    arrays = {"points": MESH.points, "cells": MESH.cells, "singular_values": 0.8 ** np.arange(30.0)}
    comparison.add_dataset(name, load_dataset_spec("beam-tiny").model_dump(mode="json"), arrays)


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Two sweeps, a failed and a skipped row, a row with infinite errors, one with a few failed samples, a hostile label."""
    made = Comparison(
        tmp_path_factory.mktemp("run"), {"processor": "<b>fast</b>", "versions": {"numpy": "2.4"}}
    )
    add_tiny(made)
    for rank, error, latency in (
        (5, 0.05, 1.0),
        (10, 0.02, 1.5),
        (20, 0.008, 2.5),
        (25, 0.002, 4.0),
    ):
        add_row(made, "pod", {"n_modes": rank}, error, latency)
    for rank, error, latency in ((5, 0.06, 0.2), (20, 0.029, 0.5)):
        add_row(made, "hpod", {"n_modes": rank, "cubature_tolerance": 0.01}, error, latency)
    add_row(made, "fem", {}, 0.0, 8.0)
    add_row(
        made,
        "partial",
        {},
        0.004,
        5.0,
        n_failed=3,
        reason="SolverError: no equilibrium",
        warnings=["only 12 modes of <25>"],
    )
    add_row(made, "broken", {}, 0.001, 0.1, n_failed=N_TEST)
    add_row(made, HOSTILE, {}, 0.2, 2.0)
    add_failed(made, "umesh", {"channels": 64}, "failed", REASON)
    add_failed(made, "deim", {}, "skipped", "needs pip install 'mor-bench[learn]'")
    return made


@pytest.fixture(scope="module")
def written(comparison: Comparison) -> list[Path]:
    """All that `render` writes."""
    return render(comparison)


def console_text(comparison: Comparison, width: int = 200) -> str:
    """What `print_tables` prints."""
    stream = io.StringIO()
    print_tables(comparison, Console(file=stream, width=width))
    return stream.getvalue()


class _Resources(HTMLParser):
    """Collects the tags of a page, and what they load."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [
            value or ""
            for name, value in attrs
            if name in ("src", "srcset", "data", "poster", "background")
        ]
        self.links += [value or "" for name, value in attrs if name == "href"]


def test_console_shows_every_row_with_its_reason(comparison: Comparison) -> None:
    text = console_text(comparison)
    for row in comparison.rows:
        assert row["label"] in text
    for said in (
        REASON,
        "needs pip install 'mor-bench[learn]'",
        "SolverError: no equilibrium",
        "warning: only 12 modes of <25>",
    ):
        assert said in text
    assert f"3 of {N_TEST} test samples without a prediction" in text
    assert "not measured" in text


@pytest.mark.parametrize("width", [80, 100, 120])
def test_console_fits_its_width_without_squeezed_words(comparison: Comparison, width: int) -> None:
    lines = console_text(comparison, width).splitlines()
    assert max(map(len, lines)) <= width
    table = lines[4 : next(i for i, line in enumerate(lines) if line.startswith("Pareto"))]
    fragments = [line.strip() for line in table if line.strip()]
    assert min(map(len, fragments)) >= 3
    assert any(
        line.startswith("pod [n_modes=20]") and line.rstrip().endswith("yes") for line in table
    )


def test_a_legacy_code_page_does_not_end_the_run(comparison: Comparison) -> None:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="cp1252")
    print_tables(comparison, Console(file=stream, width=120))
    assert b"pod [n_modes=20]" in raw.getvalue()


def test_needs_and_front_marks(comparison: Comparison) -> None:
    entries = {entry.label: entry for entry in entries_of(comparison, "beam-tiny")}
    assert [label for label, entry in entries.items() if entry.meets_needs] == ["pod [n_modes=20]"]
    on_front = {label for label, entry in entries.items() if entry.on_front}
    expected = (
        {f"hpod [n_modes={r}, cubature_tolerance=0.01]" for r in (5, 20)}
        | {f"pod [n_modes={r}]" for r in (10, 20, 25)}
        | {"fem"}
    )
    assert on_front == expected
    assert "pod [n_modes=20] is the only configuration that meets the needs" in headline(
        comparison, "beam-tiny"
    )


def test_meeting_only_one_need_is_not_enough(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {})
    add_tiny(made)
    add_row(made, "slow", {}, 0.001, 6.0)
    add_row(made, "coarse", {}, 0.03, 0.1)
    assert not any(entry.meets_needs for entry in entries_of(made, "beam-tiny"))
    assert re.search(
        r"No configuration meets .* Nearest is slow: .* 2 times the latency allowed",
        headline(made, "beam-tiny"),
    )


def test_targets_out_of_reach(comparison: Comparison) -> None:
    headings, rows = target_cells(comparison, "beam-tiny", "time_at_error")
    assert headings == ["10 %", "3 %", "1 %", "0.3 %", "0.1 %"]
    assert rows["umesh"] == rows["deim"] == rows["broken"] == [NOT_REACHED] * 5
    assert [cell == NOT_REACHED for cell in rows["hpod"]] == [False, False, True, True, True]
    assert rows["pod"][2].split("\n")[1] == "r=20"
    headings, rows = target_cells(comparison, "beam-tiny", "error_at_time")
    assert headings[:3] == ["0.1 ms", "1 ms", "3 ms"]
    assert rows["pod"][0] == NOT_REACHED
    assert rows["pod"][-1].startswith("0.2")
    assert NOT_REACHED in console_text(comparison)


def test_the_page_says_it_all(comparison: Comparison, written: list[Path]) -> None:
    page = written[-1].read_text(encoding="utf-8")
    assert written[-1] == comparison.out / "report.html"
    text = unescape(re.sub(r"<[^>]*>", " ", page))
    for row in comparison.rows:
        assert row["label"] in text
        assert (row["reason"] or "") in text
    assert headline(comparison, "beam-tiny") in text
    assert "warning: only 12 modes of <25>" in text
    for word in (
        NOT_REACHED,
        "not measured",
        "results.json",
        "samples/",
        "x-min",
        "2.4",
        "never extrapolates",
        "infinite",
    ):
        assert word in text
    assert len(
        re.findall(
            r'<tr class="[^"]*"><td class="text">', page.split("Failures, skips and warnings")[0]
        )
    ) == len(comparison.rows)


def test_the_page_escapes_and_needs_no_network(written: list[Path]) -> None:
    page = written[-1].read_text(encoding="utf-8")
    resources = _Resources()
    resources.feed(page)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert not {"script", "link", "iframe", "object"} & set(resources.tags)
    assert "<b>fast</b>" not in page
    assert "31 GiB <needed>" not in page
    assert len(resources.sources) == len(written) - 1
    assert all(source.startswith("data:image/png;base64,") for source in resources.sources)
    assert not any("//" in link or ":" in link for link in resources.links)
    assert not re.search(r"url\(|@import|https?://", page)


def test_figures_are_pictures(comparison: Comparison, written: list[Path]) -> None:
    kinds = ["error-against-time", "error-against-deformation", "worst-samples", "singular-values"]
    assert [path.name for path in written[:-1]] == [
        *(f"beam-tiny--{kind}.png" for kind in kinds),
        "all-datasets--performance-profile.png",
    ]
    for path in written[:-1]:
        assert path.parent == comparison.out / "figures"
        assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
        pixels = imread(path)[..., :3]
        assert pixels.shape[1] == 1410
        assert pixels.shape[0] > 300
        assert pixels.std() > 0.03
        assert (
            len(np.unique(pixels @ np.array([1.0, 7.3, 53.1]))) > 50
        )  # colours, not only black on white
    assert not list(comparison.out.rglob("*.tmp"))


def test_inputs_are_unchanged_and_reading_back_gives_the_same_text(
    comparison: Comparison, written: list[Path]
) -> None:
    again = Comparison.read(comparison.out)
    assert again.rows == comparison.rows
    assert console_text(again) == console_text(comparison)


def test_one_row(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {})
    add_tiny(made)
    add_row(made, "pod", {"n_modes": 5}, 0.005, 1.0, discretisation_error_m=0.0123)
    assert discretisation_error(entries_of(made, "beam-tiny")).startswith(
        "1.2e-02 m; methods' errors below it"
    )
    made.rows[0] = made.rows[0].with_parts(discretisation_rel_l2=0.205)
    assert discretisation_error(entries_of(made, "beam-tiny")).startswith(
        "1.2e-02 m, relative L2 (median) 20.5 %; "
    )
    assert "1.2e-02 m" in console_text(made)
    assert len(render(made)) == 5


def test_no_row_ran_and_several_datasets(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {})
    add_tiny(made)
    add_tiny(made, "other")
    add_failed(made, "pod", {"n_modes": 5}, "failed", "no memory")
    add_failed(made, "pod", {"n_modes": 5}, "skipped", "not supported", dataset="other")
    page = write_report(made).read_text(encoding="utf-8")
    assert page.count("No configuration gave a usable result") == 2
    for text in (page, console_text(made)):
        assert "no memory" in text
        assert "not supported" in text
        assert text.count(NOT_REACHED) >= 22


def test_no_rows_at_all(tmp_path: Path) -> None:
    page = write_report(Comparison(tmp_path, {})).read_text(encoding="utf-8")
    assert "nothing to report" in page


def test_a_row_without_a_number_is_not_good(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {})
    add_tiny(made)
    add_row(made, "pod", {"n_modes": 5}, 0.005, 1.0)
    unknown = ErrorSummary(**dict.fromkeys(ErrorSummary.model_fields, float("nan")))
    made.rows[0] = made.rows[0].with_parts(error=unknown)
    assert not entries_of(made, "beam-tiny")[0].meets_needs
    assert "No configuration gave a usable result" in write_report(made).read_text(encoding="utf-8")
    assert "nan" in console_text(made)


def test_best_of_a_method_prefers_finite_errors(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {})
    add_tiny(made)
    add_row(made, "pod", {"n_modes": 20}, 0.001, 1.0, n_failed=2)
    add_row(made, "pod", {"n_modes": 5}, 0.05, 1.0)
    assert [entry.label for entry in best_per_method(entries_of(made, "beam-tiny"))] == [
        "pod [n_modes=5]"
    ]


def test_numbers() -> None:
    assert [
        number(v) for v in (None, float("inf"), 0.0, 0.00064, 0.843, 99.94, 99.96, 1234.4, 123456.0)
    ] == [
        "–",
        "inf",
        "0",
        "6.4e-04",
        "0.843",
        "99.9",
        "100",
        "1234",
        "1.2e+05",
    ]
    assert percent(0.008) == "0.8"
    assert [size_of(v) for v in (None, 12, 999.6, 12345, 2.5e9)] == [
        "–",
        "12 B",
        "1 kB",
        "12.3 kB",
        "2.5 GB",
    ]
    assert (
        short_swept({"n_modes": "20", "cubature_tolerance": "0.01", "n_heads": "4"})
        == "r=20, ctol=0.01, nh=4"
    )


def test_a_warning_that_many_configurations_gave_is_said_once(tmp_path: Path) -> None:
    made = Comparison(tmp_path, {})
    for n in range(3):
        add_row(
            made, "pod", {"n_modes": n}, 0.01, 1.0, warnings=["it locks"] + ["few modes"] * (n == 2)
        )
    entries = entries_of(made, "beam-tiny")
    first, _, last = (entry.label for entry in entries)
    assert warnings_of(entries) == [(f"{first} and 2 more", "it locks"), (last, "few modes")]


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Two datasets with everything that a run can measure."""
    return synthetic_comparison(tmp_path_factory.mktemp("rich"), ("beam-coarse", "beam-fine"))


@pytest.fixture(scope="module")
def analysis(rich: Comparison) -> dict[str, Any]:
    return analyse(rich, n_resamples=300)


def page_text(page: Path) -> str:
    return unescape(re.sub(r"<[^>]*>", " ", page.read_text(encoding="utf-8")))


def test_the_page_has_a_section_for_all_that_was_measured(
    rich: Comparison, analysis: dict[str, Any]
) -> None:
    paths = render(rich, analysis)
    kinds = [
        "error-against-time",
        "learning-curves",
        "error-against-deformation",
        "worst-samples",
        "singular-values",
    ]
    names = [f"{dataset}--{kind}.png" for dataset in ("beam-coarse", "beam-fine") for kind in kinds]
    assert [path.name for path in paths] == [
        *names,
        "all-datasets--performance-profile.png",
        "report.html",
    ]
    page = paths[-1].read_text(encoding="utf-8")
    assert page.count("<img ") == len(names) + 1
    titles = re.findall("<h3>(.*?)</h3>", page)
    assert [title for title in titles if not title.startswith("Who is faster")] == [
        *[
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
        ]
        * 2,
        "Performance profile",
        "In its regime",
    ]
    text = page_text(paths[-1])
    for said in (
        "processes differ by 14 %",
        "4.2 times as large as on the shipped one",
        "no graphics processor): 20,000 samples or more, on a GPU",
        "errors over 13 load regions, latencies over 5 processes that differ by",
        "6 of 5 (over)",
        "flagged 41.7 % of 60",
        "Who is faster at 1 %, the error that is needed",
    ):
        assert said in text


def test_nothing_is_shown_of_what_was_not_measured(
    comparison: Comparison, written: list[Path]
) -> None:
    page = written[-1].read_text(encoding="utf-8")
    for absent in (
        "Timing<",
        "Memory and cost",
        "Named test sets",
        "Hidden test set",
        "Tuning budget",
        "In its regime",
        "Error measures",
    ):
        assert absent not in page
    assert "nan" not in page_text(written[-1]).split()
    assert not re.search("<tbody></tbody>", page)


@pytest.mark.parametrize("width", [80, 120])
def test_the_console_shows_doubts_and_pairs(
    rich: Comparison, analysis: dict[str, Any], width: int
) -> None:
    stream = io.StringIO()
    print_tables(rich, Console(file=stream, width=width), analysis)
    text = stream.getvalue()
    assert max(map(len, text.splitlines())) <= width
    assert re.search(r"^linear-fem .*\d~ ", text, re.MULTILINE)
    assert "linear-fem: timing not stable: processes differ by 14 %" in text
    assert "pca-regression [n_input_modes=5]: on the hidden test set" in text
    assert "Who is faster at 1 %, the error that is needed" in text
    found = re.search(r"^\(1\) fem +· +([+-?][\d.]+) +([+-?][\d.]+)", text, re.MULTILINE)
    assert found is not None
    assert found[1].startswith("+")
    assert found[2].startswith("-")
    assert len(text.splitlines()) < 2 * 100 + (width < 100) * 60


def test_the_matrix_and_its_targets_carry_intervals(
    rich: Comparison, analysis: dict[str, Any]
) -> None:
    reached, cells, absent = pairwise_cells(rich, "beam-coarse", 0.01, analysis)
    assert (reached, absent) == (["fem", "pod", "pca-regression"], ["hpod", "linear-fem", "umesh"])
    assert [line[i] for i, line in enumerate(cells)] == ["·"] * 3
    assert cells[0][1][1:] == cells[1][0][1:]
    record = next(
        r
        for r in analysis["pairwise"]
        if (r["dataset"], r["target_rel_l2_median"], r["a"], r["b"])
        == ("beam-coarse", 0.01, "pod", "fem")
    )
    assert cells[1][0] == f"-{number(record['ratio'])}"
    matrix = next(
        grid
        for grid in dataset_details(rich, "beam-coarse", analysis)
        if "1 %, the error" in grid.title
    )
    assert (
        matrix.rows[1][1]
        == f"-{number(record['ratio'])}\n{number(record['low'])}–{number(record['high'])}"
    )
    assert (
        matrix.rows[0][2]
        == f"+{number(record['ratio'])}\n{number(record['low'])}–{number(record['high'])}"
    )
    _, rows = target_cells(rich, "beam-coarse", "time_at_error", analysis)
    assert re.fullmatch(r"[\d.]+ ms \([\d.]+\)\nr=\d+\n[\d.]+–[\d.]+", rows["pod"][1])


def test_the_tables_of_the_paper(rich: Comparison) -> None:
    entries = entries_of(rich, "beam-coarse")
    network = next(entry for entry in entries if entry.method == "umesh")
    measures = error_measures(
        "beam-coarse",
        [
            *entries,
            Entry(
                {**network.row, "label": "large", "parameters": {"channels": 128, "steps": 3}},
                False,
                False,
            ),
        ],
    )
    assert measures is not None
    assert (
        len(measures.rows) == 2 + 8 - 1
    )  # both of ours; of the paper's eight, one has the size of one of ours
    small, large = dict(zip(measures.headings, measures.rows[0], strict=False)), measures.rows[1]
    assert (small["c"], small["k"], small["FSS"]) == ("16", "2", "64")
    assert large[:4] == ["large", "128", "3", "1024"]
    assert large[5::2] == ["0.0007", "0.0006", "–", "0.00352", "2.5", "35"]
    assert [row[0] for row in measures.rows[2:]] == ["not run here"] * 7
    fine = entries_of(rich, "beam-fine")
    error, time = same_error("beam-fine", fine), same_time("beam-fine", fine)
    assert error is not None
    assert time is not None
    assert {row[0]: row[4:] for row in error.rows}["pod"] == ["120", "0.006"]
    assert {row[0]: row[4:] for row in time.rows}["hpod"] == ["5", "0.084"]
    assert {row[0]: row[1] for row in error.rows}["linear-fem"] == "not reached"
    assert {row[0]: row[1] for row in error.rows}["fem"] == "fem [tolerance=0.1]"
    others = [entry for entry in entries if entry.method != "umesh"]
    assert (
        error_measures("beam-coarse", others),
        same_error("beam-coarse", others),
        same_time("beam-coarse", others),
    ) == (None, None, None)


def test_the_figures_of_the_paper_are_those_of_its_tables() -> None:
    sizes = {(row.dataset, row.channels, row.steps): row for row in PUBLISHED}
    assert len(sizes) == len(PUBLISHED) == 13
    assert sizes["beam-coarse", 64, 5].train_min == 426
    assert sizes["liver-tet", 128, 3].mean_m == 5.33e-5
    assert {row.dataset for row in PUBLISHED} <= {
        "beam-coarse",
        "beam-coarse-3-forces",
        "beam-fine",
        "l-shape",
        "liver-hex",
        "liver-tet",
    }
