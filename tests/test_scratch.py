"""Temporary folders of processes that this process cannot see."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mor_bench.scratch import scratch_folder

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
