"""Base of the projections on a curved manifold in a POD space, over weighted cells."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.compliance import Compliance, project
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import accurate_modes, pod
from mor_bench.reduction.coordinates import error_weights
from mor_bench.reduction.cubature import sparse_nnls
from mor_bench.reduction.curved import (
    CoordinateMap,
    CurvedLoad,
    CurvedModel,
    CurvedProblem,
    curved_system,
)
from mor_bench.reduction.galerkin import GalerkinProblem, stiffness_times
from mor_bench.reduction.static_correction import mark_of, marked_scene, model_of, refuse_inverted
from mor_bench.reduction.weighted_cells import weighted_cells
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.cubature_states import softened_if_locked
from mor_bench.surrogates.free_dofs import answer_each

Array = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]


class CurvedPOD(Surrogate):
    """Galerkin projection on u = s + Φ c(q), where a subclass fits the map c to snapshots.

    The r primary modes are the leading POD modes of the snapshots. The secondary modes are those of
    what the primary ones leave. With static correction, s is the part of the linear response that
    the primary modes lack, and c describes the snapshots without it. See
    `mor_bench.reduction.static_correction`. The correction is part of the equilibrium here, and the
    stiffness of the kept cells scales the load, so small loads get the linear response with any
    cubature.

    A subclass declares the parameters below as its hyperparameters.

    Parameters
    ----------
    n_latent : int
        Number r of latent coordinates q, less than the snapshots' rank.
    n_secondary : int
        Number of secondary modes, capped at the rank of what the primary ones leave.
    static_correction : bool
        Whether to add the linear response that the primary modes lack. Without it, the answer is
        on the manifold, as published.
    cubature_tolerance : float
        Allowed relative residual of the reduced forces in the cubature, in [0, 1); 0 keeps all
        cells.
    n_cubature_snapshots : int
        Training snapshots whose reduced forces are matched, spread evenly over the training set.
    tolerance : float
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    """

    n_latent: int
    n_secondary: int
    static_correction: bool
    cubature_tolerance: float
    n_cubature_snapshots: int
    tolerance: float

    @abstractmethod
    def fit_map(
        self, scene: Scene, samples: Snapshots, coordinates: Array, n_latent: int
    ) -> tuple[dict[str, NDArray[Any]], Array]:
        """Return the arrays of the map, and latent coordinates (n_samples, r) of the samples.

        `coordinates` (n_samples, N) are those of the samples in Φ; the first r are primary.
        """

    @abstractmethod
    def take_map(self, model: Arrays, n_latent: int, n_coordinates: int) -> CoordinateMap:
        """Return the map from the checked arrays of `fit_map`."""

    def directions(self, slopes: Array) -> Array:
        """Return the directions (N, k) in which the cubature matches forces, from D (N, r)."""
        return slopes

    def supports(self, scene: Scene) -> str | None:
        if scene.springs:
            return "its cubature has no springs, and the scene rests on some"
        return unknown_equations(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        model, displacements = FullOrderModel(scene), samples.free_displacements
        primary = accurate_modes(displacements, self.n_latent)
        offsets = np.zeros_like(displacements)
        if self.static_correction:
            offsets = model.rest_factor.solve(samples.free_forces.T).T
            offsets = offsets - samples.free_forces @ _primary_response(model, primary) @ primary.T
        targets = displacements - offsets
        rest = pod(targets - targets @ primary @ primary.T, self.n_secondary).modes
        # The remainder may be small against the primary part, so round-off is projected out. A mode
        # of round-off alone may lie in the primary span, and little of it is left.
        rest = rest - primary @ (primary.T @ rest)
        secondary = np.linalg.qr(rest[:, np.linalg.norm(rest, axis=0) > 0.5])[0]
        if not secondary.size:
            raise InvalidInputError(
                f"`n_latent` must be less than the rank of the snapshots, {primary.shape[1]}, "
                f"because their other modes are learned; got {self.n_latent}."
            )
        modes = np.hstack([primary, secondary])
        arrays, latent = self.fit_map(scene, samples, targets @ modes, primary.shape[1])
        weights, reduced = np.ones(scene.mesh.n_cells), scene
        if self.static_correction:
            reduced = softened_if_locked(model, samples, primary)
        if self.cubature_tolerance > 0:
            curve = self.take_map(arrays, primary.shape[1], modes.shape[1])
            states = []
            for row in _spread(displacements, self.n_cubature_snapshots):
                c, slopes = curve.at(latent[row])
                states.append((offsets[row] + modes @ c, self.directions(slopes)))
            system = curved_system(model_of(reduced, model), modes, states)
            weights = sparse_nnls(system, system.sum(axis=1), self.cubature_tolerance).weights
        cells = np.flatnonzero(weights)
        secondary = np.ascontiguousarray(modes[:, primary.shape[1] :])
        kept = {"cells": cells, "weights": weights[cells], **mark_of(scene, reduced)}
        return {"primary": primary, "secondary": secondary, **kept, **arrays}

    def prepare(self, scene: Scene, model: Arrays) -> None:
        n_free = len(scene.free_dofs)
        primary = take_array(model, "primary", (n_free, None))
        self.modes_ = primary
        self.space_ = np.hstack([primary, take_array(model, "secondary", (n_free, None))])
        self.cells_ = take_array(model, "cells", (None,), np.int64)
        weights = take_array(model, "weights", (len(self.cells_),))
        reduced = marked_scene(scene, model)
        self.curve_ = self.take_map(model, primary.shape[1], self.space_.shape[1])
        assembler, self.rows_ = weighted_cells(reduced, self.cells_, weights)
        sampled = GalerkinProblem(assembler, self.space_[self.rows_])
        self.curved_ = CurvedModel(sampled, self.curve_)
        self.curved_.linear.prepare()
        self.model_ = FullOrderModel(scene)
        self._to_load = self.space_
        if self.static_correction:
            self.compliance_ = Compliance(self.model_)
            forces = np.zeros_like(self.space_)
            forces[self.rows_] = self.curved_.rest_forces
            self._to_load = self.model_.rest_factor.solve(forces)
            self._to_primary = _primary_response(self.model_, primary)

    def answer(self, forces: Array) -> Array:
        return answer_each(self.scene_, forces, self._solve)

    def _solve(self, force: Array) -> Array:
        offset, at_rest = np.zeros_like(force), None
        projected = project(self._to_load, force[None])[0]
        if self.static_correction:
            lacked = project(self._to_primary, force[None])[0]
            offset = self.compliance_.solve(force) - self.modes_ @ lacked
            at_rest = self.curved_.linear.rest_tangent @ lacked
            count(multiply_adds=self.modes_.size + lacked.size**2)
        else:
            at_rest = self.curved_.slope.T @ projected
            count(multiply_adds=self.curved_.slope.size)
        load = CurvedLoad(projected, at_rest, offset[self.rows_])
        u = np.asarray(offset + self.space_ @ self.curve_.at(self.solve(load))[0])
        count(multiply_adds=self.space_.size)
        if len(self.cells_) < self.scene_.mesh.n_cells:
            refuse_inverted(self.model_, u)
        return u

    def offsets(self, forces: Array) -> Array:
        """Return what static correction adds under loads (n, n_free), N, in m; zero without it."""
        if not self.static_correction:
            return np.zeros_like(forces)
        responses = np.array([self.compliance_.solve(force) for force in forces])
        return np.asarray(responses - forces @ self._to_primary @ self.modes_.T)

    def solve(self, load: CurvedLoad) -> Array:
        """Return the latent coordinates of the equilibrium under a load."""
        problem = CurvedProblem(self.curved_, load)
        options = NewtonOptions(self.tolerance)
        return solve_equilibrium(problem, load.at_rest, options=options).displacement


def _primary_response(model: FullOrderModel, primary: Array) -> Array:
    """Return V (VᵀK₀V)⁻¹, (n_free, r), which maps a load to the linear response in V."""
    stiffness = primary.T @ stiffness_times(model.assembler.pattern, model.rest_tangent, primary)
    return np.ascontiguousarray(np.linalg.solve(stiffness, primary.T).T)


def _spread(displacements: Array, n_wanted: int) -> NDArray[np.int64]:
    """Return numbers of at most ``n_wanted`` nonzero snapshots, evenly spread."""
    moved = np.flatnonzero(displacements.any(axis=1))
    return np.asarray(moved[np.unique(np.linspace(0, len(moved) - 1, n_wanted).astype(int))])


def coordinate_weights(samples: Snapshots) -> Array:
    """Return weights (n_samples, 1) that make errors of coordinates relative to displacements."""
    return error_weights(samples.free_displacements)[:, None]
