"""Progress bars of generation and of a single training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.runs.listener import Listener

PRINT_EVERY_S = 10.0
"""Interval between printed lines of progress if there is no terminal for a bar, s."""

PREPARING = "Preparing; large meshes, large datasets and a first compilation take a minute."


@contextmanager
def show_progress(console: Console, *, quiet: bool = False) -> Iterator[Listener]:
    """Show the progress of a generation or a fit."""
    if quiet:
        yield Listener()
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with ExitStack() as stack:
        progress = stack.enter_context(Progress(*columns, console=console, transient=True))
        spoken = stack.enter_context(notice_if_slow(PREPARING, partial(print_plain, console)))
        bars = _Bars(progress, spoken)
        yield Listener(generating=bars.generating, training=bars.training)


@dataclass
class _Bars:
    progress: Progress
    spoken: Callable[[], None]
    """Called when a line or bar is shown."""

    tasks: dict[str, TaskID] = field(default_factory=dict)
    begun: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Number done and time at the first call: earlier work does not count for the rate."""

    printed_at: dict[str, float] = field(default_factory=dict)

    def generating(self, dataset: str, done: int, total: int) -> None:
        now = perf_counter()
        self._begin(dataset, f"samples of {escape(dataset)}", done, total)
        before, since = self.begun[dataset]
        rate = (done - before) / (now - since) if done > before else 0.0
        self._update(dataset, done, rate=f"{rate:.1f}/s" if rate else "")
        if rate and self._is_due(dataset, now, done == total):
            left = (total - done) / rate
            self._print(
                f"{dataset}: {done:,} of {total:,} samples, {rate:.1f}/s, {left:.0f} s left"
            )

    def training(self, done: int, total: int, loss: float) -> None:
        self._begin("training", "training", done, total)
        self._update("training", done, rate=f"loss {loss:.3g}")
        if self._is_due("training", perf_counter()):
            self._print(f"training: {done:,} of {total:,} iterations, loss {loss:.3g}")

    def _begin(self, name: str, description: str, done: int, total: int) -> None:
        if self.progress.console.is_terminal:
            self.spoken()
        if name not in self.tasks:
            self.tasks[name] = self.progress.add_task(
                description, total=total, completed=done, rate=""
            )
            now = perf_counter()
            self.begun[name] = done, now
            self.printed_at[name] = now

    def _update(self, name: str, done: int, **fields: Any) -> None:
        self.progress.update(self.tasks[name], completed=done, **fields)

    def _is_due(self, name: str, now: float, last: bool = False) -> bool:
        """Return whether to print a line now; if so, record the time."""
        if self.progress.console.is_terminal:
            return False
        due = last or now - self.printed_at[name] >= PRINT_EVERY_S
        if due:
            self.printed_at[name] = now
        return due

    def _print(self, text: str) -> None:
        self.spoken()
        print_plain(self.progress.console, text)


def print_plain(console: Console, text: str) -> None:
    """Print a text as it is."""
    console.print(text, highlight=False, markup=False)
