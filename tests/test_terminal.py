"""What a user sees in a terminal: widths, help texts, lists, cards, and completion."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from click import unstyle
from typer.testing import CliRunner, Result

from mor_bench.cli.app import COMMANDS, app
from mor_bench.cli.clear_errors import clear_errors
from mor_bench.cli.console import DEFAULT_WIDTH
from mor_bench.cli.help_texts import EXIT_CODES
from mor_bench.options import RunOptions, command_line
from mor_bench.report.line_wrapping import command_lines
from mor_bench.report.suite_overview import overview
from mor_bench.results.comparison import Comparison
from mor_bench.specs import list_suite, load_dataset_spec, load_method_spec
from mor_bench.version import __version__
from tests.commands import mor_bench_command
from tests.synthetic import synthetic_comparison

EXPORTS = [("export", name) for name in ("vtu", "gif", "numpy", "onnx", "asv")]


def mor_bench(*arguments: str, columns: str | None = None, **env: str | None) -> Result:
    return CliRunner(env={"COLUMNS": columns, **env}).invoke(app, arguments, prog_name="mor-bench")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    made = synthetic_comparison(tmp_path_factory.mktemp("runs") / "first", per_region=4)
    made.rows[:] = [row.with_parts(told="equations") for row in made.rows]
    made.write()
    return made


@pytest.mark.parametrize("columns", ["80", "120", None])
def test_a_report_in_a_pipe_has_the_width_of_columns(run: Comparison, columns: str | None) -> None:
    shown = mor_bench("report", str(run.out), "--told", "equations", columns=columns)
    assert shown.exit_code == 0, shown.output
    lines = [line for line in shown.stdout.splitlines() if not line.startswith("  mor-bench ")]
    width = int(columns or DEFAULT_WIDTH)
    assert width - 12 < max(map(len, lines)) <= width
    assert any(re.match(r"\* fem · tol 0\.1 +[\d.]+ +[\d.]+ +[\d.]+ ", li) for li in lines)


def test_wide_tables_show_every_column_in_whole_lines(run: Comparison) -> None:
    shown = mor_bench("report", str(run.out), "--told", "equations", "--wide", columns="80")
    assert "pod · r80" in shown.stdout
    assert "[n_modes=" not in shown.stdout
    head = next(line for line in shown.stdout.splitlines() if line.startswith("  configuration"))
    assert len(head) > 150
    for word in (
        "queries/s",
        "memory",
        "model",
        "σ(e)",
        "Time at error",
        "The fastest configuration",
    ):
        assert word in shown.stdout


def test_pick_uses_short_names_and_explains_them(run: Comparison) -> None:
    shown = mor_bench("pick", "beam-coarse", "--run", str(run.out)).stdout
    assert "pca-regression-linear · k20 wins" in shown
    assert "[n_input_modes=" not in shown
    assert "k = n_input_modes (number of input modes)" in " ".join(shown.split())


@pytest.mark.parametrize("columns", ["60", "80", "120"])
def test_pick_wraps_between_words_and_keeps_names_and_units_whole(
    run: Comparison, columns: str
) -> None:
    shown = mor_bench("pick", "beam-coarse", "--run", str(run.out), columns=columns).stdout
    lines = [line for line in shown.splitlines() if str(run.out) not in line]
    assert int(columns) - 20 < max(map(len, lines)) <= int(columns)
    assert not re.search(r"(·|[\d.]+)\n +(%|ms|s|core-s|[kMG]B|[a-z]+\d)\b", shown)
    assert re.search(r"\n {4}latency  [\d.]+ ms median", shown)


def test_a_command_that_is_too_long_for_a_line_can_be_copied() -> None:
    command = "mor-bench run beam-coarse -m fem -m 'pod[n_modes=10, 20]' --out out --retime"
    assert command_lines(command, 90) == [f"  {command}"]
    lines = command_lines(command, 40)
    assert max(map(len, lines)) <= 40
    assert len(lines) > 2
    assert shlex.split("\n".join(lines).replace("\\\n", "")) == shlex.split(command)


def test_a_warning_of_mor_bench_is_one_line_without_its_place_in_the_code() -> None:
    shown = mor_bench("show", "pca-regression-force")
    assert shown.exit_code == 0, shown.output
    warned = [line for line in shown.stderr.splitlines() if "is now" in line]
    assert len(warned) == 1
    assert warned[0].startswith("warning: `pca-regression-force` is now `pca-regression`.")
    assert "RenamedWarning" not in shown.stderr
    assert ".py" not in shown.stderr


def test_checked_files_are_shown_from_the_current_folder_and_wrapped() -> None:
    shown = mor_bench("check", "datasets/beam-tiny.toml", "methods/pod.toml", columns="60").stdout
    assert max(map(len, shown.splitlines())) <= 60
    assert shown.startswith("datasets/beam-tiny.toml: dataset, 24 cells, 63 nodes, ")
    assert "\nmethods/pod.toml: method, 4 quick and 7 full" in shown


def test_a_quiet_report_prints_the_verdict_alone(
    run: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mor_bench.cli.slow_notice.SILENT_S", 0.0)
    monkeypatch.setattr("mor_bench.cli.result_commands.render", lambda *_, **__: [Path("page")])
    shown = mor_bench("report", str(run.out), "--quiet", columns="80")
    *verdict, page = shown.stdout.splitlines()
    assert page == "page"
    assert 40 < max(map(len, verdict)) <= 80
    assert " ".join(verdict).count(". ") == 2
    assert shown.stderr == ""


@pytest.mark.parametrize("name", [*((name,) for name in COMMANDS if name != "export"), *EXPORTS])
def test_every_command_shows_examples_and_exit_codes(name: tuple[str, ...]) -> None:
    shown = mor_bench(*name, "--help", columns="80").stdout
    assert max(map(len, shown.splitlines())) <= 80
    examples, codes = shown.partition("Examples:\n")[2].split("Exit codes:\n")
    assert len(re.findall("^  mor-bench ", examples, re.MULTILINE)) == 2
    assert set(re.findall(r"^  (\d+) ", codes, re.MULTILINE)) >= set(map(str, EXIT_CODES))


def test_the_help_groups_options_and_commands_by_panels() -> None:
    shown = mor_bench("run", "--help", columns="100").stdout
    place = {panel: shown.index(f"\n{panel}:\n") for panel in ("Comparison", "Training", "Output")}
    assert place["Comparison"] < shown.index("--memory-limit")
    assert place["Training"] < shown.index("--fit-seconds") < place["Output"] or place["Output"]
    panels = {line.panel for _, _, line in command_line(RunOptions)}
    assert panels == {"Comparison", "Training", "Data", "Folders"}
    assert all(f"\n{panel}:\n" in shown for panel in panels)
    listed = mor_bench("--help").stdout
    assert all(f"\n{panel}:\n" in listed for panel in ("Compare", "Look up", "Methods", "Data"))
    assert "--install-completion" in listed


def test_the_version_is_printed() -> None:
    assert mor_bench("--version").stdout == f"{__version__}\n"


def test_an_unknown_command_gets_the_nearest_one() -> None:
    found = mor_bench("rum")
    assert found.exit_code == 2
    assert "No such command 'rum'. Did you mean 'run'?" in " ".join(found.output.split())


def test_a_terminal_gets_the_names_that_exist_the_most_similar_first(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    for load, name in ((load_method_spec, "pood"), (load_dataset_spec, "beam-tini")):
        with pytest.raises(SystemExit), clear_errors():
            load(name)
    said = unstyle(capsys.readouterr().err)
    methods, datasets = said.split("mor-bench: unknown dataset ")
    first, nearest, *families = methods.splitlines()
    assert first == (
        "mor-bench: unknown method 'pood'; did you mean 'pod'? `mor-bench list` shows the names."
    )
    assert nearest.startswith("  most similar: pod, ")
    assert "  hyper-reduction: hpod, ecm, deim" in families
    assert max(map(len, [nearest, *families])) <= 60
    listed = re.findall(r"[\w-]+", " ".join(line.partition(":")[2] or line for line in families))
    assert set(listed) >= set(list_suite("methods"))
    assert datasets.startswith("'beam-tini'; did you mean 'beam-tiny'?")
    assert "\n  most similar: beam-tiny" in datasets
    assert max(map(len, datasets.splitlines()[1:])) <= 60


def test_a_program_gets_an_unknown_name_in_one_line() -> None:
    shown = mor_bench("run", "beam-tiny", "-m", "pood")
    assert shown.stderr.splitlines() == [
        "mor-bench: unknown method 'pood'; did you mean 'pod'? `mor-bench list` shows the names."
    ]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("mor-bench re", ["report", "refine"]),
        ("mor-bench run beam-ti", ["beam-tiny"]),
        ("mor-bench run beam-tiny -m hpo", ["hpod"]),
        ("mor-bench show pod-t", ["pod-tensor"]),
        ("mor-bench run --verb", ["--verbose"]),
    ],
)
def test_the_shell_completes_commands_names_and_options(words: str, expected: list[str]) -> None:
    count = str(len(words.split()) - 1)
    env = {"_MOR_BENCH_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": count}
    assert mor_bench(**env).stdout.split() == expected


def test_lists_group_by_family_and_fit_the_width() -> None:
    for columns in ("60", "80", "120"):
        shown = mor_bench("list", columns=columns).stdout.splitlines()
        assert max(map(len, shown)) <= int(columns)
        assert "Methods: hyper-reduction" in shown
        assert "Datasets: boxes of hexahedra" in shown
    line = next(line for line in shown if line.startswith("  umesh-small "))
    assert "force, snapshots, [learn]" in line
    assert load_method_spec("umesh-small").title in line


@pytest.mark.slow
def test_what_method_files_state_about_needs_is_true() -> None:
    for name in list_suite("methods"):
        spec = load_method_spec(name)
        needs = spec.load_class()(**spec.parameters).needs_snapshots
        assert needs == spec.snapshots, name
    needing = {item.name for item in overview()["methods"] if "[learn]" in item.needs}
    code = """
