"""Uncertainty of the error of a method that is trained with several seeds.

The question is always the error of another training. The logarithms of the errors of k trainings
are taken as normal: another one differs from their mean by Student's t with k - 1 degrees of
freedom, times their standard deviation, times sqrt(1 + 1/k). A resampling of few trainings would
hold too little: of three, it never leaves the range of the three.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import exp, inf, sqrt

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.bootstrap import LEVEL, student_t, widen
from mor_bench.analysis.frontier import EXACT

Statistic = Callable[[NDArray[np.float64], NDArray[np.int32]], NDArray[np.float64]]
"""`weighted_medians` or `weighted_means`."""


def seed_interval(errors: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % prediction interval for the error of another training.

    The test set is the same. The interval is unbounded for a single training, and above if a
    training failed (an infinite error).

    Parameters
    ----------
    errors : (k,) float
        Errors of trainings that differ only in their seed.
    """
    logs = np.log(np.maximum(errors, EXACT))
    finite = logs[np.isfinite(logs)]
    if len(finite) < 2:
        return 0.0, inf
    middle, half = float(finite.mean()), student_t(LEVEL, len(finite) - 1) * _prediction_sd(finite)
    return exp(middle - half), exp(middle + half) if len(finite) == len(logs) else inf


def _prediction_sd(logs: NDArray[np.float64]) -> float:
    return float(logs.std(ddof=1)) * sqrt(1 + 1 / len(logs))


def error_draws(
    trainings: NDArray[np.float64],
    weights: NDArray[np.int32],
    factor: float,
    statistic: Statistic,
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw the error of another training on other load regions: a nested bootstrap.

    Each draw resamples the load regions, computes the error of every training on them, and draws
    another training from the mean and the scatter of these errors.

    Parameters
    ----------
    trainings : (k, n_samples) float64
        Errors of each training on the test samples; all infinite for a training that failed. With
        one training, only the regions vary.
    weights : (n_samples, n) int
        Resamples of the load regions, from `resample_weights`.
    factor : float
        Widens the spread between resamples, see `widening`.
    statistic : callable
        The error of a training on weighted samples.
    generator : numpy.random.Generator

    Returns
    -------
    (n,) float64
        Infinite in the share of trainings that failed.
    """
    n, once = weights.shape[1], np.ones((weights.shape[0], 1), dtype=np.int32)
    points = np.array([statistic(errors, once)[0] for errors in trainings])
    good = np.isfinite(points)
    if not good.any():
        return np.full(n, inf)
    bounds = float(trainings[good].min()), float(trainings[good].max())
    resampled = np.array([statistic(errors, weights) for errors in trainings[good]])
    if len(trainings) == 1:
        return widen(resampled[0], float(points[0]), factor, bounds)
    logs = np.log(np.maximum(resampled, EXACT))
    middle = float(np.exp(np.log(np.maximum(points[good], EXACT)).mean()))
    draws = widen(np.exp(logs.mean(axis=0)), middle, factor, bounds)
    if len(logs) > 1:
        with np.errstate(invalid="ignore"):
            sd = logs.std(axis=0, ddof=1) * sqrt(1 + 1 / len(logs))
        draws = draws * np.exp(np.nan_to_num(sd) * _student_draws(len(logs) - 1, n, generator))
    failed = generator.permutation(n) < round(n * np.mean(~good))
    return np.where(failed, inf, draws)


def _student_draws(df: int, n: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return evenly spaced quantiles of Student's t in random order: the tails without chance."""
    from scipy.special import stdtrit

    return np.asarray(stdtrit(df, (generator.permutation(n) + 0.5) / n))
