"""Time at error and error at time, from the swept configurations of each method.

The error that the verdict compares with a limit selects a configuration: the upper bound on the
validation part. The figures are its latency and its error on the test set. Nothing is interpolated,
so they agree with the verdict, with break-even and with the rows of the configurations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isnan
from typing import Any

from mor_bench.results.row import Row

USELESS = 1.0
"""Relative error of answering zero. Configurations that are no better are in no Pareto front."""

TARGET_ERRORS = (0.10, 0.03, 0.01, 0.003, 0.001)
"""Median relative L2 errors over the test set, as fractions."""

TARGET_TIMES_MS = (0.1, 1.0, 3.0, 10.0, 33.0, 100.0)
"""Median latencies of one query, ms."""

EXACT = 1e-16
"""Replaces an error of zero, which has no logarithm: the round-off of double precision."""


@dataclass(frozen=True)
class Point:
    """A configuration on the plane of latency and test error.

    `bound` is the error that selects configurations; without one, the test error does.
    """

    latency_ms: float
    error: float
    label: str
    bound: float | None = None

    @property
    def selecting(self) -> float:
        return self.error if self.bound is None else self.bound


def non_dominated(points: Sequence[Point]) -> list[Point]:
    """Return the Pareto front of latency and the error that selects, fastest first."""
    front: list[Point] = []
    useful = [p for p in points if max(p.error, p.selecting) < USELESS]
    for point in sorted(useful, key=lambda p: (p.latency_ms, p.selecting)):
        if not front or point.selecting < front[-1].selecting:
            front.append(point)
    return front


def fastest_within(points: Sequence[Point], target: float) -> Point | None:
    """Return the fastest point whose `selecting` error meets the target."""
    able = [p for p in points if p.selecting <= target and p.selecting < USELESS]
    return min(able, key=lambda p: (p.latency_ms, p.selecting), default=None)


def most_accurate_within(points: Sequence[Point], target_ms: float) -> Point | None:
    """Return the point with the least `selecting` error among those that are fast enough."""
    able = [p for p in points if p.latency_ms <= target_ms and p.selecting < USELESS]
    # Errors that differ in round-off are equal: two sizes may have become the same model.
    return min(able, key=lambda p: (float(f"{p.selecting:.5g}"), p.latency_ms), default=None)


def time_at_error(points: Sequence[Point], target: float) -> dict[str, Any]:
    """Return the latency of the configuration that is selected for an error. None: not reached."""
    best = fastest_within(points, target)
    return {"latency_ms": best and best.latency_ms, "best": _selected(best)}


def error_at_time(points: Sequence[Point], target_ms: float) -> dict[str, Any]:
    """Return the test error of the configuration selected for a latency. None: not reached."""
    best = most_accurate_within(points, target_ms)
    return {"error": best and best.error, "best": _selected(best)}


def _selected(point: Point | None) -> dict[str, Any] | None:
    """Return the figures of a selected configuration; `error` is that of the test set."""
    if point is None:
        return None
    return {
        "label": point.label,
        "latency_ms": point.latency_ms,
        "error": point.error,
        "bound": point.bound,
    }


def number_or_inf(value: float | None) -> float:
    """Return a figure of a row; infinity if it is missing or not a number."""
    return inf if value is None or isnan(value) else float(value)


def median_error(row: Row) -> float:
    """Median relative L2 error of a row; infinite if there is none."""
    return number_or_inf(row.error.rel_l2_median if row.error else None)


def selecting_error(row: Row) -> float:
    """Median relative L2 error that selects a row: on the validation part, or else on the test."""
    return number_or_inf(row.validation.rel_l2_median) if row.validation else median_error(row)


def median_latency_ms(row: Row) -> float:
    """Median latency of a row, ms; infinite if there is none."""
    return number_or_inf(row.latency_ms.median if row.latency_ms else None)


def is_point(row: Row) -> bool:
    """Return whether a row ran, was timed and was scored, so that it has an error and a latency."""
    return row.status == "ok" and row.error is not None and 0 < median_latency_ms(row) < inf


def points_of(rows: Sequence[Row], bounds: Mapping[str, float]) -> list[Point]:
    """Return the points of the rows that have one; `bounds` holds their errors that select."""
    return [
        Point(median_latency_ms(row), median_error(row), row.label, bounds[row.label])
        for row in rows
        if is_point(row)
    ]


def compare(rows: Sequence[Row], bounds: Mapping[str, float]) -> dict[str, Any]:
    """Time at error and error at time of all methods on a dataset.

    A method without a usable row reaches no target. `bounds` holds the error that selects each row,
    by label.
    """
    at_error, at_time = [], []
    for dataset, method in dict.fromkeys((row.dataset, row.method) for row in rows):
        mine = [row for row in rows if (row.dataset, row.method) == (dataset, method)]
        points = points_of(mine, bounds)
        key = {"dataset": dataset, "method": method}
        at_error += [
            {**key, "target_rel_l2_median": target, **time_at_error(points, target)}
            for target in TARGET_ERRORS
        ]
        at_time += [
            {**key, "target_latency_ms": target, **error_at_time(points, target)}
            for target in TARGET_TIMES_MS
        ]
    return {"time_at_error": at_error, "error_at_time": at_time}
