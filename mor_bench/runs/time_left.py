"""The time left in a run, from its plan and from the durations of what it has done."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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

PRIOR_S = 5.0
"""Planned seconds of finished tasks whose measured pace counts as much as the prior one."""

MOST_CORRECTION = 8.0
"""Largest factor by which the pace of a stage corrects the plan."""

MEASURED: tuple[StageName, ...] = ("timing",)
"""Stages whose share of what is done comes from measured durations of their parts."""

FITTED: tuple[StageName, ...] = ("fit", "other seeds", "learning curve")
"""Stages of fits."""

PACE_SPREAD, EXCESS_S = 1.0, 2.0
"""Standard deviations of the factor by which fits are slower than planned, and of the seconds that
each step takes beyond that, before any fit is measured."""

NOISE, NOISE_S = 0.15, 0.3
"""Deviation of a fit from the law of its stage: a share of its duration, and s."""

OVERTIME = 0.1
"""Share of its duration so far that a task which takes longer than planned is expected to take."""


class Task(NamedTuple):
    """A part of a run with a planned duration."""

    dataset: str
    stage: StageName
    method: str = ""


Known = Mapping[Task, float]
"""Measured seconds of tasks."""


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
        factor, more = self._law(task.stage, self.spent, self._common(self.spent))
        steps = [factor * seconds + more for seconds in self.steps.get(task, [])]
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
        order, known = list(self.steps), self._known(now)
        first = 0 if self._current is None else order.index(self._current) + 1
        ahead = sum(self._expected(task, known) for task in order[first:])
        return ahead + self._left_in_current(now, known)

    def _known(self, now: float) -> Known:
        """Return what is measured; a task under way counts once it takes longer than expected."""
        task, elapsed = self._current, now - self._since
        if task is None or elapsed <= self._expected(task, self.spent):
            return self.spent
        if self._seen[0] > 0 and task.stage not in FITTED:  # its share says more
            return self.spent
        return {**self.spent, task: elapsed}

    def _expected(self, task: Task, known: Known) -> float:
        """Return the expected seconds of a task, from those that are measured.

        On a machine under load all is slower by a factor. Beside it, each fit takes some seconds
        more than planned, for processes and scores, however long it trains.
        """
        planned = sum(self.steps[task])
        if task.stage not in FITTED:
            return planned * self._pace(task.stage, known)
        factor, more = self._law(task.stage, known, self._common(known))
        return factor * planned + len(self.steps[task]) * more

    def _law(self, stage: StageName, known: Known, prior: float) -> tuple[float, float]:
        """Return how the fits of a stage depend on the plan: a factor, and seconds per step.

        They are fitted to the measured tasks by weighted least squares. `prior` is the factor
        before any is measured.
        """
        # Normal equations of both numbers; each prior is like a measurement.
        aa, ab, bb = PACE_SPREAD**-2, 0.0, EXCESS_S**-2
        ya, yb = prior * aa, 0.0
        for task in [task for task in known if task.stage == stage]:
            planned, n, spent = sum(self.steps[task]), len(self.steps[task]), known[task]
            weight = (NOISE * spent + NOISE_S) ** -2
            aa, ab, bb = aa + weight * planned**2, ab + weight * planned * n, bb + weight * n**2
            ya, yb = ya + weight * planned * spent, yb + weight * n * spent
        factor = (bb * ya - ab * yb) / (aa * bb - ab**2)
        if yb < ab * factor:  # then no step takes longer than planned by the factor
            factor = ya / aa
        factor = min(max(factor, 1 / MOST_CORRECTION), MOST_CORRECTION)
        return factor, max(0.0, (yb - ab * factor) / bb)

    def _common(self, known: Known, prior: float = 1.0) -> float:
        """Return measured over planned seconds of all stages but fits and timing."""
        apart = (*FITTED, *MEASURED)
        return self._ratio([task for task in known if task.stage not in apart], known, prior)

    def _pace(self, stage: StageName, known: Known) -> float:
        """Return measured over planned seconds of a stage, or of all before it, fits included.

        A slow machine does not lengthen turns of timing: they end after a fixed time.
        """
        common = self._common(known, self._law("fit", known, 1.0)[0])
        prior = 1.0 if stage in MEASURED else common
        pace = self._ratio([task for task in known if task.stage == stage], known, prior)
        return min(max(pace, 1 / MOST_CORRECTION), MOST_CORRECTION)

    def _ratio(self, done: Sequence[Task], known: Known, prior: float) -> float:
        done = [task for task in done if sum(self.steps[task]) > 0]
        planned = sum(sum(self.steps[task]) for task in done)
        spent = sum(known[task] for task in done)
        return (spent + PRIOR_S * prior) / (planned + PRIOR_S)

    def _left_in_current(self, now: float, known: Known) -> float:
        if self._current is None:
            return 0.0
        total = self._expected(self._current, known)
        fraction, at_s = self._seen
        if fraction > 0:
            trust = 1.0 if self._current.stage in MEASURED else min(1.0, 2 * fraction)
            total = (1 - trust) * total + trust * at_s / fraction
        elapsed = now - self._since
        return max(total - elapsed, OVERTIME * elapsed * (1 - fraction))
