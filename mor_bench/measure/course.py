"""The course of a long measurement: how much of it is done, from the durations of its parts."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from statistics import fmean
from time import perf_counter

Report = Callable[[int, int], None]
"""Called with the time that has passed and the time expected in all, ms."""


class Course:
    """Reports how much is done, at the beginning and after each part.

    Parts of a kind are expected to take as long as those before.

    Parameters
    ----------
    parts : mapping
        Number and typical seconds of the parts of each kind.
    report : callable
    clock : callable
        Returns the time, s.
    """

    def __init__(
        self,
        parts: Mapping[str, tuple[int, float]],
        report: Report,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        self._left = Counter({kind: n for kind, (n, _) in parts.items()})
        self._typical = {kind: seconds for kind, (_, seconds) in parts.items()}
        self._taken: defaultdict[str, list[float]] = defaultdict(list)
        self._report, self._clock = report, clock
        self._begun = self._last = clock()
        self._tell()

    def done(self, kind: str) -> None:
        """Record that a part has ended that began when the one before ended."""
        now = self._clock()
        self._taken[kind].append(now - self._last)
        self._last = now
        self._left[kind] -= 1
        self._tell()

    def skip(self, name: str) -> None:
        """Record that no further part will come of the kinds whose last word is a name."""
        for kind in self._left:
            if kind.endswith(f" {name}"):
                self._left[kind] = 0

    def _tell(self) -> None:
        passed = self._last - self._begun
        self._report(round(1e3 * passed), round(1e3 * (passed + self._rest())))

    def _rest(self) -> float:
        return sum(n * self._expected(kind) for kind, n in self._left.items())

    def _expected(self, kind: str) -> float:
        taken = self._taken[kind]
        return fmean(taken) if taken else self._typical[kind]
