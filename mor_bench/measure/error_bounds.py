"""Bounds of a prediction's error, calibrated by split-conformal prediction.

The samples for the calibration must not have been used for training. Loads of one region share
their errors, so a region counts as one group: Lee, Barber and Willett, "Distribution-free inference
with hierarchical data" (2023), section 3. The bound then holds for a load in a new region, if the
regions are exchangeable. It says nothing about other kinds of loads. Samples with several forces
share regions in many ways, so each counts as a group, and the bound is no promise for new regions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.measure.predictions import predict_all
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

LEVEL = 0.9
"""Default share of loads whose error the bound holds for."""


@runtime_checkable
class WithSpread(Protocol):
    """A method that says how uncertain its answers are, such as an ensemble by disagreement."""

    def spread(self, forces: ArrayLike) -> NDArray[np.float64]:
        """Return the uncertainty relative to the prediction, of shape () or (n,)."""


@dataclass(frozen=True)
class ErrorBound:
    """A bound of the relative L2 error that holds for a given share of new loads.

    Attributes
    ----------
    level : float
        Share of loads for which the bound holds.
    relative_l2 : float
        Bound of the norm of the error over the norm of the reference; infinite if there are too few
        groups for this level.
    n_samples, n_groups : int
        Samples of the calibration, and independent groups among them.
    nodes : (n,) int64, optional
        The nodes that count, where the scene's `[needs] outputs` is a part of them.
    per_spread : float, optional
        Another bound of the same error, of a method with a `spread`: this factor times the spread,
        so that uncertain answers have wider bounds. Infinite as `relative_l2`.

    Examples
    --------
    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> linear = mor_bench.load_method("linear-fem").fit(data.scene)
    >>> bound = mor_bench.error_bound(linear, data.validation)
    >>> bound.level, bound.n_samples, bound.n_groups, bound.relative_l2
    (0.9, 30, 3, inf)
    """

    level: float
    relative_l2: float
    n_samples: int
    n_groups: int
    nodes: NDArray[np.int64] | None = field(default=None, compare=False)
    per_spread: float | None = None

    def of_prediction(
        self, displacements: ArrayLike, spread: ArrayLike | None = None
    ) -> NDArray[np.float64]:
        """Return the bound of the norm of each prediction's error, m.

        A relative bound b < 1 gives the error at most b / (1 - b) times the norm of the prediction,
        since the norm of the reference is at most that of the prediction plus that of the error.
        For b >= 1, and for a prediction that is not finite, the bound is infinite.

        Parameters
        ----------
        displacements : (n_nodes, 3) or (n, n_nodes, 3)
            Predictions û, m.
        spread : float or (n,), optional
            The method's `spread` for these loads; then b is `per_spread` times it.

        Returns
        -------
        array of shape () or (n,)

        Raises
        ------
        InvalidInputError
            If a spread is given and the method has none, or it is no number >= 0 for each
            prediction.
        """
        counting = slice(None) if self.nodes is None else self.nodes
        found = np.asarray(displacements, dtype=np.float64)[..., counting, :]
        norm = np.linalg.norm(found, axis=(-2, -1))
        share = np.asarray(self.relative_l2)
        if spread is not None:
            if self.per_spread is None:
                raise InvalidInputError(
                    "`spread` must be left out: this is not the bound of a method with a spread."
                )
            given = np.asarray(spread, dtype=np.float64)
            if given.shape not in ((), norm.shape) or not (given >= 0).all():
                raise InvalidInputError(
                    f"`spread` must hold numbers >= 0 of shape {norm.shape}; got {given}."
                )
            share = np.full(given.shape, inf)
            if isfinite(self.per_spread):
                share = _scaled(self.per_spread, given)
        known = (share < 1) & np.isfinite(norm)
        within, size = np.where(known, share, 0.0), np.where(known, norm, 0.0)
        return np.asarray(np.where(known, within / (1 - within) * size, inf))


def error_bound(method: Surrogate, samples: Snapshots, level: float = LEVEL) -> ErrorBound:
    """Calibrate a bound of a fitted method's error on samples that it has not learned from.

    Samples of one load region count as one group if the scene's split is by region, as in a run.
    Otherwise, and with several forces at a time, each sample is a group of its own. Then the bound
    is no promise for loads in new regions.

    Parameters
    ----------
    method : Surrogate
    samples : Snapshots
        For example `Dataset.validation`.
    level : float
        In (0, 1).

    Raises
    ------
    InvalidInputError
        If the level is out of range, or there are no samples.

    Examples
    --------
    Samples of one load region count as one group, so few regions bound few loads:

    >>> import mor_bench
    >>> data = mor_bench.load_dataset("beam-tiny")
    >>> linear = mor_bench.load_method("linear-fem").fit(data.scene)
    >>> error_bound(linear, data.train, level=0.5).relative_l2 < 0.2
    True

    A method with a spread also gives every load a bound of its own:

    >>> ensemble = mor_bench.load_method("pod-nn-ensemble", iterations=50)
    >>> bound = error_bound(ensemble.fit(data.scene, data.train), data.validation, level=0.5)
    >>> forces = data.test.forces
    >>> bound.of_prediction(ensemble.predict(forces), ensemble.spread(forces)).shape
    (40,)
    """
    if not (isinstance(level, float) and 0 < level < 1):
        raise InvalidInputError(f"`level` of `error_bound` must be in (0, 1); got {level!r}.")
    if len(samples) == 0:
        raise InvalidInputError("`samples` of `error_bound` must hold at least one sample; got 0.")
    scene, given = samples.scene, samples.given
    predicted = predict_all(method, given)
    errors = sample_errors(predicted, samples.displacements, scene.output_nodes)
    spreads = method.spread(given.query) if isinstance(method, WithSpread) else None
    regions = samples.regions if scene.spec.split.by == "region" else None
    bound = calibrated(errors.relative_l2, regions, level, spreads)
    part = len(scene.output_nodes) < scene.mesh.n_nodes
    return replace(bound, nodes=scene.output_nodes) if part else bound


def calibrated(
    errors: NDArray[np.float64],
    regions: NDArray[np.int64] | None,
    level: float = LEVEL,
    spreads: NDArray[np.float64] | None = None,
) -> ErrorBound:
    """Return the bound from the relative L2 errors (n,) of a calibration set.

    Parameters
    ----------
    errors : (n,) float64
        NaN counts as infinite.
    regions : (n,) or (n, k) int64, optional
        Load regions of the samples. Samples with several forces share regions in many ways, so each
        counts as a group of its own. So does each sample if `regions` is None.
    level : float
    spreads : (n,) float64, optional
        Those of a method with a spread; they give the bound `per_spread`.
    """
    errors = np.where(np.isnan(errors), inf, errors)
    groups = np.arange(len(errors))
    if regions is not None and regions.ndim == 1:
        groups = np.unique(regions, return_inverse=True)[1]
    n_groups = int(groups.max()) + 1
    mass = 1.0 / np.bincount(groups)[groups] / (n_groups + 1)
    per_spread = None
    if spreads is not None:
        # An infinite spread bounds any error.
        scores = np.where((errors > 0) & np.isfinite(spreads), inf, 0.0)
        np.divide(errors, spreads, out=scores, where=(spreads > 0) & np.isfinite(spreads))
        per_spread = _quantile(scores, mass, level)
    bound = _quantile(errors, mass, level)
    return ErrorBound(level, bound, len(errors), n_groups, per_spread=per_spread)


def _quantile(values: NDArray[np.float64], mass: NDArray[np.float64], level: float) -> float:
    """Return the least value whose mass with that of all lower ones reaches the level, or inf."""
    order = np.argsort(values, kind="stable")
    reached = np.flatnonzero(np.cumsum(mass[order]) >= level - 1e-12)
    return float(values[order[reached[0]]]) if len(reached) else inf


def covered(
    bound: ErrorBound, scores: Mapping[str, Mapping[str, Any]], *, scaled: bool = False
) -> dict[str, float]:
    """Return the share of the samples of each test set whose error keeps the bound.

    With `scaled`, it is the bound `per_spread`.
    """
    share = bound.per_spread if scaled else bound.relative_l2
    if share is None or not isfinite(share):
        return {}
    held = {
        name: score["relative_l2"] <= (_scaled(share, score["spread"]) if scaled else share)
        for name, score in scores.items()
    }
    return {name: float(each.mean()) for name, each in held.items()}


def _scaled(per_spread: float, spreads: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `per_spread` times each spread, and infinity for an infinite spread."""
    finite = np.isfinite(spreads)
    return np.where(finite, per_spread * np.where(finite, spreads, 0.0), inf)
