"""The progress of a run: what it does now, and the time left."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from threading import Lock
from time import monotonic
from typing import cast

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import Task as Bar
from rich.text import Text

from mor_bench.cli.progress_bars import PREPARING, print_plain
from mor_bench.cli.slow_notice import notice_if_slow
from mor_bench.report.number_format import milliseconds_text, percent, seconds_text
from mor_bench.results.row import Row
from mor_bench.runs.listener import Listener
from mor_bench.runs.plan import Plan, StageName
from mor_bench.runs.time_left import Task, TimeLeft

PRINT_EVERY_S = 10.0
"""Interval between printed lines if there is no terminal, s."""

WIDEST = 40
"""Most characters of the text beside the bar."""


@contextmanager
def show_run(
    console: Console, plan: Callable[[], Plan], *, quiet: bool = False, verbose: bool = False
) -> Iterator[Listener]:
    """Show the progress of a run; `plan` is called when the run has begun its work."""
    if quiet:
        yield Listener()
        return
    left = _Left()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=16),
        TimeElapsedColumn(),
        left,
    )
    with ExitStack() as stack:
        progress = stack.enter_context(Progress(*columns, console=console, transient=True))
        notice = notice_if_slow(PREPARING, partial(print_plain, console))
        shown = _Shown(progress, left, plan, stack.enter_context(notice), verbose)
        yield Listener(
            compiling=shown.compiling,
            generating=shown.generating,
            starting=shown.starting,
            fitted=shown.fitted,
            repeating=shown.repeating,
            timing=shown.timing,
            finished=shown.finished,
        )


class _Left(ProgressColumn):
    """The time left beside the bar, which counts down between the events."""

    estimate: TimeLeft | None = None

    def render(self, task: Bar) -> Text:
        return Text(self.text(monotonic()), style="progress.remaining")

    def text(self, now: float) -> str:
        """Format the time left; empty while it is unknown."""
        return "" if self.estimate is None else f"{_rounded(self.estimate.seconds(now))} left"


def _rounded(seconds: float) -> str:
    """Format a duration with two digits or so."""
    if seconds < 100:
        return f"{max(seconds, 1):.0f} s"
    if seconds < 570:
        return f"{seconds / 60:.1f} min"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


class _Shown:
    """Shows the events of a run on one bar, or in lines if there is no terminal."""

    def __init__(
        self,
        progress: Progress,
        left: _Left,
        plan: Callable[[], Plan],
        spoken: Callable[[], None],
        verbose: bool,
    ) -> None:
        self._progress, self._left, self._plan, self._verbose = progress, left, plan, verbose
        self._spoken = spoken
        self._bar = progress.add_task("starting", total=1.0)
        self._began = self._printed = monotonic()
        self._first: dict[str, int] = {}
        """Samples that each dataset had at the first event: they were not generated now."""

        self._fits: Counter[Task] = Counter()
        self._lock = Lock()

    def compiling(self, method: str, done: int, total: int) -> None:
        if done == 0:
            self._print("Compiling numerical kernels. This happens once per machine and version.")
        self._show(f"compiling {method}", self._compilation(), done / total)

    def generating(self, dataset: str, done: int, total: int) -> None:
        before = self._first.setdefault(dataset, done)
        fraction = (done - before) / (total - before) if total > before else 1.0
        text = f"{dataset}: {done:,} of {total:,} samples"
        self._show(text, Task(dataset, "samples"), fraction)

    def starting(self, dataset: str, label: str, number: int, total: int) -> None:
        task = Task(dataset, "fit", _method(label))
        share = self._estimate().share(task, self._fits[task])
        self._fits[task] += 1
        self._show(f"{dataset}: fit {number} of {total}, {label}", task, share)

    def fitted(self, row: Row) -> None:
        if not row.ok:
            self._print(f"{row.label}: {row.status}: {row.reason}", "red")
        elif self._verbose and row.error and row.offline_s:
            origin = ", trained elsewhere" if row.trained_elsewhere else ""
            error = f"error {percent(row.error.rel_l2_median)} % (median)"
            self._print(f"{row.label}: {error}, fit {seconds_text(row.offline_s.fit)}{origin}")

    def repeating(self, dataset: str, label: str, stage: str) -> None:
        task = Task(dataset, cast(StageName, stage), _method(label))
        self._show(f"{dataset}: {stage}, {label}", task)

    def timing(self, dataset: str, done: int, total: int) -> None:
        fraction = done / max(total, 1)
        text = f"{dataset}: timing in turns, {100 * fraction:.0f} %"
        self._show(text, Task(dataset, "timing"), fraction)

    def finished(self, row: Row) -> None:
        if self._verbose and row.latency_ms:
            doubt = ", not stable" if row.latency_ms.stable is False else ""
            latency = milliseconds_text(row.latency_ms.median)
            self._print(f"{row.label}: latency {latency} (median){doubt}")

    def _estimate(self) -> TimeLeft:
        with self._lock:
            if self._left.estimate is None:
                self._left.estimate = TimeLeft.of(self._plan())
            return self._left.estimate

    def _compilation(self) -> Task:
        """Return the first compilation that is not finished; its events name no dataset."""
        estimate = self._estimate()
        waiting = (
            t for t in estimate.steps if t.stage == "compilation" and t not in estimate.spent
        )
        return next(waiting, Task("", "compilation"))

    def _show(self, text: str, task: Task, fraction: float = 0.0) -> None:
        """Show what the run does now, and how much of it is done."""
        now, estimate = monotonic(), self._estimate()
        estimate.enter(task, now, fraction)
        elapsed, left = now - self._began, estimate.seconds(now)
        share = elapsed / max(elapsed + left, 1e-9)
        shown = text if len(text) <= WIDEST else f"{text[: WIDEST - 1]}…"
        self._progress.update(self._bar, description=escape(shown), completed=share)
        if self._progress.console.is_terminal:
            self._spoken()
        elif now - self._printed >= PRINT_EVERY_S:
            self._printed = now
            self._print(f"{text}; {self._left.text(now)}")

    def _print(self, text: str, style: str | None = None) -> None:
        self._spoken()
        self._progress.console.print(
            text, style=style, highlight=False, markup=False, soft_wrap=True
        )


def _method(label: str) -> str:
    """Return the method of a configuration's label."""
    return label.partition(" [")[0]
