"""Coordinates that regressions work in, and what their errors count."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.reduction.basis import pod

Array = NDArray[np.float64]

SMALLEST = 0.2
"""Errors count relative to the displacement, or to this share of the root mean square displacement where that is larger."""


def input_axes(inputs: Array, n_modes: int, evenness: float) -> Array:
    """Axes (n, n_modes) of scaled principal coordinates of inputs (n_samples, n), without a mean.

    Their sizes lie between the coordinates' own (evenness 0) and equal ones (1), on a logarithmic scale; their mean square is
    1 with either. The number of modes is capped at the rank of the inputs with a warning.
    """
    used = np.flatnonzero(inputs.any(axis=0))  # of forces only a few columns
    modes = pod(inputs[:, used], n_modes).modes
    squares = ((inputs[:, used] @ modes) ** 2).mean(axis=0)
    axes = np.zeros((inputs.shape[1], modes.shape[1]))
    axes[used] = modes / np.sqrt(squares**evenness * squares.mean() ** (1.0 - evenness))
    return axes


def change_of_basis(old: Array, new: Array) -> Array:
    """B (n_new, n_old) for bases (n, n_old) and (n, n_new): xᵀold = (xᵀnew) B for x in the span of new, and new B a nearest to old."""
    change: Array = np.linalg.pinv(new) @ old
    return change


def error_weights(displacements: Array) -> Array:
    """(n_samples,) what errors are multiplied by so that they count relative to displacements (n_samples, n), see `SMALLEST`."""
    sizes = np.linalg.norm(displacements, axis=1)
    typical = float(np.sqrt((sizes**2).mean()))
    weights: Array = typical / np.maximum(sizes, SMALLEST * typical)
    return weights
