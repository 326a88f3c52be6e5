"""Hyper-reduced POD by the empirical cubature method (ECM)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.reduction.cubature import ecsw_system
from mor_bench.reduction.empirical_cubature import empirical_cubature
from mor_bench.surrogates.cubature_states import States
from mor_bench.surrogates.hyper_reduced import CubatureSurrogate

Array = NDArray[np.float64]


@dataclass(eq=False)
class EmpiricalCubaturePOD(CubatureSurrogate):
    """POD-Galerkin over a few weighted cells that integrate a basis of the reduced forces exactly.

    ``cubature_tolerance`` is the fraction of the reduced cell forces that the basis may miss, in
    the Frobenius norm over cells, snapshots and modes; 0 keeps every cell with weight 1
    (Hernández, Caicedo, Ferrer 2017). The weights sum to the number of cells. The other parameters
    are those of `CubatureSurrogate`.
    """

    def choose_cells(
        self, states: States, modes: Array, tolerance: float
    ) -> dict[str, NDArray[Any]]:
        ((model, q),) = states()
        weights = empirical_cubature(
            ecsw_system(model.assembler, model.cell_dofs, modes, q), tolerance
        ).weights
        cells = np.flatnonzero(weights)
        return {"cells": cells, "weights": weights[cells]}
