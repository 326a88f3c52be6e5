"""Fresh processes in milliseconds: a server imports what all methods need, once, and forks a worker whenever it is asked.

Importing takes a second, which a comparison of thirty configurations would pay a hundred times. Two servers share
nothing: for each replicate of a timing there is a new one. Linux only; elsewhere every worker is a new interpreter.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from threading import Condition, Lock, Thread
from time import monotonic, sleep
from typing import Any, BinaryIO

from mor_bench import errors

CAN_FORK = sys.platform == "linux"

START_S = 120.0


def environment() -> dict[str, str]:
    """The parent's, with its own package first: ``-m`` must find the same one."""
    package = str(Path(errors.__file__).parents[1])
    paths = [package, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))}


class Nursery:
    """The parent's side of a server. Started at once; ready when it is first needed.

    Parameters
    ----------
    yielding : bool
        Let OpenMP's threads sleep while they wait for each other. On a machine that does other things too a training is
        two to three times faster so; single queries on several threads are slower.
    """

    def __init__(self, yielding: bool = False) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="mor-bench-")
        self._path = os.path.join(self._folder.name, "s")
        self._ended: dict[int, int] = {}
        self._news = Condition()
        self._lock = Lock()
        self._environment = {
            **({"OMP_WAIT_POLICY": "passive"} if yielding else {}),
            **environment(),
        }
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mor_bench.sandbox.worker", self._path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=self._environment,
            start_new_session=True,
        )
        Thread(target=self._listen, args=(self._process.stdout,), daemon=True).start()

    def _listen(self, news: BinaryIO) -> None:
        """Take down how workers ended."""
        for line in news:
            pid, status = map(int, line.split())
            with self._news:
                self._ended[pid] = os.waitstatus_to_exitcode(status)
                self._news.notify_all()

    def new_worker(self, said: str) -> tuple[socket.socket, int]:
        """A connection to a new worker, and its process id; its standard error goes to a file."""
        with self._lock:
            if self._process.poll() is not None:  # a method has ended it
                Path(self._path).unlink(missing_ok=True)
                self._start()
        until = monotonic() + START_S
        connection = socket.socket(socket.AF_UNIX)
        while True:
            try:
                connection.connect(self._path)
                break
            except (FileNotFoundError, ConnectionRefusedError):
                if monotonic() > until or self._process.poll() is not None:
                    raise errors.MorBenchError(
                        "the server that methods' processes are forked from does not start."
                    ) from None
                sleep(0.02)
        connection.sendall(said.encode() + b"\n")
        return connection, int.from_bytes(_exactly(connection, 8), "little")

    def exit_code(self, pid: int, within_s: float = 5.0) -> int:
        """How a worker ended, as `subprocess` has it."""
        with self._news:
            self._news.wait_for(lambda: pid in self._ended, within_s)
            return self._ended.get(pid, 1)

    def close(self) -> None:
        """End the server; its workers end with their connections."""
        assert self._process.stdin
        with suppress(OSError):
            self._process.stdin.close()
        self._process.wait()
        self._folder.cleanup()


def _exactly(connection: socket.socket, n: int) -> bytes:
    received = b""
    while len(received) < n:
        part = connection.recv(n - len(received))
        if not part:
            raise errors.MorBenchError(
                "the server that methods' processes are forked from has died."
            )
        received += part
    return received


PRELOADED = (
    "sklearn.linear_model",
    "mor_bench.measure.query_cost",
    "mor_bench.sandbox.handover",
    "mor_bench.machine",
    "mor_bench.surrogates.fem",
    "mor_bench.surrogates.deim",
    "mor_bench.surrogates.ecm",
    "mor_bench.surrogates.hpod",
    "mor_bench.surrogates.pca_regression",
    "mor_bench.surrogates.pod",
)
"""What methods import: no fit's time holds an import. PyTorch is not among it, since few need it and it takes two seconds."""


def _preload() -> None:
    """Import what methods import, and load the compiled kernels by solving once."""
    import numpy as np

    for module in PRELOADED:
        import_module(module)
    from mor_bench.machine import pinned_threads
    from mor_bench.scene.scene import load_scene
    from mor_bench.surrogates.fem import FullFEM

    with pinned_threads(1):
        scene = load_scene("beam-tiny")
        force = np.zeros((scene.mesh.n_nodes, 3))
        force[-1] = 0.1
        FullFEM().fit(scene).predict(force)


def serve(path: str, work: Callable[[BinaryIO, BinaryIO], Any]) -> None:
    """Fork a worker for every connection, tell on standard output how each ended, and end with standard input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _preload()
    news = os.dup(1)
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen(64)
    while True:
        ready = select.select([listener.fileno(), 0, woken], [], [])[0]
        if woken in ready:
            os.read(woken, 4096)
            _tell_ended(news)
        if 0 in ready and not os.read(0, 1):
            os._exit(0)
        if listener.fileno() in ready:
            connection, _ = listener.accept()
            said = b""
            while not said.endswith(b"\n") and (part := connection.recv(4096)):
                said += part
            if said.endswith(b"\n") and os.fork() == 0:
                os.setsid()  # what a method does to its process group is done to its own
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for descriptor in (listener.fileno(), news, woken, wake):
                    os.close(descriptor)
                errors_to = os.open(said.strip(), os.O_WRONLY)
                os.dup2(errors_to, 2)
                connection.sendall(os.getpid().to_bytes(8, "little"))
                work(connection.makefile("rb"), connection.makefile("wb"))
            connection.close()


def _tell_ended(news: int) -> None:
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            return
        os.write(news, f"{pid} {status}\n".encode())
