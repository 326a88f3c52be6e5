"""Hyper-reduced POD by the discrete empirical interpolation method (DEIM, Q-DEIM)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.model_arrays import take_array, take_indices
from mor_bench.reduction.basis import pod
from mor_bench.reduction.discrete_interpolation import Selection, interpolation_rows
from mor_bench.reduction.galerkin import stiffness_times
from mor_bench.reduction.petrov import InterpolatedProblem
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto
from mor_bench.reduction.subspace import Subspace, extent_of
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.hyper_reduced import (
    nodal,
    reduced_points,
    training_coordinates,
)

Array = NDArray[np.float64]

FORCE_MODES = (10, 20, 40, 80, 160)
"""Candidates for "auto"."""


@dataclass(eq=False)
class InterpolatedPOD(Surrogate):
    """POD-Galerkin with a nonlinear force that is interpolated from a few of its entries.

    The linear part of the force is projected exactly. The remainder n(u) = f(u) - K₀u is
    approximated in the span of the leading modes U of its training snapshots: f_r(q) = ΦᵀK₀Φ q +
    ΦᵀU (PᵀU)⁻¹ Pᵀ n(Φq) (Chaturantabut & Sorensen 2010). Pᵀ selects as many dofs as U has columns.
    Only the cells that touch these dofs are integrated. The tangent is not symmetric and there is
    no potential, so stability is not guaranteed.

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
    n_force_snapshots : int
        Training snapshots whose forces span U, spread evenly over the training set.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    """

    n_modes: Annotated[int, Field(ge=1)] | Auto = 20
    n_force_modes: Annotated[int, Field(ge=1)] | Auto = 40
    selection: Selection = "pivoted-qr"
    n_force_snapshots: Annotated[int, Field(ge=1)] = 300
    tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8

    sized: ClassVar = {"n_modes": MODES, "n_force_modes": FORCE_MODES, "tolerance": TOLERANCES}

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        displacements = samples.free_displacements
        modes = pod(displacements, self.value("n_modes")).modes
        model = FullOrderModel(scene)
        stiff = stiffness_times(model.assembler.pattern, model.rest_tangent, modes)
        q = training_coordinates(displacements, modes, self.n_force_snapshots)
        forces = np.array([model.force(modes @ own).force - stiff @ own for own in q])
        basis = pod(forces, self.value("n_force_modes")).modes
        dofs = interpolation_rows(basis, self.selection)
        return {
            "modes": modes,
            "dofs": dofs,
            "interpolation": np.linalg.solve(basis[dofs].T, basis.T @ modes),
            "rest": modes.T @ stiff,
        }

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        n_free = len(scene.free_dofs)
        self.modes_ = take_array(model, "modes", (n_free, None))
        r = self.modes_.shape[1]
        dofs = take_indices(model, "dofs", n_free)
        sampled = np.zeros((n_free, r))
        sampled[dofs] = take_array(model, "interpolation", (len(dofs), r))
        touched = np.zeros(scene.mesh.n_nodes, dtype=bool)
        touched[scene.free_dofs[dofs] // 3] = True
        self.cells_ = np.flatnonzero(touched[scene.mesh.cells].any(axis=1))
        points = reduced_points(
            scene,
            self.cells_,
            np.ones(len(self.cells_)),
            nodal(scene, self.modes_),
            nodal(scene, sampled),
        )
        self.subspace_ = Subspace(scene, self.modes_)
        rest = take_array(model, "rest", (r, r))
        try:
            self.problem_ = InterpolatedProblem(points, rest, extent_of(scene))
        except np.linalg.LinAlgError:
            raise InvalidInputError("`rest` must be positive definite.") from None

    def answer(self, forces: Array) -> Array:
        options = NewtonOptions(self.value("tolerance"))
        return self.subspace_.answer(forces, lambda load: self.problem_.solve(load, options))
