"""Temporary folders of processes that this process cannot see."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mor_bench.scratch import scratch_folder
from tests.small_runs import COMMAND

ROOT = Path(__file__).parents[1]

IN_A_CONTAINER = ["unshare", "--pid", "--fork", "--mount-proc", "--map-root-user"]
"""Starts a command that has its own numbers of processes, as in a container."""


def can_unshare() -> bool:
    if shutil.which("unshare") is None:
        return False
    return subprocess.run([*IN_A_CONTAINER, "true"], capture_output=True).returncode == 0


@pytest.mark.skipif(not can_unshare(), reason="needs `unshare` and the right to use it")
def test_a_container_with_the_same_name_keeps_folders_of_the_host(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    code = "from mor_bench.scratch import remove_abandoned as f; f(); print('removed')"
    with scratch_folder() as folder:
        command = [*IN_A_CONTAINER, sys.executable, "-c", code]
        environment = {**os.environ, "TMPDIR": str(tmp_path)}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.stdout == "removed\n", done.stderr
        assert folder.is_dir()


@pytest.mark.slow
def test_a_training_leaves_no_temporary_file(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    places = {"TMPDIR": tmp_path / "tmp", "HOME": tmp_path / "home"}
    for place in places.values():
        place.mkdir()
    command = [*COMMAND, "fit", "beam-tiny", "-m", "umesh-small", "--set", "iterations=5"]
    command += ["--limit", "60", "--cache", "cache", "--out", "net.safetensors"]
    environment = {**os.environ, **{name: str(place) for name, place in places.items()}}
    environment.pop("TORCHINDUCTOR_CACHE_DIR", None)
    environment["PYTHONPATH"] = str(ROOT)
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    left = {path.name for path in places["TMPDIR"].iterdir()}
    assert left <= {".ses"}  # ONNX Runtime's own, where it is installed
