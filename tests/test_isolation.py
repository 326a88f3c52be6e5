"""A method can spoil only its own row, not the comparison or other methods."""

from __future__ import annotations

import errno
import json
import os
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from mor_bench.errors import InvalidInputError, SpecError
from mor_bench.options import RunOptions
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from mor_bench.runs import dataset_run
from mor_bench.runs.configurations import CORE_METHODS, checked_specs
from mor_bench.runs.plan import plan
from mor_bench.runs.run_folder import only_run_in
from mor_bench.scratch import identity
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.generate import dataset_folder, generation_seconds
from mor_bench.specs import load_generated_spec
from tests.case_marks import nightly_but
from tests.commands import mor_bench_command
from tests.small_runs import PLAIN, method_file, run_small
from tests.third_party import Peeker

FORCES = str(PLAIN[1])


def command_lines(processes: list[psutil.Process]) -> list[list[str]]:
    """Return the command lines of processes that have not ended."""
    found = []
    for process in processes:
        with suppress(psutil.NoSuchProcess):  # a zombie is one, too
            found.append(process.cmdline())
    return found


def broken_file(folder: Path, how: str) -> Path:
    return method_file(folder, how, "tests.third_party:Broken", how=how)


def seen_by(row: Row) -> list[str]:
    found = [text for text in row.warnings if text.startswith("saw ")]
    assert found
    return [item for text in found for item in json.loads(text.removeprefix("saw "))]


