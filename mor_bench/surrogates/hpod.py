"""Hyper-reduced POD by energy-conserving sampling and weighting (ECSW)."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.cubature import ecsw_system, sparse_nnls, triangle
from mor_bench.reduction.sizing import Auto
from mor_bench.surrogates.hyper_reduced import CubatureSurrogate, nodal, reduced_points

Array = NDArray[np.float64]


class HyperReducedPOD(CubatureSurrogate):
    """POD-Galerkin that integrates over a few weighted cells only, chosen by non-negative least squares.

    The weights are trained so that the reduced force of the projected snapshots is kept to a relative residual of
    ``cubature_tolerance``, where 0 keeps every cell with weight 1 (Farhat et al. 2014). The sum of the weights is not the
    number of cells, and volume is not preserved. Weights that are not negative keep a potential: the tangent is symmetric.

    Parameters
    ----------
    sampling : {"cells", "points"}
        With "cells" every point of a chosen cell is integrated, as published. With "points" a second cubature to the same
        tolerance, of the points of the cells that the first one chose, leaves few of them, each with a weight of its own (Yano &
        Patera 2019 choose points so): at equal error, 20 modes of the fine beam take 0.27 ms at 127 points instead of 1.1 ms at
        848. Positive det F is checked at these points only.
    n_modes, cubature_tolerance, n_cubature_snapshots, tolerance
        As for `CubatureSurrogate`.
    """

    def __init__(
        self,
        n_modes: Annotated[int, Field(ge=1)] | Auto = 20,
        cubature_tolerance: Annotated[float, Field(ge=0, lt=1)] | Auto = 1e-3,
        n_cubature_snapshots: Annotated[int, Field(ge=1)] = 300,
        tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8,
        sampling: Literal["cells", "points"] = "points",
    ) -> None:
        super().__init__(n_modes, cubature_tolerance, n_cubature_snapshots, tolerance)
        self.sampling = sampling

    def _train(
        self, model: FullOrderModel, modes: Array, q: Array, tolerance: float
    ) -> tuple[NDArray[np.int64], Array]:
        system = ecsw_system(model.assembler, model.cell_dofs, modes, q)
        weights = sparse_nnls(system, system.sum(axis=1), tolerance).weights
        cells = np.flatnonzero(weights)
        if self.sampling == "cells":
            return cells, weights[cells]
        points = reduced_points(model.scene, cells, np.ones(len(cells)), nodal(model.scene, modes))
        own = np.concatenate([points.point_forces(coordinates).T for coordinates in q])
        target = np.concatenate(
            [modes.T @ model.force(modes @ coordinates).force for coordinates in q]
        )
        both = triangle(np.column_stack([own, target]))
        factors = sparse_nnls(
            np.ascontiguousarray(both[:, :-1]), both[:, -1], tolerance
        ).weights.reshape(len(cells), -1)
        used = factors.any(axis=1)
        return cells[used], factors[used]
