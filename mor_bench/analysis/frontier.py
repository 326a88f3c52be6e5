"""Time at error and error at time, from the swept configurations of each method.

The errors that the verdict compares with a limit select the configurations of the frontier: upper
bounds on the validation part. Its errors are those of the test set. Between two adjacent
configurations the frontier is a straight line in log-log. Nothing is extrapolated beyond them. Each
interpolated figure comes with the configuration that the verdict would choose for the target.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, inf, isnan, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def _interpolate(x: float, x0: float, y0: float, x1: float, y1: float) -> float:
    span = log(x1) - log(x0)
    if span == 0:  # neighbouring floats may have the same logarithm
        return min(y0, y1)
    share = (log(x) - log(x0)) / span
    return exp(log(y0) + share * (log(y1) - log(y0)))


def time_at_error(points: Sequence[Point], target: float) -> dict[str, Any]:
    """Return the interpolated latency at an error, and the configuration to select for it.

    Selected is the fastest one whose `selecting` error meets the target. The interpolated latency
    is that at which the test error of the frontier first meets it. None: not reached.
    """
    able = [p for p in points if p.selecting <= target and p.selecting < USELESS]
    best = _selected(min(able, key=lambda p: (p.latency_ms, p.selecting), default=None))
    front = non_dominated(points)
    real = next((p for p in front if p.error <= target), None)
    if real is None:
        return {"latency_ms": None, "best": best}
    before = front.index(real) - 1
    latency = real.latency_ms
    if before >= 0:
        p = front[before]
        latency = _interpolate(
            target, p.error, p.latency_ms, max(real.error, EXACT), real.latency_ms
        )
    return {"latency_ms": latency, "best": best}


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


def error_at_time(points: Sequence[Point], target_ms: float) -> dict[str, Any]:
    """Return the interpolated error at a latency, and the configuration to select within it.

    Selected is the one with the least `selecting` error. The interpolated error is the test error
    of the frontier. None: not reached.
    """
    able = [p for p in points if p.latency_ms <= target_ms and p.selecting < USELESS]
    best = _selected(min(able, key=lambda p: (p.selecting, p.latency_ms), default=None))
    front = non_dominated(points)
    within = [p for p in front if p.latency_ms <= target_ms]
    if not within:
        return {"error": None, "best": best}
    real = within[-1]
    error = real.error
    if len(within) < len(front):
        p = front[len(within)]
        error = _interpolate(
            target_ms, real.latency_ms, max(real.error, EXACT), p.latency_ms, max(p.error, EXACT)
        )
    return {"error": error, "best": best}


def frontier_draws(
    log_latencies: NDArray[np.float64],
    log_errors: NDArray[np.float64],
    errors: Sequence[float],
    times_ms: Sequence[float],
    log_selecting: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute `time_at_error` and `error_at_time` for many resamples at once.

    Parameters
    ----------
    log_latencies, log_errors : (n_configurations, n) float64
        Natural logarithms of latencies in ms and of relative L2 errors; no error is below `EXACT`.
    errors, times_ms : sequence of float
        Targets.
    log_selecting : (n_configurations, n) float64, optional
        Natural logarithms of the errors that select the frontier; `log_errors` without them.

    Returns
    -------
    (n_errors, n) float64
        Logarithms of the latencies at the errors; infinite where not reached.
    (n_times, n) float64
        Logarithms of the errors at the latencies; infinite where not reached.
    """
    log_selecting = log_errors if log_selecting is None else log_selecting
    useful = np.maximum(log_errors, log_selecting) < log(USELESS)
    log_selecting = np.where(useful, log_selecting, inf)
    order = np.lexsort((log_selecting, log_latencies), axis=0)
    latency, error, selecting = (
        np.take_along_axis(values, order, 0)
        for values in (log_latencies, log_errors, log_selecting)
    )
    n_configurations, n = latency.shape
    numbers, columns = np.arange(n_configurations)[:, None], np.arange(n)
    least = np.minimum.accumulate(selecting, axis=0)
    on_front = np.vstack([np.isfinite(selecting[:1]), (selecting[1:] < least[:-1])])
    # The last point of the front up to each configuration.
    last = np.maximum.accumulate(np.where(on_front, numbers, -1), axis=0)
    at_error, at_time = np.full((len(errors), n), np.inf), np.full((len(times_ms), n), np.inf)
    for out, target in zip(at_error, np.log(np.maximum(errors, EXACT)), strict=True):
        meets = on_front & (error <= target)
        real = meets.argmax(axis=0)
        before = np.where(real > 0, last[real - 1, columns], -1)
        here = latency[real, columns]
        share = _share(target, error[before, columns], error[real, columns])
        between = latency[before, columns] + share * (here - latency[before, columns])
        out[:] = np.where(meets.any(axis=0), np.where(before >= 0, between, here), np.inf)
    for out, target in zip(at_time, np.log(times_ms), strict=True):
        count = (latency <= target).sum(axis=0)
        real = np.where(count > 0, last[count - 1, columns], -1)
        later = on_front & (numbers >= count)
        after = later.argmax(axis=0)
        here = error[real, columns]
        share = _share(target, latency[real, columns], latency[after, columns])
        with np.errstate(invalid="ignore"):
            between = here + share * (error[after, columns] - here)
        out[:] = np.where(real >= 0, np.where(later.any(axis=0), between, here), np.inf)
    return at_error, at_time


def _share(x: float, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """Relative position of x between start and end; 1 where they coincide or are not finite."""
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (x - start) / (end - start)
    return np.where(np.isfinite(share), share, 1.0)


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


def compare(rows: Sequence[Row], bounds: Mapping[str, float]) -> dict[str, Any]:
    """Time at error and error at time of all methods on a dataset.

    A method without a usable row reaches no target. `bounds` holds the error that selects each row,
    by label.
    """
    at_error, at_time = [], []
    for dataset, method in dict.fromkeys((row.dataset, row.method) for row in rows):
        points = [
            Point(
                median_latency_ms(row),
                median_error(row),
                row.label,
                bounds[row.label],
            )
            for row in rows
            if (row.dataset, row.method) == (dataset, method) and is_point(row)
        ]
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
