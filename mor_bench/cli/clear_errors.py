"""One line on standard error, and an exit code, for errors, signals and closed streams."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Timer, current_thread, main_thread
from types import FrameType
from typing import TYPE_CHECKING

import typer

from mor_bench.errors import MorBenchError, UnknownNameError, printable

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

KEPT = (
    "Finished samples and rows are kept. "
    "Repeat the command with the same --out to continue a run. "
    "A training resumes from its last checkpoint."
)

ENDING = ("SIGTERM", "SIGHUP")
"""Signals that stop a command as an interrupt does."""

LATER_S = 0.05
"""Time after which a signal is sent again whose exception was dropped, s."""

NO_THREAD = "can't start new thread"
"""Message of the `RuntimeError` by which Python reports that there is no memory for a thread."""


class StoppedBySignal(BaseException):
    """A signal asks this process to end; ``number`` names the signal.

    It is no `KeyboardInterrupt`, which Typer turns into an exit code of its own.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextmanager
def clear_errors() -> Iterator[None]:
    """Exit with code 2 after an error of mor-bench or a file, and with 128 + n after signal n."""
    try:
        with _signals_as_interrupts():
            yield
            sys.stdout.flush()
    except UnknownNameError as error:
        _exit(str(error), "red", 2, _known(error))
    except MorBenchError as error:
        _exit(str(error), "red", 2)
    except BrokenPipeError:
        _forget_output()
        raise SystemExit(128 + 13) from None  # as a program that SIGPIPE ends
    except OSError as error:
        where = error.filename
        if not where:  # mor-bench names the files that it writes
            _forget_output()
            where = "standard output or a temporary file"
        _exit(f"{where}: {error.strerror or error}", "red", 2)
    except ImportError as error:  # an incomplete installation, or no memory for a library
        _exit(f"a library cannot be loaded: {error}", "red", 2)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and str(error) != NO_THREAD:
            raise
        _exit(f"memory is short{f': {error}' if str(error) else ''}. {KEPT}", "red", 2)
    except StoppedBySignal as stop:
        exit_by_signal(stop)
    except KeyboardInterrupt:
        _exit(f"stopped. {KEPT}", "yellow", 130)


def exit_by_signal(stop: StoppedBySignal) -> None:
    """Say which signal ended the command, and exit with 128 + its number."""
    by = f" by {signal.Signals(stop.number).name}"
    _exit(f"stopped{by}. {KEPT}", "yellow", 128 + stop.number)


@contextmanager
def _signals_as_interrupts() -> Iterator[None]:
    """Raise `StoppedBySignal` at the first signal; ignored signals, as under nohup, stay so.

    Python drops an exception that arises in a finaliser, and says so. A signal may come just then,
    since each import runs a finaliser: it is sent again.
    """

    def stop(number: int, _: FrameType | None) -> None:
        for other in (*caught, signal.SIGINT):
            signal.signal(other, signal.SIG_IGN)  # the clean-up takes a moment
        raise StoppedBySignal(number)

    def send_again(dropped: UnraisableHookArgs, /) -> None:
        if isinstance(dropped.exc_value, StoppedBySignal):
            number = dropped.exc_value.number
            signal.signal(number, stop)
            Timer(LATER_S, os.kill, (os.getpid(), number)).start()
        else:
            known(dropped)

    present = [getattr(signal, name) for name in ENDING if hasattr(signal, name)]
    caught = [number for number in present if signal.getsignal(number) == signal.SIG_DFL]
    if current_thread() is not main_thread():
        caught = []
    for number in caught:
        signal.signal(number, stop)
    known = sys.unraisablehook
    if caught:
        sys.unraisablehook = send_again
    try:
        yield
    finally:
        for number in caught:
            signal.signal(number, signal.SIG_DFL)
        sys.unraisablehook = known


def open_streams() -> None:
    """Connect closed standard streams to nothing, and let odd letters never raise.

    A file that is opened later would otherwise become standard output.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            with suppress(OSError):
                os.fstat(number)
                continue
            nothing = os.open(os.devnull, os.O_RDWR)
            if nothing != number:
                os.dup2(nothing, number)
                os.close(nothing)
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        # On Windows, the encodings of files and pipes lack letters such as ē.
        if reconfigure := getattr(stream, "reconfigure", None):
            reconfigure(errors="replace")


def _forget_output() -> None:
    """Drop what could not be written, so that Python does not try again when it ends."""
    with suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)


def _known(error: UnknownNameError) -> list[str]:
    """Return the names that exist, for a reader at a terminal; a program gets one line."""
    if not sys.stderr.isatty():
        return []
    from mor_bench.cli.console import console_width  # slow to import
    from mor_bench.cli.known_names import known_lines

    return [printable(line, keep="") for line in known_lines(error, console_width())]


def _exit(message: str, colour: str, code: int, more: Sequence[str] = ()) -> None:
    with suppress(OSError):  # the terminal may be gone
        typer.secho(f"mor-bench: {printable(message, keep='')}", fg=colour, err=True)
        for line in more:
            typer.echo(line, err=True)
    raise SystemExit(code) from None
