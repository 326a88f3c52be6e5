"""Galerkin on the quadratic manifold of the modal derivatives, with static correction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import SolverError
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.model_arrays import take_array
from mor_bench.reduction.cubature import sparse_nnls
from mor_bench.reduction.derivative_modes import linear_modes, modal_derivatives
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.manifold import ManifoldProblem, QuadraticManifold, manifold_system
from mor_bench.reduction.static_correction import (
    model_of,
    refuse_inverted,
    softened,
    static_correction,
)
from mor_bench.reduction.weighted_cells import weighted_cells
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs.load_ranges import largest_of
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.free_dofs import answer_each

Array = NDArray[np.float64]

N_CUBATURE_LOADS = 200
"""Number of loads for the training of the cubature on the manifold."""


@dataclass(eq=False)
class QuadraticManifoldGalerkin(Surrogate):
    """Few linear modes, each bent by its modal derivatives: u = Φq + ½ Σ qᵢqⱼψᵢⱼ.

    Static correction adds the part of the linear response outside Φ
    (`mor_bench.reduction.static_correction`). ECSW keeps few cells. It is trained on equilibria of
    the manifold itself, without a full-order solve. Jain and Tiso (Simulation-free hyper-reduction
    for geometrically nonlinear structural dynamics, J. Comput. Nonlinear Dynam. 13 (2018)) lift
    linear solutions instead. The static correction uses the stiffness of the kept cells, so small
    loads get the linear response with any cubature.

    Parameters
    ----------
    n_modes : int
        Unknowns q; capped at the rank of the linear responses to the scene's loads with a warning.
    cubature_tolerance : float
        Allowed relative residual of the reduced forces in the cubature, in [0, 1); 0 keeps all
        cells.
    tolerance : float
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    """

    n_modes: Annotated[int, Field(ge=1)] = 5
    cubature_tolerance: Annotated[float, Field(ge=0, lt=1)] = 1e-3
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8

    needs_snapshots: ClassVar[bool] = False

    def supports(self, scene: Scene) -> str | None:
        if scene.springs:
            return "its cubature has no springs, and the scene rests on some"
        return unknown_equations(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        full = FullOrderModel(scene)
        modes = linear_modes(scene, full, self.n_modes).modes
        manifold = QuadraticManifold(modes, modal_derivatives(full, modes))
        weights = np.ones(scene.mesh.n_cells)
        if self.cubature_tolerance > 0:
            reduced = model_of(softened(scene), full)
            states = _states_under_loads(reduced, manifold)
            system = manifold_system(reduced.assembler, reduced.cell_dofs, manifold, states)
            weights = sparse_nnls(system, system.sum(axis=1), self.cubature_tolerance).weights
        cells = np.flatnonzero(weights)
        return {
            "modes": modes,
            "derivatives": manifold.derivatives,
            "cells": cells,
            "weights": weights[cells],
        }

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        self.cells_, self.weights_ = model["cells"], model["weights"]
        modes = take_array(model, "modes", (len(scene.free_dofs), None))
        self.manifold_ = QuadraticManifold(modes, model["derivatives"])
        assembler, rows = weighted_cells(softened(scene), self.cells_, self.weights_)
        self.linear_ = GalerkinProblem(assembler, modes[rows])
        self.sampled_ = QuadraticManifold(modes[rows], self.manifold_.derivatives[rows])
        self.model_ = FullOrderModel(scene)
        self.compliance_ = Compliance(self.model_)
        self.linear_.prepare()

    def answer(self, forces: Array) -> Array:
        return answer_each(self.scene_, forces, self._solve)

    def _solve(self, load: Array) -> Array:
        modes = self.manifold_.modes
        problem = ManifoldProblem(self.linear_, self.sampled_, self.manifold_.curvature(load))
        count(multiply_adds=modes.size)
        q = solve_equilibrium(
            problem, modes.T @ load, options=NewtonOptions(self.tolerance)
        ).displacement
        # The stiffness of the sampled cells also corrects their error at small strains.
        correction = static_correction(self.compliance_, self.linear_.rest_factor, modes, load)
        u = self.manifold_.at(q)[0] + correction
        refuse_inverted(self.model_, u)
        return np.asarray(u)


def _states_under_loads(model: FullOrderModel, manifold: QuadraticManifold) -> list[Array]:
    """Return equilibria q on the manifold, with all cells, under random forces on patches."""
    scene, rng = model.scene, np.random.default_rng(0)
    linear = GalerkinProblem(model.assembler, manifold.modes)
    on_nodes = scene.patch_weights.toarray() * scene.patch_scales[:, None]
    largest = largest_of(scene.generated.load_plan.magnitude)
    chosen = np.linspace(0, len(on_nodes) - 1, N_CUBATURE_LOADS).round().astype(int)
    vectors = rng.normal(size=(len(chosen), 3))
    vectors *= (
        largest
        * rng.uniform(0.2, 1.0, (len(chosen), 1))
        / np.linalg.norm(vectors, axis=1, keepdims=True)
    )
    states = []
    for weights, vector in zip(on_nodes[chosen], vectors, strict=True):
        load = scene.at_free_dofs(np.outer(weights, vector).reshape(1, -1))[0]
        problem = ManifoldProblem(linear, manifold, manifold.curvature(load))
        try:
            states.append(
                solve_equilibrium(
                    problem, manifold.modes.T @ load, options=NewtonOptions(1e-4)
                ).displacement
            )
        except SolverError as error:
            failed = error
    if not states:
        raise failed
    return states
