"""End a process when its parent has died, whatever the process does at that moment."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Thread

if sys.platform == "linux":
    import fcntl

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36


def adopt_orphans() -> None:
    """Become the parent of every process that a descendant leaves behind; Linux only."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def end_descendants() -> None:
    """End all that this process and its descendants have started."""
    import psutil  # here, because its import takes 10 ms

    while left := psutil.Process().children(recursive=True):
        for process in left:
            with suppress(psutil.Error):
                process.kill()
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


def end_with_parent(parent: int) -> None:
    """Let the kernel end this process with the thread that started it; Linux only.

    Parameters
    ----------
    parent : int
        The parent's process number; if it has died already, this process ends now.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def end_with_pipe(reading: int) -> None:
    """Let the kernel end this process when the other end of a pipe closes; Linux only.

    It needs no thread of this process, so foreign code that holds Python's lock does not delay it.
    If this process leads a process group, the whole group ends.
    """
    if sys.platform != "linux":
        return
    process = os.getpid()
    fcntl.fcntl(reading, fcntl.F_SETOWN, -process if os.getpgrp() == process else process)
    fcntl.fcntl(reading, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(reading, fcntl.F_SETFL, fcntl.fcntl(reading, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([reading], [], [], 0.0)[0]:  # nothing is ever written: it has closed already
        os._exit(1)


@contextmanager
def wait_for_end(control: socket.socket) -> Iterator[None]:
    """End this process as soon as the other end of a socket closes, while the body runs."""
    stopped, stop = os.pipe()
    events = select.poll()
    events.register(control, 0)  # waits for the end only, not for requests
    events.register(stopped, 0)

    def watch() -> None:
        if events.poll()[0][0] != stopped:
            os._exit(1)

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.close(stop)
        thread.join()
        os.close(stopped)
