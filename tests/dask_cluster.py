"""A Dask cluster on this machine, for tests of generation and of runs on clusters."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


class Cluster:
    """A Dask scheduler and workers over TCP, in processes of their own, without shared folders."""

    def __init__(self, folder: Path, workers: tuple[str, ...]) -> None:
        pytest.importorskip("distributed", reason="needs pip install 'mor-bench[cluster]'")
        folder.mkdir()
        file = folder / "scheduler.json"
        self._folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        address = ["--host", "127.0.0.1", "--port", "0"]
        self._start("scheduler", "scheduler", *address, "--scheduler-file", str(file))
        limit = time.time() + 60
        while not file.exists() or not file.stat().st_size:
            assert time.time() < limit, "the scheduler does not start"
            time.sleep(0.05)
        self.address: str = json.loads(file.read_text())["address"]
        for name in workers:
            options = ["--no-nanny", "--nthreads", "1", "--name", name]
            self._start("worker", name, self.address, *options)

    def _start(self, kind: str, name: str, *options: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, "--no-dashboard"]
        with open(self._folder / f"{name}.log", "wb") as log:
            self.processes[name] = subprocess.Popen(
                command, cwd=self._folder, env=environment, stdout=log, stderr=log
            )

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes.values():
            process.kill()
            process.wait()
