"""Intervals of time at error and error at time, and the verdict on each pair of methods."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.bootstrap import central_interval
from mor_bench.analysis.draws import Draws, finite_or_none
from mor_bench.analysis.frontier import EXACT, TARGET_ERRORS, fastest_within, points_of
from mor_bench.analysis.latency_intervals import verdict_of

Record = dict[str, Any]
Times = dict[str, tuple[float, NDArray[np.float64]]]
"""Logarithm of the latency at an error, and its draws, by method; only methods that reach it."""


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
    places = {row.label: i for i, row in enumerate(draws.rows)}
    for record in records["time_at_error"]:
        _add_interval(record, "latency_ms", draws.log_latencies, places)
    for record in records["error_at_time"]:
        _add_interval(record, "error", draws.log_errors, places)
    wanted = {needed} if needed and isfinite(needed) and needed > 0 else set()
    methods = list(dict.fromkeys(record["method"] for record in records["time_at_error"]))
    dataset = records["time_at_error"][0]["dataset"] if records["time_at_error"] else ""
    found = []
    for target in sorted({*TARGET_ERRORS, *wanted}, reverse=True):
        times = _times_at(target, draws, places)
        found += [
            {
                "dataset": dataset,
                "target_rel_l2_median": target,
                "a": a,
                "b": b,
                **_pair(a, b, times),
            }
            for a in methods
            for b in methods
            if a != b
        ]
    return found


def _times_at(target: float, draws: Draws, places: Mapping[str, int]) -> Times:
    """Return the latency of the configuration of each method that is selected for an error."""
    found: Times = {}
    for method in dict.fromkeys(row.method for row in draws.rows):
        mine = [row for row in draws.rows if row.method == method]
        best = fastest_within(points_of(mine, draws.error_bounds), target)
        if best is not None:
            found[method] = log(best.latency_ms), draws.log_latencies[places[best.label]]
    return found


def _add_interval(
    record: Record, key: str, draws: NDArray[np.float64], places: Mapping[str, int]
) -> None:
    """Add the interval of the selected configuration's figure to a record."""
    record.update(low=None, high=None)
    if record["best"] is None:
        return
    low, high = (np.exp(end) for end in central_interval(draws[places[record["best"]["label"]]]))
    # The median of few samples can lie outside its bootstrap quantiles.
    low, high = min(low, record[key]), max(high, record[key])
    if key == "error":  # draws of an error of zero equal the round-off
        low, high = (0.0 if end <= EXACT else end for end in (low, high))
    record.update(low=finite_or_none(low), high=finite_or_none(high))


def _pair(a: str, b: str, times: Times) -> Record:
    """Return the ratio of the times of two methods at an error, with its interval."""
    missing = [name for name in (a, b) if name not in times]
    if missing:
        return {"verdict": "not reached", "by": missing, "ratio": None, "low": None, "high": None}
    (first, first_draws), (second, second_draws) = times[a], times[b]
    measured = first - second
    low, high = central_interval(first_draws - second_draws)
    low, high = min(low, measured), max(high, measured)
    return {
        "verdict": verdict_of(low, high),
        "by": [],
        "ratio": float(np.exp(measured)),
        "low": float(np.exp(low)),
        "high": float(np.exp(high)),
    }
