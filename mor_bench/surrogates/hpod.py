"""Hyper-reduced POD by energy-conserving sampling and weighting (ECSW)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.reduction.cubature import sparse_nnls
from mor_bench.surrogates.hyper_reduced import CubatureSurrogate


class HyperReducedPOD(CubatureSurrogate):
    """POD-Galerkin that integrates over a few weighted cells only, chosen by non-negative least squares.

    The weights are trained so that the reduced force of the projected snapshots is kept to a relative residual of
    ``cubature_tolerance``, where 0 keeps every cell with weight 1 (Farhat et al. 2014). The sum of the weights is not the
    number of cells, and volume is not preserved. Weights that are not negative keep a potential: the tangent is symmetric.

    The other parameters are those of `CubatureSurrogate`.
    """

    def _train(self, system: NDArray[np.float64]) -> NDArray[np.float64]:
        return sparse_nnls(system, system.sum(axis=1), self.cubature_tolerance).weights
