"""Algebraic multigrid for meshes whose banded factor would be too large."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse import linalg as sp_linalg

from mor_bench.counting import count
from mor_bench.errors import SolverError
from mor_bench.mechanics.chebyshev import Chebyshev, cycles_for, lowest_eigenvalue
from mor_bench.mechanics.cycles import Cycle, Exact, Inverse, level_of
from mor_bench.mechanics.pattern import Pattern
from mor_bench.mechanics.rotated import multiply

CYCLE_TOLERANCE = 1e-12
"""Relative residual of a solve by multigrid."""
ACCEPTED_RESIDUAL = 1e-8
"""Relative residual that is accepted where round-off prevents a smaller one."""
MAX_CYCLES = 1000
COARSEST = 200
"""Largest number of aggregates on the coarsest level, whose matrix is inverted."""
REDUCTION = 0.3
"""Factor by which an approximate solution reduces every error at least; it sets the cycles.

An exact inverse would hardly save iterations, because the tangent differs from the matrix.
"""
COARSE_CYCLES = 2
"""Cycles on each coarser level: with one, iterations grow with the number of levels."""


def inverse_of(hierarchy: list[Any], dtype: Any) -> tuple[Inverse, int]:
    """Return the approximate inverse of the finest matrix, and its number of cycles.

    Parameters
    ----------
    hierarchy : list of pyamg levels
        With matrices ``A`` and prolongations ``P``, the finest first.
    dtype : NumPy type
    """
    coarsest = hierarchy[-1].A.toarray().astype(np.float64)
    inverse: Inverse = Exact(np.linalg.pinv(coarsest, rcond=1e-14, hermitian=True).astype(dtype))
    n_cycles = 1
    for level in reversed(hierarchy[:-1]):
        cycle = Cycle(level_of(level.A, level.P, dtype), inverse)
        lowest = lowest_eigenvalue(cycle)
        finest = level is hierarchy[0]
        n_cycles = cycles_for(lowest, REDUCTION) if finest else COARSE_CYCLES
        inverse = Chebyshev(cycle, lowest, n_cycles)
    return inverse, n_cycles


class Multigrid:
    """Smoothed aggregation by PyAMG, with the rigid motions as near null space.

    Vaněk, Mandel & Brezina, Computing 56, 1996.

    Parameters
    ----------
    pattern : Pattern
    points : (n_nodes, 3) float64
        Reference positions of the nodes with a free dof, m.
    frames : tuple of arrays, optional
        Indices (n,) of nodes whose vectors are in a frame, and its axes (n, 3, 3), as rows.
    """

    def __init__(
        self,
        pattern: Pattern,
        points: NDArray[np.float64],
        frames: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None,
    ) -> None:
        self._pattern, self._points, self._frames = pattern, points, frames

    def factor(self, values: NDArray[np.float64]) -> MultigridFactor:
        """Build the hierarchy, which counts as a factorisation without arithmetic.

        Does not check that the matrix is positive definite.
        """
        count(factorisations=1)
        return MultigridFactor(self._pattern, values, self._points, self._frames)


class MultigridFactor:
    """A multigrid hierarchy.

    Cycles in float32 are the preconditioner; the less compressible the material, the more. A solve
    uses conjugate gradients with it.

    Attributes
    ----------
    n_cycles : int
        Cycles on the finest level per back-solve.
    place : (n,) int64
        Position of each unknown in the order of `solve_in_place`.
    """

    def __init__(
        self,
        pattern: Pattern,
        values: NDArray[np.float64],
        points: NDArray[np.float64],
        frames: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None,
    ) -> None:
        from pyamg import smoothed_aggregation_solver

        self._pattern, self._values = pattern, pattern.complete(values)
        x = points - points.mean(axis=0)
        motions = np.zeros((len(points), 3, 6))
        motions[:, :, :3] = np.eye(3)
        for axis in range(3):
            motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x / np.abs(x).max())
        if frames is not None:
            motions[frames[0]] = frames[1] @ motions[frames[0]]
        near_null = pattern.pad(pattern.cut(motions.reshape(-1, 6)))
        blocks = sp.csr_matrix(pattern.whole.symmetric(self._values)).tobsr(blocksize=(3, 3))
        # Matrices of plates and other ill-conditioned bodies may be indefinite in single precision.
        for dtype in (np.float32, np.float64):
            hierarchy: Any = smoothed_aggregation_solver(
                blocks.astype(dtype),
                B=near_null.astype(dtype),
                strength=None,
                improve_candidates=None,
                max_coarse=COARSEST,
            ).levels
            self._inverse, self.n_cycles = inverse_of(hierarchy, dtype)
            response = self._inverse(np.ones(pattern.whole.n, dtype))
            if np.isfinite(response).all() and response.sum() > 0:
                break
        self._dtype = dtype
        self.place = np.arange(pattern.whole.n)

    def single_precision(self) -> MultigridFactor:
        return self

    def solve_in_place(self, x: NDArray[np.float32]) -> None:
        count(back_solves=len(x), multiply_adds=len(x) * self._inverse.multiply_adds)
        for row in x:
            row[:] = self._inverse(row.astype(self._dtype))

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        if rhs.ndim == 2:
            return np.stack([self.solve(column) for column in rhs.T], axis=1)
        whole, n = self._pattern.whole, self._pattern.whole.n
        rhs, scale = self._pattern.pad(rhs), float(np.abs(rhs).max()) or 1.0

        def product(x: NDArray[np.float64]) -> NDArray[np.float64]:
            y = np.empty(n)
            multiply(whole.indptr, whole.indices, self._values, x.ravel(), y)
            return y

        def cycles(residual: NDArray[np.float64]) -> NDArray[Any]:
            # The cycles, a product with the matrix, and six with vectors.
            count(
                back_solves=1,
                multiply_adds=self._inverse.multiply_adds + 2 * len(self._values) + 5 * n,
            )
            return np.asarray(self._inverse(residual.ravel().astype(self._dtype)))

        matrix, inverse = (
            sp_linalg.LinearOperator((n, n), apply, dtype=np.float64) for apply in (product, cycles)
        )
        iterations = -(-MAX_CYCLES // self.n_cycles)
        solution, failed = sp_linalg.cg(
            matrix, rhs / scale, rtol=CYCLE_TOLERANCE, maxiter=iterations, M=inverse
        )
        missed = 0.0
        if failed:
            left = product(solution) - rhs / scale
            missed = float(np.linalg.norm(left) / np.linalg.norm(rhs / scale))
        if not missed <= ACCEPTED_RESIDUAL:
            raise SolverError(
                "multigrid does not converge for the stiffness at rest: the residual is "
                f"{missed:.1e} of the load after {MAX_CYCLES} cycles. The body may be too "
                'slender; try `solver = "superlu"`.'
            )
        return self._pattern.cut(np.asarray(solution * scale))
