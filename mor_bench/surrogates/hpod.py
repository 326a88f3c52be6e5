"""Hyper-reduced POD by energy-conserving sampling and weighting (ECSW)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.cubature import ecsw_system, sparse_nnls, triangle
from mor_bench.surrogates.hyper_reduced import CubatureSurrogate, nodal, reduced_points

Array = NDArray[np.float64]


@dataclass(eq=False)
class HyperReducedPOD(CubatureSurrogate):
    """POD-Galerkin over a few weighted cells only, chosen by non-negative least squares.

    The weights reproduce the reduced force of the projected snapshots to a relative residual of
    ``cubature_tolerance`` (Farhat et al. 2014). They do not sum to the number of cells, so volume
    is not preserved. No weight is negative, so a potential exists and the tangent is symmetric.

    Parameters
    ----------
    n_modes, cubature_tolerance, n_cubature_snapshots, tolerance
        See `CubatureSurrogate`.
    sampling : {"cells", "points"}
        "cells": integrate every point of a chosen cell, as published. "points": a second cubature
        to the same tolerance keeps few points of these cells, each with its own weight (Yano &
        Patera 2019 choose points in this way). Then positive det F is checked at these points only.
    """

    sampling: Literal["cells", "points"] = "points"

    def choose_cells(
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
        if model.springs is not None:  # they are no part of the cubature
            target -= (q @ (modes.T @ (model.springs @ modes))).ravel()
        both = triangle(np.column_stack([own, target]))
        factors = sparse_nnls(
            np.ascontiguousarray(both[:, :-1]), both[:, -1], tolerance
        ).weights.reshape(len(cells), -1)
        used = factors.any(axis=1)
        return cells[used], factors[used]
