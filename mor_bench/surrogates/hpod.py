"""Hyper-reduced POD by energy-conserving sampling and weighting (ECSW)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from mor_bench.reduction.cubature import ecsw_system, sparse_nnls, triangle
from mor_bench.surrogates.cubature_states import States
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
    n_modes, cubature_tolerance, n_cubature_snapshots, tolerance, matching
        See `CubatureSurrogate`.
    sampling : {"cells", "points"}
        "cells": integrate every point of a chosen cell, as published. "points": a second cubature
        to the same tolerance keeps few points of these cells, each with its own weight (Yano &
        Patera 2019 choose points in this way). Then positive det F is checked at these points only.
    """

    sampling: Literal["cells", "points"] = "points"

    takes_parameters: ClassVar = True

    def choose_cells(
        self, states: States, modes: Array, tolerance: float
    ) -> tuple[NDArray[np.int64], Array]:
        systems = [ecsw_system(m.assembler, m.cell_dofs, modes, q) for m, q in states()]
        system = systems[0] if len(systems) == 1 else _short(np.concatenate(systems))
        weights = sparse_nnls(system, system.sum(axis=1), tolerance).weights
        cells = np.flatnonzero(weights)
        if self.sampling == "cells":
            return cells, weights[cells]
        own, target = [], []
        for model, q in states():
            on_nodes = nodal(model.scene, modes)
            points = reduced_points(model.scene, cells, np.ones(len(cells)), on_nodes)
            forces = np.array([modes.T @ model.force(modes @ row).force for row in q])
            if model.springs is not None:  # they are no part of the cubature
                forces -= q @ (modes.T @ (model.springs @ modes))
            own += [points.point_forces(row).T for row in q]
            target.append(forces.ravel())
        both = triangle(np.column_stack([np.concatenate(own), np.concatenate(target)]))
        factors = sparse_nnls(
            np.ascontiguousarray(both[:, :-1]), both[:, -1], tolerance
        ).weights.reshape(len(cells), -1)
        used = factors.any(axis=1)
        return cells[used], factors[used]


def _short(system: Array) -> Array:
    """Return a matrix with the same least-squares problem; QR pays above 4 rows per column."""
    return triangle(system) if len(system) > 4 * system.shape[1] else system
