"""Base of hyper-reduced methods: training coordinates, nodal modes, a model over cells."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import body_of, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.parametric import Bodies
from mor_bench.model_arrays import take_array, take_indices
from mor_bench.reduction.galerkin import CubatureProblem
from mor_bench.reduction.points import ReducedPoints
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto
from mor_bench.reduction.static_correction import mark_of, marked_scene
from mor_bench.reduction.subspace import Subspace, extent_of
from mor_bench.scene.scene import Scene
from mor_bench.scene.scene_at import scale_of
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.corrected import Correction, basis_of, lacks_correction
from mor_bench.surrogates.cubature_states import (
    Matching,
    States,
    are_far,
    equilibria,
    in_energy,
    projected_states,
    training_rows,
)

Array = NDArray[np.float64]


def nodal(scene: Scene, rows: Array) -> Array:
    """Return modes (n_nodes, 3, r) from a row for each free dof; zero at supports."""
    return scene.columns_at_all_dofs(rows).reshape(scene.mesh.n_nodes, 3, -1)


def reduced_points(
    scene: Scene,
    cells: NDArray[np.int64],
    weights: Array,
    modes: Array,
    test_modes: Array | None = None,
    positions: Array | None = None,
) -> ReducedPoints:
    """Return the scene's law over some cells, with nodal modes and test modes (n_nodes, 3, r).

    With ``positions`` (n, 3), each entry of ``cells`` has a single point; see `Discretisation`.
    """
    body = replace(body_of(scene, cells), positions=positions)
    return ReducedPoints(body, weights, modes, test_modes)


CUBATURE_TOLERANCES = (3e-2, 1e-2, 3e-3, 1e-3)
"""Candidates for "auto"."""


@dataclass(eq=False)
class CubatureSurrogate(Surrogate):
    """POD-Galerkin over weighted cells; a subclass chooses cells and weights.

    Parameters
    ----------
    n_modes : int or "auto"
        Size r of the basis; capped at the modes that the snapshots determine, with a warning.
        "auto", also for the tolerances: the cheapest values that meet the scene's need, see
        `mor_bench.reduction.sizing`.
    cubature_tolerance : float or "auto"
        Allowed error of the cubature, in [0, 1). A smaller value keeps more cells: slower, and
        closer to plain POD. 0 keeps every cell.
    n_cubature_snapshots : int
        Training snapshots whose reduced forces are matched, spread evenly over the training set.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    matching : {"force", "energy", "as-needed"}
        What the cubature matches to its tolerance. "force": the forces of projected snapshots, in
        the Euclidean norm, as published. "energy": the forces of equilibria in the span of the
        modes, in the norm of the inverse stiffness at rest. It needs fewer cells at an equal error,
        and a solve of plain POD for each training state. "as-needed": "energy" if the projected
        snapshots are far from equilibrium, as in a nearly incompressible body, else "force".
    static_correction : bool
        Whether to add the part of the linear response that the modes lack. They then span the
        nonlinear parts of the snapshots, as in `LocalPOD` with one cluster. See
        `mor_bench.reduction.static_correction`. Not for contact or sampled parameters.
    """

    n_modes: Annotated[int, Field(ge=1)] | Auto = 20
    cubature_tolerance: Annotated[float, Field(ge=0, lt=1)] | Auto = 1e-3
    n_cubature_snapshots: Annotated[int, Field(ge=1)] = 300
    tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8
    matching: Matching = "as-needed"
    static_correction: bool = False

    sized: ClassVar = {
        "n_modes": MODES,
        "cubature_tolerance": CUBATURE_TOLERANCES,
        "tolerance": TOLERANCES,
    }

    def supports(self, scene: Scene) -> str | None:
        if reason := unknown_equations(scene, contact=True):
            return reason
        return lacks_correction(scene) if self.static_correction else None

    @abstractmethod
    def choose_cells(
        self, states: States, modes: Array, tolerance: float
    ) -> dict[str, NDArray[Any]]:
        """Return the model's ``cells`` (n,), and ``weights`` of them (n,) or of their points.

        ``positions`` (n, 3) mean that an entry of ``cells`` has a single point there.
        There is one body, unless the class takes sampled parameters and the scene has some.
        """

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        tolerance = self.value("cubature_tolerance")
        modes, reduced = basis_of(scene, samples, self.value("n_modes"), self.static_correction)
        kept = {"modes": modes, **mark_of(scene, reduced)}
        if tolerance == 0:
            whole = {"cells": np.arange(scene.mesh.n_cells), "weights": np.ones(scene.mesh.n_cells)}
            return {**kept, **whole}
        return {**kept, **self.choose_cells(*self._matched(reduced, samples, modes), tolerance)}

    def _matched(self, scene: Scene, samples: Snapshots, modes: Array) -> tuple[States, Array]:
        """Return training states, and the modes on which their forces are matched."""
        states = projected_states(scene, samples, modes, self.n_cubature_snapshots)
        if self.matching == "force":
            return states, modes
        loads = samples.free_forces[
            training_rows(samples.free_displacements, self.n_cubature_snapshots)
        ]
        if self.matching == "as-needed" and not are_far(states, loads, modes):
            return states, modes
        return in_energy(equilibria(states, loads, modes), modes)

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        self.modes_ = take_array(model, "modes", (len(scene.free_dofs), None))
        moved = "positions" in model
        self.cells_ = take_indices(model, "cells", scene.mesh.n_cells, distinct=not moved)
        self.positions_ = take_array(model, "positions", (len(self.cells_), 3)) if moved else None
        if moved and not (np.abs(model["positions"]) <= 1).all():
            raise InvalidInputError("`positions` must be in [-1, 1].")
        shape = (len(self.cells_), None)[: model["weights"].ndim]
        self.weights_ = take_array(model, "weights", shape)
        by_cell = self.weights_.reshape(len(self.cells_), -1)
        if not ((by_cell >= 0).all() and by_cell.any(axis=1).all()):
            raise InvalidInputError(
                "`weights` must be positive for a cell, or for some of its points."
            )
        self.subspace_ = Subspace(scene, self.modes_)
        self._on_nodes = nodal(scene, self.modes_)
        self.problem_ = self._problem(marked_scene(scene, model))
        self.problem_.prepare()
        if self.static_correction:
            self.correction_ = Correction(scene)
        if scene.contact:
            from mor_bench.reduction.pressed_modes import PressedModes  # only such scenes need it

            self.pressed_ = PressedModes(scene, self.problem_, self.modes_)
        if scene.parameter_names:
            self.bodies_ = Bodies(scene)

    def _problem(self, scene: Scene) -> CubatureProblem:
        rule = self.cells_, self.weights_, self._on_nodes
        points = reduced_points(scene, *rule, positions=self.positions_)
        return CubatureProblem(points, extent_of(scene))

    def _problem_of(self, parameters: Array) -> CubatureProblem:
        """Return the problem of a body, (n_parameters,)."""
        scene = self.bodies_.at(parameters)
        if self.scene_.springs or scene.generated.is_preloaded:
            return self._problem(scene)
        body = replace(body_of(scene, self.cells_), positions=self.positions_)
        points = self.problem_.points.scaled(body, scale_of(self.scene_, parameters))
        return CubatureProblem(points, extent_of(scene))

    def answer(self, forces: Array) -> Array:
        if self.static_correction:
            tolerance = self.value("tolerance")
            return self.correction_.answer(self.problem_, self.modes_, forces, tolerance)
        options = NewtonOptions(self.value("tolerance"))
        return self.subspace_.answer(
            forces, lambda load: self.problem_.solve(load, options).displacement
        )

    def answer_observed(self, observed: ObservedDisplacements) -> Array:
        options = NewtonOptions(self.value("tolerance"))
        return self.subspace_.answer_given(
            observed.values, lambda given: self.pressed_.solve(given, options)
        )

    def answer_parametric(self, forces: Array, parameters: Array) -> Array:
        options = NewtonOptions(self.value("tolerance"))

        def solve(load: Array, values: Array) -> Array:
            body, factor = self.bodies_.shared(values)
            reference = self.bodies_.is_reference(body)
            problem = self.problem_ if reference else self._problem_of(body)
            return problem.solve(factor * load, options).displacement

        return self.subspace_.answer_each(forces, parameters, solve)
