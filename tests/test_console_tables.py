"""The tables of a comparison on the console: verdict, six columns, notes, and everything."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from mor_bench.analysis.analyse import analyse
from mor_bench.report.aligned_lines import Line, aligned_lines
from mor_bench.report.console_tables import Detail, print_plan, print_tables
from mor_bench.report.number_format import milliseconds_text, seconds_text
from mor_bench.report.short_names import renamed, short_names
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import TrainedElsewhere
from mor_bench.runs.plan import Plan, Step
from tests.report_runs import add_row, tiny
from tests.synthetic import a_row, synthetic_comparison

LONG = "a-method-of-somebody-else-whose-name-is-longer-than-the-whole-first-column"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """All methods, an unstable timing, a doubt by the hidden set, and rows without a result."""
    found = synthetic_comparison(tmp_path_factory.mktemp("run"), per_region=8)
    reason = "OutOfMemoryError: 31 GiB <needed> & 24 GiB there"
    for method, status in (("fno", "failed"), ("deeponet", "failed"), (LONG, "skipped")):
        row = a_row(method, dataset="beam-coarse", status=status, reason=reason, n_failed=None)
        found.put(row)
    found.rows[3] = found.rows[3].with_parts(warnings=["only 12 modes of <25>"])
    return found


@pytest.fixture(scope="module")
def analysis(made: Comparison) -> dict[str, Any]:
    return analyse(made, n_resamples=200)


@pytest.fixture
def shown(made: Comparison, analysis: dict[str, Any]) -> Any:
    """Print with a width and a detail, and return the text."""

    def text(width: int, **detail: bool) -> str:
        stream = io.StringIO()
        print_tables(made, Console(file=stream, width=width), analysis, Detail(**detail))
        return stream.getvalue()

    return text


def test_the_iterations_of_a_training_elsewhere_stand_beside_those_of_the_file(
    tmp_path: Path,
) -> None:
    made = tiny(tmp_path)
    made.settings = {"profile": "quick"}
    quick = {"parameters": {"iterations": 45}}
    made.methods = {"net": {"parameters": {"iterations": 1000}, "profiles": {"quick": quick}}}
    training = TrainedElsewhere(
        machine="M x 2",
        core_s=5.0,
        wall_s=9.0,
        threads=1,
        iterations=200,
        seed=0,
        commit="0123456789",
        date="2026-01-01",
        versions={},
    )
    add_row(made, "net", {}, 0.01, 1.0, trained_elsewhere=training)
    stream = io.StringIO()
    print_tables(made, Console(file=stream, width=300), analyse(made, n_resamples=20))
    assert "trained elsewhere for 200 iterations, not the 1,000 of its method file" in (
        stream.getvalue()
    )
    assert "`--train` trains here for 45 iterations" in stream.getvalue()


@pytest.mark.parametrize("width", [80, 100, 120])
def test_six_columns_fit_the_width_and_no_name_is_broken(
    made: Comparison, shown: Any, width: int
) -> None:
    lines = shown(width).splitlines()
    uncut = [line for line in lines if not line.startswith("  mor-bench run ")]
    assert max(map(len, uncut)) <= width
    start = next(i for i, line in enumerate(lines) if line.startswith("  configuration"))
    end = next(i for i, line in enumerate(lines) if line.startswith("*: on the Pareto"))
    assert lines[start].split()[1:] == ["(%)", "(%)", "(ms)", "(core-s)", "qualifies"]
    table = "\n".join(lines[start:end])
    for name in map(str, short_names(made.rows).values()):
        assert re.search(rf"^[* ] {re.escape(name)}( |$)", table, re.MULTILINE), name
    after = lines[lines.index(f"  {LONG}") + 1]
    assert after.split() == ["–", "–", "–", "–", "skipped"]


def test_the_verdict_comes_first_and_is_alone_if_quiet(
    shown: Any, made: Comparison, analysis: dict[str, Any]
) -> None:
    headline = renamed(analysis["verdicts"][0]["headline"], short_names(made.rows))
    assert " · " in headline
    needs, finding = headline.split(". ", 1)
    assert shown(10_000).splitlines()[1:3] == [finding, f"- {needs}."]
    assert shown(10_000, quiet=True) == f"{headline}\n"
    narrow = shown(60, quiet=True).splitlines()
    assert " ".join(narrow) == headline
    assert max(map(len, narrow)) <= 60


def test_doubts_about_the_choice_are_named_and_other_notes_counted(shown: Any) -> None:
    text = shown(80)
    flat = " ".join(text.split())
    assert re.search(r"^  linear-fem +[\d.]+ +[\d.]+ +~[\d.]+ ", text, re.MULTILINE)
    assert "pca-regression-linear · k5: the median error is" in flat
    assert "- 1 of 18 timings was not stable" in flat
    again = text.partition("\n  mor-bench run ")[2].partition("--retime\n")[0]
    assert all(line.endswith(" \\") for line in again.splitlines()[:-1])
    assert "fno, deeponet: failed: OutOfMemoryError: 31 GiB <needed> & 24 GiB there" in flat
    assert "notes on methods, timings and samples: --verbose" in flat
    for noise in ("processes differ by 14 %", "only 12 modes", "Who is faster"):
        assert noise not in flat
    full = shown(80, verbose=True)
    assert "linear-fem: timing not stable: processes differ by 14 %" in full
    assert "warning: only 12 modes of <25>" in full


def test_wide_output_has_every_column_and_table_in_whole_lines(shown: Any) -> None:
    text = shown(80, wide=True)
    lines = text.splitlines()
    rows = [line for line in lines if re.match(r"[* ] (fem|pod|hpod) · ", line)]
    assert len({len(line) for line in rows[:2]}) == 1
    assert min(map(len, rows)) > 200
    for said in ("Time at error", "Who is faster at 1 %, the required error", "queries/s", "ē"):
        assert said in text
    assert re.search(r"^\(1\) fem +· +\+[\d.]+ +-[\d.]+", text, re.MULTILINE)


def test_swept_parameters_that_do_not_vary_stand_in_the_caption(tmp_path: Path, shown: Any) -> None:
    assert "hpod · r10, ctol 0.001" in shown(80)
    made = Comparison(tmp_path, {})
    for r in (3, 5):
        made.rows.append(a_row("pod", {"n_modes": r, "how": "fast"}, status="skipped"))
    stream = io.StringIO()
    print_tables(made, Console(file=stream, width=80))
    assert "  pod · r3  " in stream.getvalue()
    assert "Same in all rows: pod: fast." in stream.getvalue()


def test_durations_have_readable_units() -> None:
    values = (None, 0.0, 1.3e-5, 5.5e-4, 0.0123, 0.9999, 12.34, 119.0, 300.0, 7300.0, float("inf"))
    texts = ["–", "0 s", "13 µs", "0.55 ms", "12.3 ms", "1 s", "12.3 s", "119 s", "5 min"]
    assert [seconds_text(value) for value in values] == [*texts, "2.03 h", "inf"]
    assert milliseconds_text(0.62) == "0.62 ms"


def test_columns_align_by_the_width_of_letters() -> None:
    lines = [Line(["ē", "1"]), Line(["名前", "22"]), Line(["group"]), Line(["long name", "3"])]
    found = [text.plain for text in aligned_lines(["a", "b\nc"], lines, 9)]
    assert found == [
        "       b",
        "a      c",
        "ē      1",
        "名前  22",
        "group",
        "long name",
        "       3",
    ]


def test_each_column_of_figures_has_one_unit_which_its_heading_names(shown: Any) -> None:
    lines = shown(80, wide=True).splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("  configuration"))
    end = next(i for i, line in enumerate(lines) if line.startswith("*: on the Pareto"))
    units = lines[start].split()
    assert units[1:5] == ["(%)", "(%)", "(ms)", "(core-s)"]
    assert units.count("(ms)") >= 4
    assert lines[start - 1].split()[:3] == ["median", "p95", "median"]
    cells = " ".join(lines[start + 1 : end])
    assert not re.search(r"\d (µs|ms|s|min|h|%)(?= |$)", cells)
    assert re.search(r"\d (MB|kB)(?= |$)", cells)  # sizes have readable units


def test_the_runner_up_and_loads_beyond_the_training_are_named(
    made: Comparison, shown: Any, tmp_path: Path
) -> None:
    text = " ".join(shown(80).split())
    assert "- Best other method: fem · tol 0.1, " in text
    said = (
        r"Beyond the training loads, the median relative L2 error of \S+ · k\d+ is [\d.]+ % on 2x"
    )
    assert re.search(said, text)
    quick = tiny(tmp_path)
    add_row(quick, "pod", {"n_modes": 5}, 0.005, 1.0)
    stream = io.StringIO()
    print_tables(quick, Console(file=stream, width=80), analyse(quick, n_resamples=20))
    quickly = " ".join(stream.getvalue().split())
    assert (
        "Errors beyond the training loads were not measured; "
        "`mor-bench run beam-tiny --profile full` measures them."
    ) in quickly


NAMES = (
    "a-method-of-another-group [n_modes=20, cubature_tolerance=0.001, sampling=points, seed=12345]",
    "hpod [n_modes=20, cubature_tolerance=0.001]",
    "pca-gaussian-process [n_input_modes=10, n_output_modes=40]",
    "fem",
)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_plan_breaks_no_name(width: int) -> None:
    reason = "it needs pip install 'mor-bench[learn]', which brings PyTorch and onnxruntime"
    steps = [Step("beam-coarse-3-forces", "60 of 60 samples", False, 0.0123, "samples")]
    steps += [Step("beam-coarse-3-forces", name, False, 4321.0) for name in NAMES]
    steps += [
        Step("beam-tiny", "5,000 samples", True, 0.0, "samples"),
        Step("beam-tiny", f"umesh [channels=8] (left out: {reason})", False, 0.0),
        Step("beam-tiny", "umesh-small (trained elsewhere)", False, 0.0),
        Step("beam-tiny", "mine", False, None),
    ]
    stream = io.StringIO()
    print_plan(Plan(steps, []), Console(file=stream, width=width))
    lines = stream.getvalue().splitlines()
    for name in (*NAMES, "umesh [channels=8]", "umesh-small", "mine"):
        assert any(re.match(rf"  {re.escape(name)}($|  )", line) for line in lines), name
    assert all(len(line) <= width for line in lines if NAMES[0] not in line)
    flat = " ".join(stream.getvalue().split())
    for said in (
        "– beam-coarse-3-forces –",
        "in the cache",
        "trained elsewhere",
        reason,
        "unknown",
    ):
        assert said in flat
    assert re.search(r"fem +4321\b", stream.getvalue())
