"""Coordinates for regressions, and weights of their errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.reduction.basis import pod

Array = NDArray[np.float64]

SMALLEST = 0.2
"""Least reference size of errors, relative to the root mean square displacement."""


def input_axes(inputs: Array, n_modes: int, evenness: float) -> Array:
    """Return axes (n, n_modes) of scaled principal coordinates of inputs (n_samples, n).

    No mean is removed. Evenness 0 keeps the coordinates' relative sizes, 1 makes them equal, and
    values between interpolate on a logarithmic scale. The mean square is always 1. The number of
    modes is capped at the rank of the inputs with a warning.
    """
    used = np.flatnonzero(inputs.any(axis=0))  # forces act on few dofs
    modes = pod(inputs[:, used], n_modes).modes
    squares = ((inputs[:, used] @ modes) ** 2).mean(axis=0)
    axes = np.zeros((inputs.shape[1], modes.shape[1]))
    axes[used] = modes / np.sqrt(squares**evenness * squares.mean() ** (1.0 - evenness))
    return axes


def change_of_basis(old: Array, new: Array) -> Array:
    """Return B (n_new, n_old) for bases old (n, n_old) and new (n, n_new).

    xᵀold = (xᵀnew) B for x in the span of new, and new B is nearest to old.
    """
    change: Array = np.linalg.pinv(new) @ old
    return change


def error_weights(displacements: Array, smallest: float = SMALLEST) -> Array:
    """Return weights (n_samples,) that make errors relative to displacements (n_samples, n).

    Displacements smaller than a part `smallest` of the root mean square get the weight of that
    size.
    """
    sizes = np.linalg.norm(displacements, axis=1)
    typical = float(np.sqrt((sizes**2).mean()))
    weights: Array = typical / np.maximum(sizes, smallest * typical)
    return weights
