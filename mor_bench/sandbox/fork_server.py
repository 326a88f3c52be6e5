"""Start processes in milliseconds: a server imports what they need once, then forks.

Importing takes a second, which a comparison of thirty configurations would pay a hundred times.
Each replicate of a timing gets a server of its own, so that replicates share nothing. Linux only;
elsewhere each process is a new interpreter.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Condition, Lock, Thread
from typing import Any, BinaryIO

from mor_bench import errors
from mor_bench.parent_death import (
    adopt_orphans,
    end_descendants,
    end_with_parent,
    wait_for_end,
)
from mor_bench.sandbox.session import Session

CAN_FORK = sys.platform == "linux"

START_S = 120.0
"""Time limit for the server to start, s."""

CHILD_MODULE = "mor_bench.sandbox.child"


def environment() -> dict[str, str]:
    """Return environment variables with which ``python -m`` finds this package."""
    package = str(Path(errors.__file__).parents[1])
    paths = [package, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))}


class ForkServer:
    """The parent's side of a fork server, whose process starts at once.

    Parameters
    ----------
    session : type of Session
        Its `preload` runs in the server before the first fork.
    passive_wait : bool
        Let OpenMP's threads sleep while they wait for each other. Trainings are then two to three
        times faster on a machine with other load; single queries on several threads are slower.
    """

    def __init__(self, session: type[Session], passive_wait: bool = False) -> None:
        self._session = session
        self._exit_codes: dict[int, int] = {}
        self._child_ended = Condition()
        self._restarting = Lock()
        wait = {"OMP_WAIT_POLICY": "passive"} if passive_wait else {}
        self._environment = {**wait, **environment()}
        self._start()

    def _start(self) -> None:
        # A pair of sockets has no path by which a method could ask the server for a process.
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", CHILD_MODULE, str(theirs.fileno()), self._session.path()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                env=self._environment,
                start_new_session=True,
                pass_fds=[theirs.fileno()],
            )
        Thread(target=self._record_exits, args=(self._process.stdout,), daemon=True).start()

    def _record_exits(self, reports: BinaryIO) -> None:
        for line in reports:
            pid, status = map(int, line.split())
            with self._child_ended:
                self._exit_codes[pid] = os.waitstatus_to_exitcode(status)
                self._child_ended.notify_all()

    def fork(self, stderr: BinaryIO) -> tuple[socket.socket, int]:
        """Fork a process whose standard error goes to an open file.

        Returns
        -------
        connection : socket
            For requests and answers.
        pid : int

        Raises
        ------
        MorBenchError
            If the server does not start, or dies.
        """
        with self._restarting:
            if self._process.poll() is not None:  # foreign code has ended it
                self._control.close()
                self._start()
        connection, theirs = socket.socketpair()
        connection.settimeout(START_S)
        pid = b""
        with suppress(OSError), theirs:
            socket.send_fds(self._control, [b"fork"], [theirs.fileno(), stderr.fileno()])
        with suppress(OSError):
            pid = connection.recv(8, socket.MSG_WAITALL)
        if len(pid) < 8:
            connection.close()
            raise errors.MorBenchError(
                "the fork server of the methods' processes does not start, or has died."
            )
        connection.settimeout(None)
        return connection, int.from_bytes(pid, "little")

    def exit_code(self, pid: int, within_s: float = 5.0) -> int:
        """Return the exit code of a forked process; a signal is negative, as in `subprocess`."""
        with self._child_ended:
            self._child_ended.wait_for(lambda: pid in self._exit_codes, within_s)
            return self._exit_codes.get(pid, 1)

    def close(self) -> None:
        """End the server and all forked processes."""
        self._control.close()
        self._process.wait()


def serve(
    control: socket.socket,
    preload: Callable[[], None],
    answer_requests: Callable[[BinaryIO, BinaryIO], Any],
) -> None:
    """Preload, then fork a process for every message on a socket, until the other end closes.

    A message carries two descriptors: the process's connection and its standard error.
    Standard output carries a line ``pid status`` for each forked process that has ended.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    adopt_orphans()
    with wait_for_end(control):
        preload()
    reports = os.dup(1)
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    while True:
        ready = select.select([control.fileno(), woken], [], [])[0]
        if woken in ready:
            os.read(woken, 4096)
            _report_ended(reports)
        if control.fileno() not in ready:
            continue
        message, descriptors, _, _ = socket.recv_fds(control, 16, 2)
        if not message:
            end_descendants()
            os._exit(0)
        server = os.getpid()
        if os.fork() == 0:
            end_with_parent(server)
            os.setsid()  # a signal to the child's process group must not reach the server
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            control.close()
            for descriptor in (reports, woken, wake):
                os.close(descriptor)
            os.dup2(descriptors[1], 2)
            os.close(descriptors[1])
            connection = socket.socket(fileno=descriptors[0])
            connection.sendall(os.getpid().to_bytes(8, "little"))
            answer_requests(connection.makefile("rb"), connection.makefile("wb"))
        for descriptor in descriptors:
            os.close(descriptor)


def _report_ended(reports: int) -> None:
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            return
        with suppress(OSError):
            os.write(reports, f"{pid} {status}\n".encode())
