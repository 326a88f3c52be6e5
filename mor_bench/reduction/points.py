"""Reduced internal force and tangent as sums over quadrature points, without a mesh.

At a quadrature point, the gradient of mode m is a fixed 3x3 matrix G_m. With H = Σ_m q_m G_m,
F = I + H and the weights w, for any element,

    f_m = Σ w G_m : P(F),      K_mk = Σ w G_m : A(F) : G_k,      A = dP/dF.

Work and memory depend only on the numbers of points and modes. DEIM needs test functions that
differ from the modes; they make the tangent unsymmetric.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import cholesky_multiply_adds, count, triangular_multiply_adds
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.discretisation import Discretisation, law_parameters, quadrature_of
from mor_bench.mechanics.laws import SAINT_VENANT_KIRCHHOFF, point_multiply_adds, point_stresses
from mor_bench.mechanics.newton import HOPELESS, PLAIN_ITERATIONS, Solution
from mor_bench.mechanics.problem import ROUND_OFF
from mor_bench.reduction.point_kernels import LANES, full_steps, gradients, integrate, project

Array = NDArray[np.float64]

SVK_MULTIPLY_ADDS = 77, 162
"""Multiply-adds per point for Saint Venant-Kirchhoff: P, energy and det F from H; and A."""


def tangent_multiply_adds(r: int, symmetric: bool) -> int:
    """Return multiply-adds per point for A : G_k of all modes and products with test functions."""
    products = 0
    for k in range(0, r, 2):
        pair = 2 if k + 1 < r else 1
        n = min(k + 2, r) if symmetric else r
        products += 2 * (n - n % 4) + pair * (n % 4)
    return 81 * 2 * -(-r // 2) + 9 * products


def _batched(values: Array) -> Array:
    """Rearrange (n_points, ...) to (n_batches, ..., LANES), padded with zeros."""
    padded = np.zeros((-(-len(values) // LANES) * LANES, *values.shape[1:]))
    padded[: len(values)] = values
    return np.ascontiguousarray(np.moveaxis(padded.reshape(-1, LANES, *values.shape[1:]), 1, -1))


def _parameters_of_lanes(parameters: Array) -> Array:
    """Return law parameters (n_points, n) as (n_batches, n * LANES); the last fill the padding."""
    padding = -len(parameters) % LANES
    padded = np.pad(parameters, ((0, padding), (0, 0)), mode="edge")
    return _batched(padded).reshape(-1, parameters.shape[1] * LANES)


def _mode_gradients(shape_gradients: Array, cell_modes: Array, kept: NDArray[np.int64]) -> Array:
    """Return gradients of modes (n_batches, r, 9 * LANES) at the kept points.

    They come from gradients of shape functions (n_cells, n_points, n_nodes, 3) and nodal modes
    (n_cells, n_nodes, 3, r).
    """
    own = np.einsum("cqaj,caim->cqmij", shape_gradients, cell_modes, optimize=True)
    r = own.shape[2]
    return _batched(own.reshape(-1, r, 9)[kept]).reshape(-1, r, 9 * LANES)


def _scaled(mode_gradients: Array, scale: Array) -> Array:
    """Return gradients of modes (n_batches, r, 9 * LANES) on a body scaled along the axes."""
    n_batches, r, _ = mode_gradients.shape
    by_axis = mode_gradients.reshape(n_batches, r, 3, 3, LANES) / scale[:, None]
    return by_axis.reshape(mode_gradients.shape)


class ReducedPoints:
    """Reduced internal force and tangent over the weighted quadrature points of some cells.

    Parameters
    ----------
    body : Discretisation
    factors : (n_cells,) or (n_cells, n_cell_points) float64
        Cubature weights, which multiply those of the quadrature; points with weight 0 are left out.
    modes : (n_nodes, 3, r) float64
        Displacement of each mode at every node, zero at supports. Only rows of the cells' nodes are
        read.
    test_modes : (n_nodes, 3, r) or (n_cells, n_cell_nodes, 3, r) float64, optional
        Test functions that the force is projected on, continuous or for each cell by itself; the
        modes by default. Springs add nothing to those of cells.

    Attributes
    ----------
    n_cells, n_points, n_unknowns : int
    """

    def __init__(
        self,
        body: Discretisation,
        factors: Array,
        modes: Array,
        test_modes: Array | None = None,
    ) -> None:
        rule, cells = quadrature_of(body), body.cells
        weights = (rule.weights * factors.reshape(len(cells), -1)).ravel()
        kept = np.flatnonzero(weights)
        self.n_cells, self.n_points, self.n_unknowns = len(cells), len(kept), modes.shape[2]
        self.trial = _mode_gradients(rule.gradients, modes[cells], kept)
        self.symmetric = test_modes is None
        self.test = self.trial
        if test_modes is not None:
            by_cell = test_modes if test_modes.ndim == 4 else test_modes[cells]
            self.test = _mode_gradients(rule.gradients, by_cell, kept)
        self.weights = _batched(weights[kept])
        self._kept = kept
        self._lame: Array | None
        self._take(body)
        force, tangent = SVK_MULTIPLY_ADDS
        if self._lame is None:
            force, tangent = point_multiply_adds(body.material.law, rule.parameters.shape[1])
        force += 18 * self.n_unknowns
        tangent += force + tangent_multiply_adds(self.n_unknowns, self.symmetric)
        self._multiply_adds = self.n_points * force, self.n_points * tangent
        self._springs: Array | None = None
        if body.springs is not None and (test_modes is None or test_modes.ndim == 3):
            self._lame = None  # its kernels have no springs
            tested = modes if test_modes is None else test_modes
            moved = body.springs @ modes.reshape(-1, self.n_unknowns)
            self._springs = tested.reshape(-1, self.n_unknowns).T @ moved
        self._rest: tuple[Array, Array] | None = None
        if body.rest is not None:
            self._lame = None  # its kernels start from an undeformed body
            rest = _mode_gradients(rule.gradients, body.rest[cells][..., None], kept)[:, 0]
            self._rest = rest, np.zeros(self.n_unknowns)
            self._rest = rest, self.force(np.zeros(self.n_unknowns)).force

    def _take(self, body: Discretisation) -> None:
        """Take the law and its parameters at the kept points."""
        law = body.material.law
        parameters = np.tile(law_parameters(body), (self.n_cells, 1))[self._kept]
        self._stresses = point_stresses(law)
        self._parameters = _parameters_of_lanes(parameters)
        self._lame = _batched(parameters) if law == SAINT_VENANT_KIRCHHOFF else None

    def scaled(self, body: Discretisation, scale: Array) -> ReducedPoints:
        """Return the points with another material, scaled along the axes (3,).

        Neither this body nor the new one may have springs or a rest state.
        """
        found = copy(self)
        found._take(body)
        if (scale != 1.0).any():
            found.weights = self.weights * float(np.prod(scale))
            found.trial = _scaled(self.trial, scale)
            found.test = found.trial if self.symmetric else _scaled(self.test, scale)
        return found

    def _gradients(self, q: Array) -> Array:
        """Return du/dX (n_batches, 9 * LANES) of the total displacement."""
        H = np.empty((len(self.weights), 9 * LANES))
        gradients(self.trial, q, H)
        return H if self._rest is None else H + self._rest[0]

    def count(self, forces: int, tangents: int) -> None:
        """Count evaluations of the force alone, and of force and tangent."""
        work = forces * self._multiply_adds[0] + tangents * self._multiply_adds[1]
        count(element_evaluations=(forces + tangents) * self.n_cells, multiply_adds=work)

    def _sum(self, q: Array, tangent: Array) -> State:
        force = np.zeros(self.n_unknowns)
        self.count(len(tangent) == 0, len(tangent) > 0)
        if self._lame is not None:
            bases, material = (self.trial, self.test, self.symmetric), (self.weights, self._lame)
            return State(force, *integrate(q, *bases, *material, force, tangent))
        H, P = self._gradients(q), np.empty((len(self.weights), 9 * LANES))
        A = np.empty((len(self.weights) if len(tangent) else 0, 81 * LANES))
        energy, min_det = self._stresses(
            H, self.weights, self._parameters, P, A if len(tangent) else None
        )
        project(P, A, self.trial, self.test, self.symmetric, force, tangent)
        if self._springs is not None:
            own = self._springs @ q
            force, energy = force + own, energy + 0.5 * float(own @ q)
            if len(tangent):
                tangent += self._springs
        if self._rest is None:
            return State(force, energy, min_det)
        held = self._rest[1]
        return State(force - held, energy - float(held @ q), min_det)

    def force(self, q: Array) -> State:
        """Return the state at coordinates ``q`` (r,): reduced force, energy and min det F."""
        return self._sum(q, np.empty((0, 0)))

    def force_and_tangent(self, q: Array) -> tuple[State, Array]:
        """Return the state and the reduced tangent (r, r)."""
        tangent = np.zeros((self.n_unknowns, self.n_unknowns))
        return self._sum(q, tangent), tangent

    def point_forces(self, q: Array) -> Array:
        """Return each point's part of the reduced force, (n_points, r); to train cubatures."""
        P = np.empty((len(self.weights), 9 * LANES))
        self._stresses(self._gradients(q), self.weights, self._parameters, P, None)
        if self._rest is not None:
            held = np.empty_like(P)
            self._stresses(self._rest[0], self.weights, self._parameters, held, None)
            P -= held
        test, stress = self.test.reshape(len(P), -1, 9, LANES), P.reshape(len(P), 9, LANES)
        own = np.einsum("bmcl,bcl->blm", test, stress)
        return np.asarray(own.reshape(-1, self.n_unknowns)[: self.n_points])

    def full_steps(
        self, load: Array, start: Array, tolerance: float, extent: float
    ) -> Solution | None:
        """Take full Newton steps with Saint Venant-Kirchhoff; see `point_kernels.full_steps`.

        Returns None for other laws, or if the steps find no stable solution with det F > 0.
        """
        if self._lame is None:
            return None
        q = start.copy()
        converged, min_det, iterations, tangents, forces, factors, solves = full_steps(
            load,
            q,
            self.trial,
            self.weights,
            self._lame,
            tolerance,
            HOPELESS,
            ROUND_OFF,
            extent,
            PLAIN_ITERATIONS,
        )
        self.count(forces, tangents)
        r = self.n_unknowns
        dense = factors * cholesky_multiply_adds(r, r - 1)
        dense += solves * triangular_multiply_adds(r, r - 1)
        count(
            factorisations=factors,
            reduced_factorisations=factors,
            back_solves=solves,
            reduced_back_solves=solves,
            multiply_adds=dense,
        )
        return Solution(q, min_det, iterations, 0) if converged and min_det > 0 else None
