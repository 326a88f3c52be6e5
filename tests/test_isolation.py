"""A method's process: what it cannot see, and what it cannot do to others."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, SpecError
from mor_bench.measure.method_session import MethodSession
from mor_bench.options import RunOptions
from mor_bench.results.comparison import Comparison
from mor_bench.runs.configurations import CORE_METHODS, checked_specs
from mor_bench.sandbox.fork_server import CAN_FORK, ForkServer
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess
from mor_bench.snapshots.dataset import Dataset
from tests.third_party import Peeker


def method_file(folder: Path, name: str, surrogate: str, **knobs: Any) -> Path:
    path = folder / f"{name}.toml"
    values = "\n".join(f"{key} = {json.dumps(value)}" for key, value in knobs.items())
    path.write_text(
        f'title = "t"\nsource = "s"\nsurrogate = "{surrogate}"\n[parameters]\n{values}\n'
    )
    return path


def saw(row: dict[str, Any]) -> list[str]:
    return [
        item for text in row["warnings"] if text.startswith("saw ") for item in json.loads(text[4:])
    ]


def test_a_method_that_looks_for_the_test_set_does_not_find_it(
    tiny: Dataset, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    folders = [str(cache / "datasets"), str(cache / "fits"), str(out / "samples"), str(cache)]
    shards = [str(path) for path in cache.glob("datasets/*/shard-*.h5")]
    monkeypatch.setenv("MOR_BENCH_TEST_SHARDS", os.pathsep.join(shards))
    mor_bench.run(
        ["beam-tiny"], ["linear-fem"], out=out, cache=cache
    )  # so that there are results to look at, too
    path = method_file(tmp_path, "peeker", "tests.third_party:Peeker", folders=folders[:3])
    comparison = mor_bench.run(["beam-tiny"], ["linear-fem", path], out=out, cache=cache)
    assert comparison.rows[1]["status"] == "ok", comparison.rows[1]["reason"]
    assert any(text.startswith("saw ") for text in comparison.rows[1]["warnings"])
    assert saw(comparison.rows[1]) == []
    # The same method outside of a comparison finds all of it: it does look.
    with pytest.warns(UserWarning, match="saw") as caught:
        Peeker(folders).fit(tiny.scene, tiny.train)
    found = saw({"warnings": [str(item.message) for item in caught]})
    assert {item.split()[0] for item in found} >= {
        "dataset",
        "_list",
        "_open",
        "_hdf5",
        "_program",
        "_load",
    }


def test_a_fresh_test_set_is_drawn_after_all_fits_and_tells_the_same_as_the_shipped_one(
    cache: Path, tmp_path: Path
) -> None:
    arguments: dict[str, Any] = {
        "datasets": ["beam-tiny"],
        "methods": ["linear-fem", "pod"],
        "cache": cache,
    }
    one, again, other = (
        mor_bench.run(**arguments, out=tmp_path / name, test_seed=seed)
        for name, seed in (("a", 7), ("b", 7), ("c", 8))
    )
    linear = one.rows[0]
    assert linear["hidden"]["seed"] == 7
    assert linear["hidden"]["n"] == linear["n_test"]
    assert linear["hidden"]["rel_l2_median"] != linear["error"]["rel_l2_median"]
    assert 0.3 < linear["hidden"]["rel_l2_median"] / linear["error"]["rel_l2_median"] < 3
    assert [row["hidden"] for row in again.rows] == [row["hidden"] for row in one.rows]
    assert other.rows[0]["hidden"]["rel_l2_median"] != linear["hidden"]["rel_l2_median"]
    assert not list(cache.glob("**/*hidden*"))


HOW = {
    "hang": "fitting took longer than the limit of 8 s",
    "memory": "fitting took more memory than the limit",
    "segfault": "SIGSEGV",
    "end": "ended with code 7",
    "orphan": "ended with code 7",
    "kill-group": "SIGKILL",
    "kill-parent": "",
    "odd-text": "crashed with RuntimeError: file ?",
    "batches-only": "while timed: a single load of shape (63, 3) is not answered in that shape",
    "print": None,
    "fork": None,
}
"""What a broken method does, and what its row must say; None where it still answers."""


@pytest.fixture(scope="module")
def broken(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    folder = tmp_path_factory.mktemp("broken")
    methods: list[str | Path] = [
        method_file(folder, how, "tests.third_party:Broken", how=how) for how in HOW
    ]
    out = folder / "out"
    return mor_bench.run(
        ["beam-tiny"],
        [*methods, "linear-fem"],
        out=out,
        cache=cache,
        time_limit_s=8.0,
        memory_limit_bytes=1.5e9,
    )


def test_what_hangs_or_eats_memory_or_dies_costs_its_own_row_only(broken: Comparison) -> None:
    rows = {row["method"]: row for row in broken.rows}
    assert rows["linear-fem"]["status"] == "ok"
    for how, words in HOW.items():
        assert rows[how]["status"] == ("ok" if words is None else "failed"), (
            how,
            rows[how]["reason"],
        )
        assert words is None or words in rows[how]["reason"]
    assert Comparison.read(broken.out).rows == json.loads(json.dumps(broken.rows))


def test_fits_that_fail_cost_their_part_of_the_budget(cache: Path, tmp_path: Path) -> None:
    path = tmp_path / "hang.toml"
    path.write_text(
        'title = "t"\nsource = "s"\nsurrogate = "tests.third_party:Broken"\n[sweep]\nhow = ["hang", "print", "end"]'
    )
    rows = mor_bench.run(
        ["beam-tiny"], [path], out=tmp_path / "out", cache=cache, time_limit_s=2.0
    ).rows
    assert [row["status"] for row in rows] == ["failed", "skipped", "skipped"]
    assert rows[1]["reason"] == "beyond the tuning budget of 2 s of fitting"
    assert rows[0]["tuning_s"] >= 2.0


def test_what_one_method_learns_from_no_other_can_change(tmp_path: Path) -> None:
    poison = method_file(tmp_path, "poison", "tests.third_party:Poison")
    poisoned = mor_bench.run(
        ["beam-tiny"],
        [poison, "pca-regression-force"],
        out=tmp_path / "a",
        cache=tmp_path / "cache",
    )
    clean = mor_bench.run(
        ["beam-tiny"], ["pca-regression-force"], out=tmp_path / "b", cache=tmp_path / "other"
    )
    assert (poisoned.rows[0]["status"], poisoned.rows[0]["reason"]) == (
        "failed",
        "it wrote over the training samples",
    )
    assert poisoned.rows[1]["error"] == clean.rows[0]["error"]


def test_all_configurations_are_fitted_before_one_is_asked_for_the_test_set(
    cache: Path, tmp_path: Path
) -> None:
    path = tmp_path / "leaky.toml"
    note = tmp_path / "forces.npy"
    knobs = f'[parameters]\npath = "{note.as_posix()}"\n[sweep]\nn = [1, 2, 3]'
    path.write_text(f'title = "t"\nsource = "s"\nsurrogate = "tests.third_party:Leaky"\n{knobs}')
    rows = mor_bench.run(["beam-tiny"], [path], out=tmp_path / "out", cache=cache).rows
    assert note.exists()
    assert [(row["status"], row["warnings"]) for row in rows] == [("ok", [])] * 3


def test_a_method_that_answers_otherwise_when_it_is_timed_fails(
    cache: Path, tmp_path: Path
) -> None:
    path = method_file(tmp_path, "worse", "tests.third_party:Broken", how="worse-alone")
    row = mor_bench.run(["beam-tiny"], [path], out=tmp_path / "out", cache=cache).rows[0]
    assert row["status"] == "failed"
    assert "while it is timed, on loads on which it was scored with" in row["reason"]


def test_two_runs_do_not_write_to_one_folder(cache: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / ".running").write_text(f"{os.getppid()} {psutil.Process(os.getppid()).create_time()!r}")
    with pytest.raises(InvalidInputError, match="another run, process"):
        mor_bench.run(["beam-tiny"], ["linear-fem"], out=out, cache=cache)
    (out / ".running").write_text("1234567 1.0")
    assert (
        mor_bench.run(["beam-tiny"], ["linear-fem"], out=out, cache=cache).rows[0]["status"] == "ok"
    )


def test_what_a_method_prints_is_no_answer(broken: Comparison) -> None:
    row = next(row for row in broken.rows if row["method"] == "print")
    assert row["status"] == "ok"
    assert row["offline_s"]["fit"] > 0


def test_no_process_is_left(broken: Comparison) -> None:
    time.sleep(0.5)
    left = [process.cmdline() for process in psutil.Process().children(recursive=True)]
    assert not [command for command in left if "mor_bench.sandbox.child" in command]


def test_a_module_beside_its_file_competes(cache: Path, tmp_path: Path) -> None:
    (tmp_path / "my_method.py").write_text(
        "from tests.third_party import Zero\n\nclass Mine(Zero):\n    pass\n"
    )
    path = method_file(tmp_path, "mine", "my_method:Mine")
    comparison = mor_bench.run(["beam-tiny"], [path], out=tmp_path / "out", cache=cache)
    assert comparison.rows[0]["status"] == "ok", comparison.rows[0]["reason"]
    assert comparison.rows[0]["error"]["rel_l2_median"] == pytest.approx(1.0)
    suite = tmp_path / "suite" / "methods"
    suite.mkdir(parents=True)
    (suite / "my_method.py").write_text((tmp_path / "my_method.py").read_text())
    path.rename(suite / "mine.toml")
    assert [
        method.name for method in checked_specs(["beam-tiny"], None, RunOptions(suite=tmp_path / "suite"))[1]
    ] == [*CORE_METHODS, "mine"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("import no_such_module", "cannot be imported"),
        ("", "has no class 'Mine'"),
        ("class Mine:\n    def __init__(self): pass", "unknown key `x`"),
    ],
)
def test_a_mistake_in_a_method_of_ones_own_is_told_before_anything_runs(
    content: str, words: str, cache: Path, tmp_path: Path
) -> None:
    (tmp_path / "mistaken.py").write_text(content)
    path = method_file(tmp_path, "mine", "mistaken:Mine", x=1)
    with pytest.raises(SpecError, match=words):
        mor_bench.run(["beam-tiny"], ["linear-fem", path], out=tmp_path / "out", cache=cache)
    assert not (tmp_path / "out").exists()


def test_a_module_that_ends_python_when_imported_costs_its_own_row(
    cache: Path, tmp_path: Path
) -> None:
    (tmp_path / "deadly.py").write_text("import os\nos._exit(9)\n")
    path = method_file(tmp_path, "mine", "deadly:Mine")
    comparison = mor_bench.run(
        ["beam-tiny"], [path, "linear-fem"], out=tmp_path / "out", cache=cache
    )
    assert [row["status"] for row in comparison.rows] == ["failed", "ok"]
    assert "ended with code 9" in comparison.rows[0]["reason"]


def test_the_first_failure_ends_a_run_that_is_to_fail_fast(cache: Path, tmp_path: Path) -> None:
    path = method_file(tmp_path, "broken", "tests.third_party:Broken")
    comparison = mor_bench.run(
        ["beam-tiny"], [path, "linear-fem"], out=tmp_path / "out", cache=cache, fail_fast=True
    )
    assert [row["status"] for row in comparison.rows] == ["failed"]


def test_a_changed_source_is_fitted_again_and_nothing_else(cache: Path, tmp_path: Path) -> None:
    source = tmp_path / "aside.py"
    source.write_text("VALUE = 1")
    (tmp_path / "changing.py").write_text(
        "from aside import VALUE\nfrom tests.third_party import Zero\n\nclass Mine(Zero):\n    value = VALUE\n"
    )
    path = method_file(tmp_path, "changing", "changing:Mine")
    own = tmp_path / "cache"
    mor_bench.run(["beam-tiny"], [path, "linear-fem"], out=tmp_path / "a", cache=own)
    before = {item.parent.name: item.stat().st_mtime_ns for item in own.glob("fits/*/fit.json")}
    source.write_text("VALUE = 2")
    mor_bench.run(["beam-tiny"], [path, "linear-fem"], out=tmp_path / "b", cache=own)
    after = {item.parent.name: item.stat().st_mtime_ns for item in own.glob("fits/*/fit.json")}
    assert len(before) == 2
    assert before.items() <= after.items()
    assert [name.rpartition("-")[0] for name in after.keys() - before.keys()] == ["changing"]


def test_a_damaged_fit_is_made_again(cache: Path, tmp_path: Path) -> None:
    own = tmp_path / "cache"
    first = mor_bench.run(["beam-tiny"], ["pca-regression-force"], out=tmp_path / "a", cache=own)
    model = next(own.glob("fits/*/model.safetensors"))
    model.write_bytes(model.read_bytes()[:-1] + b"x")
    for path in own.glob("fits/*/*.h5"):
        path.write_bytes(b"nothing")
    mor_bench.run(["beam-tiny"], ["linear-fem"], out=tmp_path / "c", cache=own)
    for content in (b"null", b"[]", b"{}", b'{"model_sha256": null}'):
        next(own.glob("fits/linear-fem-*/fit.json")).write_bytes(content)
        assert (
            mor_bench.run(["beam-tiny"], ["linear-fem"], out=tmp_path / "c", cache=own).rows[0][
                "status"
            ]
            == "ok"
        )
    again = mor_bench.run(["beam-tiny"], ["pca-regression-force"], out=tmp_path / "b", cache=own)
    assert again.rows[0]["status"] == "ok"
    assert again.rows[0]["error"] == first.rows[0]["error"]


@pytest.mark.parametrize(
    "forked",
    [
        pytest.param(
            True,
            marks=pytest.mark.skipif(not CAN_FORK, reason="forking servers are used on Linux only"),
        ),
        False,
    ],
)
def test_a_worker_says_how_it_failed(forked: bool, tiny: Dataset) -> None:
    server = ForkServer(MethodSession) if forked else None
    try:
        with SandboxedProcess(MethodSession, fork_server=server) as worker:
            with pytest.raises(SpecError, match="unknown key `n_mode`"):
                worker.ask(
                    "check",
                    60.0,
                    surrogate="mor_bench.surrogates.pod:PODGalerkin",
                    configurations=[{"n_mode": 1}],
                    where="pod",
                )
            with pytest.raises(MethodFailedError, match="crashed with AttributeError"):
                worker.ask("no such request", 60.0)
    finally:
        if server:
            server.close()


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    import signal
    import subprocess

    script = (
        "from tests.third_party import *\nfrom mor_bench.sandbox.process import SandboxedProcess\nfrom mor_bench.measure.method_session import MethodSession\nfrom mor_bench.sandbox.fork_server import CAN_FORK, ForkServer\n"
        "n = ForkServer(MethodSession) if CAN_FORK else None\nw = SandboxedProcess(MethodSession, fork_server=n)\nprint(w.pid, flush=True)\ntime.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout
    pid = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    until = time.monotonic() + 20
    while (
        psutil.pid_exists(pid)
        and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
        and time.monotonic() < until
    ):
        time.sleep(0.1)
    assert not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
