"""The command line, as a user sees it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

import mor_bench
from mor_bench.cli.app import COMMANDS
from mor_bench.cli.suite_commands import BUSY
from mor_bench.machine import describe_machine
from mor_bench.options import FitOptions, Options, RunOptions, command_line
from mor_bench.specs import list_suite
from tests.commands import invoke
from tests.verification.trust_record import git


def printed(code: str) -> str:
    """Run Python code in a new process and return what it prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_help_imports_nothing_heavy() -> None:
    heavy = ["numpy", "scipy", "numba", "pandas", "torch", "matplotlib", "pydantic", "h5py", "rich"]
    code = f"""
import sys
from typer.testing import CliRunner
from mor_bench.cli.app import app
assert CliRunner().invoke(app, ["--help"]).exit_code == 0
print([name for name in {heavy} if name in sys.modules])
"""
    assert printed(code) == "[]"


def test_the_library_imports_torch_only_for_methods_that_need_it() -> None:
    code = """
import sys, mor_bench
mor_bench.load_scene("beam-tiny")
mor_bench.load_method("pod")
print("torch" in sys.modules)
"""
    assert printed(code) == "False"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_help_text_and_a_summary_in_the_list(name: str) -> None:
    assert COMMANDS[name][1] in " ".join(invoke("--help").output.split())
    found = invoke(name, "--help")
    assert found.exit_code == 0
    assert f"Usage: mor-bench {name}" in found.output.replace("root", "mor-bench")


@pytest.mark.parametrize(("name", "model"), [("run", RunOptions), ("fit", FitOptions)])
def test_the_help_shows_every_option_with_its_description_and_default(
    name: str, model: type[Options]
) -> None:
    shown = " ".join(invoke(name, "--help").output.split())
    for option, field, line in command_line(model):
        assert f" {line.flag} " in shown, option
        assert str(field.description) in shown, option
        default = line.default or field.default
        if default:
            assert f"[default: {default}]" in shown, option


