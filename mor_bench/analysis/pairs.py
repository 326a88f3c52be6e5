"""Intervals of time at error and error at time, and the verdict on each pair of methods."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.bootstrap import central_interval
from mor_bench.analysis.draws import Draws, finite_or_none
from mor_bench.analysis.frontier import (
    EXACT,
    TARGET_ERRORS,
    TARGET_TIMES_MS,
    frontier_draws,
    median_error,
    median_latency_ms,
)
from mor_bench.analysis.latency_intervals import verdict_of

Record = dict[str, Any]
LogTimes = dict[str, dict[float, NDArray[np.float64]]]
"""Draws of the logarithm of the time at an error, by method and error."""


def add_intervals(
    records: dict[str, list[Record]], draws: Draws, needed: float | None
) -> list[Record]:
    """Add intervals to the records of one dataset; return the records of its pairs of methods.

    Parameters
    ----------
    records : dict
        `time_at_error` and `error_at_time` of the dataset; changed in place.
    draws : Draws
    needed : float or None
        Relative L2 error that the dataset requires: one more target of the pairs.
    """
    wanted = {needed} if needed and isfinite(needed) and needed > 0 else set()
    targets = sorted({*TARGET_ERRORS, *wanted}, reverse=True)
    times: LogTimes = {}
    for method in dict.fromkeys(record["method"] for record in records["time_at_error"]):
        at_error, at_time = _method_draws(method, draws, targets)
        times[method] = dict(zip(targets, at_error, strict=True))
        errors = dict(zip(TARGET_TIMES_MS, at_time, strict=True))
        for record in records["time_at_error"]:
            if record["method"] == method:
                _add_interval(record, "latency_ms", times[method][record["target_rel_l2_median"]])
        for record in records["error_at_time"]:
            if record["method"] == method:
                _add_interval(record, "error", errors[record["target_latency_ms"]])
    values = _measured_times(draws, targets)
    dataset = records["time_at_error"][0]["dataset"] if records["time_at_error"] else ""
    return [
        {
            "dataset": dataset,
            "target_rel_l2_median": target,
            "a": a,
            "b": b,
            **_pair({name: values.get((name, target), inf) for name in (a, b)}, times, target),
        }
        for target in targets
        for a in times
        for b in times
        if a != b
    ]


def _method_draws(
    method: str, draws: Draws, targets: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    mine = [i for i, row in enumerate(draws.rows) if row.method == method]
    if not mine:
        n = draws.log_latencies.shape[1]
        return np.full((len(targets), n), inf), np.full((len(TARGET_TIMES_MS), n), inf)
    errors = draws.log_errors[mine]
    selecting = np.broadcast_to(_log_selecting(draws, mine), errors.shape)
    return frontier_draws(draws.log_latencies[mine], errors, targets, TARGET_TIMES_MS, selecting)


def _log_selecting(draws: Draws, numbers: Sequence[int]) -> NDArray[np.float64]:
    """Return the errors (n, 1) that select the frontier; they are not resampled."""
    bounds = [draws.error_bounds[draws.rows[i].label] for i in numbers]
    return np.log(np.maximum(bounds, EXACT))[:, None]


def _add_interval(record: Record, key: str, draws: NDArray[np.float64]) -> None:
    low, high = (np.exp(end) for end in central_interval(draws))
    value = record[key]
    if value is not None:  # the median of few samples can lie outside its bootstrap quantiles
        low, high = min(low, value), max(high, value)
    if key == "error":  # draws of an error of zero equal the round-off
        low, high = (0.0 if end <= EXACT else end for end in (low, high))
    record.update(low=finite_or_none(low), high=finite_or_none(high))
    record["not_reached"] = float(np.mean(~np.isfinite(draws)))


def _measured_times(draws: Draws, targets: Sequence[float]) -> dict[tuple[str, float], float]:
    """Log latency of each method at each error without resampling; infinite if not reached."""
    out: dict[tuple[str, float], float] = {}
    for method in dict.fromkeys(row.method for row in draws.rows):
        numbers = [i for i, row in enumerate(draws.rows) if row.method == method]
        mine = [draws.rows[i] for i in numbers]
        latencies = np.log([[median_latency_ms(row)] for row in mine])
        errors = np.log(np.maximum([[median_error(row)] for row in mine], EXACT))
        at_error, _ = frontier_draws(latencies, errors, targets, (), _log_selecting(draws, numbers))
        for target, value in zip(targets, at_error[:, 0], strict=True):
            out[method, target] = float(value)
    return out


def _pair(values: dict[str, float], times: LogTimes, target: float) -> Record:
    """Ratio of the times of two methods at an error; an end is None if one may not reach it.

    `values` holds the log latency at the error by method, the first method first; infinite if not
    reached.
    """
    missing = [name for name, value in values.items() if not isfinite(value)]
    if missing:
        return {"verdict": "not reached", "by": missing, "ratio": None, "low": None, "high": None}
    a, b = values
    first, second = times[a][target], times[b][target]
    neither = ~np.isfinite(first) & ~np.isfinite(second)
    with np.errstate(invalid="ignore"):
        ratios = first - second
    low, _ = central_interval(np.where(neither, -inf, ratios))
    _, high = central_interval(np.where(neither, inf, ratios))
    measured = values[a] - values[b]
    low, high = min(low, measured), max(high, measured)
    return {
        "verdict": verdict_of(low, high),
        "by": [],
        "ratio": float(np.exp(measured)),
        "low": float(np.exp(low)) if isfinite(low) else None,
        "high": float(np.exp(high)) if isfinite(high) else None,
    }
