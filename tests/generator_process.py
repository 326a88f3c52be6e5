"""Killable processes that generate a dataset, forked from one that has imported everything.

    python -m tests.generator_process SPEC SHARD_SIZE

reads lines ``start FOLDER WORKERS``, which prints a process number, and ``wait NUMBER``, which
prints the exit status. Files are written in pieces with pauses between them, so that a signal at a
random time often interrupts a write.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

PIECES = 8
PAUSE_S = 0.002


def files(folder: Path) -> dict[str, bytes]:
    """Return the committed files without timings. They must not depend on interruptions."""
    paths = [path for path in sorted(folder.glob("[!.]*")) if "seconds-" not in path.name]
    return {path.name: path.read_bytes() for path in paths}


def shards(folder: Path) -> dict[str, bytes]:
    return {name: content for name, content in files(folder).items() if name.startswith("shard-")}


class SlowFile:
    """An unbuffered file that writes content in pieces."""

    def __init__(self, path: Path, mode: str) -> None:
        self._file = open(path, mode, buffering=0)  # noqa: SIM115, closed by __exit__

    def __enter__(self) -> SlowFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, content: bytes) -> int:
        size = -(-len(content) // PIECES)
        for start in range(0, len(content), size):
            self._file.write(content[start : start + size])
            time.sleep(PAUSE_S)
        return len(content)

    def flush(self) -> None:
        self._file.flush()

    def fileno(self) -> int:
        return self._file.fileno()


class Generators:
    """The process that forks. Tests kill its children."""

    def __init__(self, spec_json: str, shard_size: int) -> None:
        root = Path(__file__).parents[1]
        command = [sys.executable, "-m", "tests.generator_process", spec_json, str(shard_size)]
        pinned = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            command, cwd=root, env=pinned, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> Generators:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def _ask(self, *words: object) -> int:
        assert self._process.stdin
        assert self._process.stdout
        print(*words, file=self._process.stdin, flush=True)
        return int(self._process.stdout.readline())

    def start(self, cache: Path, workers: int = 1) -> int:
        """Begin to generate into a cache folder; return the process number."""
        return self._ask("start", cache, workers)

    def wait(self, process: int) -> int:
        """Wait for a process; return its exit status, or minus the signal that killed it."""
        return self._ask("wait", process)


def _serve(spec_json: str, shard_size: int) -> None:
    from mor_bench.snapshots import generate as module
    from mor_bench.snapshots import store
    from mor_bench.specs import DatasetSpec

    spec = DatasetSpec.model_validate_json(spec_json)
    module.SHARD_SIZE = shard_size
    with (
        tempfile.TemporaryDirectory() as folder
    ):  # children inherit the model and the compiled kernels
        module.generate(spec, limit=1, workers=1, cache=Path(folder))
    replaced: Any = store
    replaced.open = SlowFile
    for line in sys.stdin:
        verb, *words = line.split()
        if verb == "wait":
            print(os.waitstatus_to_exitcode(os.waitpid(int(words[0]), 0)[1]), flush=True)
            continue
        child = os.fork()
        if child:
            print(child, flush=True)
            continue
        status = 1
        try:
            module.generate(spec, workers=int(words[1]), cache=Path(words[0]))
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)


if __name__ == "__main__":
    _serve(sys.argv[1], int(sys.argv[2]))
