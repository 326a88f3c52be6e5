"""The time left in a run, from its plan and from the durations of what it has done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from mor_bench.runs.plan import Plan, StageName, Step

ORDER: tuple[tuple[StageName, ...], ...] = (
    ("compilation",),
    ("samples",),
    ("fit", "scores"),
    ("other seeds",),
    ("timing",),
    ("learning curve",),
)
"""Stages of a run on one dataset, in order. A method's fits and scores are one task."""

UNKNOWN_S = 5.0
"""Assumed duration of a fit that nothing is known about, s."""

PRIOR_S = 15.0
"""Planned seconds of finished tasks whose measured pace counts as much as the prior one."""

MOST_CORRECTION = 5.0
"""Largest factor by which the pace of a stage corrects the plan."""

MEASURED: tuple[StageName, ...] = ("timing",)
"""Stages whose share of what is done comes from measured durations of their parts."""

NO_FASTER: tuple[StageName, ...] = ("timing", "report")
"""Stages that others can show to be slower than planned, but not faster."""

FITTED: tuple[StageName, ...] = ("fit", "other seeds", "learning curve")
"""Stages of fits."""

OVERTIME = 0.1
"""Share of its duration so far that a task which takes longer than planned is expected to take."""


class Task(NamedTuple):
    """A part of a run with a planned duration."""

    dataset: str
    stage: StageName
    method: str = ""


def tasks_of(plan: Plan) -> Iterator[tuple[Task, list[float]]]:
    """Yield the tasks of a plan and the planned seconds of their steps, in the order of the run."""
    every = [*plan.steps, *plan.stages]
    for dataset in dict.fromkeys(step.dataset for step in every):
        for stages in ORDER:
            mine = [s for s in every if s.dataset == dataset and s.stage in stages]
            for method in dict.fromkeys(step.method for step in mine):
                steps = [step for step in mine if step.method == method]
                yield Task(dataset, stages[0], method), [_seconds(step) for step in steps]
    yield Task("", "report"), [plan.stage_seconds("report")]


def _seconds(step: Step) -> float:
    if step.done:
        return 0.0
    return UNKNOWN_S if step.seconds is None else step.seconds


@dataclass
class TimeLeft:
    """An estimate of the time left, which learns from every finished task.

    Attributes
    ----------
    steps : dict
        Planned seconds of each step of each task, in the order of the run.
    spent : dict
        Measured seconds of each finished task.
    """

    steps: dict[Task, list[float]]
    spent: dict[Task, float] = field(default_factory=dict)
    _current: Task | None = None
    _since: float = 0.0
    _seen: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, plan: Plan) -> TimeLeft:
        """Make the estimate of a planned run."""
        return cls(dict(tasks_of(plan)))

    def share(self, task: Task, n: int) -> float:
        """Return the planned share of the first steps of a task."""
        more = self._excess(task.stage)
        steps = [seconds + more for seconds in self.steps.get(task, [])]
        return sum(steps[:n]) / sum(steps) if sum(steps) else 0.0

    def enter(self, task: Task, now: float, fraction: float = 0.0) -> None:
        """Record at a time, s, that a task has begun, or how much of it is done."""
        if task not in self.steps:
            return
        if task != self._current:
            if self._current is not None:
                self.spent[self._current] = now - self._since
            self._current, self._since = task, now
        self._seen = fraction, now - self._since

    def seconds(self, now: float) -> float:
        """Estimate the seconds from now to the end of the run."""
        order = list(self.steps)
        first = 0 if self._current is None else order.index(self._current) + 1
        ahead = sum(map(self._expected, order[first:]))
        return ahead + self._left_in_current(now)

    def _expected(self, task: Task) -> float:
        """Return the expected seconds of a task that is not finished.

        Fits that exceed their plan do so by about the same time each, for processes and scores,
        however long they train. All else is slower or faster by a factor.
        """
        planned, more = sum(self.steps[task]), self._excess(task.stage)
        if more > 0:
            return planned + len(self.steps[task]) * more
        return planned * self._pace(task.stage)

    def _excess(self, stage: StageName) -> float:
        """Return by how much a step of a stage of fits exceeds its plan, s; 0 if it does not."""
        done = [task for task in self.spent if task.stage == stage and self.steps[task]]
        if stage not in FITTED or not done:
            return 0.0
        more = sum(self.spent[task] - sum(self.steps[task]) for task in done)
        return max(0.0, more / sum(len(self.steps[task]) for task in done))

    def _pace(self, stage: StageName) -> float:
        """Return measured over planned seconds of the stage, or of all but fits at first.

        A machine under load is slow throughout. But a fast compilation does not make the timing
        faster, whose turns have given seconds, or the report, whose plan has the machine's speed.
        """
        common = self._ratio([task for task in self.spent if task.stage not in FITTED], 1.0)
        common = max(common, 1.0) if stage in NO_FASTER else common
        pace = self._ratio([task for task in self.spent if task.stage == stage], common)
        return min(max(pace, 1 / MOST_CORRECTION), MOST_CORRECTION)

    def _ratio(self, done: Sequence[Task], prior: float) -> float:
        planned = sum(sum(self.steps[task]) for task in done)
        spent = sum(self.spent[task] for task in done)
        return (spent + PRIOR_S * prior) / (planned + PRIOR_S)

    def _left_in_current(self, now: float) -> float:
        if self._current is None:
            return 0.0
        total = self._expected(self._current)
        fraction, at_s = self._seen
        if fraction > 0:
            trust = 1.0 if self._current.stage in MEASURED else min(1.0, 2 * fraction)
            total = (1 - trust) * total + trust * at_s / fraction
        elapsed = now - self._since
        return max(total - elapsed, OVERTIME * elapsed * (1 - fraction))
