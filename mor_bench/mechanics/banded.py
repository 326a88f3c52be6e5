"""Banded Cholesky factors, in double precision by LAPACK and in single precision by a kernel."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse.csgraph import reverse_cuthill_mckee

from mor_bench.counting import cholesky_multiply_adds, count, is_counting, triangular_multiply_adds
from mor_bench.mechanics.linear import NotPositiveDefiniteError, n_columns
from mor_bench.mechanics.pattern import Pattern
from mor_bench.scene.dofs import dofs_of_nodes

MANY, WIDE = 64, 256
"""Least number of right-hand sides, and least bandwidth, for solving by blocks of rows."""
BLOCK = 96
"""Number of rows in a block."""


@njit(inline="always")
def _forward(band, right_hand_sides, whole):
    """Solve with L for the first ``whole`` unknowns, four columns at once."""
    n, width = band.shape
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
            # The ends of b, c and d reach beyond that of a.
            for k in range(last, min(width - 1, n - j - 4)):
                at = x[j + 4 + k]
                if k + 3 < width:
                    at -= b[k + 3] * x1
                if k + 2 < width:
                    at -= c[k + 2] * x2
                at -= d[k + 1] * x3
                x[j + 4 + k] = at


@njit(inline="always")
def _remainder(band, right_hand_sides, whole):
    """Solve with L and Lᵀ for the unknowns from ``whole`` on."""
    n = len(band)
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


@njit(inline="always")
def _backward(band, right_hand_sides, whole):
    """Solve with Lᵀ for the first ``whole`` unknowns, four columns at once."""
    n, width = band.shape
    zero = np.float32(0.0)
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def banded_solve(band, right_hand_sides):
    """Solve L Lᵀ x = x in place for every row x of (m, n).

    ``band`` (n, bandwidth + 1) holds the columns of L with inverted diagonals. Processing
    four columns at once loads and stores x once per four multiply-adds. All right-hand
    sides use the four columns before the next four are fetched.
    """
    n = len(band)
    whole = n - n % 4
    _forward(band, right_hand_sides, whole)
    _remainder(band, right_hand_sides, whole)
    _backward(band, right_hand_sides, whole)


def inverted_columns(band: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the columns of L, with inverted diagonals, of a factor in LAPACK's upper storage."""
    width, n = band.shape
    columns = np.zeros((n, width), dtype=np.float32)
    for k in range(width):
        columns[: n - k, k] = band[width - 1 - k, k:]
    columns[:, 0] = 1.0 / band[width - 1]
    return columns


class BandedFactor:
    """A banded Cholesky factor in LAPACK's upper storage."""

    def __init__(
        self, band: NDArray[np.float64], order: NDArray[np.int64] | None, pattern: Pattern
    ) -> None:
        self._band, self._order, self._pattern = band, order, pattern

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        rhs, (width, n), m = self._pattern.pad(rhs), self._band.shape, n_columns(rhs)
        count(back_solves=m, multiply_adds=m * triangular_multiply_adds(n, width - 1))
        by_blocks = n_columns(rhs) >= MANY and len(self._band) >= WIDE
        solve = self._solve_many if by_blocks else self._solve_few
        if self._order is None:
            return self._pattern.cut(solve(rhs))
        solution = np.empty_like(rhs)
        solution[self._order] = solve(rhs[self._order])
        return self._pattern.cut(solution)

    def _solve_few(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(dpbtrs(self._band, rhs)[0]).reshape(rhs.shape)

    def _solve_many(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve by blocks of rows of L for all right-hand sides at once.

        LAPACK solves for one after the other, which takes 4 times as long on beam-fine.
        """
        width, n = self._band.shape
        x, below = np.array(rhs, order="C"), np.zeros((BLOCK, width - 1 + BLOCK))
        # Column j of the storage is row j of L. Entry (j, i) stands at i - j + width - 1 in it.
        starts = range(0, n, BLOCK)

        def rows_of(start: int) -> tuple[int, int, NDArray[np.float64], NDArray[np.float64]]:
            """Return the block's end, first column, part left of the diagonal, and triangle."""
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
        """Return a copy in float32, which solves twice as fast."""
        n = self._band.shape[1]
        columns, place = inverted_columns(self._band), np.arange(n)
        if self._order is not None:
            place[self._order] = np.arange(n)
        return SingleBandedFactor(columns, place)


class SingleBandedFactor:
    """A banded Cholesky factor in single precision.

    Parameters
    ----------
    columns : (n, bandwidth + 1) float32
        Columns of L with inverted diagonals.
    place : (n,) int64
        Number of each unknown's column.
    """

    def __init__(self, columns: NDArray[np.float32], place: NDArray[np.int64]) -> None:
        self._columns, self.place = columns, place

    def solve_in_place(self, x: NDArray[np.float32]) -> None:
        """Overwrite right-hand sides x (m, n), in the factor's order, by the solutions."""
        if is_counting():
            n, width = self._columns.shape
            work = triangular_multiply_adds(n, width - 1)
            count(back_solves=len(x), multiply_adds=len(x) * work)
        banded_solve(self._columns, x)


class BandedCholesky:
    """LAPACK's banded Cholesky, in natural or reverse Cuthill-McKee order.

    The order with the smaller band is taken.

    Attributes
    ----------
    place : (n_nodes,) int64
        Position of each node in the order.
    bandwidth : int
        Largest distance of two linked unknowns.
    """

    def __init__(self, pattern: Pattern) -> None:
        graph = pattern.whole.node_graph
        order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        a, b = graph.nonzero()
        natural, reordered = int(np.abs(a - b).max()), int(np.abs(place[a] - place[b]).max())
        self.place = place if reordered < natural else np.arange(len(order))
        self.bandwidth = 3 * min(natural, reordered) + 2
        self._order = dofs_of_nodes(order) if reordered < natural else None
        self._place = dofs_of_nodes(place) if reordered < natural else None
        self._pattern = pattern

    @property
    def entries(self) -> int:
        """Number of stored entries of the band."""
        return self._pattern.whole.n * (self.bandwidth + 1)

    @property
    def node_entries(self) -> int:
        """Number of stored entries of the band of a matrix with one unknown per node."""
        return len(self.place) * (self.bandwidth // 3 + 1)

    def factor(self, values: NDArray[np.float64]) -> BandedFactor:
        whole = self._pattern.whole
        count(factorisations=1, multiply_adds=cholesky_multiply_adds(whole.n, self.bandwidth))
        rows: NDArray[np.integer] = whole.rows
        columns: NDArray[np.integer] = whole.indices
        if self._place is not None:
            rows, columns = self._place[rows], self._place[columns]
        low, high = np.minimum(rows, columns), np.maximum(rows, columns)
        flat = np.zeros(self.entries)
        flat[high * np.int64(self.bandwidth) + self.bandwidth + low] = self._pattern.complete(
            values
        )
        band, info = dpbtrf(flat.reshape(whole.n, self.bandwidth + 1).T, overwrite_ab=1)
        if info != 0:
            raise NotPositiveDefiniteError
        return BandedFactor(band, self._order, self._pattern)
