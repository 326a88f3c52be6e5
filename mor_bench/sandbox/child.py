"""The main loop of a sandboxed process, in which a session answers the parent's requests.

Requests come pickled from the parent, which is trusted. Answers go back as JSON, since foreign code
may have touched them.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import socket
import sys
import sysconfig
import tempfile
import warnings
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from traceback import walk_tb
from typing import Any, BinaryIO

from mor_bench.errors import MorBenchError, printable, text_of
from mor_bench.parent_death import end_with_pipe
from mor_bench.sandbox.seal import Restrictions, seal
from mor_bench.sandbox.session import Session, session_class

LIBRARIES = tuple(
    f"{sysconfig.get_path(part)}{os.sep}" for part in ("stdlib", "purelib", "platlib")
)
"""Folders of the standard library and of installed packages."""


class _Child:
    """The process's session, and how requests reach it."""

    session: Session

    def start(
        self,
        session: str,
        arguments: dict[str, Any],
        import_path: list[str],
        restrictions: Restrictions,
    ) -> dict[str, Any]:
        """Import the session class, seal the process, and make the session."""
        made_by = session_class(session)
        seal(restrictions)
        if restrictions.scratch is not None:
            os.environ["TMPDIR"] = tempfile.tempdir = str(restrictions.scratch)
            os.environ.pop("TORCHINDUCTOR_CACHE_DIR", None)  # where it may not write
        sys.path[:] = import_path
        self.session = made_by(**arguments)
        return {}

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the result of a request, or its error, and its warnings."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            try:
                name = request.pop("do")
                answer = (self.start if name == "start" else getattr(self.session, name))(**request)
            except MorBenchError as error:
                answer = {"error": type(error).__name__, "message": _shown(error)}
            except (Exception, SystemExit) as error:  # foreign code runs here
                answer = {"error": None, "message": crash(error)}
        notes = [_shown(w.message) for w in caught if issubclass(w.category, UserWarning)]
        return {**answer, "warnings": list(dict.fromkeys(notes))}


def crash(error: BaseException) -> str:
    """Describe an error and its location, if possible outside installed packages."""
    places = [(frame.f_code.co_filename, line) for frame, line in walk_tb(error.__traceback__)]
    own = [place for place in places if not place[0].startswith(("<", *LIBRARIES))]
    file, line = (own or places)[-1]
    where = f"{Path(file).name}, line {line}"
    return _shown(f"crashed with {type(error).__name__}: {text_of(error)} ({where})")


def _shown(error: object) -> str:
    """Return the text of an error with every character that UTF-8 cannot hold replaced."""
    return printable(str(error).encode("utf-8", "replace").decode())


def _read(requests: BinaryIO, queue: SimpleQueue[dict[str, Any]]) -> None:
    while True:
        queue.put(_next(requests))


def _next(requests: BinaryIO) -> dict[str, Any]:
    """Return the next request. End the process at once when the parent is gone."""
    try:
        request: dict[str, Any] = pickle.load(requests)
    except (EOFError, OSError):
        os._exit(1)
    return request


def answer_requests(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests until the parent closes the pipe. Prints go to standard error."""
    # A terminal interrupts all processes; the parent ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(2, 1)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    queue: SimpleQueue[dict[str, Any]] = SimpleQueue()
    reader = Thread(target=_read, args=(requests, queue), daemon=True)
    child, process = _Child(), os.getpid()
    # The first request seals this thread. Only then may another start, which the seal covers too.
    request = _next(requests)
    while True:
        answer = child.answer(request)
        if os.getpid() != process:  # foreign code has forked, and this is the copy
            os._exit(0)
        answers.write(json.dumps(answer).encode() + b"\n")
        answers.flush()
        if reader.ident is None:
            reader.start()
        request = queue.get()


def main() -> None:
    """Answer requests on standard input.

    With the descriptor of a pipe as argument, end when its other end closes. With a socket's
    descriptor and a session class as arguments, serve forks instead.
    """
    if len(sys.argv) == 3:
        from mor_bench.sandbox.fork_server import serve

        control = socket.socket(fileno=int(sys.argv[1]))
        # Importing the class takes seconds, in which the parent may die.
        serve(control, lambda: session_class(sys.argv[2]).preload(), answer_requests)
    else:
        if len(sys.argv) == 2:
            end_with_pipe(int(sys.argv[1]))
        answer_requests(os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb"))


if __name__ == "__main__":
    main()
