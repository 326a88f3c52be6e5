"""The console that tables and progress are printed to."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from rich.console import Console

from mor_bench.report.line_wrapping import wrapped

DEFAULT_WIDTH, LEAST_WIDTH = 80, 40
"""Width without a terminal, and the least width that tables are fitted to, in characters."""

MOST_DIGITS = 5
"""Digits of a width in COLUMNS; a longer number is ignored."""


def make_console(stderr: bool = False, quiet: bool = False) -> Console:
    """Make a console for standard output or standard error; a quiet one prints nothing."""
    return Console(stderr=stderr, quiet=quiet, width=console_width())


def console_width() -> int:
    """Return the environment's COLUMNS, else the width of the terminal, also beside a pipe."""
    given = os.environ.get("COLUMNS", "")
    if given.isdecimal() and len(given) <= MOST_DIGITS and int(given) > 0:
        return max(int(given), LEAST_WIDTH)
    for stream in (sys.stdout, sys.stderr, sys.stdin):
        with suppress(OSError, ValueError, AttributeError):
            if columns := os.get_terminal_size(stream.fileno()).columns:
                return max(columns, LEAST_WIDTH)
    return DEFAULT_WIDTH


def print_wrapped(text: str, indent: str = "  ") -> None:
    """Print a text in lines of this width that end between words; later lines are indented."""
    print(*wrapped(text, console_width(), indent), sep="\n")
