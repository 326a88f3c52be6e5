"""Hyper-reduced POD by the empirical cubature method (ECM)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.reduction.empirical_cubature import empirical_cubature
from mor_bench.surrogates.hyper_reduced import CubatureSurrogate


class EmpiricalCubaturePOD(CubatureSurrogate):
    """POD-Galerkin over a few weighted cells that integrate a basis of the reduced cell forces exactly, and their number.

    ``cubature_tolerance`` is the share of the reduced cell forces, in the Frobenius norm over cells, snapshots and modes, that
    the basis may lack; 0 keeps every cell with weight 1 (Hernández, Caicedo, Ferrer 2017). The weights sum to the number of cells.

    The other parameters are those of `CubatureSurrogate`.
    """

    def _train(self, system: NDArray[np.float64]) -> NDArray[np.float64]:
        return empirical_cubature(system, self.cubature_tolerance).weights
