"""One line on standard error, and an exit code, for every error that is raised on purpose."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer

from mor_bench.errors import MorBenchError, printable

STOPPED = (
    "stopped; finished samples and rows are kept. "
    "Repeat the command with the same --out to continue a run. "
    "A training resumes from its last checkpoint."
)


@contextmanager
def clear_errors() -> Iterator[None]:
    """Exit with code 2 after an error of mor-bench or a file, and with 130 after an interrupt."""
    try:
        yield
    except MorBenchError as error:
        _exit(str(error), "red", 2)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _exit(f"{place}{error.strerror or error}", "red", 2)
    except KeyboardInterrupt:
        _exit(STOPPED, "yellow", 130)


def _exit(message: str, colour: str, code: int) -> None:
    typer.secho(f"mor-bench: {printable(message)}", fg=colour, err=True)
    raise typer.Exit(code) from None
