"""A method's process seen from outside: asked, watched, and ended when it takes too long or too much memory."""

from __future__ import annotations

import json
import pickle
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from time import monotonic
from types import TracebackType
from typing import Any, Self

import psutil

from mor_bench import errors
from mor_bench.errors import MorBenchError
from mor_bench.scene.scene import Scene

LOOK_EVERY_S = 0.2
"""Between looks at a process's memory."""

START_LIMIT_S = 120.0


class MethodFailedError(MorBenchError):
    """A method crashed, its process died, or it took more time or memory than it may."""


class Worker:
    """A fresh Python process of `mor_bench.harness.worker`.

    Parameters
    ----------
    scene : Scene or None
    sealed : list of Path
        Folders that the process must not look into.
    folder : Path, optional
        Where a third party's module lies.
    memory_limit_bytes : float
        Resident memory, of the process and its children, at which it is ended.
    """

    def __init__(self, scene: Scene | None, sealed: list[Path], folder: Path | None = None, memory_limit_bytes: float = float("inf")) -> None:
        self._memory_limit = memory_limit_bytes
        self._said = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mor_bench.harness.worker"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said, env=_environment(),
        )  # fmt: skip
        self._watched = psutil.Process(self._process.pid)
        self._answers: SimpleQueue[bytes] = SimpleQueue()
        Thread(target=self._listen, daemon=True).start()
        path = [str(folder), *sys.path] if folder else list(sys.path)
        try:
            self.ask("begin", START_LIMIT_S, path=path, scene=scene, sealed=[str(item) for item in sealed])
        except BaseException:
            self.end()
            raise

    def _listen(self) -> None:
        assert self._process.stdout
        with suppress(ValueError, OSError):
            for line in self._process.stdout:
                self._answers.put(line)
        self._answers.put(b"")

    def ask(self, do: str, within_s: float, /, **request: Any) -> dict[str, Any]:
        """Make a request and wait for its answer.

        Parameters
        ----------
        do : str
            A function of `mor_bench.harness.worker.Session`.
        within_s : float
            Seconds until the process is ended.
        **request
            The function's arguments.

        Raises
        ------
        MethodFailedError
            If the method crashes, or its process dies or is ended.
        MorBenchError
            Of the kind that the method raised.
        """
        assert self._process.stdin
        with suppress(BrokenPipeError, OSError):  # it has died: said below
            pickle.dump({"do": do, **request}, self._process.stdin)
            self._process.stdin.flush()
        until = monotonic() + within_s
        while True:
            try:
                line = self._answers.get(timeout=max(0.0, min(LOOK_EVERY_S, until - monotonic())))
                break
            except Empty:
                if monotonic() >= until:
                    self.end()
                    raise MethodFailedError(f"{_DOING.get(do, do)} took longer than the limit of {within_s:g} s") from None
                if (used := self._memory()) > self._memory_limit:
                    self.end()
                    raise MethodFailedError(
                        f"{_DOING.get(do, do)} took more memory than the limit: {used / 1e9:.3g} GB of {self._memory_limit / 1e9:.3g} GB"
                    ) from None
        if not line:
            raise MethodFailedError(self._how_it_died())
        try:
            answer: dict[str, Any] = json.loads(line)
        except ValueError:
            self.end()
            raise MethodFailedError("it wrote into the pipe of its answers") from None
        if "error" not in answer:
            return answer
        kind = getattr(errors, answer["error"] or "", None)
        if isinstance(kind, type) and issubclass(kind, MorBenchError):
            raise kind(answer["message"])
        raise MethodFailedError(answer["message"])

    def _memory(self) -> int:
        total = 0
        with suppress(psutil.Error):
            for process in [self._watched, *self._watched.children(recursive=True)]:
                total += process.memory_info().rss
        return total

    def _how_it_died(self) -> str:
        code = self._process.wait()
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        last = f": {lines[-1]}" if lines else ""
        if code < 0:
            return f"its process died of {signal.Signals(-code).name}{last}"
        return f"its process ended with code {code}{last}"

    def end(self) -> None:
        """End the process and all that it started."""
        with suppress(psutil.Error):
            for process in self._watched.children(recursive=True):
                with suppress(psutil.Error):
                    process.kill()
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._said):
            if stream:
                with suppress(OSError):
                    stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.end()


_DOING = {"begin": "starting its process", "check": "importing it", "fit": "fitting", "load": "loading the model", "predict": "predicting",
          "warm": "warming up", "time": "timing", "throughput": "timing batches", "cost": "counting the cost"}  # fmt: skip


def _environment() -> dict[str, str]:
    """The parent's, with its own package first: `-m` must find the same one."""
    import os

    package = str(Path(errors.__file__).parents[1])
    paths = [package, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))}
