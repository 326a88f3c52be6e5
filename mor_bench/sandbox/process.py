"""A method's process seen from outside: asked, watched, and ended when it takes too long or too much memory."""

from __future__ import annotations

import json
import os
import pickle
import signal
import socket
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
from mor_bench.sandbox.fork_server import Nursery, environment
from mor_bench.scene.scene import Scene

LOOK_EVERY_S = 0.2
"""Between looks at a process's memory."""

START_LIMIT_S = 120.0

MEMORY_SHARE = 0.75
"""Of the machine's memory, that a method may take unless another limit is given."""


def default_memory_limit_bytes() -> float:
    """What a method's process may take unless another limit is given."""
    return MEMORY_SHARE * float(psutil.virtual_memory().total)


class MethodFailedError(MorBenchError):
    """A method crashed, its process died, or it took more time or memory than it may."""


class Worker:
    """A fresh process of `mor_bench.sandbox.worker`.

    Parameters
    ----------
    scene : Scene or None
    sealed : list of Path
        Folders that the process must not look into.
    folder : Path, optional
        Where a third party's module lies.
    memory_limit_bytes : float
        Resident memory, of the process and its children, at which it is ended.
    nursery : Nursery, optional
        What the process is forked from; otherwise it is a new interpreter.
    open_one : Path, optional
        A folder within the sealed ones that stays open.
    """

    def __init__(
        self,
        scene: Scene | None,
        sealed: list[Path],
        folder: Path | None = None,
        memory_limit_bytes: float = float("inf"),
        nursery: Nursery | None = None,
        open_one: Path | None = None,
    ) -> None:
        self._memory_limit = memory_limit_bytes
        self._said = tempfile.NamedTemporaryFile()  # noqa: SIM115 - closed by `end`
        self._process = _Forked(nursery, self._said.name) if nursery else _Started(self._said)
        self._watched = psutil.Process(self._process.pid)
        self._answers: SimpleQueue[bytes] = SimpleQueue()
        Thread(target=self._listen, daemon=True).start()
        path = [str(folder), *sys.path] if folder else list(sys.path)
        try:
            within = None if open_one is None else str(open_one)
            self.ask(
                "begin",
                START_LIMIT_S,
                path=path,
                scene=scene,
                sealed=[str(item) for item in sealed],
                open_one=within,
            )
        except BaseException:
            self.end()
            raise

    def _listen(self) -> None:
        with suppress(ValueError, OSError):
            for line in self._process.answers:
                self._answers.put(line)
        self._answers.put(b"")

    def ask(self, do: str, within_s: float, /, **request: Any) -> dict[str, Any]:
        """Make a request and wait for its answer.

        Parameters
        ----------
        do : str
            A function of `mor_bench.sandbox.worker.Session`.
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
        with suppress(OSError):  # it has died: said below
            pickle.dump({"do": do, **request}, self._process.requests)
            self._process.requests.flush()
        until = monotonic() + within_s
        while True:
            try:
                line = self._answers.get(timeout=max(0.0, min(LOOK_EVERY_S, until - monotonic())))
                break
            except Empty:
                if monotonic() >= until:
                    self.end()
                    raise MethodFailedError(
                        f"{_DOING.get(do, do)} took longer than the limit of {within_s:g} s"
                    ) from None
                if self._is_dead() and self._answers.empty():  # a child of it may hold the pipe
                    line = b""
                    break
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

    def _is_dead(self) -> bool:
        try:
            return bool(self._watched.status() == psutil.STATUS_ZOMBIE)
        except psutil.Error:
            return True

    def _memory(self) -> int:
        total = 0
        with suppress(psutil.Error):
            for process in [self._watched, *self._watched.children(recursive=True)]:
                total += process.memory_info().rss
        return total

    def _how_it_died(self) -> str:
        code = self._process.exit_code()
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
        if hasattr(os, "killpg"):
            with suppress(OSError):  # what it started without a session of its own
                os.killpg(self._process.pid, signal.SIGKILL)
        with suppress(psutil.Error):
            self._watched.kill()
        self._process.close()
        self._said.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.end()


_DOING = {
    "begin": "starting its process",
    "check": "importing it",
    "fit": "fitting",
    "load": "loading the model",
    "predict": "predicting",
    "warm": "warming up",
    "time": "timing",
    "throughput": "timing batches",
    "cost": "counting the cost",
    "flag": "telling its range",
    "stress": "importing it",
    "stress_case": "the case",
}


class _Started:
    """A new interpreter."""

    def __init__(self, said: Any) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mor_bench.sandbox.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            env=environment(),
            start_new_session=True,
        )
        assert self._process.stdin
        assert self._process.stdout
        self.pid = self._process.pid
        self.requests, self.answers = self._process.stdin, self._process.stdout

    def exit_code(self) -> int:
        return self._process.wait()

    def close(self) -> None:
        self._process.wait()
        for stream in (self.requests, self.answers):
            with suppress(OSError):
                stream.close()


class _Forked:
    """A child of a nursery's server."""

    def __init__(self, nursery: Nursery, said: str) -> None:
        self._nursery = nursery
        self._connection, self.pid = nursery.new_worker(said)
        self.requests, self.answers = (
            self._connection.makefile("wb"),
            self._connection.makefile("rb"),
        )

    def exit_code(self) -> int:
        return self._nursery.exit_code(self.pid)

    def close(self) -> None:
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        for stream in (self.requests, self._connection):
            with suppress(OSError):
                stream.close()
