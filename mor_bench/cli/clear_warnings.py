"""One line on standard error for each warning of mor-bench, without its place in the code."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

import typer

from mor_bench import errors
from mor_bench.errors import printable


@contextmanager
def clear_warnings() -> Iterator[None]:
    """Print each of mor-bench's own warnings once, as ``warning: TEXT``; leave others alone."""
    known, said = warnings.showwarning, set[str]()

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if category.__module__ != errors.__name__ or file is not None:
            known(message, category, filename, lineno, file, line)
            return
        text = printable(" ".join(str(message).split()), keep="")
        if text not in said:
            said.add(text)
            with suppress(OSError, ValueError):  # the stream may be closed
                typer.secho(f"warning: {text}", file=sys.stderr, fg="yellow")

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = known
