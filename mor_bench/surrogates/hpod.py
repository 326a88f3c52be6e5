"""Hyper-reduced POD by energy-conserving sampling and weighting (ECSW)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.elements import GAUSS
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.cubature import ecsw_system, short, sparse_nnls, triangle
from mor_bench.reduction.moved_points import PointRule, move_points
from mor_bench.scene.scene import Scene
from mor_bench.surrogates.cubature_states import States
from mor_bench.surrogates.hyper_reduced import CubatureSurrogate, nodal, reduced_points

Array = NDArray[np.float64]

MOVED_ONLY = "points move in H8 with full integration only, of a body without sampled parameters"


@dataclass(eq=False)
class HyperReducedPOD(CubatureSurrogate):
    """POD-Galerkin over a few weighted cells only, chosen by non-negative least squares.

    The weights reproduce the reduced force of the projected snapshots to a relative residual of
    ``cubature_tolerance`` (Farhat et al. 2014). They do not sum to the number of cells, so volume
    is not preserved. No weight is negative, so a potential exists and the tangent is symmetric.

    Parameters
    ----------
    n_modes, cubature_tolerance, n_cubature_snapshots, tolerance, matching, static_correction
        See `CubatureSurrogate`.
    sampling : {"cells", "points", "moved"}
        "cells": integrate every point of a chosen cell, as published. "points": a second cubature
        to the same tolerance keeps few points of these cells, each with its own weight (Yano &
        Patera 2019 choose points in this way). Then positive det F is checked at these points only.
        "moved": these points move within and between cells while as many as possible leave, to the
        same tolerance (after Hernández et al. 2024, see `mor_bench.reduction.moved_points`). Half
        as many points suffice, and queries are faster. Fits take longer. Only for H8 with full
        integration and a body without sampled parameters.
    """

    sampling: Literal["cells", "points", "moved"] = "points"

    takes_parameters: ClassVar = True

    def supports(self, scene: Scene) -> str | None:
        if reason := super().supports(scene):
            return reason
        if self.sampling != "moved":
            return None
        whole = scene.mesh.cells.shape[1] == 8 and not scene.selective
        return None if whole and not scene.parameter_names else MOVED_ONLY

    def choose_cells(
        self, states: States, modes: Array, tolerance: float
    ) -> dict[str, NDArray[Any]]:
        systems = [ecsw_system(m.assembler, m.cell_dofs, modes, q) for m, q in states()]
        system = systems[0] if len(systems) == 1 else short(np.concatenate(systems))
        weights = sparse_nnls(system, system.sum(axis=1), tolerance).weights
        cells = np.flatnonzero(weights)
        if self.sampling == "cells":
            return {"cells": cells, "weights": weights[cells]}
        own, targets = [], []
        for model, q in states():
            on_nodes = nodal(model.scene, modes)
            points = reduced_points(model.scene, cells, np.ones(len(cells)), on_nodes)
            own += [points.point_forces(row).T for row in q]
            targets.append(_forces(model, modes, q).ravel())
        target = np.concatenate(targets)
        both = triangle(np.column_stack([np.concatenate(own), target]))
        factors = sparse_nnls(
            np.ascontiguousarray(both[:, :-1]), both[:, -1], tolerance
        ).weights.reshape(len(cells), -1)
        if self.sampling == "moved":
            cell, point = np.nonzero(factors)
            start = PointRule(cells[cell], GAUSS[point], factors[cell, point])
            return vars(_moved(states, modes, target, start, tolerance))
        used = factors.any(axis=1)
        return {"cells": cells[used], "weights": factors[used]}


def _moved(
    states: States, modes: Array, target: Array, start: PointRule, tolerance: float
) -> PointRule:
    """Return a rule with moved points for the states of a single body, see `move_points`."""
    ((model, q),) = states()
    scene, on_nodes = model.scene, nodal(model.scene, modes)

    def integrands(cells: NDArray[np.int64], positions: Array) -> Array:
        points = reduced_points(scene, cells, np.ones(len(cells)), on_nodes, positions=positions)
        return np.concatenate([points.point_forces(row) for row in q], axis=1)

    return move_points(scene.mesh, integrands, target, start, tolerance)


def _forces(model: FullOrderModel, modes: Array, q: Array) -> Array:
    """Return the reduced forces of states (n, r) without springs, which no cubature replaces."""
    forces = np.array([modes.T @ model.force(modes @ row).force for row in q])
    return forces if model.springs is None else forces - q @ (modes.T @ (model.springs @ modes))
