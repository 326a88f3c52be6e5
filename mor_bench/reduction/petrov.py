"""A reduced model with interpolated force, and Newton's method for its unsymmetric tangents.

Such a model has no potential. There is no energy to descend on, and no Cholesky factor that
identifies a stable equilibrium. A solution must have a small residual, and det F > 0 at the
integrated points. The determinant of its tangent must have the same sign as at rest. A path that
meets no singular tangent keeps that sign.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgetrf, dgetrs

from mor_bench.counting import count, triangular_multiply_adds, uncounted
from mor_bench.errors import InvalidInputError, InvertedElementError, NoEquilibriumError
from mor_bench.mechanics.load_steps import LoadSteps
from mor_bench.mechanics.newton import (
    HOPELESS,
    MAX_ITERATIONS,
    MAX_LOAD_N,
    PLAIN_ITERATIONS,
    NewtonOptions,
)
from mor_bench.mechanics.problem import LINEAR, is_round_off
from mor_bench.reduction.galerkin import dense_factor
from mor_bench.reduction.points import ReducedPoints

Array = NDArray[np.float64]

MAX_HALVINGS = 8
"""Largest number of halvings of a step that does not lower the residual."""


class InterpolatedProblem:
    """The force f_r(q) = (K_r - K_s) q + s(q), which is exact to first order at rest.

    K_r is the reduced stiffness at rest, and K_s the tangent of the sampled force s at rest.

    Parameters
    ----------
    points : ReducedPoints
        The sampled force s, on test functions that interpolate and project.
    rest : (r, r) float64
        ΦᵀK₀Φ.
    extent : float
        Coordinates of this size are displacements of the size of the body.

    Raises
    ------
    NotPositiveDefiniteError
        If ``rest`` is not positive definite.
    """

    def __init__(self, points: ReducedPoints, rest: Array, extent: float) -> None:
        self.points, self.extent = points, extent
        with uncounted():
            self._linear = rest - points.force_and_tangent(np.zeros(len(rest)))[1]
            self.rest_factor = dense_factor(rest)

    def linearise(self, q: Array) -> tuple[Array, Array, float]:
        """Return force, tangent, and min det F over the sampled cells."""
        state, tangent = self.points.force_and_tangent(q)
        count(multiply_adds=len(q) ** 2)
        return state.force + self._linear @ q, tangent + self._linear, state.min_det_f

    def solve(self, load: Array, options: NewtonOptions) -> Array:
        """Return the equilibrium (r,) by full steps from rest, or else by load increments.

        Raises
        ------
        InvertedElementError
            If the load can be followed only through det F <= 0 in a sampled cell.
        NoEquilibriumError
            If no equilibrium was found within the allowed cut-backs.
        InvalidInputError
            If the load exceeds `MAX_LOAD_N`.
        """
        if not load.any():
            return np.zeros_like(load)
        if np.abs(load).max() > MAX_LOAD_N:
            raise InvalidInputError(
                f"the reduced load must be within ±{MAX_LOAD_N:g} N; got {np.abs(load).max():g}."
            )
        start = self.rest_factor.solve(load)
        if np.abs(start).max() <= LINEAR * self.extent:
            return start
        q, _, iterations = self._newton(load, start, options.tolerance, damped=False)
        if q is not None:
            return q
        steps, at = LoadSteps(0.5), np.zeros_like(load)
        while True:
            found, min_det, spent = self._newton(
                steps.target * load, at, options.tolerance, damped=True
            )
            iterations += spent
            if found is not None:
                at = found
                steps.accept()
                if steps.complete:
                    return at
                continue
            steps.cut()
            if steps.cuts > options.max_cuts or iterations > MAX_ITERATIONS:
                story = steps.story(iterations)
                if min_det <= 0:
                    raise InvertedElementError(
                        f"sampled elements invert: {story}; the smallest det F was {min_det:.3g}."
                    )
                raise NoEquilibriumError(
                    f"no equilibrium of the interpolated force found: {story}; "
                    "a symmetric method may find one."
                )

    def _newton(
        self, load: Array, start: Array, tolerance: float, damped: bool
    ) -> tuple[Array | None, float, int]:
        """Return the solution or None, the last min det F, and the number of iterations.

        If damped, every step lowers the residual.
        """
        q, size, load_norm = start, np.inf, float(np.linalg.norm(load))
        force, tangent, min_det = self.linearise(q)
        for iteration in range(1, PLAIN_ITERATIONS + 1):
            residual, before = load - force, size
            size = float(np.linalg.norm(residual))
            if not size <= HOPELESS * load_norm:
                return None, min_det, iteration
            step, positive = _factored(tangent, residual)
            floor = self.extent if size > 0.5 * before else 0.0
            small = np.isfinite(step).all() and is_round_off(step, q, floor)
            if size <= tolerance * load_norm or small:
                return (q if positive and min_det > 0 else None), min_det, iteration
            for halving in range(MAX_HALVINGS if damped else 1):
                trial = q + 0.5**halving * step
                force, tangent, min_det = self.linearise(trial)
                if not damped or (min_det > 0 and np.linalg.norm(load - force) < size):
                    break
            else:
                return None, min_det, iteration
            q = trial
        return None, min_det, PLAIN_ITERATIONS


def _factored(matrix: Array, rhs: Array) -> tuple[Array, bool]:
    """Solve by LU with partial pivoting; return also whether the determinant is positive."""
    n = len(rhs)
    work = (n**3 - n) // 3 + triangular_multiply_adds(n, n - 1)
    count(
        factorisations=1,
        reduced_factorisations=1,
        back_solves=1,
        reduced_back_solves=1,
        multiply_adds=work,
    )
    factor, pivots, info = dgetrf(matrix)
    if info != 0:
        return np.full(n, np.nan), False
    swaps = int((pivots != np.arange(n)).sum())
    positive = (swaps + int((np.diag(factor) < 0).sum())) % 2 == 0
    return np.asarray(dgetrs(factor, pivots, rhs)[0]), positive
