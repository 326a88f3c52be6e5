"""Resamples of the latencies and errors of a dataset's configurations, and their intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.bootstrap import (
    central_interval,
    cluster_numbers,
    resample_weights,
    weighted_means,
    weighted_medians,
    widening,
)
from mor_bench.analysis.frontier import (
    EXACT,
    is_point,
    median_error,
    median_latency_ms,
    number_or_inf,
    selecting_error,
)
from mor_bench.analysis.latency_intervals import (
    latency_draws,
    latency_intervals,
    n_processes_of,
    spreads_of,
)
from mor_bench.analysis.seeds import error_draws
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row

VALIDATION = "validation_rel_l2_median"
"""Name of the median relative L2 error on the validation part, and of its interval."""

Interval = tuple[float, float]
Samples = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Draws:
    """Resamples of the latencies and errors of the usable rows of a dataset.

    Attributes
    ----------
    rows : list of Row
        The rows that have a latency and an error.
    log_latencies, log_errors : (n_rows, n) float64
        Natural logarithms. Resample i uses the same load regions and processes in all rows.
    intervals : dict
        By label: the intervals of `rel_l2_median`, `mean_dof_m`, `latency_ms` and `VALIDATION`,
        where there are raw samples.
    error_bounds : dict
        By label: `error_bound` of each row that ran.
    clusters, timing : dict
        The resampled units, and the spread between processes; empty without raw samples.
    """

    rows: list[Row]
    log_latencies: NDArray[np.float64]
    log_errors: NDArray[np.float64]
    intervals: dict[str, dict[str, Interval]] = field(default_factory=dict)
    error_bounds: dict[str, float] = field(default_factory=dict)
    clusters: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, Any] = field(default_factory=dict)


def draws_of(comparison: Comparison, dataset: str, n: int, generator: np.random.Generator) -> Draws:
    """Resample a dataset n times: its load regions for the errors, its processes for latencies."""
    ran = [row for row in comparison.rows if row.dataset == dataset and row.status == "ok"]
    raw = {row.label: _raw_samples(comparison, row) for row in ran}
    failed_seeds = {row.label: len(row.seeds.failed) if row.seeds else 0 for row in ran}
    resampler, held_out = (
        _Resampler(_regions(comparison, dataset, part), n, generator)
        for part in ("test", "validation")
    )
    intervals: dict[str, dict[str, Interval]] = {row.label: {} for row in ran}
    errors: dict[str, NDArray[np.float64]] = {}
    for label, samples in raw.items():
        if len(samples.get("relative_l2", ())) < 2:
            continue
        failed = failed_seeds[label]
        errors[label] = resampler.draws(samples, "relative_l2", failed)
        intervals[label]["rel_l2_median"] = central_interval(errors[label])
        if "mean_dof_m" in samples:
            means = resampler.draws(samples, "mean_dof_m", failed)
            intervals[label]["mean_dof_m"] = central_interval(means)
        if len(samples.get("validation_relative_l2", ())) > 1:
            validation = held_out.draws(samples, "validation_relative_l2", failed)
            intervals[label][VALIDATION] = central_interval(validation)
    for label, interval in latency_intervals(raw).items():
        intervals[label]["latency_ms"] = interval
    usable = [row for row in ran if is_point(row)]
    medians = np.array([median_latency_ms(row) for row in usable], dtype=float)
    latencies = latency_draws([raw[row.label] for row in usable], medians, n, generator)
    drawn = [errors.get(row.label, np.full(n, median_error(row))) for row in usable]
    return Draws(
        usable,
        latencies,
        np.log(np.maximum(np.array(drawn).reshape(len(usable), n), EXACT)),
        intervals,
        {row.label: error_bound(row, intervals[row.label]) for row in ran},
        resampler.resampled,
        _timing_facts(raw),
    )


def answers_all(row: Row) -> bool:
    """Return whether a row ran and left no load of any part without an answer."""
    others = (row.hidden, row.validation)
    return row.ok and row.n_failed == 0 and not any(o and o.rel_l2_max == inf for o in others)


def error_bound(row: Row, intervals: Mapping[str, Interval]) -> float:
    """Return the error that selects a row: `error_high`; infinite without an answer to a load."""
    return error_high(row, intervals) if answers_all(row) else inf


def error_high(row: Row, intervals: Mapping[str, Interval]) -> float:
    """Return the error of a row that is compared with limits.

    It is the upper end of the 95 % interval on the validation part, or on the test set if there is
    none. The median error on a fresh test set counts if it is larger.
    """
    error = selecting_error(row)
    _, high = intervals.get(VALIDATION if row.validation else "rel_l2_median", (0.0, error))
    fresh = number_or_inf(row.hidden.rel_l2_median) if row.hidden else 0.0
    return max(error, high, fresh)


def _raw_samples(comparison: Comparison, row: Row) -> Samples:
    try:
        return comparison.samples(row)
    except (OSError, KeyError):
        return {}


def _regions(comparison: Comparison, dataset: str, part: str) -> NDArray[Any] | None:
    try:
        return comparison.dataset_arrays(dataset).get(f"{part}_regions")
    except OSError:
        return None


def _timing_facts(raw: Mapping[str, Samples]) -> dict[str, Any]:
    """Number of processes, and the relative standard deviations between them (None if unknown)."""
    timed = [samples for samples in raw.values() if len(samples.get("latency_ms", ()))]
    if not timed:
        return {}
    spreads = spreads_of(timed)
    specific, common = (
        spread.sd if spread.df > 0 else None for spread in (spreads.specific, spreads.common)
    )
    n_processes = max(map(n_processes_of, timed))
    return {"n_processes": n_processes, "specific": specific, "common": common}


class _Resampler:
    """Bootstrap of errors. Configurations with equal numbers of test samples share resamples."""

    def __init__(
        self, regions: NDArray[Any] | None, n: int, generator: np.random.Generator
    ) -> None:
        self.regions, self.n, self.generator = regions, n, generator
        self.resampled: dict[str, Any] = {}
        self._weights: dict[int, tuple[NDArray[np.int32], float]] = {}

    def _resamples(self, n_samples: int) -> tuple[NDArray[np.int32], float]:
        """Weights (n_samples, n) of the resamples, and the factor that widens their spread."""
        if n_samples not in self._weights:
            clusters = cluster_numbers(self.regions, n_samples)
            count = int(clusters.max()) + 1
            weights = resample_weights(clusters, self.n, self.generator)
            self._weights[n_samples] = weights, widening(count)
            of_samples = clusters.shape[1] == 1 and count == n_samples
            found = {"of": "test samples" if of_samples else "load regions", "n": count}
            self.resampled = self.resampled or found
        return self._weights[n_samples]

    def draws(self, samples: Samples, name: str, failed: int) -> NDArray[np.float64]:
        """Draw the error of a test set over load regions and, if there are several, over seeds.

        Parameters
        ----------
        samples : dict
            Raw samples of a configuration; those of other seeds are named ``seeds_NAME``.
        name : str
            Name of the samples. The mean of ``mean_dof_m`` is drawn, the median of the others.
        failed : int
            Number of seeds whose training failed.
        """
        first = np.asarray(samples[name], dtype=float)[None]
        others = np.asarray(samples.get(f"seeds_{name}", first[:0]), dtype=float)
        lost = np.full((failed, first.shape[1]), inf)
        trainings = np.concatenate([first, others.reshape(-1, first.shape[1]), lost])
        weights, factor = self._resamples(first.shape[1])
        statistic = weighted_means if name == "mean_dof_m" else weighted_medians
        return error_draws(trainings, weights, factor, statistic, self.generator)


def finite_or_none(value: float) -> float | None:
    """Replace an infinite figure by None, because JSON has no infinity."""
    return float(value) if isfinite(value) else None


def headlines(row: Row, draws: Draws) -> dict[str, Any]:
    """Value, low and high of the median error, the mean error and the median latency of a row.

    The median error on the validation part is added if there is one, and the error that selects.
    A latency interval that was stored with the row takes precedence.
    """
    error, latency = row.error, row.latency_ms
    intervals = draws.intervals[row.label]
    values = {
        "rel_l2_median": median_error(row),
        "mean_dof_m": number_or_inf(error.mean_dof_m if error else None),
        "latency_ms": median_latency_ms(row),
    }
    if row.validation:
        values[VALIDATION] = selecting_error(row)
    found: dict[str, Any] = {"dataset": row.dataset, "label": row.label}
    found["error_bound"] = finite_or_none(draws.error_bounds[row.label])
    for name, value in values.items():
        low, high = intervals.get(name, (inf, inf))
        if (
            name == "latency_ms"
            and latency
            and latency.low is not None
            and latency.high is not None
        ):
            low, high = latency.low, latency.high
        found[name] = {
            "value": finite_or_none(value),
            "low": finite_or_none(min(low, value) if isfinite(low) else low),
            "high": finite_or_none(max(high, value)),
        }
    return found
