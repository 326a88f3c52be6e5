"""Uncertainty of latencies that were measured in a few fresh processes.

Queries agree far better within a process than between processes. So the number of processes sets
the uncertainty, not the number of queries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, log, nan, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.bootstrap import LEVEL, student_t

TYPICAL_SPREAD = 0.014
"""Relative standard deviation of a configuration's median between processes, quiet machine."""

TYPICAL_DRIFT = 0.02
"""Relative standard deviation of a drift common to all configurations, between runs minutes apart.

It is 0.7 % within a run, and it cancels in ratios.
"""

PRIOR_DF = 2.0
"""Degrees of freedom of the typical values: two processes can agree to 0.01 % by chance."""

NORMAL_MEDIAN = 0.6745
"""Median size of a standard normal variable."""

ENOUGH = 4
"""Number of processes from which on a median ignores one that is slow throughout."""

Samples = Mapping[str, NDArray[Any]]
"""Raw samples of a configuration: `latency_ms`, `process` and `round` of each query, (n,) each.

A missing `process` or `round` counts as a single one.
"""


@dataclass(frozen=True)
class Spread:
    """Relative standard deviation of a median between processes, with its degrees of freedom."""

    sd: float
    df: float

    def moderated(self, typical: float) -> Spread:
        """Pool with a typical spread; with a single process, only the typical spread counts."""
        df = self.df + PRIOR_DF
        return Spread(sqrt((self.df * self.sd**2 + PRIOR_DF * typical**2) / df), df)


@dataclass(frozen=True)
class Spreads:
    """Spread between processes of configurations that were timed together.

    Attributes
    ----------
    common : Spread
        Common to all configurations of a process, such as the machine's drift. Cancels in ratios.
    specific : Spread
        The rest, pooled over the configurations.
    own : (n,) float64
        Specific standard deviation of each configuration alone; NaN with a single process.
    """

    common: Spread
    specific: Spread
    own: NDArray[np.float64]


def _log_medians(samples: Samples) -> dict[tuple[int, int], float]:
    times = np.asarray(samples["latency_ms"], dtype=float)
    process, turn = (
        np.asarray(samples[name]) if name in samples else np.zeros(len(times), dtype=int)
        for name in ("process", "round")
    )
    keys, group = np.unique(np.stack([process, turn], axis=1), axis=0, return_inverse=True)
    group = group.ravel()
    return {
        (int(p), int(r)): float(np.log(np.median(times[group == i])))
        for i, (p, r) in enumerate(keys)
    }


def _cube(all_samples: Sequence[Samples]) -> NDArray[np.float64]:
    """Log medians (n_configurations, n_processes, n_rounds); NaN where nothing was timed."""
    medians = [_log_medians(samples) for samples in all_samples]
    processes, rounds = (sorted({key[i] for found in medians for key in found}) for i in (0, 1))
    cube = np.full((len(medians), len(processes), len(rounds)), nan)
    for c, found in enumerate(medians):
        for (process, turn), value in found.items():
            cube[c, processes.index(process), rounds.index(turn)] = value
    return cube


def spreads_of(all_samples: Sequence[Samples]) -> Spreads:
    """Estimate the spread between processes by a two-way analysis of variance of the log medians.

    The configurations were timed in turns, so process p and round r are the same moment for all.
    With a single configuration, all spread counts as specific. Now and then, a process is a third
    slower throughout. The median over `ENOUGH` processes ignores it. So the specific spread is then
    a median size of deviations, which such a process changes less than their root mean square.
    """
    cube = _cube(all_samples)
    n, degrees = len(cube), np.maximum(np.isfinite(cube).any(axis=2).sum(axis=1) - 1.0, 0.0)
    correction = n / (n - 1) if n > 1 else 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        moments = (
            _nan_mean(cube - _nan_mean(_nan_median(cube), axis=1)[:, None, None], axis=0)
            if n > 1
            else np.zeros(cube.shape[1:])
        )
        rest = _centred(_nan_median(cube - moments))
        own = np.where(
            degrees > 0, np.sqrt(correction * (degrees + 1) / degrees) * _scale(rest, axis=1), nan
        )
        shared = _nan_mean(_centred(_nan_median(cube)), axis=0)
    df, most = float(degrees.sum()) / correction, float(degrees.max())
    if df == 0:
        return Spreads(Spread(0.0, 0.0), Spread(0.0, 0.0), own)
    specific = float(_scale(rest)) ** 2 * np.isfinite(rest).sum() / df
    common = float(np.nansum(shared**2)) / most - specific / n if n > 1 else 0.0
    return Spreads(
        Spread(sqrt(max(common, 0.0)), most if n > 1 else 0.0), Spread(sqrt(specific), df), own
    )


