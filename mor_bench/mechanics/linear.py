"""Direct solvers for the tangent: they factorise a symmetric matrix whose pattern never changes.

A failed Cholesky factorisation is news about the mechanics (the equilibrium is not stable), so each solver says whether
the matrix was positive definite instead of going on with a meaningless direction.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from mor_bench.mechanics.assembly import Pattern

MAX_BANDED_WORK = 1e10
"""n times bandwidth squared up to which the banded factorisation beats SuperLU (fine beam: 2.6e9, 114 against 433 ms)."""


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


class BandedFactor:
    """A banded Cholesky factor, in LAPACK's upper storage."""

    def __init__(self, band: NDArray[np.float64], order: NDArray[np.int64] | None) -> None:
        self._band, self._order = band, order

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._order is None:
            return np.asarray(dpbtrs(self._band, rhs)[0]).reshape(rhs.shape)
        solution = np.empty_like(rhs)
        solution[self._order] = np.asarray(dpbtrs(self._band, rhs[self._order])[0]).reshape(rhs.shape)
        return solution

    def single_precision(self) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Columns of L (n, bandwidth + 1) float32, with inverted diagonals, and the place in them of each row."""
        width, n = self._band.shape
        columns = np.zeros((n, width), dtype=np.float32)
        for k in range(width):
            columns[: n - k, k] = self._band[width - 1 - k, k:]
        columns[:, 0] = 1.0 / self._band[width - 1]
        place = np.arange(n)
        if self._order is not None:
            place[self._order] = np.arange(n)
        return columns, place


class BandedCholesky:
    """LAPACK's banded Cholesky, in natural order or after reverse Cuthill-McKee, whichever has the smaller band."""

    def __init__(self, pattern: Pattern) -> None:
        rows, columns = pattern.rows, pattern.indices
        matrix = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=(pattern.n, pattern.n))
        order = reverse_cuthill_mckee(sp.csr_matrix(matrix + matrix.T), symmetric_mode=True)
        place = np.empty(pattern.n, dtype=np.int64)
        place[order] = np.arange(pattern.n)
        natural, reordered = int(np.abs(columns - rows).max()), int(np.abs(place[columns] - place[rows]).max())
        self.bandwidth = min(natural, reordered)
        self._order = order.astype(np.int64) if reordered < natural else None
        if self._order is not None:
            rows, columns = place[rows], place[columns]
        low, high = np.minimum(rows, columns), np.maximum(rows, columns)
        self._n = pattern.n
        self._places = high * (self.bandwidth + 1) + self.bandwidth + low - high

    @property
    def work(self) -> float:
        """n times bandwidth squared: the multiply-adds of a factorisation."""
        return float(self._n) * self.bandwidth**2

    def factor(self, values: NDArray[np.float64]) -> BandedFactor:
        flat = np.zeros(self._n * (self.bandwidth + 1))
        flat[self._places] = values
        band, info = dpbtrf(flat.reshape(self._n, self.bandwidth + 1).T, overwrite_ab=1)
        if info != 0:
            raise NotPositiveDefiniteError
        return BandedFactor(band, self._order)


class SparseLU:
    """SuperLU in symmetric mode without pivoting, ordered by minimum degree; the signs of U's diagonal tell definiteness."""

    def __init__(self, pattern: Pattern) -> None:
        rows, columns = pattern.rows, pattern.indices
        off = np.flatnonzero(rows != columns)
        number = np.arange(1, len(rows) + 1)
        entries = (np.concatenate([number, number[off]]), (np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]])))
        template = sp.csc_array(entries, shape=(pattern.n, pattern.n))
        template.sort_indices()
        self._template, self._gather = template, template.data - 1

    def factor(self, values: NDArray[np.float64]) -> Factor:
        t = self._template
        matrix = sp.csc_matrix((values[self._gather], t.indices, t.indptr), shape=t.shape)
        try:
            lu = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:
            raise NotPositiveDefiniteError from error
        if not np.all(lu.U.diagonal() > 0):
            raise NotPositiveDefiniteError
        return lu


def choose_solver(pattern: Pattern) -> LinearSolver:
    """The faster of the two direct solvers for a pattern."""
    banded = BandedCholesky(pattern)
    return banded if banded.work <= MAX_BANDED_WORK else SparseLU(pattern)
