"""Collect a method's predictions for scoring."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.snapshots.given import Given
from mor_bench.surrogate import Surrogate


def predict_all(method: Surrogate, given: Given) -> NDArray[np.float64]:
    """Return predictions (n, n_nodes, 3), m; NaN where the method found no equilibrium.

    Parameters
    ----------
    method : Surrogate
    given : Forces, ParametricForces or ObservedDisplacements
        With values (n, n_nodes, 3).

    Raises
    ------
    InvalidInputError
        If the method returns another shape or no floats.
    """
    try:
        # Copies, because a method may change its input, which the scoring still needs.
        predicted = np.asarray(method.predict(_copied(given)))
    except SolverError:
        predicted = np.full(given.values.shape, np.nan)
        for i, answer in enumerate(predicted):
            try:
                answer[:] = method.predict(_copied(given[i]))
            except SolverError:
                continue
    if predicted.shape != given.values.shape or predicted.dtype.kind != "f":
        raise InvalidInputError(
            f"`predict` must return floats of shape {given.values.shape}; "
            f"it returned {predicted.dtype} of shape {predicted.shape}."
        )
    return predicted.astype(np.float64, copy=False)


def _copied(given: Given) -> ArrayLike:
    return given.with_values(given.values.copy()).query
