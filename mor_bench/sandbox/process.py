"""The parent's side of a sandboxed process: requests, and limits of time and memory."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from threading import Event, Thread, get_ident
from time import monotonic
from typing import Any, BinaryIO, Self, TypeVar

import psutil
from pydantic import ValidationError

from mor_bench import errors
from mor_bench.checked_files import parse_json
from mor_bench.errors import MorBenchError, StoreError
from mor_bench.machine import SIGNAL_CHECK_S, memory_limit_bytes
from mor_bench.sandbox.fork_server import CHILD_MODULE, ForkServer, environment
from mor_bench.sandbox.seal import Restrictions
from mor_bench.sandbox.session import Answer, Session

MEMORY_CHECK_S = 0.2
"""Interval between checks of a process's memory, s."""

START_LIMIT_S = 120.0
"""Time limit for a process to start, s."""

MOST_ANSWER_BYTES, MOST_WAITING = 64 * 2**20, 4
"""Largest answer, and number of unread answers; a process that sends more is not read on."""

MOST_LAST_WORDS = 2**14
"""Bytes at the end of the standard error output of a dead process that are read."""

MEMORY_SHARE = 0.75
"""Default memory limit of a method, as a share of the memory of the machine or container."""


def default_memory_limit_bytes() -> float:
    """Return the default memory limit of a method."""
    return MEMORY_SHARE * memory_limit_bytes()


_R = TypeVar("_R")

_ALIVE: set[SandboxedProcess] = set()


class StoppableThreads(ThreadPoolExecutor):
    """A pool of threads that a signal can interrupt at any time."""

    def in_order(self, function: Callable[..., _R], /, *arguments: Iterable[Any]) -> Iterator[_R]:
        """Return an iterator over the results in the order of the arguments."""
        futures = [self.submit(function, *items) for items in zip(*arguments, strict=False)]

        def results() -> Iterator[_R]:
            try:
                for future in futures:
                    while not wait([future], timeout=SIGNAL_CHECK_S).done:
                        pass
                    yield future.result()
            finally:
                for future in futures:
                    future.cancel()

        return results()


@contextmanager
def stoppable_threads(n: int) -> Iterator[StoppableThreads]:
    """Open a pool of threads that wait for processes which they start.

    After an error in the body, such as an interrupt, these processes are ended, because a fit may
    last an hour and the pool waits for its threads.
    """
    own: set[int] = set()
    executor = StoppableThreads(n, initializer=lambda: own.add(get_ident()))
    stop, left = Event(), Event()

    def end_processes() -> None:
        stop.wait()
        while not left.wait(0.05):
            for process in [item for item in tuple(_ALIVE) if item.thread in own]:
                process.end()

    # It starts first, since later there may be no memory for another thread.
    Thread(target=end_processes, daemon=True).start()
    try:
        yield executor
    except BaseException:
        stop.set()
        executor.shutdown(cancel_futures=True)
        raise
    finally:
        executor.shutdown()
        left.set()
        stop.set()


class MethodFailedError(MorBenchError):
    """A method crashed, its process died, or it exceeded its limit of time or memory."""


class _Error(Answer):
    error: str | None
    message: str


def parsed_answer(line: bytes, session: type[Session], do: str) -> dict[str, Any]:
    """Parse the answer to a request, which foreign code may have forged.

    Raises
    ------
    MethodFailedError
        If it is neither an error nor an answer to this request.
    """
    try:
        answer: dict[str, Any] = parse_json(line, "answer")
        kind = _Error if "error" in answer else session.answers.get(do, Answer)
        kind.model_validate(answer)
    except (StoreError, TypeError, ValidationError):
        raise MethodFailedError("the method wrote to its result pipe") from None
    return answer


def _signal_name(number: int) -> str:
    with suppress(ValueError):  # real-time signals have no names
        return signal.Signals(number).name
    return f"signal {number}"