@pytest.mark.slow
def test_a_method_cannot_find_a_test_sample_or_a_result(
    tiny: Dataset, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    folders = [str(cache / "datasets"), str(cache / "fits"), str(out / "samples")]
    run_small(["linear-fem"], out, cache)  # creates results that the next run could find
    shards = [str(path) for path in cache.glob("datasets/*/shard-*.h5")]
    monkeypatch.setenv("MOR_BENCH_TEST_SHARDS", os.pathsep.join(shards))
    path = method_file(tmp_path, "peeker", "tests.third_party:Peeker", folders=folders)
    row = run_small(["linear-fem", path], out, cache).rows[1]
    assert row.ok, row.reason
    assert seen_by(row) == []
    with pytest.warns(UserWarning, match="_open"):  # it does search
        Peeker(folders).fit(tiny.scene, tiny.train)


@pytest.mark.slow
def test_a_broken_method_spoils_its_own_row_only(cache: Path, tmp_path: Path) -> None:
    reasons = {
        "kill-group": "SIGKILL",
        "kill-parent": "",
        "batches-only": "the answer to a single load of shape (63, 3) has another shape",
        "worse-alone": "the scored error on the same loads is",
        "print": None,
        "save-pipe": "a device or pipe",
        "fork": None,
    }
    methods: list[str | Path] = [broken_file(tmp_path, how) for how in reasons]
    found = run_small([*methods, "linear-fem"], tmp_path / "out", cache, time_limit_s=5.0)
    rows = {row.method: row for row in found.rows}
    assert rows["linear-fem"].ok
    for how, words in reasons.items():
        assert rows[how].ok == (words is None), (how, rows[how].reason)
        assert words is None or words in str(rows[how].reason)
    assert Comparison.read(found.out).rows == found.rows
    left = command_lines(psutil.Process().children(recursive=True))
    assert not [command for command in left if str(tmp_path) in " ".join(command)]


@pytest.mark.slow
def test_failed_fits_use_up_the_tuning_budget(cache: Path, tmp_path: Path) -> None:
    how = {"how": ["hang", "print", "end"]}
    path = method_file(tmp_path, "hang", "tests.third_party:Broken", sweep=how)
    rows = run_small([path], tmp_path / "out", cache, time_limit_s=2.0).rows
    assert [row.status for row in rows] == ["failed", "skipped", "skipped"]
    assert rows[1].reason == "beyond the tuning budget of 2 s of fitting"
    assert (rows[0].tuning_s or 0.0) >= 2.0


@pytest.mark.slow
def test_a_full_disk_during_a_fit_is_reported_as_such(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def on_a_full_disk(*_: object) -> None:
        raise OSError(errno.ENOSPC, "the disk is full", "fit.json")

    monkeypatch.setattr(dataset_run, "fit_configuration", on_a_full_disk)
    with pytest.raises(OSError, match="the disk is full"):
        run_small(["linear-fem"], tmp_path / "out", cache)


@pytest.mark.slow
def test_no_method_can_change_what_another_learns_from(
    tmp_path: Path, plain_run: Comparison
) -> None:
    poison = method_file(tmp_path, "poison", "tests.third_party:Poison")
    poisoned = run_small([poison, FORCES], tmp_path / "a", tmp_path / "cache").rows
    assert (poisoned[0].status, poisoned[0].reason) == (
        "failed",
        "the method overwrote the training samples",
    )
    assert poisoned[1].error == plain_run.rows[1].error


@pytest.mark.slow
def test_no_method_sees_a_test_load_before_all_configurations_are_fitted(
    cache: Path, tmp_path: Path
) -> None:
    note = tmp_path / "__pycache__" / "forces.npy"  # elsewhere it cannot write
    note.parent.mkdir()
    path = method_file(
        tmp_path, "leaky", "tests.third_party:Leaky", sweep={"n": [1, 2, 3]}, path=str(note)
    )
    rows = run_small([path], tmp_path / "out", cache).rows
    assert note.exists()
    assert [(row.status, row.warnings) for row in rows] == [("ok", [])] * 3


@pytest.mark.slow
def test_a_hidden_test_set_depends_on_its_seed_only(cache: Path, tmp_path: Path) -> None:
    one, again, other = (
        run_small(["linear-fem"], tmp_path / name, cache, test_seed=seed).rows[0]
        for name, seed in (("a", 7), ("b", 7), ("c", 8))
    )
    assert one.hidden
    assert other.hidden
    assert one.error
    assert (one.hidden.seed, one.hidden.n) == (7, one.n_test)
    assert again.hidden == one.hidden
    assert other.hidden.rel_l2_median != one.hidden.rel_l2_median != one.error.rel_l2_median
    assert 0.3 < one.hidden.rel_l2_median / one.error.rel_l2_median < 3
    assert not list(cache.glob("**/*hidden*"))


def test_two_runs_cannot_write_to_the_same_folder(cache: Path, tmp_path: Path) -> None:
    (tmp_path / ".running").write_text(str(identity(os.getppid())))
    with pytest.raises(InvalidInputError, match=r"another run \(process"):
        run_small(["linear-fem"], tmp_path, cache)
    assert [path.name for path in tmp_path.iterdir()] == [".running"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_in_the_place_of_a_small_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / ".running")
    with only_run_in(tmp_path):
        assert (tmp_path / ".running").is_file()
    spec = load_generated_spec("beam-tiny")
    folder = dataset_folder(spec, tmp_path)
    folder.mkdir(parents=True)
    os.mkfifo(folder / "seconds-00000.txt")
    (folder / "seconds-00001.txt").write_text("-1e300")
    assert generation_seconds(spec, tmp_path, 100) is None


@pytest.mark.slow
def test_the_first_failure_ends_a_run_that_fails_fast(cache: Path, tmp_path: Path) -> None:
    (tmp_path / ".running").write_text("1234567-1")  # of a run that has ended
    methods: list[str | Path] = [broken_file(tmp_path, "end"), "linear-fem"]
    found = run_small(methods, tmp_path, cache, fail_fast=True)
    assert [row.status for row in found.rows] == ["failed"]


@pytest.mark.slow
def test_methods_of_a_suite_folder_join_those_of_the_default(tmp_path: Path) -> None:
    suite = tmp_path / "suite" / "methods"
    suite.mkdir(parents=True)
    (suite / "my_method.py").write_text("from tests.third_party import Zero as Mine\n")
    method_file(suite, "mine", "my_method:Mine")
    methods = checked_specs(["beam-tiny"], None, RunOptions(suite=tmp_path / "suite")).methods
    assert [method.name for method in methods] == [*CORE_METHODS, "mine"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("import no_such_module", "cannot be imported"),
        ("", "has no class 'Mine'"),
        (
            "from tests.third_party import Zero\n\nclass Mine(Zero):\n    def __init__(self): pass",
            "unknown key `x`",
        ),
    ],
)
def test_a_mistake_in_a_users_method_is_reported_before_anything_runs(
    content: str, words: str, cache: Path, tmp_path: Path
) -> None:
    (tmp_path / "mistaken.py").write_text(content)
    path = method_file(tmp_path, "mine", "mistaken:Mine", x=1)
    with pytest.raises(SpecError, match=words):
        run_small(["linear-fem", path], tmp_path / "out", cache)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_module_that_ends_python_when_imported_costs_its_own_row(
    cache: Path, tmp_path: Path
) -> None:
    (tmp_path / "deadly.py").write_text("import os\nos._exit(9)\n")
    path = method_file(tmp_path, "mine", "deadly:Mine")
    rows = run_small([path, "linear-fem"], tmp_path / "out", cache).rows
    assert [row.status for row in rows] == ["failed", "ok"]
    assert "ended with code 9" in str(rows[0].reason)


@pytest.mark.slow
def test_only_a_method_whose_source_changed_is_fitted_again(tmp_path: Path) -> None:
    source, cache = tmp_path / "aside.py", tmp_path / "cache"
    source.write_text("VALUE = 1")
    (tmp_path / "changing.py").write_text(
        "from aside import VALUE\nfrom tests.third_party import Zero\n\n"
        "class Mine(Zero):\n    value = VALUE\n"
    )
    path = method_file(tmp_path, "changing", "changing:Mine")
    run_small([path, "linear-fem"], tmp_path / "a", cache)
    before = {item.parent.name: item.stat().st_mtime_ns for item in cache.glob("fits/*/fit.json")}
    source.write_text("VALUE = 2")
    run_small([path, "linear-fem"], tmp_path / "b", cache)
    after = {item.parent.name: item.stat().st_mtime_ns for item in cache.glob("fits/*/fit.json")}
    assert len(before) == 2
    assert before.items() <= after.items()
    assert [name.rpartition("-")[0] for name in after.keys() - before.keys()] == ["changing"]


@pytest.mark.slow
def test_a_damaged_fit_is_made_again(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    first = run_small([FORCES], tmp_path / "a", cache).rows[0]
    model = next(cache.glob("fits/*/model.safetensors"))
    model.write_bytes(model.read_bytes()[:-1] + b"x")
    for path in cache.glob("fits/*/*.h5"):
        path.write_bytes(b"nothing")
    again = run_small([FORCES], tmp_path / "b", cache).rows[0]
    assert again.ok
    assert again.error == first.error
    next(cache.glob(f"fits/{FORCES}-*/fit.json")).write_bytes(b"{}")
    assert run_small([FORCES], tmp_path / "b", cache).rows[0].error == first.error


BROKEN_MODULES = {
    "syntax": ("class Mine(:\n", "SyntaxError"),
    "null": ("x = 1\0\n", "null bytes"),
    "name": ("\nclass Mine(Nothing): pass\n", "NameError: name 'Nothing' is not defined"),
    "exit": ("import sys\nsys.exit(0)\n", "SystemExit: 0"),
    "end": ("import os\nos._exit(0)\n", "ended"),
    "odd-text": (
        "class Odd(Exception):\n    def __str__(self):\n        raise ValueError\n\nraise Odd\n",
        "its text cannot be formed",
    ),
    "no-method": ("class Mine:\n    pass\n", "has no methods `fit` and `predict`"),
    "abstract": (
        "from abc import ABC, abstractmethod\nfrom tests.third_party import Zero\n\n"
        "class Mine(Zero, ABC):\n    @abstractmethod\n    def more(self): ...\n",
        "is abstract: it lacks `more`",
    ),
    "silent": (
        "import mor_bench\n\nclass Mine(mor_bench.Surrogate):\n    pass\n",
        "neither `answer` nor `predict`",
    ),
}
"""Code of a method's module, and words of the one line that reports it."""


def broken_module(folder: Path, how: str) -> Path:
    (folder / f"module_{how.replace('-', '_')}.py").write_text(BROKEN_MODULES[how][0])
    return method_file(folder, how, f"module_{how.replace('-', '_')}:Mine")


@pytest.mark.slow
def test_a_module_that_cannot_be_imported_costs_its_own_row(cache: Path, tmp_path: Path) -> None:
    methods = [broken_module(tmp_path, how) for how in BROKEN_MODULES]
    rows = run_small([*methods, "linear-fem"], tmp_path / "out", cache).rows
    assert rows[-1].ok
    for row, (_, words) in zip(rows[:-1], BROKEN_MODULES.values(), strict=True):
        assert row.status == "failed"
        assert words in str(row.reason), row.reason
    steps = plan(["beam-tiny"], [*methods, "linear-fem"], cache=cache).steps
    left_out = {step.method: step for step in steps if "(left out: " in step.label}
    assert left_out.keys() == BROKEN_MODULES.keys()
    for how, (_, words) in BROKEN_MODULES.items():
        assert words in left_out[how].label
        assert left_out[how].seconds == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("how", nightly_but(2, ["syntax", "exit", "end", "odd-text", "abstract"]))
@pytest.mark.parametrize("command", ["check", "fit"])
def test_a_module_that_cannot_be_imported_is_one_line_of_check_and_fit(
    how: str, command: str, cache: Path, tmp_path: Path
) -> None:
    file = str(broken_module(tmp_path, how))
    fit = ["beam-tiny", "-m", file, "--out", "m.safetensors", "--cache", str(cache), "--limit=60"]
    done = mor_bench_command(command, *([file] if command == "check" else fit), cwd=tmp_path)
    assert done.returncode == 2, done
    *before, line = done.stderr.strip().splitlines()
    assert BROKEN_MODULES[how][1] in line
    assert not [text for text in before if "Traceback" in text or "mor-bench: " in text]
    assert not list(tmp_path.glob("*m.safetensors*"))
