"""Hyper-reduced POD by the empirical cubature method (ECM)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mor_bench.reduction.cubature import ecsw_system, short
from mor_bench.reduction.empirical_cubature import empirical_cubature
from mor_bench.surrogates.cubature_states import States
from mor_bench.surrogates.hyper_reduced import CubatureSurrogate, nodal, reduced_points

Array = NDArray[np.float64]


@dataclass(eq=False)
class EmpiricalCubaturePOD(CubatureSurrogate):
    """POD-Galerkin over a few weighted cells that integrate a basis of the reduced forces exactly.

    ``cubature_tolerance`` is the fraction of the reduced cell forces that the basis may miss, in
    the Frobenius norm over cells, snapshots and modes; 0 keeps every cell with weight 1
    (Hernández, Caicedo, Ferrer 2017). The weights sum to the number of cells.

    Parameters
    ----------
    n_modes, cubature_tolerance, n_cubature_snapshots, tolerance, matching, static_correction
        See `CubatureSurrogate`.
    sampling : {"cells", "points"}
        "cells": integrate every point of a chosen cell, as Kratos does. "points": a second cubature
        to the same tolerance keeps few points of these cells, each with its own weight. Then
        positive det F is checked at these points only.
    """

    sampling: Literal["cells", "points"] = "cells"

    def choose_cells(
        self, states: States, modes: Array, tolerance: float
    ) -> dict[str, NDArray[Any]]:
        ((model, q),) = states()
        weights = empirical_cubature(
            ecsw_system(model.assembler, model.cell_dofs, modes, q), tolerance
        ).weights
        cells = np.flatnonzero(weights)
        weights = weights[cells]
        if self.sampling == "cells":
            return {"cells": cells, "weights": weights}
        points = reduced_points(model.scene, cells, weights, nodal(model.scene, modes))
        forces = np.concatenate([points.point_forces(row).T for row in q])
        factors = empirical_cubature(short(forces), tolerance).weights.reshape(len(cells), -1)
        used = factors.any(axis=1)
        return {"cells": cells[used], "weights": factors[used] * weights[used, None]}