class SandboxedProcess:
    """A fresh process that runs a session.

    Parameters
    ----------
    session : type of Session
        Class that answers the requests.
    restrictions : Restrictions
    fork_server : ForkServer, optional
        Fork the process from it; by default the process is a new interpreter.
    **arguments
        Keyword arguments of the session.

    Raises
    ------
    MethodFailedError
        If the process does not start.
    """

    def __init__(
        self,
        session: type[Session],
        restrictions: Restrictions = Restrictions(),
        fork_server: ForkServer | None = None,
        **arguments: Any,
    ) -> None:
        self._session, self._memory_limit = session, restrictions.memory_bytes
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `end`
        self._process = (
            _Forked(fork_server, self._stderr) if fork_server else _Spawned(self._stderr)
        )
        self._watched = psutil.Process(self._process.pid)
        self.thread = get_ident()
        _ALIVE.add(self)
        self._answers: SimpleQueue[bytes] = SimpleQueue()
        Thread(target=self._read_answers, daemon=True).start()
        folder = restrictions.import_from
        try:
            self.ask(
                "start",
                START_LIMIT_S,
                session=session.path(),
                arguments=arguments,
                import_path=[*([str(folder)] if folder else []), *sys.path],
                restrictions=restrictions,
            )
        except BaseException:
            self.end()
            raise

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def _read_answers(self) -> None:
        with suppress(ValueError, OSError):
            while line := self._process.answers.readline(MOST_ANSWER_BYTES):
                self._answers.put(line)
                if not line.endswith(b"\n") or self._answers.qsize() > MOST_WAITING:
                    break
        self._answers.put(b"")

    def ask(self, do: str, within_s: float, /, **request: Any) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Parameters
        ----------
        do : str
            A public method of the session.
        within_s : float
            Time limit, s; the process is ended when it is exceeded.
        **request
            The method's arguments.

        Raises
        ------
        MethodFailedError
            If the session crashes, or its process dies or is ended.
        MorBenchError
            If the session raised one, with the same type and text.
        """
        with suppress(OSError):  # a dead process is noticed while waiting
            pickle.dump({"do": do, **request}, self._process.requests)
            self._process.requests.flush()
        line = self._wait_for_answer(do, within_s)
        if not line:
            raise MethodFailedError(self._cause_of_death())
        try:
            answer = parsed_answer(line, self._session, do)
        except MethodFailedError:
            self.end()
            raise
        if "error" not in answer:
            return answer
        kind = getattr(errors, answer["error"] or "", None)
        if isinstance(kind, type) and issubclass(kind, MorBenchError):
            raise kind(answer["message"])
        raise MethodFailedError(answer["message"])

    def _wait_for_answer(self, do: str, within_s: float) -> bytes:
        """Return the next answer, empty if the process died; enforce the limits meanwhile."""
        until = monotonic() + within_s
        activity = "starting its process" if do == "start" else self._session.activities.get(do, do)
        while True:
            try:
                return self._answers.get(timeout=max(0.0, min(MEMORY_CHECK_S, until - monotonic())))
            except Empty:
                if monotonic() >= until:
                    self.end()
                    raise MethodFailedError(
                        f"{activity} took longer than the limit of {within_s:g} s"
                    ) from None
                # Checked here too, since a child of the process may keep the pipe open.
                if self._is_dead() and self._answers.empty():
                    return b""
                if (used := self._memory_bytes()) > self._memory_limit:
                    self.end()
                    raise MethodFailedError(
                        f"{activity} took more memory than the limit: "
                        f"{used / 1e9:.3g} GB of {self._memory_limit / 1e9:.3g} GB"
                    ) from None

    def _is_dead(self) -> bool:
        try:
            return bool(self._watched.status() == psutil.STATUS_ZOMBIE)
        except psutil.Error:
            return True

    def _memory_bytes(self) -> int:
        total = 0
        with suppress(psutil.Error):
            for process in [self._watched, *self._watched.children(recursive=True)]:
                total += process.memory_info().rss
        return total

    def _cause_of_death(self) -> str:
        code = self._process.exit_code()
        size = self._stderr.seek(0, os.SEEK_END)
        self._stderr.seek(max(0, size - MOST_LAST_WORDS))
        words = self._stderr.read(MOST_LAST_WORDS).decode(errors="replace")
        lines = words.strip().splitlines()
        last = f": {lines[-1]}" if lines else ""
        if code < 0:
            return f"its process died of {_signal_name(-code)}{last}"
        return f"its process ended with code {code}{last}"

    def end(self) -> None:
        """End the process and all that it started."""
        _ALIVE.discard(self)
        with suppress(psutil.Error):
            for process in self._watched.children(recursive=True):
                with suppress(psutil.Error):
                    process.kill()
        if hasattr(os, "killpg"):
            with suppress(OSError):  # orphans that stayed in its process group
                os.killpg(self.pid, signal.SIGKILL)
        with suppress(psutil.Error):
            self._watched.kill()
        self._process.close()
        self._stderr.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


class _Spawned:
    """A new interpreter."""

    def __init__(self, stderr: BinaryIO) -> None:
        # It closes when this process ends, however it ends.
        reading, life = os.pipe()
        self._life = os.fdopen(life, "wb")
        inherited = (reading,) if sys.platform == "linux" else ()
        self._process = subprocess.Popen(
            [sys.executable, "-m", CHILD_MODULE, *map(str, inherited)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            env=environment(),
            start_new_session=True,
            pass_fds=inherited,
        )
        os.close(reading)
        assert self._process.stdin
        assert self._process.stdout
        self.pid = self._process.pid
        self.requests, self.answers = self._process.stdin, self._process.stdout

    def exit_code(self) -> int:
        return self._process.wait()

    def close(self) -> None:
        self._process.wait()
        for stream in (self._life, self.requests, self.answers):
            with suppress(OSError):
                stream.close()


class _Forked:
    """A process forked from a server."""

    def __init__(self, fork_server: ForkServer, stderr: BinaryIO) -> None:
        self._fork_server = fork_server
        self._connection, self.pid = fork_server.fork(stderr)
        self.requests = self._connection.makefile("wb")
        self.answers = self._connection.makefile("rb")

    def exit_code(self) -> int:
        return self._fork_server.exit_code(self.pid)

    def close(self) -> None:
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        for stream in (self.requests, self._connection):
            with suppress(OSError):
                stream.close()
