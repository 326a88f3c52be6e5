"""Uncertainty of errors and latencies: what a repeated measurement, other load regions or another training seed would give.

Latencies come from a few fresh processes per configuration. Their queries agree far better within a process than between
processes, so that the processes count, not the queries. Errors come from test samples of a few load regions, which
resemble each other within a region, so that the regions count, not the samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, log, nan, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError

LEVEL = 0.95
"""Of all intervals but those of `compare_latency`."""

COMPARISON_LEVEL = 0.98
"""Of the interval of `compare_latency`: at 95 %, six or more of a hundred comparisons of identical code would often be called different."""

TYPICAL_SPREAD = 0.014
"""Relative standard deviation of a configuration's median between fresh processes on a quiet machine."""

TYPICAL_DRIFT = 0.02
"""The same of what slows all configurations alike, between runs that are minutes apart; within a run it is 0.7 %. It cancels in ratios."""

PRIOR_DF = 2.0
"""Degrees of freedom that these count for beside what was measured: two processes may agree by chance to 0.01 %."""

Samples = Mapping[str, NDArray[Any]]
"""Raw samples of a configuration: `latency_ms` (n,), and of each query its `process` and `round` (n,), one of each if absent."""


@dataclass(frozen=True)
class Spread:
    """Relative standard deviation of a median between processes, and the degrees of freedom with which it is known."""

    sd: float
    df: float

    def moderated(self, typical: float) -> Spread:
        """The spread with a typical one mixed in; of a single process, the typical one itself."""
        df = self.df + PRIOR_DF
        return Spread(sqrt((self.df * self.sd**2 + PRIOR_DF * typical**2) / df), df)


@dataclass(frozen=True)
class Spreads:
    """How configurations that were timed together scatter between processes.

    Attributes
    ----------
    common : Spread
        Of what hits all configurations of a process alike, such as the machine's drift. It cancels in ratios.
    specific : Spread
        Of the rest, pooled over the configurations.
    own : (n,) float64
        The specific part of each configuration alone; NaN of a single process.
    """

    common: Spread
    specific: Spread
    own: NDArray[np.float64]


def student_t(level: float, df: float) -> float:
    """Half-width of the central interval of Student's t, in standard deviations."""
    from scipy.special import stdtrit

    return float(stdtrit(df, (1 + level) / 2))


def _log_medians(samples: Samples) -> dict[tuple[int, int], float]:
    """Logarithm of the median latency of each process and round."""
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
    """(n_configurations, n_processes, n_rounds) log medians; NaN where a configuration was not timed."""
    medians = [_log_medians(samples) for samples in all_samples]
    processes, rounds = (sorted({key[i] for found in medians for key in found}) for i in (0, 1))
    cube = np.full((len(medians), len(processes), len(rounds)), nan)
    for c, found in enumerate(medians):
        for (process, turn), value in found.items():
            cube[c, processes.index(process), rounds.index(turn)] = value
    return cube


def spreads_of(all_samples: Sequence[Samples]) -> Spreads:
    """Spread between processes of configurations that were timed in turn, so that process p and round r are the same moment for all.

    A two-way analysis of variance of the log medians, configurations by processes. Of a single configuration all spread
    counts as specific.

    Parameters
    ----------
    all_samples : sequence of mapping
        Raw samples of each configuration.
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
        own = np.where(degrees > 0, np.sqrt(correction * np.nansum(rest**2, axis=1) / degrees), nan)
        shared = _nan_mean(_centred(_nan_median(cube)), axis=0)
    df, most = float(degrees.sum()) / correction, float(degrees.max())
    if df == 0:
        return Spreads(Spread(0.0, 0.0), Spread(0.0, 0.0), own)
    specific = float(np.nansum(rest**2)) / df
    common = float(np.nansum(shared**2)) / most - specific / n if n > 1 else 0.0
    return Spreads(
        Spread(sqrt(max(common, 0.0)), most if n > 1 else 0.0), Spread(sqrt(specific), df), own
    )


def _nan_median(cube: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median over the last axis, NaN where nothing is."""
    out = np.full(cube.shape[:-1], nan)
    seen = np.isfinite(cube).any(axis=-1)
    out[seen] = np.nanmedian(cube[seen], axis=-1)
    return out


