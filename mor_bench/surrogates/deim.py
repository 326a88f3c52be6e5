"""Hyper-reduced POD by the discrete empirical interpolation method (DEIM, Q-DEIM)."""

from __future__ import annotations

from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.reduction.basis import pod
from mor_bench.reduction.discrete_interpolation import Selection, interpolation_rows
from mor_bench.reduction.galerkin import stiffness_times
from mor_bench.reduction.petrov import InterpolatedProblem
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto, size_to_needs
from mor_bench.reduction.subspace import Subspace, extent_of
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.hyper_reduced import (
    checked_array,
    checked_indices,
    nodal,
    reduced_points,
    training_coordinates,
)

Array = NDArray[np.float64]

FORCE_MODES = (10, 20, 40, 80, 160)
"""To choose from."""


class InterpolatedPOD(Surrogate):
    """POD-Galerkin whose nonlinear force is interpolated from a few of its entries.

    The linear part of the force is projected exactly; the rest n(u) = f(u) - K₀u is taken in the span of the leading modes U of
    its training snapshots, f_r(q) = ΦᵀK₀Φ q + ΦᵀU (PᵀU)⁻¹ Pᵀ n(Φq), where Pᵀ picks as many dofs as U has columns (Chaturantabut &
    Sorensen 2010). Only the cells that touch these dofs are integrated. The tangent is not symmetric and there is no potential:
    nothing keeps the model stable.

    Parameters
    ----------
    n_modes : int or "auto"
        Size r of the basis Φ; capped at the snapshots' rank with a warning. "auto", here and of the next and the last: as
        little work as meets the scene's need, see `mor_bench.reduction.sizing`.
    n_force_modes : int or "auto"
        Columns of U, and dofs sampled; capped at the rank of the nonlinear forces with a warning.
    selection : {"greedy", "pivoted-qr"}
        How dofs are chosen: as Chaturantabut & Sorensen, or by pivoted QR (Q-DEIM, Drmač & Gugercin 2016).
    n_force_snapshots : int
        Training snapshots whose forces span U, spread evenly over the training set.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load.
    """

    def __init__(
        self,
        n_modes: Annotated[int, Field(ge=1)] | Auto = 20,
        n_force_modes: Annotated[int, Field(ge=1)] | Auto = 40,
        selection: Selection = "pivoted-qr",
        n_force_snapshots: Annotated[int, Field(ge=1)] = 300,
        tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8,
    ) -> None:
        self.n_modes = n_modes
        self.n_force_modes = n_force_modes
        self.selection = selection
        self.n_force_snapshots = n_force_snapshots
        self.tolerance = tolerance

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            known = self._checked_snapshots(snapshots)
            knobs = size_to_needs(
                self,
                scene,
                known,
                {"n_modes": MODES, "n_force_modes": FORCE_MODES, "tolerance": TOLERANCES},
            )
            displacements = known.free_displacements
            modes = pod(displacements, knobs["n_modes"]).modes
            model = FullOrderModel(scene)
            stiff = stiffness_times(model.assembler.pattern, model.rest_tangent, modes)
            q = training_coordinates(displacements, modes, self.n_force_snapshots)
            forces = np.array([model.force(modes @ own).force - stiff @ own for own in q])
            basis = pod(forces, knobs["n_force_modes"]).modes
            dofs = interpolation_rows(basis, self.selection)
            interpolation = np.linalg.solve(basis[dofs].T, basis.T @ modes)
            self._restore(
                {
                    "modes": modes,
                    "dofs": dofs,
                    "interpolation": interpolation,
                    "rest": modes.T @ stiff,
                }
            )
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        options = NewtonOptions(self.tolerance_)
        return self._subspace.answer(
            batch, lambda load: self.problem_.solve(load, options)
        ).reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {
            "modes": self.modes_,
            "dofs": self.dofs_,
            "interpolation": self.interpolation_,
            "rest": self.rest_,
        }

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        scene = self.scene_
        n_free = len(scene.free_dofs)
        self.modes_ = checked_array(state["modes"], "modes", (n_free, None))
        r = self.modes_.shape[1]
        self.dofs_ = checked_indices(state["dofs"], "dofs", n_free)
        self.interpolation_ = checked_array(
            state["interpolation"], "interpolation", (len(self.dofs_), r)
        )
        self.rest_ = checked_array(state["rest"], "rest", (r, r))
        self.tolerance_, self._subspace = self._sized("tolerance"), Subspace(scene, self.modes_)
        sampled = np.zeros((n_free, r))
        sampled[self.dofs_] = self.interpolation_
        touched = np.zeros(scene.mesh.n_nodes, dtype=bool)
        touched[scene.free_dofs[self.dofs_] // 3] = True
        self.cells_ = np.flatnonzero(touched[scene.mesh.cells].any(axis=1))
        points = reduced_points(
            scene,
            self.cells_,
            np.ones(len(self.cells_)),
            nodal(scene, self.modes_),
            nodal(scene, sampled),
        )
        try:
            self.problem_ = InterpolatedProblem(points, self.rest_, extent_of(scene))
        except np.linalg.LinAlgError:
            raise InvalidInputError("`rest` must be positive definite.") from None