@pytest.mark.slow
def test_run_writes_all_results_and_report_redraws_them(tmp_path: Path, cache: Path) -> None:
    # On Windows, the encodings of files and pipes lack letters such as ē.
    options = ["-m", "linear-fem", "--split", "sample", "--out", "out", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "mor_bench", "run", "beam-tiny", *options, "--cache", str(cache)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "linear-fem" in done.stderr
    assert [row["split"] for row in json.loads(done.stdout)["rows"]] == ["sample"]
    out = tmp_path / "out"
    for name in ("results.json", "results.csv", "comparison.json"):
        assert (out / name).stat().st_size > 100
    figures = sorted(out.glob("figures/*.png"))
    assert len(figures) >= 3
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,iVBOR") == 1
    assert '"rows":[{"label":' in page
    for figure in figures:
        figure.unlink()
    again = invoke("report", str(out))
    assert again.exit_code == 0
    assert sorted(out.glob("figures/*.png")) == figures
    assert "linear-fem" in again.stdout


def test_list_names_every_dataset_and_method() -> None:
    listed = json.loads(invoke("list", "--json").stdout)
    plain = invoke("list").stdout
    for kind in ("datasets", "methods"):
        names = [entry["name"] for entry in listed[kind]]
        assert names == [*list_suite(kind)]
        assert all(f"  {entry['name']} " in plain for entry in listed[kind])
        for entry in listed[kind]:
            assert f"{kind.capitalize()}: {entry['family']}\n" in plain
            assert entry["needs"] in plain
            assert entry["title"].split()[0] in plain


def test_check_fails_if_any_file_is_invalid_and_reports_all(tmp_path: Path) -> None:
    good = [str(list_suite("datasets")["beam-tiny"]), str(list_suite("methods")["pod"])]
    assert invoke("check", *good).exit_code == 0
    bad = []
    for name in ("first", "second"):
        bad.append(str(tmp_path / f"{name}.toml"))
        Path(bad[-1]).write_text('title = "x"\nsurogate = "y"\n', encoding="utf-8")
    for files in ([bad[0], *good], [good[0], bad[0], good[1]], [*good, *bad]):
        done = invoke("check", *files)
        wrong = [file for file in files if file in bad]
        assert done.exit_code == 2
        lines = [line for line in done.stderr.splitlines() if BUSY not in line]
        assert [line.split(": ")[0] for line in lines] == wrong
        assert all(f"{Path(file).name}: " in done.stdout for file in good)


def test_check_without_files_checks_the_whole_suite(monkeypatch: pytest.MonkeyPatch) -> None:
    checked: list[Path] = []
    monkeypatch.setattr("mor_bench.runs.file_check.check_file", lambda path: checked.append(path))
    assert invoke("check").exit_code == 0
    assert checked == [*list_suite("datasets").values(), *list_suite("methods").values()]


def test_refine_prints_and_keeps_its_record(tmp_path: Path) -> None:
    options = ["--loads", "2", "--levels", "1", "--cache", str(tmp_path), "--json"]
    done = invoke("refine", "beam-tiny", *options)
    assert done.exit_code == 0
    (path,) = tmp_path.rglob("discretisation.json")
    record = json.loads(done.stdout)
    assert record == json.loads(path.read_text(encoding="utf-8"))
    assert record["commit"].removesuffix("-dirty") == git("rev-parse", "HEAD")
    assert record["date"].startswith(f"{datetime.now(UTC):%Y-%m-}")
    assert record["machine"]["processor"] == describe_machine()["processor"]


def test_generate_prints_the_folder_of_the_dataset_and_of_its_test_sets(tmp_path: Path) -> None:
    options = ["--limit", "5", "--workers", "1", "--cache", str(tmp_path)]
    done = invoke("generate", "beam-tiny", "--tests", *options)
    assert done.exit_code == 0
    folders = [Path(line) for line in done.stdout.splitlines()]
    sets = ["in-range", "2x", "4x", "unseen-regions", "several-forces"]
    names = ["beam-tiny", *(f"beam-tiny--{name}" for name in sets)]
    assert [folder.name.rsplit("-", 2)[0] for folder in folders] == names
    assert all((folder / "shard-00000.h5").is_file() for folder in folders)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("run beam-coars", "unknown dataset 'beam-coars'; did you mean 'beam-coarse'?"),
        ("run beam-tiny -m pood", "unknown method 'pood'; did you mean 'pod'?"),
        ("run --suite nowhere", "nowhere: a suite must hold a folder"),
        ("run beam-tiny --threads 100000", "`--threads` must be an integer in [1, "),
        ("run beam-tiny --test-seed new", "`--test-seed` must be "),
        ("report nowhere", "no such file"),
        ("refine beam-tini", "unknown dataset 'beam-tini'; did you mean 'beam-tiny'?"),
        ("refine beam-tiny --levels 0 --cache .", "`levels` must be an integer in [1, 10]; got 0."),
        ("refine beam-tiny --max-dofs 900 --cache .", "`max_dofs` must be at least 975"),
        (
            "generate beam-tiny --workers 2 --cluster tcp://127.0.0.1:1 --cache .",
            "`workers` and `cluster` cannot be used together",
        ),
        (
            "generate beam-tiny --cluster host --cache .",
            "must be the address of a Dask scheduler, tcp://host:port; got 'host'",
        ),
        (
            "export vtu beam-tiny --sample 0 --out . --part no",
            "`--part` must be train, validation, test",
        ),
        ("show hpdo", "'hpdo' is no run, method or dataset; did you mean 'hpod'?"),
        ("run beam-tiny --quiet --verbose", "`--quiet` and `--verbose` cannot be used together."),
        ("run beam-tiny -m pod[n_mods=3]", "unknown key `n_mods`; did you mean 'n_modes'?"),
        ("new-method Bad", "the name of a method must hold lower-case letters"),
    ],
)
def test_an_error_is_one_line_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = invoke(*arguments.split())
    assert done.exit_code == 2
    assert message in done.stderr
    assert "\n" not in done.stderr.strip()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--time-limit=-1", "`--time-limit` must be a number above 0; got -1.0."),
        ("--memory-limit=0.01", "`--memory-limit` must be a number of at least 0.1 GB; got 0.01."),
        ("--seeds=0", "`--seeds` must be an integer in [1, 100]; got 0."),
    ],
)
def test_errors_name_an_option_as_the_command_line_does(option: str, words: str) -> None:
    found = invoke("run", option)
    assert (found.exit_code, found.stderr) == (2, f"mor-bench: {words}\n")


def test_numbers_of_numpy_are_numbers() -> None:
    assert RunOptions(limit=np.int64(3), time_limit_s=np.float32(2.0)).limit == 3
    assert mor_bench.load_method("pod", n_modes=np.int64(3)).parameters["n_modes"] == 3
