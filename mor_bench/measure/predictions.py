"""Ask a method for predictions as the scoring needs them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.surrogate import Surrogate


def predict_all(method: Surrogate, forces: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return predictions (n, n_nodes, 3), m; NaN where the method found no equilibrium.

    Parameters
    ----------
    method : Surrogate
    forces : (n, n_nodes, 3) float64
        N.

    Raises
    ------
    InvalidInputError
        If the method returns another shape or no floats.
    """
    try:
        # Copies: what a method does to its input must not reach the scoring.
        predicted = np.asarray(method.predict(forces.copy()))
    except SolverError:
        predicted = np.full(forces.shape, np.nan)
        for answer, force in zip(predicted, forces, strict=True):
            try:
                answer[:] = method.predict(force.copy())
            except SolverError:
                continue
    if predicted.shape != forces.shape or predicted.dtype.kind != "f":
        raise InvalidInputError(
            f"`predict` must return floats of shape {forces.shape}; "
            f"it returned {predicted.dtype} of shape {predicted.shape}."
        )
    return predicted.astype(np.float64, copy=False)
