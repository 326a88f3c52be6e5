"""Hyper-reduced POD by discrete empirical interpolation (DEIM, Q-DEIM, unassembled DEIM)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.model_arrays import take_array, take_indices
from mor_bench.reduction.basis import pod
from mor_bench.reduction.discrete_interpolation import Selection, interpolation_rows
from mor_bench.reduction.galerkin import stiffness_times
from mor_bench.reduction.petrov import InterpolatedProblem
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto
from mor_bench.reduction.static_correction import mark_of, marked_scene
from mor_bench.reduction.subspace import Subspace, extent_of
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.corrected import Correction, basis_of
from mor_bench.surrogates.cubature_states import (
    are_far,
    equilibria,
    projected_states,
    training_rows,
)
from mor_bench.surrogates.hyper_reduced import nodal, reduced_points

Array = NDArray[np.float64]

FORCE_MODES = (10, 20, 40, 80, 160)
"""Candidates for "auto"."""
STEP = 1e-5
"""Step of the central difference, relative to the size of the body."""


@dataclass(eq=False)
class InterpolatedPOD(Surrogate):
    """POD-Galerkin with a nonlinear force that is interpolated from a few of its entries.

    The linear part of the force is projected exactly. The remainder n(u) = f(u) - K₀u is
    approximated in the span of the leading modes U of its training snapshots: f_r(q) = ΦᵀK₀Φ q +
    ΦᵀU (PᵀU)⁻¹ Pᵀ n(Φq) (Chaturantabut & Sorensen 2010). Pᵀ selects as many dofs as U has columns.
    Only the cells that touch these dofs are integrated. The tangent is not symmetric and there is
    no potential, so stability is not guaranteed.

    The unassembled variant (Tiso & Rixen 2013) treats the forces of all cells on their own nodes as
    one long vector, before cells are summed. An entry of it belongs to one cell, and an entry of
    the assembled force to as many as meet at a node. So it integrates fewer cells.

    Parameters
    ----------
    n_modes : int or "auto"
        Size r of the basis Φ; capped at the snapshots' rank with a warning. "auto", also for
        `n_force_modes` and `tolerance`: the cheapest values that meet the scene's need, see
        `mor_bench.reduction.sizing`.
    n_force_modes : int or "auto"
        Columns of U, and dofs sampled; capped at the rank of the nonlinear forces with a warning.
    selection : {"greedy", "pivoted-qr"}
        Choice of the dofs: by Chaturantabut & Sorensen, or by pivoted QR (Q-DEIM, Drmač & Gugercin
        2016).
    sampling : {"dofs", "cell-dofs", "cells"}
        Entries that are evaluated. "dofs": of the assembled force (DEIM). "cell-dofs": of the
        forces of single cells (unassembled DEIM). "cells": all entries of the cells that
        "cell-dofs" chooses; least squares fits the basis to them (gappy POD, Everson & Sirovich
        1995). It costs the same, and is the most accurate and stable of the three.
    states : {"projected", "equilibria", "as-needed"}
        States whose forces span U: projected snapshots, or the equilibria in the span of the modes
        under the same loads. "as-needed": equilibria if the projected snapshots are far from them,
        as in a nearly incompressible body.
    n_force_snapshots : int
        Training snapshots whose forces span U, spread evenly over the training set.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    static_correction : bool
        As in `CubatureSurrogate`.
    """

    n_modes: Annotated[int, Field(ge=1)] | Auto = 20
    n_force_modes: Annotated[int, Field(ge=1)] | Auto = 40
    selection: Selection = "pivoted-qr"
    n_force_snapshots: Annotated[int, Field(ge=1)] = 300
    tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8
    sampling: Literal["dofs", "cell-dofs", "cells"] = "dofs"
    states: Literal["projected", "equilibria", "as-needed"] = "as-needed"
    static_correction: bool = False

    sized: ClassVar = {"n_modes": MODES, "n_force_modes": FORCE_MODES, "tolerance": TOLERANCES}

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        modes, reduced = basis_of(scene, samples, self.value("n_modes"), self.static_correction)
        model = FullOrderModel(reduced)
        stiff = stiffness_times(model.assembler.pattern, model.rest_tangent, modes)
        q = self._coordinates(reduced, samples, modes)
        kept = {"modes": modes, "rest": modes.T @ stiff, **mark_of(scene, reduced)}
        if self.sampling != "dofs":
            return {**kept, **self._unassembled(model, modes, q)}
        forces = np.array([model.force(modes @ own).force - stiff @ own for own in q])
        basis = pod(forces, self.value("n_force_modes")).modes
        dofs = interpolation_rows(basis, self.selection)
        interpolation = np.linalg.solve(basis[dofs].T, basis.T @ modes)
        return {**kept, "dofs": dofs, "interpolation": interpolation}

    def _coordinates(self, scene: Scene, samples: Snapshots, modes: Array) -> Array:
        """Return coordinates (n, r) of the training states."""
        states = projected_states(scene, samples, modes, self.n_force_snapshots)
        rows = training_rows(samples.free_displacements, self.n_force_snapshots)
        loads = samples.free_forces[rows]
        wanted = self.states == "equilibria"
        if wanted or (self.states == "as-needed" and are_far(states, loads, modes)):
            states = equilibria(states, loads, modes)
        ((_, q),) = states()
        return q

    def _unassembled(self, model: FullOrderModel, modes: Array, q: Array) -> dict[str, Any]:
        """Return entries of the forces of cells, and their part in the reduced force."""
        by_cell = np.vstack([modes, np.zeros(modes.shape[1])])[model.cell_dofs]
        on_entries = by_cell.reshape(-1, modes.shape[1])
        basis = pod(_remainders(model, modes, q), self.value("n_force_modes")).modes
        entries = interpolation_rows(basis, self.selection)
        if self.sampling == "cells":
            width = model.cell_dofs.shape[1]
            free = model.cell_dofs < len(modes)
            free[np.setdiff1d(np.arange(len(free)), entries // width)] = False
            entries = np.flatnonzero(free)
        fitted = np.linalg.lstsq(basis[entries].T, basis.T @ on_entries, rcond=None)[0]
        return {"entries": entries, "interpolation": fitted}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        n_free = len(scene.free_dofs)
        self.modes_ = take_array(model, "modes", (n_free, None))
        r = self.modes_.shape[1]
        if self.sampling == "dofs":
            dofs = take_indices(model, "dofs", n_free)
            sampled = np.zeros((n_free, r))
            sampled[dofs] = take_array(model, "interpolation", (len(dofs), r))
            touched = np.zeros(scene.mesh.n_nodes, dtype=bool)
            touched[scene.free_dofs[dofs] // 3] = True
            self.cells_ = np.flatnonzero(touched[scene.mesh.cells].any(axis=1))
            tested = nodal(scene, sampled)
        else:
            shape = (*scene.mesh.cells.shape, 3)
            entries = take_indices(model, "entries", int(np.prod(shape)))
            self.cells_, own = np.unique(entries // (shape[1] * 3), return_inverse=True)
            by_cell = np.zeros((len(self.cells_), shape[1] * 3, r))
            rows = take_array(model, "interpolation", (len(entries), r))
            by_cell[own, entries % (shape[1] * 3)] = rows
            tested = _along_axes(scene, self.cells_, by_cell).reshape(-1, *shape[1:], r)
        rule = self.cells_, np.ones(len(self.cells_)), nodal(scene, self.modes_)
        points = reduced_points(marked_scene(scene, model), *rule, tested)
        self.subspace_ = Subspace(scene, self.modes_)
        rest = take_array(model, "rest", (r, r))
        try:
            self.problem_ = InterpolatedProblem(points, rest, extent_of(scene))
        except NotPositiveDefiniteError:
            raise InvalidInputError("`rest` must be positive definite.") from None
        if self.static_correction:
            self.correction_ = Correction(scene)

    def answer(self, forces: Array) -> Array:
        if self.static_correction:
            tolerance = self.value("tolerance")
            return self.correction_.answer(self.problem_, self.modes_, forces, tolerance)
        options = NewtonOptions(self.value("tolerance"))
        return self.subspace_.answer(forces, lambda load: self.problem_.solve(load, options))


def _remainders(model: FullOrderModel, modes: Array, q: Array) -> Array:
    """Return the forces of cells without their linear part, (n, n_cells n_cell_dofs), N.

    The linear part is a central difference. Its error, about 1e-9 of the force, is a part of the
    remainder, and the sampled force keeps its exact tangent at rest. Held dofs get zeros.
    """
    step, force_of = STEP * model.extent, model.assembler.cell_forces
    linear = np.array([(force_of(u) - force_of(-u)).ravel() for u in step * modes.T]) / (2 * step)
    forces = np.array([force_of(modes @ own).ravel() for own in q])
    return np.asarray((forces - q @ linear) * (model.cell_dofs.ravel() < len(modes)))


def _along_axes(scene: Scene, cells: NDArray[np.int64], by_cell: Array) -> Array:
    """Turn rows (n_cells, n_cell_dofs, r) from the frames of oblique supports to x, y and z."""
    if scene.frames is None:
        return by_cell
    turned = np.empty_like(by_cell)
    for number, cell in enumerate(scene.mesh.cells[cells]):
        fields = np.zeros((by_cell.shape[2], scene.mesh.n_dofs))
        dofs = dofs_of_nodes(cell)
        fields[:, dofs] = by_cell[number].T
        turned[number] = scene.frames.to_global(fields)[:, dofs].T
    return turned
