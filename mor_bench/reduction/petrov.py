"""The reduced model that interpolates its nonlinear force, and Newton's method for tangents that are not symmetric.

Such a model has no potential: no energy to descend on, and no Cholesky factor that tells a stable equilibrium. What is checked is
the residual, det F > 0 at the points that are integrated, and that the tangent's determinant has the sign that it has at rest,
which it keeps on a path that meets no singular tangent.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgetrf, dgetrs

from mor_bench.counting import count, triangular_multiply_adds, uncounted
from mor_bench.errors import InvalidInputError, InvertedElementError, NoEquilibriumError
from mor_bench.mechanics.newton import (
    HOPELESS,
    MAX_ITERATIONS,
    MAX_LOAD_N,
    PLAIN_ITERATIONS,
    NewtonOptions,
)
from mor_bench.mechanics.problem import LINEAR, ROUND_OFF
from mor_bench.reduction.points import ReducedPoints

Array = NDArray[np.float64]

MAX_HALVINGS = 8
"""Of a step that does not lower the residual."""


class InterpolatedProblem:
    """f_r(q) = (K_r - K_s) q + s(q): exact at rest, where s has the tangent K_s and K_r is the reduced stiffness.

    Parameters
    ----------
    points : ReducedPoints
        s: the sampled force, on test functions that interpolate and project.
    rest : (r, r) float64
        ΦᵀK₀Φ.
    extent : float
        Coordinates of this size are displacements of the size of the body.

    Raises
    ------
    numpy.linalg.LinAlgError
        If ``rest`` is not positive definite.
    """

    def __init__(self, points: ReducedPoints, rest: Array, extent: float) -> None:
        self.points, self.extent = points, extent
        with uncounted():
            self._linear = rest - points.force_and_tangent(np.zeros(len(rest)))[1]
        np.linalg.cholesky(rest)
        self._rest = rest

    def linearise(self, q: Array) -> tuple[Array, Array, float]:
        """Force, tangent, min det F over the sampled cells."""
        state, tangent = self.points.force_and_tangent(q)
        count(multiply_adds=len(q) ** 2)
        return state.force + self._linear @ q, tangent + self._linear, state.min_det_f

    def solve(self, load: Array, options: NewtonOptions) -> Array:
        """The equilibrium that full steps from rest lead to, else the one that load increments do, (r,).

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
        start = _factored(self._rest, load)[0]
        if np.abs(start).max() <= LINEAR * self.extent:
            return start
        q, _, iterations = self._newton(load, start, options.tolerance, damped=False)
        if q is not None:
            return q
        reached, increment, cuts, at = 0.0, 0.5, 0, np.zeros_like(load)
        while True:
            target = min(1.0, reached + increment)
            q, min_det, spent = self._newton(target * load, at, options.tolerance, damped=True)
            iterations += spent
            if q is not None:
                if target == 1.0:
                    return q
                at, reached, increment = q, target, 2.0 * increment
                continue
            cuts += 1
            increment *= 0.5
            if cuts > options.max_cuts or iterations > MAX_ITERATIONS:
                story = f"stopped at {reached:.4g} of the load after {iterations} iterations and {cuts} cut-backs"
                if min_det <= 0:
                    raise InvertedElementError(
                        f"sampled elements invert: {story}; det F <= 0 was {min_det:.3g}."
                    )
                raise NoEquilibriumError(
                    f"no equilibrium of the interpolated force found: {story}; a symmetric method may find one."
                )

    def _newton(
        self, load: Array, start: Array, tolerance: float, damped: bool
    ) -> tuple[Array | None, float, int]:
        """The solution or None, the last min det F, and the number of iterations; damped, every step lowers the residual."""
        q, size, load_norm = start, np.inf, float(np.linalg.norm(load))
        force, tangent, min_det = self.linearise(q)
        for iteration in range(1, PLAIN_ITERATIONS + 1):
            residual = load - force
            size = float(np.linalg.norm(residual))
            if not size <= HOPELESS * load_norm:
                return None, min_det, iteration
            step, positive = _factored(tangent, residual)
            small = np.isfinite(step).all() and np.abs(step).max() <= ROUND_OFF * np.abs(q).max()
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
    """Solution by LU with partial pivoting, and whether the determinant is positive."""
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