import sys
sys.modules["torch"] = None
from mor_bench.errors import MissingDependencyError
from mor_bench.specs import list_suite, load_dataset_spec, load_method_spec
for name in list_suite("methods"):
    try:
        load_method_spec(name).load_class()
    except MissingDependencyError:
        print(name)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == needing


def test_show_prints_a_method_a_dataset_or_a_run(run: Comparison, tmp_path: Path) -> None:
    method = mor_bench("show", "hpod", columns="80").stdout
    assert max(map(len, method.splitlines())) <= 80
    for text in ("hyper-reduction", "equations, snapshots", "ECSW", "n_cubature_snapshots"):
        assert text in method
    assert re.search(r"^  n_modes +10, 20, 40 +an integer of at least 1", method, re.MULTILINE)
    dataset = mor_bench("show", "beam-tiny", columns="80").stdout
    for text in ("24 cells, 63 nodes", "saint-venant-kirchhoff", "≤ 1 %, ≤ 3 ms", "mor-bench pick"):
        assert text in dataset
    shown = mor_bench("show", str(run.out), columns="80").stdout
    assert "18 (18 ok)" in shown
    assert f"mor-bench report {run.out}" in shown
    content = json.loads(mor_bench("show", "hpod", "--json").stdout)
    assert content["facts"]["family"] == "hyper-reduction"


@pytest.mark.slow
def test_a_quiet_run_prints_the_verdict_and_the_report_alone(tmp_path: Path, cache: Path) -> None:
    options = ["-m", "linear-fem", "-m", "pod[n_modes=3,9]", "--cache", str(cache), "--quiet"]
    done = mor_bench_command("run", "beam-tiny", "--out", "out", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    *headline, path = done.stdout.splitlines()
    assert headline[0].startswith("beam-tiny needs ")
    assert path.endswith("report.html")
    assert done.stderr == ""
    rows = Comparison.read(tmp_path / "out").rows
    assert [row.label for row in rows] == ["linear-fem", "pod [n_modes=3]", "pod [n_modes=9]"]
