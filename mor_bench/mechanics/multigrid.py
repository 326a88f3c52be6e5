"""Algebraic multigrid for meshes whose banded factor would be too large."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse import linalg as sp_linalg

from mor_bench.counting import count
from mor_bench.errors import SolverError
from mor_bench.mechanics.pattern import Pattern

CYCLE_TOLERANCE = 1e-12
"""Relative residual of a solve by multigrid."""
ACCEPTED_RESIDUAL = 1e-8
"""Relative residual that is accepted where round-off prevents a smaller one."""
MAX_CYCLES = 300


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

    One V-cycle in float32 is the preconditioner. A solve uses conjugate gradients with it.
    """

    def __init__(
        self,
        pattern: Pattern,
        values: NDArray[np.float64],
        points: NDArray[np.float64],
        frames: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None,
    ) -> None:
        from pyamg import smoothed_aggregation_solver

        self._pattern, matrix = pattern, pattern.whole.symmetric(pattern.complete(values))
        self._matrix = sp.csr_matrix(matrix).tobsr(blocksize=(3, 3))
        x = points - points.mean(axis=0)
        motions = np.zeros((len(points), 3, 6))
        motions[:, :, :3] = np.eye(3)
        for axis in range(3):
            motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x / np.abs(x).max())
        if frames is not None:
            motions[frames[0]] = frames[1] @ motions[frames[0]]
        near_null = pattern.pad(pattern.cut(motions.reshape(-1, 6)))
        # The coarsest matrix of plates and other ill-conditioned bodies may be indefinite
        # in single precision, or even in double precision.
        for dtype, coarse in (
            (np.float32, "cholesky"),
            (np.float64, "cholesky"),
            (np.float64, "pinv"),
        ):
            levels: Any = smoothed_aggregation_solver(
                self._matrix.astype(dtype),
                B=near_null.astype(dtype),
                strength=None,
                improve_candidates=None,
                max_coarse=500,
                presmoother=("block_gauss_seidel", {"sweep": "forward"}),
                postsmoother=("block_gauss_seidel", {"sweep": "backward"}),
                coarse_solver=coarse,
            )
            self._cycle, self._dtype = levels.aspreconditioner(), dtype
            # A cycle has three sweeps over each level's matrix (smoother, residual, smoother), the
            # transfers, and the coarsest solve.
            transfers = sum(
                3 * level.A.nnz + level.R.nnz + level.P.nnz for level in levels.levels[:-1]
            )
            self._cycle_multiply_adds = int(transfers + levels.levels[-1].A.shape[0] ** 2)
            try:
                response = self._cycle @ np.ones(pattern.whole.n, dtype)
            except np.linalg.LinAlgError:
                continue
            if np.isfinite(response).all() and response.sum() > 0:
                break
        self.place = np.arange(pattern.whole.n)

    def single_precision(self) -> MultigridFactor:
        return self

    def solve_in_place(self, x: NDArray[np.float32]) -> None:
        count(back_solves=len(x), multiply_adds=len(x) * self._cycle_multiply_adds)
        for row in x:
            row[:] = self._cycle @ row.astype(self._dtype)

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        if rhs.ndim == 2:
            return np.stack([self.solve(column) for column in rhs.T], axis=1)
        rhs, scale = self._pattern.pad(rhs), float(np.abs(rhs).max()) or 1.0

        def one_cycle(residual: NDArray[np.float64]) -> NDArray[Any]:
            # A cycle, a product with the matrix, and six with vectors.
            count(
                back_solves=1,
                multiply_adds=self._cycle_multiply_adds + self._matrix.nnz + 6 * len(rhs),
            )
            return np.asarray(self._cycle @ residual.astype(self._dtype))

        cycle = sp_linalg.LinearOperator(self._matrix.shape, one_cycle, dtype=np.float64)
        solution, failed = sp_linalg.cg(
            self._matrix, rhs / scale, rtol=CYCLE_TOLERANCE, maxiter=MAX_CYCLES, M=cycle
        )
        missed = 0.0
        if failed:
            left = self._matrix @ solution - rhs / scale
            missed = float(np.linalg.norm(left) / np.linalg.norm(rhs / scale))
        if not missed <= ACCEPTED_RESIDUAL:
            raise SolverError(
                "multigrid does not converge for the stiffness at rest: the residual is "
                f"{missed:.1e} of the load after {MAX_CYCLES} cycles. The body may be too "
                'slender; try `solver = "superlu"`.'
            )
        return self._pattern.cut(np.asarray(solution * scale))
