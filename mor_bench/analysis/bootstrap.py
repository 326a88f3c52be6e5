"""Bootstrap over the load regions of a test set.

Errors within a load region resemble each other, so regions are resampled, not samples.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

LEVEL = 0.95
"""Level of all intervals."""


def student_t(level: float, df: float) -> float:
    """Half-width of the central interval of Student's t distribution, in standard deviations."""
    from scipy.special import stdtrit

    return float(stdtrit(df, (1 + level) / 2))


def cluster_numbers(regions: NDArray[np.int64] | None, n_samples: int) -> NDArray[np.int64]:
    """Number the load regions of each test sample from 0, as an (n_samples, k) array.

    A load that acts on the same region in every sample, such as a pressure, tells nothing apart and
    is left out. If fewer than two regions remain, each sample is a cluster of its own.
    """
    if regions is not None and len(regions) == n_samples > 0:
        columns = regions.reshape(n_samples, -1)
        varying = columns[:, (columns != columns[0]).any(axis=0)]
        names, numbers = np.unique(varying, return_inverse=True)
        if len(names) > 1:
            return np.asarray(numbers.reshape(varying.shape))
    return np.arange(n_samples)[:, None]


def resample_weights(
    clusters: NDArray[np.int64], n: int, generator: np.random.Generator
) -> NDArray[np.int32]:
    """Count how often each test sample occurs in each bootstrap resample of the load regions.

    Regions are drawn with replacement, as many as there are. A sample with one region counts as
    often as its region. A sample with several regions counts as the product of their counts (the
    pigeonhole bootstrap: Owen 2007; Davezies, D'Haultfœuille, Guyonvarch 2021). Resampling only the
    first region would hold the others fixed, and connected components would form one cluster.

    Parameters
    ----------
    clusters : (n_samples, k) int
        From `cluster_numbers`.
    n : int
        Number of resamples.
    generator : numpy.random.Generator

    Returns
    -------
    (n_samples, n) int32
        Each column has at least one positive count.
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
    """Medians (n,) of values (n_samples,), with integer weights (n_samples, n)."""
    order = np.argsort(values)
    ordered, below = values[order], np.cumsum(weights[order], axis=0, dtype=np.int32)
    size = below[-1]
    lower, upper = ((below < rank).sum(axis=0) for rank in ((size + 1) // 2, size // 2 + 1))
    return np.asarray(0.5 * (ordered[lower] + ordered[upper]))


def weighted_means(values: NDArray[np.float64], weights: NDArray[np.int32]) -> NDArray[np.float64]:
    """Means (n,) of values (n_samples,), with integer weights (n_samples, n)."""
    with np.errstate(invalid="ignore"):
        failed = ~np.isfinite(values)
        means = np.where(failed, 0.0, values) @ weights / weights.sum(axis=0)
    return np.asarray(
        np.where(weights[failed].any(axis=0), np.inf, means) if failed.any() else means
    )


def widening(n_clusters: int) -> float:
    """Factor that corrects the spread of resamples of few clusters; 1.16 for 13 clusters.

    Resamples of K clusters vary too little, by the factor sqrt((K - 1) / K). Percentiles assume a
    normal distribution, but Student's t with K - 1 degrees of freedom applies (Hesterberg 2015,
    What teachers should know about the bootstrap).
    """
    from scipy.special import ndtri

    return (
        sqrt(n_clusters / (n_clusters - 1))
        * student_t(LEVEL, n_clusters - 1)
        / float(ndtri((1 + LEVEL) / 2))
    )


def widen(
    draws: NDArray[np.float64], value: float, factor: float, bounds: tuple[float, float]
) -> NDArray[np.float64]:
    """Stretch draws of a positive figure away from its value on the log scale, within bounds."""
    finite = np.isfinite(draws)
    if not 0 < value < np.inf:
        return draws
    safe = np.where(finite & (draws > 0), draws, value)
    stretched = np.clip(value * (safe / value) ** factor, *bounds)
    return np.asarray(np.where(finite & (draws > 0), stretched, draws))


def central_interval(draws: NDArray[np.float64]) -> tuple[float, float]:
    """Central 95 % of the draws; an end is infinite if more than 2.5 % of the draws are."""
    low, high = np.quantile(draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="inverted_cdf")
    return float(low), float(high)
