"""Solvers for symmetric positive definite matrices of one pattern: direct ones, and multigrid for large meshes.

A failed Cholesky factorisation is news about the mechanics (the equilibrium is not stable), so each direct solver says
whether the matrix was positive definite instead of going on with a meaningless direction.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse import linalg as sp_linalg
from scipy.sparse.csgraph import reverse_cuthill_mckee

from mor_bench.counting import cholesky_multiply_adds, count, is_counting, triangular_multiply_adds
from mor_bench.errors import SolverError
from mor_bench.mechanics.assembly import Pattern
from mor_bench.scene.dofs import dofs_of_nodes

MAX_BAND_ENTRIES = 1e8
"""Entries of a band (0.8 GB) up to which a banded factor of the rest state is kept; multigrid serves larger meshes."""
CYCLE_TOLERANCE = 1e-12
"""Relative residual of a solve by multigrid."""
ACCEPTED_RESIDUAL = 1e-8
"""Relative residual that will do where round-off allows no less."""
MAX_CYCLES = 300
MANY, WIDE = 64, 256
"""Right-hand sides, and entries of a column of the band, from which a banded factor serves all of them by blocks."""
BLOCK = 96
"""Rows of such a block."""


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has an eigenvalue <= 0 (or the factorisation met a zero pivot)."""


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solution for one (n,) or several (n, m) right-hand sides."""
        ...


class LinearSolver(Protocol):
    """Factorises matrices of one pattern."""

    def factor(self, values: NDArray[np.float64]) -> Factor:
        """Factorise; raises `NotPositiveDefiniteError`."""
        ...


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def banded_solve(band, right_hand_sides):
    """Solve L Lᵀ x = x in place for every row x of (m, n); band (n, bandwidth + 1) holds the columns of L, diagonals inverted.

    Four columns at once, so that x is loaded and stored once for four multiply-adds; they serve every right-hand side
    before the next four are fetched.
    """
    n, width = band.shape
    zero = np.float32(0.0)
    whole = n - n % 4
    for j in range(0, whole, 4):
        a, b, c, d = band[j], band[j + 1], band[j + 2], band[j + 3]
        last = min(width - 4, n - j - 4)
        a4, b4, c4, d4 = a[4 : 4 + last], b[3 : 3 + last], c[2 : 2 + last], d[1 : 1 + last]
        for r in range(len(right_hand_sides)):
            x = right_hand_sides[r]
            x0 = x[j] * a[0]
            x1 = (x[j + 1] - a[1] * x0) * b[0]
            x2 = (x[j + 2] - a[2] * x0 - b[1] * x1) * c[0]
            x3 = (x[j + 3] - a[3] * x0 - b[2] * x1 - c[1] * x2) * d[0]
            x[j], x[j + 1], x[j + 2], x[j + 3] = x0, x1, x2, x3
            tail = x[j + 4 : j + 4 + last]
            for k in range(last):
                tail[k] -= a4[k] * x0 + b4[k] * x1 + c4[k] * x2 + d4[k] * x3
            for k in range(
                last, min(width - 1, n - j - 4)
            ):  # the ends of b, c, d reach beyond that of a
                at = x[j + 4 + k]
                if k + 3 < width:
                    at -= b[k + 3] * x1
                if k + 2 < width:
                    at -= c[k + 2] * x2
                at -= d[k + 1] * x3
                x[j + 4 + k] = at
    for r in range(len(right_hand_sides)):
        x = right_hand_sides[r]
        for j in range(whole, n):
            x[j] *= band[j, 0]
            for k in range(1, n - j):
                x[j + k] -= band[j, k] * x[j]
        for j in range(n - 1, whole - 1, -1):
            s = x[j]
            for k in range(1, n - j):
                s -= band[j, k] * x[j + k]
            x[j] = s * band[j, 0]
    for j in range(whole - 4, -1, -4):
        a, b, c, d = band[j], band[j + 1], band[j + 2], band[j + 3]
        last = min(width - 4, n - j - 4)
        a4, b4, c4, d4 = a[4 : 4 + last], b[3 : 3 + last], c[2 : 2 + last], d[1 : 1 + last]
        for r in range(len(right_hand_sides)):
            x = right_hand_sides[r]
            tail = x[j + 4 : j + 4 + last]
            s0, s1, s2, s3 = zero, zero, zero, zero
            for k in range(last):
                s0 += a4[k] * tail[k]
                s1 += b4[k] * tail[k]
                s2 += c4[k] * tail[k]
                s3 += d4[k] * tail[k]
            for k in range(last, min(width - 1, n - j - 4)):
                at = x[j + 4 + k]
                if k + 3 < width:
                    s1 += b[k + 3] * at
                if k + 2 < width:
                    s2 += c[k + 2] * at
                s3 += d[k + 1] * at
            x3 = (x[j + 3] - s3) * d[0]
            x2 = (x[j + 2] - s2 - c[1] * x3) * c[0]
            x1 = (x[j + 1] - s1 - b[1] * x2 - b[2] * x3) * b[0]
            x[j] = (x[j] - s0 - a[1] * x1 - a[2] * x2 - a[3] * x3) * a[0]
            x[j + 1], x[j + 2], x[j + 3] = x1, x2, x3


def _n_columns(rhs: NDArray[Any]) -> int:
    """Right-hand sides in (n,) or (n, m)."""
    return 1 if rhs.ndim == 1 else int(rhs.shape[1])


class BandedFactor:
    """A banded Cholesky factor, in LAPACK's upper storage."""

    def __init__(self, band: NDArray[np.float64], order: NDArray[np.int64] | None) -> None:
        self._band, self._order = band, order

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        (width, n), m = self._band.shape, _n_columns(rhs)
        count(back_solves=m, multiply_adds=m * triangular_multiply_adds(n, width - 1))
        solve = (
            self._solve_many
            if _n_columns(rhs) >= MANY and len(self._band) >= WIDE
            else self._solve_few
        )
        if self._order is None:
            return solve(rhs)
        solution = np.empty_like(rhs)
        solution[self._order] = solve(rhs[self._order])
        return solution

    def _solve_few(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(dpbtrs(self._band, rhs)[0]).reshape(rhs.shape)

    def _solve_many(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """By blocks of rows of L for all right-hand sides at once; LAPACK takes one after the other, on beam-fine 4 times as long."""
        width, n = self._band.shape
        x, below = np.array(rhs, order="C"), np.zeros((BLOCK, width - 1 + BLOCK))
        # Column j of the storage is row j of L, in which entry (j, i) stands at i - j + width - 1.
        starts = range(0, n, BLOCK)

        def rows_of(start: int) -> tuple[int, int, NDArray[np.float64], NDArray[np.float64]]:
            """The block's end, its first column, its part left of the diagonal, and its triangle."""
            end = min(start + BLOCK, n)
            for j in range(start, end):
                row = below[j - start]
                row[:] = 0.0
                row[j - start : j - start + width] = self._band[:, j]
            first = max(0, start - (width - 1))
            left = below[: end - start, first - start + width - 1 : width - 1]
            return end, first, left, below[: end - start, width - 1 : width - 1 + end - start]

        for start in starts:
            end, first, left, triangle = rows_of(start)
            x[start:end] = solve_triangular(
                triangle, x[start:end] - left @ x[first:start], lower=True, check_finite=False
            )
        for start in reversed(starts):
            end, first, left, triangle = rows_of(start)
            x[start:end] = solve_triangular(
                triangle, x[start:end], lower=True, trans="T", check_finite=False
            )
            x[first:start] -= left.T @ x[start:end]
        return x

    def single_precision(self) -> SingleBandedFactor:
        """A copy in float32, which is solved with twice as fast."""
        width, n = self._band.shape
        columns = np.zeros((n, width), dtype=np.float32)
        for k in range(width):
            columns[: n - k, k] = self._band[width - 1 - k, k:]
        columns[:, 0] = 1.0 / self._band[width - 1]
        place = np.arange(n)
        if self._order is not None:
            place[self._order] = np.arange(n)
        return SingleBandedFactor(columns, place)


class SingleBandedFactor:
    """Columns of L (n, bandwidth + 1) float32, diagonals inverted, and the place (n,) of each unknown in them."""

    def __init__(self, columns: NDArray[np.float32], place: NDArray[np.int64]) -> None:
        self._columns, self.place = columns, place

    def solve_in_place(self, x: NDArray[np.float32]) -> None:
        """Overwrite the right-hand sides x (m, n), in the factor's order, by the solutions."""
        n, width = self._columns.shape
        count(back_solves=len(x), multiply_adds=len(x) * triangular_multiply_adds(n, width - 1))
        banded_solve(self._columns, x)


class BandedCholesky:
    """LAPACK's banded Cholesky, in natural order or after reverse Cuthill-McKee, whichever has the smaller band."""

    def __init__(self, pattern: Pattern) -> None:
        graph = pattern.node_graph
        order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        a, b = graph.nonzero()
        natural, reordered = int(np.abs(a - b).max()), int(np.abs(place[a] - place[b]).max())
        self.bandwidth = 3 * min(natural, reordered) + 2
        self._order = dofs_of_nodes(order) if reordered < natural else None
        self._place = dofs_of_nodes(place) if reordered < natural else None
        self._pattern = pattern

    @property
    def entries(self) -> int:
        """Stored entries of the band."""
        return self._pattern.n * (self.bandwidth + 1)

    def factor(self, values: NDArray[np.float64]) -> BandedFactor:
        count(
            factorisations=1,
            multiply_adds=cholesky_multiply_adds(self._pattern.n, self.bandwidth),
        )
        rows: NDArray[np.integer] = self._pattern.rows
        columns: NDArray[np.integer] = self._pattern.indices
        if self._place is not None:
            rows, columns = self._place[rows], self._place[columns]
        low, high = np.minimum(rows, columns), np.maximum(rows, columns)
        flat = np.zeros(self.entries)
        flat[high * np.int64(self.bandwidth) + self.bandwidth + low] = values
        band, info = dpbtrf(flat.reshape(self._pattern.n, self.bandwidth + 1).T, overwrite_ab=1)
        if info != 0:
            raise NotPositiveDefiniteError
        return BandedFactor(band, self._order)


@dataclass(frozen=True)
class SparseFactor:
    """SuperLU's factors."""

    lu: sp_linalg.SuperLU
    solver: SparseLU

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        if is_counting():  # the first count factorises once more
            m = _n_columns(rhs)
            count(back_solves=m, multiply_adds=m * self.solver.multiply_adds[1])
        return np.asarray(self.lu.solve(rhs))


class SparseLU:
    """SuperLU in symmetric mode without pivoting, ordered by minimum degree; the signs of U's diagonal tell definiteness."""

    def __init__(self, pattern: Pattern) -> None:
        rows, columns = pattern.rows, pattern.indices
        off = np.flatnonzero(rows != columns)
        number = np.arange(1, len(rows) + 1)
        entries = (
            np.concatenate([number, number[off]]),
            (np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]])),
        )
        template = sp.csc_array(entries, shape=(pattern.n, pattern.n))
        template.sort_indices()
        self._template, self._gather = template, template.data - 1

    def _splu(self, entries: NDArray[np.float64]) -> sp_linalg.SuperLU:
        t = self._template
        matrix = sp.csc_matrix((entries, t.indices, t.indptr), shape=t.shape)
        return sp_linalg.splu(
            matrix,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    @cached_property
    def multiply_adds(self) -> tuple[int, int]:
        """Of a factorisation, which does not make use of the symmetry, and of a solve; by factors in which no entry cancels."""
        t = self._template
        counts = np.diff(t.indptr)
        columns = np.repeat(np.arange(len(counts)), counts)
        lu = self._splu(np.where(t.indices == columns, counts[columns], -1.0))
        below, right = np.diff(lu.L.tocsc().indptr) - 1, np.diff(lu.U.tocsr().indptr) - 1
        return int((below * (1 + right)).sum()), int((below + right + 1).sum())

    def factor(self, values: NDArray[np.float64]) -> SparseFactor:
        if is_counting():  # the first count factorises once more
            count(factorisations=1, multiply_adds=self.multiply_adds[0])
        try:
            lu = self._splu(values[self._gather])
        except RuntimeError as error:
            raise NotPositiveDefiniteError from error
        if not np.all(lu.U.diagonal() > 0):
            raise NotPositiveDefiniteError
        return SparseFactor(lu, self)


class Pardiso:
    """MKL's parallel sparse Cholesky; the symbolic factorisation is done once. Needs the extra `mkl`."""

    def __init__(self, pattern: Pattern) -> None:
        from pypardiso import PyPardisoSolver
        from pypardiso.pardiso_wrapper import PyPardisoError

        self._error: type[Exception] = PyPardisoError
        self._solver = PyPardisoSolver(mtype=2)
        os.environ.setdefault(
            "PYPARDISO_MKL_RT", self._solver.libmkl._name
        )  # without it, each solver searches all of Python's folders for MKL
        indices, indptr = pattern.indices.astype(np.int32), pattern.indptr.astype(np.int32)
        self._matrix = sp.csr_matrix(
            (np.ones(len(indices)), indices, indptr), shape=(pattern.n, pattern.n)
        )
        self._phase(11, np.zeros(pattern.n))

    def _phase(self, phase: int, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        # The wrapper's own `factorize` repeats the symbolic phase and copies the matrix, its `solve` compares it.
        self._solver.set_phase(phase)
        return np.asarray(self._solver._call_pardiso(self._matrix, np.asfortranarray(rhs)))

    def factor(self, values: NDArray[np.float64]) -> Pardiso:
        """Factorise; the factor before is lost."""
        self._matrix.data = np.ascontiguousarray(values)
        try:
            self._phase(22, np.zeros(len(self._matrix.indptr) - 1))
        except self._error as error:
            raise NotPositiveDefiniteError from error
        # MKL reports millions of operations. The least number for its entries has columns
        # of equal length.
        least = self._entries**2 // (2 * self._matrix.shape[0])
        count(
            factorisations=1,
            multiply_adds=max(500_000 * int(self._solver.get_iparm(19)), least),
        )
        return self

    @property
    def _entries(self) -> int:
        """Of L, as MKL reports them."""
        return int(self._solver.get_iparm(18))

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        m = _n_columns(rhs)
        count(back_solves=m, multiply_adds=m * 2 * self._entries)
        return self._phase(33, rhs)


class Multigrid:
    """Smoothed aggregation with the rigid motions as near null space (Vaněk, Mandel & Brezina, Computing 56, 1996), by PyAMG.

    Parameters
    ----------
    pattern : Pattern
    points : (n / 3, 3) float64
        Reference positions of the free nodes, m.
    """

    def __init__(self, pattern: Pattern, points: NDArray[np.float64]) -> None:
        self._pattern, self._points = pattern, points

    def factor(self, values: NDArray[np.float64]) -> MultigridFactor:
        """Build the hierarchy, which counts as a factorisation without arithmetic; that the matrix is positive definite is not noticed."""
        count(factorisations=1)
        return MultigridFactor(self._pattern, values, self._points)


class MultigridFactor:
    """A multigrid hierarchy; one V-cycle in float32 is a preconditioner, conjugate gradients with it solve."""

    def __init__(
        self, pattern: Pattern, values: NDArray[np.float64], points: NDArray[np.float64]
    ) -> None:
        from pyamg import smoothed_aggregation_solver

        upper = sp.csr_matrix(
            (values, pattern.indices, pattern.indptr), shape=(pattern.n, pattern.n)
        )
        self._matrix = (upper + sp.triu(upper, 1).T).tobsr(blocksize=(3, 3))
        x = points - points.mean(axis=0)
        motions = np.zeros((len(points), 3, 6))
        motions[:, :, :3] = np.eye(3)
        for axis in range(3):
            motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x / np.abs(x).max())
        # Of plates and other ill-conditioned bodies the coarsest matrix is not definite in single precision, or not at all.
        for dtype, coarse in (
            (np.float32, "cholesky"),
            (np.float64, "cholesky"),
            (np.float64, "pinv"),
        ):
            levels: Any = smoothed_aggregation_solver(
                self._matrix.astype(dtype),
                B=motions.reshape(-1, 6).astype(dtype),
                strength=None,
                improve_candidates=None,
                max_coarse=500,
                presmoother=("block_gauss_seidel", {"sweep": "forward"}),
                postsmoother=("block_gauss_seidel", {"sweep": "backward"}),
                coarse_solver=coarse,
            )
            self._cycle, self._dtype = levels.aspreconditioner(), dtype
            # Of a cycle: three sweeps over each level's matrix (smoother, residual, smoother), its transfers, the coarsest solve.
            transfers = sum(
                3 * level.A.nnz + level.R.nnz + level.P.nnz for level in levels.levels[:-1]
            )
            self._cycle_multiply_adds = int(transfers + levels.levels[-1].A.shape[0] ** 2)
            try:
                response = self._cycle @ np.ones(pattern.n, dtype)
            except np.linalg.LinAlgError:
                continue
            if np.isfinite(response).all() and response.sum() > 0:
                break
        self.place = np.arange(pattern.n)

    def single_precision(self) -> MultigridFactor:
        return self

    def solve_in_place(self, x: NDArray[np.float32]) -> None:
        count(back_solves=len(x), multiply_adds=len(x) * self._cycle_multiply_adds)
        for row in x:
            row[:] = self._cycle @ row.astype(self._dtype)

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        if rhs.ndim == 2:
            return np.stack([self.solve(column) for column in rhs.T], axis=1)
        scale = float(np.abs(rhs).max()) or 1.0

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
        missed = (
            float(
                np.linalg.norm(self._matrix @ solution - rhs / scale) / np.linalg.norm(rhs / scale)
            )
            if failed
            else 0.0
        )
        if not missed <= ACCEPTED_RESIDUAL:
            raise SolverError(
                f"multigrid does not solve with the stiffness at rest: a residual of {missed:.1e} of the load after {MAX_CYCLES} cycles; "
                'is the body too slender? `solver = "superlu"` may.'
            )
        return np.asarray(solution * scale)


def choose_solver(pattern: Pattern, points: NDArray[np.float64]) -> BandedCholesky | Multigrid:
    """What factorises the stiffness at rest: a banded Cholesky up to `MAX_BAND_ENTRIES`, else multigrid."""
    banded = BandedCholesky(pattern)
    return banded if banded.entries <= MAX_BAND_ENTRIES else Multigrid(pattern, points)
