"""Reduced internal force and tangent summed over quadrature points: no mesh, no nodes, no sparse matrix.

At a quadrature point the gradient of mode m is a fixed 3x3 matrix G_m, so that with H = Σ_m q_m G_m, F = I + H and the weights w

    f_m = Σ w G_m : P(F),      K_mk = Σ w G_m : A(F) : G_k,      A = dP/dF,

whatever the element. Work and memory depend on the numbers of points and modes only. A basis of test functions other than that of
the displacement makes the tangent unsymmetric; that is what DEIM needs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench import counting
from mor_bench.counting import cholesky_multiply_adds, triangular_multiply_adds
from mor_bench.mechanics.assembly import State, quadrature_of
from mor_bench.mechanics.laws import SAINT_VENANT_KIRCHHOFF, point_multiply_adds, point_stresses
from mor_bench.mechanics.newton import HOPELESS, PLAIN_ITERATIONS, ROUND_OFF, Solution
from mor_bench.reduction.point_kernels import LANES, full_steps, gradients, integrate, project
from mor_bench.scene.materials import Material

Array = NDArray[np.float64]

SVK_MULTIPLY_ADDS = 77, 162
"""Of Saint Venant-Kirchhoff's P, energy and det F from H at one point, and of A."""


def tangent_multiply_adds(r: int, symmetric: bool) -> int:
    """Of A : G_k for all modes, taken in pairs, and their products with the test functions, at one point."""
    products = 0
    for k in range(0, r, 2):
        pair = 2 if k + 1 < r else 1
        n = min(k + 2, r) if symmetric else r
        products += 2 * (n - n % 4) + pair * (n % 4)
    return 81 * 2 * -(-r // 2) + 9 * products


def _batched(values: Array, fill: float) -> Array:
    """(n_points, ...) → (n_batches, ..., LANES), padded with ``fill``."""
    padded = np.full((-(-len(values) // LANES) * LANES, *values.shape[1:]), fill)
    padded[: len(values)] = values
    return np.ascontiguousarray(np.moveaxis(padded.reshape(-1, LANES, *values.shape[1:]), 1, -1))


def _mode_gradients(shape_gradients: Array, cell_modes: Array) -> Array:
    """(n_batches, r, 9 * LANES) gradients of modes at every point, from (n_cells, n_points, n_nodes, 3) and (n_cells, n_nodes, 3, r)."""
    n_cells, n_points = shape_gradients.shape[:2]
    own = np.einsum("cqaj,caim->cqmij", shape_gradients, cell_modes, optimize=True)
    return _batched(own.reshape(n_cells * n_points, -1, 9), 0.0).reshape(-1, own.shape[2], 9 * LANES)


class ReducedPoints:
    """Reduced internal force and tangent over the weighted quadrature points of some cells.

    Parameters
    ----------
    points : (n_nodes, 3) float64
        Reference positions, m.
    cells : (n_cells, 8) or (n_cells, 4) int
        The cells to sum over.
    material : Material
    selective : bool
        As for `Assembler`.
    cell_weights : (n_cells,) float64
        Cubature weights.
    modes : (n_nodes, 3, r) float64
        Displacement of each mode at every node; zero at supports. Only the rows of the cells' nodes are read.
    test_modes : (n_nodes, 3, r) float64, optional
        What the force is projected on; the modes by default.

    Attributes
    ----------
    n_cells, n_points, n_unknowns : int
    """

    def __init__(
        self,
        points: Array,
        cells: NDArray[np.int64],
        material: Material,
        selective: bool,
        cell_weights: Array,
        modes: Array,
        test_modes: Array | None = None,
    ) -> None:
        rule = quadrature_of(points, cells, material, selective)
        self.n_cells, per_cell, _, _ = rule.gradients.shape
        self.n_points, self.n_unknowns = self.n_cells * per_cell, modes.shape[2]
        self.trial = _mode_gradients(rule.gradients, modes[cells])
        self.symmetric = test_modes is None
        self.test = self.trial if test_modes is None else _mode_gradients(rule.gradients, test_modes[cells])
        self.weights = _batched((rule.weights * cell_weights[:, None]).ravel(), 0.0)
        parameters = np.tile(rule.parameters, (self.n_cells, 1))
        self.parameters = _batched(parameters, 0.0) if material.law == SAINT_VENANT_KIRCHHOFF else parameters
        self.law = material.law
        r = self.n_unknowns
        force, tangent = SVK_MULTIPLY_ADDS if self.law == SAINT_VENANT_KIRCHHOFF else point_multiply_adds(self.law, rule.parameters.shape[1])
        tangent += tangent_multiply_adds(r, self.symmetric)
        self._multiply_adds = self.n_points * (force + 18 * r), self.n_points * (force + 18 * r + tangent)

    def count(self, forces: int, tangents: int) -> None:
        """Count evaluations of the force alone, and of force and tangent."""
        if counting.running is not None:
            work = forces * self._multiply_adds[0] + tangents * self._multiply_adds[1]
            counting.running.add(element_evaluations=(forces + tangents) * self.n_cells, multiply_adds=work)

    def _sum(self, q: Array, tangent: Array) -> State:
        force = np.zeros(self.n_unknowns)
        self.count(len(tangent) == 0, len(tangent) > 0)
        if self.law == SAINT_VENANT_KIRCHHOFF:
            return State(force, *integrate(q, self.trial, self.test, self.symmetric, self.weights, self.parameters, force, tangent))
        H, P = np.empty((2, len(self.weights), 9 * LANES))
        A = np.empty((len(self.weights) if len(tangent) else 0, 81 * LANES))
        gradients(self.trial, q, H)
        energy, min_det = point_stresses(H, self.weights, self.law, self.parameters, P, A)
        project(P, A, self.trial, self.test, self.symmetric, force, tangent)
        return State(force, energy, min_det)

    def force(self, q: Array) -> State:
        """Reduced internal force, stored energy, J, and min det F at coordinates ``q`` (r,)."""
        return self._sum(q, np.empty((0, 0)))

    def force_and_tangent(self, q: Array) -> tuple[State, Array]:
        """`force`, and the reduced tangent (r, r)."""
        tangent = np.zeros((self.n_unknowns, self.n_unknowns))
        return self._sum(q, tangent), tangent

    def full_steps(self, load: Array, start: Array, tolerance: float, extent: float) -> Solution | None:
        """Newton's full steps for Saint Venant-Kirchhoff; None where they do not end in a stable state with det F > 0."""
        q = start.copy()
        converged, min_det, iterations, tangents, forces, factors, solves = full_steps(
            load, q, self.trial, self.weights, self.parameters, tolerance, HOPELESS, ROUND_OFF, extent, PLAIN_ITERATIONS
        )
        self.count(forces, tangents)
        if counting.running is not None:
            r = self.n_unknowns
            dense = factors * cholesky_multiply_adds(r, r - 1) + solves * triangular_multiply_adds(r, r - 1)
            counting.running.add(
                factorisations=factors, reduced_factorisations=factors, back_solves=solves, reduced_back_solves=solves, multiply_adds=dense
            )
        return Solution(q, min_det, iterations, 0) if converged and min_det > 0 else None
