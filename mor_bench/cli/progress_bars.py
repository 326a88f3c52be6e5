"""Progress bars of generation, configurations, timing and training."""

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
from mor_bench.results.row import Row
from mor_bench.runs.listener import Listener

PRINT_EVERY_S = 10.0
"""Interval between printed lines of progress if there is no terminal for a bar, s."""

PREPARING = "Preparing; large meshes and datasets take a minute."


@contextmanager
def show_progress(console: Console) -> Iterator[Listener]:
    """Show the progress of a run, fit or generation; print one line per fitted configuration."""
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
        spoken = stack.enter_context(notice_if_slow(PREPARING, partial(_print_plain, console)))
        bars = _Bars(progress, spoken)
        yield Listener(
            compiling=bars.compiling,
            generating=bars.generating,
            starting=bars.starting,
            fitted=bars.fitted,
            timing=bars.timing,
            training=bars.training,
        )


@dataclass
class _Bars:
    progress: Progress
    spoken: Callable[[], None]
    """Called when a line or bar is shown."""

    tasks: dict[str, TaskID] = field(default_factory=dict)
    begun: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Number done and time at the first call: earlier work does not count for the rate."""

    printed_at: dict[str, float] = field(default_factory=dict)

    def compiling(self, method: str, done: int, total: int) -> None:
        if "compiling" not in self.tasks:
            self._print("Compiling numerical kernels. This happens once per machine and version.")
        self._begin("compiling", "", 0, total)
        self._update("compiling", done, description=f"compiling {escape(method)}")
        if done < total and self._is_due("compiling", perf_counter()):
            self._print(f"compiling {method} ({done + 1} of {total})")
        if done == total:
            self.progress.remove_task(self.tasks.pop("compiling"))

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

    def starting(self, dataset: str, label: str, number: int, total: int) -> None:
        self._begin("run", "", 0, total)
        self._update("run", number - 1, description=escape(f"{dataset}: {label}"))

    def fitted(self, row: Row) -> None:
        text = f"{row.status}: {row.reason}"
        if row.ok and row.error and row.offline_s:
            text = (
                f"ē {row.error.mean_dof_m:.2e} m   rel. l2 {row.error.rel_l2_median:.3%}   "
                f"fit {row.offline_s.fit:.3g} s"
            ) + (" (trained elsewhere)" if row.trained_elsewhere else "")
        label = f"[bold]{escape(row.label):<46}[/bold]"
        self.spoken()
        self.progress.console.print(f"{label} {escape(text)}", highlight=False)

    def timing(self, dataset: str, done: int, total: int) -> None:
        name = f"timing {dataset}"
        if name not in self.tasks and not self.progress.console.is_terminal:
            self._print(f"{dataset}: all configurations are fitted; timing them in turns")
        self._begin(name, escape(name), 0, total)
        self._update(name, done)

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
        _print_plain(self.progress.console, text)


def _print_plain(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False)