def _nan_mean(array: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Mean over an axis, NaN where nothing is."""
    return np.asarray(np.nansum(array, axis=axis) / np.isfinite(array).sum(axis=axis))


def _centred(array: NDArray[np.float64]) -> NDArray[np.float64]:
    return array - _nan_mean(array, axis=1)[:, None]


def median_variance(n_processes: int) -> float:
    """Variance of the median over processes that differ by a standard deviation of one, at most."""
    return (pi / 2 if n_processes > 2 else 1.0) / n_processes


def n_processes_of(samples: Samples) -> int:
    """Fresh processes that a configuration was timed in."""
    return len(np.unique(samples["process"])) if "process" in samples else 1


def latency_interval(samples: Samples, pooled: Spreads | None = None) -> tuple[float, float]:
    """The interval in which the median of a repeated measurement falls: the same protocol, as many fresh processes.

    A prediction interval at 95 %: it holds the noise of both measurements. More processes average out what is specific to
    each, but not the drift that they share. In simulations as those of `compare_latency`, of eight configurations on a
    machine that drifts by up to 5 % within a run or so, 94 to 99 % of repeated medians fell into it, with 2, 3 and 5
    processes; a drift of 20 % that is slower than the whole run cannot be known from it, and leaves 85 %.

    Parameters
    ----------
    samples : mapping
        Raw samples of a configuration.
    pooled : Spreads, optional
        Of the configurations that were timed together; the larger of it and the configuration's own is used. Without it a
        drift cannot be told from differences between processes.

    Returns
    -------
    (low, high)
        ms.
    """
    own = spreads_of([samples])
    pooled = pooled or own
    common, specific = (
        pooled.common.moderated(TYPICAL_DRIFT),
        pooled.specific.moderated(TYPICAL_SPREAD),
    )
    sd = float(
        np.nanmax(
            [specific.sd, own.own[0] if pooled.common.df == 0 else _without(own.own[0], common.sd)]
        )
    )
    private, shared = sd**2 * median_variance(n_processes_of(samples)), common.sd**2
    df = (private + shared) ** 2 / (
        private**2 / specific.df + shared**2 / common.df
    )  # Welch and Satterthwaite
    centre, half = (
        log(float(np.median(samples["latency_ms"]))),
        student_t(LEVEL, df) * sqrt(2 * (private + shared)),
    )
    return exp(centre - half), exp(centre + half)


def _without(total: float, part: float) -> float:
    """Standard deviation of what is left of a total without an independent part."""
    return sqrt(max(total**2 - part**2, 0.0))


def intervals_of(samples_by_label: Mapping[str, Samples]) -> dict[str, tuple[float, float]]:
    """`latency_interval` of each of the configurations that were timed together, with the spread pooled over them."""
    timed = {
        label: samples
        for label, samples in samples_by_label.items()
        if len(samples.get("latency_ms", ()))
    }
    if not timed:
        return {}
    pooled = spreads_of(list(timed.values()))
    return {label: latency_interval(samples, pooled) for label, samples in timed.items()}


def compare_latency(samples_a: Samples, samples_b: Samples) -> dict[str, Any]:
    """Is a faster than b? From processes and rounds in which both were timed in turn.

    Each process gives one number, the median over its rounds of the log ratio of the two medians; what slows both alike
    cancels. Their mean stands in a Student-t interval at 98 %, with `TYPICAL_SPREAD` mixed into their variance as if two
    more processes had shown it.

    In 1,500 simulations each of 5 processes x 5 rounds x 40 queries with processes that differ by 0.5 to 2 %, one in twenty
    slower by 5 to 10 %, heavy-tailed queries and a drift common to both, identical code was called different in 0 to 2.9 of
    100 comparisons, and a slow-down of 10 % was found in 97 to 99.9 of 100; with processes that differ by 3 %, in 3.9 and
    91. The plain t interval at 95 % errs in 5 of 100; at 98 % it finds 91 to 95 of 100, since five processes cannot tell
    their own spread from an outlier; trimmed means and Student-t likelihoods did worse in one or the other.

    Parameters
    ----------
    samples_a, samples_b : mapping
        Raw samples of each.

    Returns
    -------
    dict
        `ratio` of latencies a / b with `low`, `high`; `verdict` on a: ``faster``, ``slower`` or, if the interval holds 1,
        ``undecided``; `n_processes`.

    Raises
    ------
    InvalidInputError
        If no process timed both.
    """
    cube = _cube([samples_a, samples_b])
    both = np.isfinite(cube).all(axis=0)
    if not both.any():
        raise InvalidInputError(
            "`samples_a` and `samples_b` must have a `process` and `round` in common; they have none."
        )
    logs = _nan_median(np.where(both, cube[0] - cube[1], nan))
    logs = logs[np.isfinite(logs)]
    n = len(logs)
    # A difference scatters sqrt(2) times as much as one configuration.
    spread = Spread(float(logs.std(ddof=1)) / sqrt(2) if n > 1 else 0.0, n - 1.0).moderated(
        TYPICAL_SPREAD
    )
    centre, half = (
        float(logs.mean()),
        student_t(COMPARISON_LEVEL, spread.df) * spread.sd * sqrt(2 / n),
    )
    low, high = centre - half, centre + half
    return {
        "ratio": exp(centre),
        "low": exp(low),
        "high": exp(high),
        "verdict": verdict_of(low, high),
        "n_processes": n,
    }


def verdict_of(low: float, high: float) -> str:
    """What the interval of a log ratio of latencies says of the first."""
    return "faster" if high < 0 else "slower" if low > 0 else "undecided"


def latency_draws(
    all_samples: Sequence[Samples | None],
    medians_ms: NDArray[np.float64],
    n: int,
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Log latencies as other sets of processes would have given them.

    A draw has one part that all configurations share and that cancels in their ratios, and one of each configuration, both
    with Student's t of the pooled degrees of freedom. The larger of a configuration's own and the pooled spread is used.

    Parameters
    ----------
    all_samples : sequence of mapping or None
        Raw samples of configurations that were timed together.
    medians_ms : (n_configurations,) float64
        Their latencies, the centres of the draws.
    n : int
        Draws.
    generator : numpy.random.Generator

    Returns
    -------
    (n_configurations, n) float64
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
    specific, common = (
        spreads.specific.moderated(TYPICAL_SPREAD),
        spreads.common.moderated(TYPICAL_DRIFT),
    )
    sd, variance = np.full(len(medians_ms), specific.sd), np.ones(len(medians_ms))
    sd[list(timed)] = np.fmax(specific.sd, spreads.own)
    variance[list(timed)] = [median_variance(n_processes_of(samples)) for samples in timed.values()]
    shared = common.sd * generator.standard_t(common.df, n)
    # The pooled variance is one number: its uncertainty is common to all configurations.
    wide = np.sqrt(specific.df / generator.chisquare(specific.df, n))
    private = (sd * np.sqrt(variance))[:, None] * generator.standard_normal((len(sd), n)) * wide
    return np.asarray(np.log(medians_ms)[:, None] + shared + private)


def clusters_of(regions: NDArray[np.int64] | None, n_samples: int) -> NDArray[np.int64]:
    """(n_samples, k) numbers from 0 of the load regions of each test sample; the samples' own numbers where there are no two regions."""
    if regions is not None and len(regions) == n_samples:
        names, numbers = np.unique(regions, return_inverse=True)
        if len(names) > 1:
            return np.asarray(numbers.reshape(n_samples, -1))
    return np.arange(n_samples)[:, None]


def resample_weights(
    clusters: NDArray[np.int64], n: int, generator: np.random.Generator
) -> NDArray[np.int32]:
    """How often each test sample is in each bootstrap resample of the load regions.

    Regions are drawn with replacement, as many as there are. A sample with one region is taken as often as its region; one
    with several forces as often as the product of how often its regions were drawn (the pigeonhole bootstrap: Owen 2007;
    Davezies, D'Haultfœuille, Guyonvarch 2021). Such samples are linked with each other through all their regions: a
    bootstrap over the first region alone would hold the others fixed, and connected components leave one cluster.

    Parameters
    ----------
    clusters : (n_samples, k) int
        From `clusters_of`.
    n : int
        Resamples.
    generator : numpy.random.Generator

    Returns
    -------
    (n_samples, n) int32
        No column is all zero.
    """
    n_clusters = int(clusters.max()) + 1
    weights = np.empty((len(clusters), n), dtype=np.int32)
    missing = np.arange(n)
    while len(missing):
        counts = generator.multinomial(
            n_clusters, np.full(n_clusters, 1 / n_clusters), size=len(missing)
        ).T.astype(np.int32)
        drawn = counts[clusters[:, 0]]
        for column in clusters[:, 1:].T:
            drawn *= counts[column]
        weights[:, missing] = drawn
        missing = missing[drawn.sum(axis=0) == 0]
    return weights


def weighted_medians(
    values: NDArray[np.float64], weights: NDArray[np.int32]
) -> NDArray[np.float64]:
    """(n,) medians of values (n_samples,), each taken as often as its row of weights (n_samples, n) says."""
    order = np.argsort(values)
    ordered, below = values[order], np.cumsum(weights[order], axis=0, dtype=np.int32)
    size = below[-1]
    lower, upper = ((below < rank).sum(axis=0) for rank in ((size + 1) // 2, size // 2 + 1))
    return np.asarray(0.5 * (ordered[lower] + ordered[upper]))


def weighted_means(values: NDArray[np.float64], weights: NDArray[np.int32]) -> NDArray[np.float64]:
    """(n,) means of values (n_samples,), each taken as often as its row of weights (n_samples, n) says."""
    with np.errstate(invalid="ignore"):
        failed = ~np.isfinite(values)
        means = np.where(failed, 0.0, values) @ weights / weights.sum(axis=0)
    return np.asarray(
        np.where(weights[failed].any(axis=0), np.inf, means) if failed.any() else means
    )


def widening(n_clusters: int) -> float:
    """Factor by which the deviations of few resampled clusters are too small.

    Resamples of K clusters vary by sqrt((K - 1) / K) too little, and percentiles take them for normal where Student's t with
    K - 1 degrees of freedom holds (Hesterberg 2015, What teachers should know about the bootstrap). 1.16 for 13 clusters.
    """
    from scipy.special import ndtri

    return (
        sqrt(n_clusters / (n_clusters - 1))
        * student_t(LEVEL, n_clusters - 1)
        / float(ndtri((1 + LEVEL) / 2))
    )


def widened(
    draws: NDArray[np.float64], value: float, factor: float, bounds: tuple[float, float]
) -> NDArray[np.float64]:
    """Draws of a positive figure, moved away from its value on the log scale by a factor, within the bounds that it cannot leave."""
    finite = np.isfinite(draws)
    if not 0 < value < np.inf:
        return draws
    safe = np.where(finite & (draws > 0), draws, value)
    stretched = np.clip(value * (safe / value) ** factor, *bounds)
    return np.asarray(np.where(finite & (draws > 0), stretched, draws))


def quantiles(draws: NDArray[np.float64]) -> tuple[float, float]:
    """The central 95 % of draws; an end is infinite where more than 2.5 % of the draws are."""
    low, high = np.quantile(draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="inverted_cdf")
    return float(low), float(high)