def _nan_median(cube: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.full(cube.shape[:-1], nan)
    seen = np.isfinite(cube).any(axis=-1)
    out[seen] = np.nanmedian(cube[seen], axis=-1)
    return out


def _nan_mean(array: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    return np.asarray(np.nansum(array, axis=axis) / np.isfinite(array).sum(axis=axis))


def _scale(array: NDArray[np.float64], axis: int | None = None) -> NDArray[np.float64]:
    """Root mean square; with `ENOUGH` columns, the median size, scaled to agree for normal values.

    NaN entries are left out.
    """
    if array.shape[1] < ENOUGH:
        return np.asarray(np.sqrt(np.nanmean(array**2, axis=axis)))
    return np.asarray(np.nanmedian(np.abs(array), axis=axis) / NORMAL_MEDIAN)


def _centred(array: NDArray[np.float64]) -> NDArray[np.float64]:
    return array - _nan_mean(array, axis=1)[:, None]


def median_variance(n_processes: int) -> float:
    """Upper bound on the variance of the median over processes of unit standard deviation."""
    return (pi / 2 if n_processes > 2 else 1.0) / n_processes


def n_processes_of(samples: Samples) -> int:
    """Number of fresh processes in which a configuration was timed."""
    return len(np.unique(samples["process"])) if "process" in samples else 1


def _latency_interval(samples: Samples, pooled: Spreads) -> tuple[float, float]:
    """Prediction interval of one configuration, ms.

    It uses the larger of two spreads: the pooled one and the configuration's own.
    """
    own = spreads_of([samples]).own[0]
    common = pooled.common.moderated(TYPICAL_DRIFT)
    specific = pooled.specific.moderated(TYPICAL_SPREAD)
    alone = own if pooled.common.df == 0 else _without(own, common.sd)
    sd = float(np.nanmax([specific.sd, alone]))
    private, shared = sd**2 * median_variance(n_processes_of(samples)), common.sd**2
    # Degrees of freedom of a sum of variances, after Welch and Satterthwaite.
    df = (private + shared) ** 2 / (private**2 / specific.df + shared**2 / common.df)
    centre = log(float(np.median(samples["latency_ms"])))
    half = student_t(LEVEL, df) * sqrt(2 * (private + shared))
    return exp(centre - half), exp(centre + half)


def _without(total: float, part: float) -> float:
    """Standard deviation that remains after an independent part is removed from a total."""
    return sqrt(max(total**2 - part**2, 0.0))


def latency_intervals(samples_by_label: Mapping[str, Samples]) -> dict[str, tuple[float, float]]:
    """Return the 95 % prediction intervals for the medians of a repeated measurement, in ms.

    The repetition uses the same protocol and as many fresh processes, so an interval contains the
    noise of both measurements. More processes average out the specific noise, but not a drift that
    they share. A run cannot show a drift that is slower than the run.

    Parameters
    ----------
    samples_by_label : mapping of mapping
        Raw samples of configurations that were timed together; empty ones are left out.
    """
    timed = {label: s for label, s in samples_by_label.items() if len(s.get("latency_ms", ()))}
    if not timed:
        return {}
    pooled = spreads_of(list(timed.values()))
    return {label: _latency_interval(samples, pooled) for label, samples in timed.items()}


def verdict_of(low: float, high: float) -> str:
    """Verdict on the first of two configurations, from the interval of their log latency ratio."""
    return "faster" if high < 0 else "slower" if low > 0 else "undecided"


def latency_draws(
    all_samples: Sequence[Samples | None],
    medians_ms: NDArray[np.float64],
    n: int,
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw log latencies (n_configurations, n) as repeated measurements would give them.

    A draw is the sum of a part that is common to all configurations and cancels in ratios, and a
    part of each configuration. Both follow Student's t with the pooled degrees of freedom.

    Parameters
    ----------
    all_samples : sequence of mapping or None
        Raw samples of configurations that were timed together.
    medians_ms : (n_configurations,) float64
        Measured latencies, the centres of the draws.
    n : int
        Number of draws.
    generator : numpy.random.Generator
    """
    timed = {
        i: samples
        for i, samples in enumerate(all_samples)
        if samples is not None and len(samples.get("latency_ms", ()))
    }
    spreads = (
        spreads_of(list(timed.values()))
        if timed
        else Spreads(Spread(0.0, 0.0), Spread(0.0, 0.0), np.zeros(0))
    )
    specific = spreads.specific.moderated(TYPICAL_SPREAD)
    common = spreads.common.moderated(TYPICAL_DRIFT)
    sd, variance = np.full(len(medians_ms), specific.sd), np.ones(len(medians_ms))
    sd[list(timed)] = np.fmax(specific.sd, spreads.own)
    variance[list(timed)] = [median_variance(n_processes_of(samples)) for samples in timed.values()]
    shared = common.sd * generator.standard_t(common.df, n)
    # The pooled variance is one number: its uncertainty is common to all configurations.
    wide = np.sqrt(specific.df / generator.chisquare(specific.df, n))
    private = (sd * np.sqrt(variance))[:, None] * generator.standard_normal((len(sd), n)) * wide
    return np.asarray(np.log(medians_ms)[:, None] + shared + private)
