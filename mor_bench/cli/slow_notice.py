"""A line for commands that are silent for more than a second or two."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from threading import Timer

from mor_bench.cli.console import console_width
from mor_bench.report.line_wrapping import wrapped

SILENT_S = 1.5
"""Time after which a command says that it works, s."""


@contextmanager
def notice_if_slow(
    text: str, say: Callable[[str], object] | None = None, *, quiet: bool = False
) -> Iterator[Callable[[], None]]:
    """Print a line if the body takes long, unless the body calls the function that it gets.

    Parameters
    ----------
    text : str
    say : callable, optional
        Prints the line; by default to standard error.
    quiet : bool
        Print nothing.
    """

    def print_text() -> None:
        with suppress(OSError, ValueError):  # the stream may be closed
            if say is not None:
                say(text)
            else:
                print(*wrapped(text, console_width()), sep="\n", file=sys.stderr, flush=True)

    timer = Timer(SILENT_S, print_text)
    timer.daemon = True
    if not quiet:
        timer.start()
    try:
        yield timer.cancel
    finally:
        timer.cancel()
