"""A sandboxed process: hidden files, reports of failures, and its end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import psutil
import pytest

import mor_bench
from mor_bench.errors import MorBenchError, SpecError
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.results.comparison import Comparison
from mor_bench.sandbox import landlock
from mor_bench.sandbox.fork_server import CAN_FORK, ForkServer
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess
from mor_bench.sandbox.seal import Restrictions
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from tests.case_marks import nightly_but
from tests.intruder import WAYS
from tests.small_runs import method_file


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer | None]:
    if not CAN_FORK:
        yield None
        return
    with closing(ForkServer(MethodSession)) as started:
        yield started


def ask_fit(
    process: SandboxedProcess, name: str, folder: Path, limit_s: float = 60.0, **parameters: Any
) -> dict[str, Any]:
    """Fit a class of `tests.third_party` that needs no samples in a process."""
    surrogate, model = f"tests.third_party:{name}", folder / "model.safetensors"
    request = FitRequest(surrogate, parameters, folder, model, 1, limit_s)
    return process.ask("fit", limit_s, request=request)


def is_gone(pid: int, within_s: float = 20.0) -> bool:
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        try:
            if psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("hang", "fitting took longer than the limit of 1 s"),
        ("memory", "fitting took more memory than the limit"),
        ("segfault", "SIGSEGV"),
        ("end", "ended with code 7"),
        ("orphan", "ended with code 7"),
        ("kill-group", "SIGKILL"),
        ("odd-text", "crashed with RuntimeError: file ?"),
        ("in-library", "Singular matrix (third_party.py, line "),
    ],
)
def test_a_failure_is_reported_and_leaves_no_process(
    how: str, words: str, server: ForkServer | None, tiny_scene: Scene, tmp_path: Path
) -> None:
    limit_s = 1.0 if how == "hang" else 60.0
    restrictions = Restrictions(memory_bytes=1.2e9)
    with SandboxedProcess(MethodSession, restrictions, server, scene=tiny_scene) as process:
        with pytest.raises(MethodFailedError) as caught:
            ask_fit(process, "Broken", tmp_path, limit_s, how=how)
        assert words in str(caught.value)
    assert is_gone(process.pid)


def test_an_interpreter_of_its_own_is_ended_once_only(tiny_scene: Scene, tmp_path: Path) -> None:
    """Its pipe must be closed once: its number may belong to another file by then."""
    with SandboxedProcess(MethodSession, scene=tiny_scene) as process:
        with pytest.raises(MethodFailedError, match="longer than the limit"):
            ask_fit(process, "Broken", tmp_path, 1.0, how="hang")
        (tmp_path / "bystander").touch()
        with (tmp_path / "bystander").open("rb") as bystander:
            process.end()
            assert bystander.read() == b""
    assert is_gone(process.pid)


@pytest.mark.parametrize("how", ["print", "fork"])
def test_prints_and_forks_of_a_method_are_not_taken_for_results(
    how: str, server: ForkServer | None, tiny_scene: Scene, tmp_path: Path
) -> None:
    with SandboxedProcess(MethodSession, fork_server=server, scene=tiny_scene) as process:
        assert ask_fit(process, "Broken", tmp_path, how=how)["fit_s"] > 0
        forces = np.zeros((2, tiny_scene.mesh.n_nodes, 3))
        out = tmp_path / "answers.npy"
        answer = process.ask("predict", 60.0, forces=forces, out=out, threads=1)
        assert answer == {"warnings": []}
        assert np.load(out).shape == forces.shape


@pytest.mark.slow
@pytest.mark.skipif(not CAN_FORK, reason="fork servers are used on Linux only")
def test_a_fork_server_restarts_after_a_method_ends_it(tiny_scene: Scene, tmp_path: Path) -> None:
    with closing(ForkServer(MethodSession)) as server:
        with (
            SandboxedProcess(MethodSession, fork_server=server, scene=tiny_scene) as process,
            pytest.raises(MethodFailedError),
        ):
            ask_fit(process, "Broken", tmp_path, 1.0, how="kill-parent")
        with SandboxedProcess(MethodSession, fork_server=server, scene=tiny_scene) as process:
            assert ask_fit(process, "Zero", tmp_path)["fit_s"] > 0


def test_an_error_keeps_its_type_and_text(server: ForkServer | None, tiny_scene: Scene) -> None:
    with SandboxedProcess(MethodSession, fork_server=server, scene=tiny_scene) as process:
        request = {"surrogate": "mor_bench.surrogates.pod:PODGalerkin", "where": "pod"}
        with pytest.raises(SpecError, match="unknown key `n_mode`"):
            process.ask("check", 60.0, configurations=[{"n_mode": 1}], **request)
        with pytest.raises(MethodFailedError, match="crashed with AttributeError"):
            process.ask("no such request", 60.0)


@pytest.mark.parametrize("sealed", [True, False])
def test_a_sealed_folder_cannot_be_seen_in_any_way(
    sealed: bool, cache: Path, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shards = [str(path) for path in cache.glob("datasets/*/shard-*.h5")]
    monkeypatch.setenv("MOR_BENCH_TEST_SHARDS", os.pathsep.join(shards))
    restrictions = Restrictions(sealed=(cache,) if sealed else ())
    with SandboxedProcess(MethodSession, restrictions, scene=tiny.scene) as process:
        warnings = ask_fit(process, "Peeker", tmp_path, folders=[str(cache)])["warnings"]
    (warning,) = (text for text in warnings if text.startswith("saw "))
    seen = {item.split()[0] for item in json.loads(warning.removeprefix("saw "))}
    # Programs are never allowed, because the sandbox would not cover them.
    assert seen == (set() if sealed else {"_list", "_open", "_hdf5", "_load"})


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_process_ends_if_its_parent_is_killed() -> None:
    script = (
        "import time\n"
        "from mor_bench.measure.method_session import MethodSession\n"
        "from mor_bench.sandbox.fork_server import CAN_FORK, ForkServer\n"
        "from mor_bench.sandbox.process import SandboxedProcess\n"
        "server = ForkServer(MethodSession) if CAN_FORK else None\n"
        "process = SandboxedProcess(MethodSession, fork_server=server)\n"
        "print(process.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout
    pid = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    assert is_gone(pid)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Linux ends such a process, others do not")
def test_a_process_that_never_releases_the_interpreter_ends_with_its_parent(tmp_path: Path) -> None:
    (tmp_path / "endless.py").write_text(
        "import os, re\n"
        f"open({str(tmp_path / '__pycache__' / 'pid')!r}, 'w').write(str(os.getpid()) + ' ')\n"
        "re.match('(a+)+$', 60 * 'a' + 'b')\n"
    )
    path = method_file(tmp_path, "endless", "endless:Mine")
    command = [sys.executable, "-m", "mor_bench", "check", str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([os.getcwd(), str(tmp_path)])}
    with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as parent:
        written = tmp_path / "__pycache__" / "pid"  # a method can write here
        until = time.monotonic() + 60.0
        while time.monotonic() < until and not (written.exists() and written.read_text()):
            time.sleep(0.05)
        pid = int(written.read_text())
        assert not is_gone(pid, 0.5)
        parent.kill()
    assert is_gone(pid, 2.0)


@pytest.mark.slow
@pytest.mark.skipif(landlock.version() < 6, reason="needs a kernel with Landlock")
@pytest.mark.parametrize("sealed", [True, False])
@pytest.mark.parametrize("way", nightly_but(3, WAYS))
def test_the_kernel_keeps_a_method_out_of_sealed_folders(
    way: str, sealed: bool, server: ForkServer | None, tiny_scene: Scene, tmp_path: Path
) -> None:
    if way == "as_a_tensor":
        pytest.importorskip("torch")
    secret, own = tmp_path / "cache" / "datasets" / "x" / "secret", tmp_path / "own"
    secret.parent.mkdir(parents=True)
    own.mkdir()
    secret.write_bytes(b"0123456789")
    with h5py.File(secret.with_suffix(".h5"), "w") as file:
        file["secret"] = np.frombuffer(b"0123456789", np.uint8)
    closed = (secret.parents[1], tmp_path / "not-yet" / "there") if sealed else ()
    restrictions = Restrictions(closed, scratch=own)
    arguments = {"way": way, "secret": str(secret), "folder": str(own)}
    with SandboxedProcess(MethodSession, restrictions, server, scene=tiny_scene) as process:
        request = FitRequest("tests.intruder:Intruder", arguments, own, own / "m", 1, 60.0)
        (said,) = process.ask("fit", 60.0, request=request)["warnings"]
    never = way == "by_a_process_of_the_fork_server"
    assert said.startswith("refused" if sealed or never else "saw "), said
    assert not sealed or secret.read_bytes() == b"0123456789"


@pytest.mark.skipif(sys.platform != "linux", reason="Landlock is part of Linux")
def test_a_kernel_that_refuses_to_close_folders_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(landlock, "version", lambda: 1)
    monkeypatch.setattr(landlock, "CREATE_RULESET", 9999)
    with pytest.raises(MorBenchError, match="refuses to close folders"):
        landlock.close_folders([tmp_path])


@pytest.mark.skipif(not landlock.version(), reason="needs a kernel with Landlock")
def test_a_third_partys_method_changes_no_file_of_others(
    server: ForkServer | None, tiny_scene: Scene, tmp_path: Path
) -> None:
    theirs, own, installed = tmp_path / "theirs", tmp_path / "own", tmp_path / "installed"
    for folder in (theirs, own, installed):
        folder.mkdir()
    code = [theirs / "method.py", installed / "page.py"]
    for path in code:
        path.write_text("")
    compiled = theirs / "__pycache__" / "method.pyc"
    package = Path(mor_bench.__file__).parent / "new_module.py"
    paths = [str(p) for p in (*code, installed / "new.pth", package, own / "notes", compiled)]
    restrictions = Restrictions((tmp_path / "cache",), import_from=theirs, scratch=own)
    with SandboxedProcess(MethodSession, restrictions, server, scene=tiny_scene) as process:
        said = ask_fit(process, "Vandal", own, paths=paths)["warnings"]
    assert [text for text in said if text.startswith("wrote")] == [
        f"wrote {own / 'notes'}",
        f"wrote {compiled}",
    ]
    assert not any(path.read_text() for path in code)
    assert not package.exists()


def test_the_kind_of_isolation_is_recorded(small_run: Comparison) -> None:
    expected = "landlock" if landlock.version() else "audit hook"
    assert Comparison.read(small_run.out).machine["isolation"] == expected


def test_a_sealed_process_works_beside_the_sealed_folders(
    server: ForkServer | None, tiny_scene: Scene, tmp_path: Path
) -> None:
    closed, own = tmp_path / "cache", tmp_path / "own"
    own.mkdir()
    (tmp_path / "loop").symlink_to(tmp_path)
    restrictions = Restrictions((closed,), exempt=closed / "mine", scratch=own)
    (closed / "mine").mkdir(parents=True)
    with SandboxedProcess(MethodSession, restrictions, server, scene=tiny_scene) as process:
        for folder in (own, closed / "mine"):
            answer = ask_fit(process, "Zero", folder)
            assert answer["model_bytes"] == (folder / "model.safetensors").stat().st_size
