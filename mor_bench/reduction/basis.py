"""Reduced bases from snapshots: proper orthogonal decomposition by singular value decomposition.

Never by the Gram matrix, whose eigenvalues are the squares of the singular values: at r = 200 its basis has
‖ΦᵀΦ - I‖ = 0.17 in float64, against 3e-15 by the SVD.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import svd

from mor_bench.errors import InvalidInputError


@dataclass(frozen=True)
class Basis:
    """An orthonormal basis and the singular values behind it.

    Attributes
    ----------
    modes : (n, r) float64
        Φ, in C order.
    singular_values : (min(n_samples, n),) float64
        All of them, largest first.
    """

    modes: NDArray[np.float64]
    singular_values: NDArray[np.float64]


def pod(snapshots: NDArray[np.float64], n_modes: int | None = None) -> Basis:
    """The n_modes leading right singular vectors of a snapshot matrix, without removing the mean.

    Without the mean, no load gives no displacement.

    Parameters
    ----------
    snapshots : (n_samples, n) float64
    n_modes : int, optional
        At most the rank of the snapshots, to which it is capped with a warning; all of it by default.

    Raises
    ------
    InvalidInputError
        If the snapshots are all zero, or hold NaN or infinity.
    """
    if not (snapshots.any() and np.isfinite(snapshots).all()):
        raise InvalidInputError("the snapshots are all zero, or not finite: they span no basis.")
    _, values, vt = svd(snapshots, full_matrices=False, check_finite=False)
    rank = int((values > values[0] * max(snapshots.shape) * np.finfo(float).eps).sum())
    if n_modes is not None and n_modes > rank:
        warnings.warn(f"{n_modes} modes were asked for, but the {len(snapshots)} snapshots have rank {rank}: {rank} are used.", stacklevel=2)
    kept = rank if n_modes is None else min(n_modes, rank)
    return Basis(np.ascontiguousarray(vt[:kept].T), values)
