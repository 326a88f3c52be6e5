"""Multigrid cycles on symmetric matrices of 3x3 blocks, of which only the lower half is stored.

A cycle starts from zero: one forward sweep of block Gauss-Seidel, the correction of the next level,
and one backward sweep. Each sweep reads half of the matrix once, since a block also acts
transposed. The correction is that of two cycles of the next level (a W-cycle): with one, the
iterations grow with the number of levels. The coarsest level has an explicit inverse.

Trottenberg, Oosterlee & Schüller, "Multigrid", Academic Press, 2001, section 2.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

VISITS = 2
"""Cycles of the next level in a cycle."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def sweep_forward(indptr, indices, lower, inverses, b, x, r):
    """Solve (L + D) x = b, and write the residual b - (L + D + Lᵀ) x = -Lᵀ x to r."""
    r[:] = 0.0
    for i in range(len(indptr) - 1):
        s0, s1, s2 = b[3 * i], b[3 * i + 1], b[3 * i + 2]
        for k in range(indptr[i], indptr[i + 1]):
            K, j = lower[k], 3 * indices[k]
            x0, x1, x2 = x[j], x[j + 1], x[j + 2]
            s0 -= K[0, 0] * x0 + K[0, 1] * x1 + K[0, 2] * x2
            s1 -= K[1, 0] * x0 + K[1, 1] * x1 + K[1, 2] * x2
            s2 -= K[2, 0] * x0 + K[2, 1] * x1 + K[2, 2] * x2
        D = inverses[i]
        x0 = D[0, 0] * s0 + D[0, 1] * s1 + D[0, 2] * s2
        x1 = D[1, 0] * s0 + D[1, 1] * s1 + D[1, 2] * s2
        x2 = D[2, 0] * s0 + D[2, 1] * s1 + D[2, 2] * s2
        x[3 * i], x[3 * i + 1], x[3 * i + 2] = x0, x1, x2
        for k in range(indptr[i], indptr[i + 1]):
            K, j = lower[k], 3 * indices[k]
            r[j] -= K[0, 0] * x0 + K[1, 0] * x1 + K[2, 0] * x2
            r[j + 1] -= K[0, 1] * x0 + K[1, 1] * x1 + K[2, 1] * x2
            r[j + 2] -= K[0, 2] * x0 + K[1, 2] * x1 + K[2, 2] * x2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def sweep_backward(indptr, indices, lower, inverses, b, x, above):
    """Improve x by one sweep of block Gauss-Seidel from the last row to the first.

    ``above`` receives Lᵀ x of the new x.
    """
    above[:] = 0.0
    for i in range(len(indptr) - 2, -1, -1):
        s0, s1, s2 = b[3 * i], b[3 * i + 1], b[3 * i + 2]
        s0, s1, s2 = s0 - above[3 * i], s1 - above[3 * i + 1], s2 - above[3 * i + 2]
        for k in range(indptr[i], indptr[i + 1]):
            K, j = lower[k], 3 * indices[k]
            x0, x1, x2 = x[j], x[j + 1], x[j + 2]
            s0 -= K[0, 0] * x0 + K[0, 1] * x1 + K[0, 2] * x2
            s1 -= K[1, 0] * x0 + K[1, 1] * x1 + K[1, 2] * x2
            s2 -= K[2, 0] * x0 + K[2, 1] * x1 + K[2, 2] * x2
        D = inverses[i]
        x0 = D[0, 0] * s0 + D[0, 1] * s1 + D[0, 2] * s2
        x1 = D[1, 0] * s0 + D[1, 1] * s1 + D[1, 2] * s2
        x2 = D[2, 0] * s0 + D[2, 1] * s1 + D[2, 2] * s2
        x[3 * i], x[3 * i + 1], x[3 * i + 2] = x0, x1, x2
        for k in range(indptr[i], indptr[i + 1]):
            K, j = lower[k], 3 * indices[k]
            above[j] += K[0, 0] * x0 + K[1, 0] * x1 + K[2, 0] * x2
            above[j + 1] += K[0, 1] * x0 + K[1, 1] * x1 + K[2, 1] * x2
            above[j + 2] += K[0, 2] * x0 + K[1, 2] * x1 + K[2, 2] * x2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def subtract_product(indptr, indices, lower, diagonal, x, r):
    """Subtract (L + D + Lᵀ) x from r."""
    for i in range(len(indptr) - 1):
        D = diagonal[i]
        x0, x1, x2 = x[3 * i], x[3 * i + 1], x[3 * i + 2]
        s0 = D[0, 0] * x0 + D[0, 1] * x1 + D[0, 2] * x2
        s1 = D[1, 0] * x0 + D[1, 1] * x1 + D[1, 2] * x2
        s2 = D[2, 0] * x0 + D[2, 1] * x1 + D[2, 2] * x2
        for k in range(indptr[i], indptr[i + 1]):
            K, j = lower[k], 3 * indices[k]
            y0, y1, y2 = x[j], x[j + 1], x[j + 2]
            s0 += K[0, 0] * y0 + K[0, 1] * y1 + K[0, 2] * y2
            s1 += K[1, 0] * y0 + K[1, 1] * y1 + K[1, 2] * y2
            s2 += K[2, 0] * y0 + K[2, 1] * y1 + K[2, 2] * y2
            r[j] -= K[0, 0] * x0 + K[1, 0] * x1 + K[2, 0] * x2
            r[j + 1] -= K[0, 1] * x0 + K[1, 1] * x1 + K[2, 1] * x2
            r[j + 2] -= K[0, 2] * x0 + K[1, 2] * x1 + K[2, 2] * x2
        r[3 * i] -= s0
        r[3 * i + 1] -= s1
        r[3 * i + 2] -= s2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def restrict(indptr, indices, blocks, fine, coarse):
    """Write Pᵀ fine to ``coarse``."""
    coarse[:] = 0.0
    for i in range(len(indptr) - 1):
        x0, x1, x2 = fine[3 * i], fine[3 * i + 1], fine[3 * i + 2]
        for k in range(indptr[i], indptr[i + 1]):
            P, j = blocks[k], 3 * indices[k]
            coarse[j] += P[0, 0] * x0 + P[1, 0] * x1 + P[2, 0] * x2
            coarse[j + 1] += P[0, 1] * x0 + P[1, 1] * x1 + P[2, 1] * x2
            coarse[j + 2] += P[0, 2] * x0 + P[1, 2] * x1 + P[2, 2] * x2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def prolong(indptr, indices, blocks, coarse, fine):
    """Add P coarse to ``fine``."""
    for i in range(len(indptr) - 1):
        s0, s1, s2 = fine[3 * i], fine[3 * i + 1], fine[3 * i + 2]
        for k in range(indptr[i], indptr[i + 1]):
            P, j = blocks[k], 3 * indices[k]
            x0, x1, x2 = coarse[j], coarse[j + 1], coarse[j + 2]
            s0 += P[0, 0] * x0 + P[0, 1] * x1 + P[0, 2] * x2
            s1 += P[1, 0] * x0 + P[1, 1] * x1 + P[1, 2] * x2
            s2 += P[2, 0] * x0 + P[2, 1] * x1 + P[2, 2] * x2
        fine[3 * i], fine[3 * i + 1], fine[3 * i + 2] = s0, s1, s2


Blocks = tuple[NDArray[np.int32], NDArray[np.int32], Floats]


@dataclass(frozen=True)
class Level:
    """One level above the coarsest.

    Attributes
    ----------
    lower : tuple of arrays
        Row pointers, columns and blocks left of the diagonal, (n_blocks, 3, 3).
    diagonal, inverses : (n / 3, 3, 3) floats
        Blocks of the diagonal, and their inverses.
    prolongation : tuple of arrays
        Row pointers, columns and blocks of P.
    """

    lower: Blocks
    diagonal: Floats
    inverses: Floats
    prolongation: Blocks
    n_coarse: int

    @property
    def multiply_adds(self) -> int:
        """Work of the sweeps and transfers of one visit, and of the residual between two."""
        lower, P = 9 * len(self.lower[1]), 9 * len(self.prolongation[1])
        return 6 * lower + 3 * self.diagonal.size + 2 * P


def level_of(matrix: Any, prolongation: Any, dtype: Any) -> Level:
    """Return the level of a symmetric sparse matrix and its prolongation, in a precision."""
    blocks = sp.csr_matrix(matrix).tobsr(blocksize=(3, 3))
    blocks.sort_indices()
    n = len(blocks.indptr) - 1
    rows = np.repeat(np.arange(n), np.diff(blocks.indptr))
    left, on = blocks.indices < rows, blocks.indices == rows
    indptr = np.append(0, np.cumsum(np.bincount(rows[left], minlength=n))).astype(np.int32)
    diagonal = np.zeros((n, 3, 3))
    diagonal[rows[on]] = blocks.data[on]
    # An aggregate of one or two nodes has fewer than six motions; the others have zero rows.
    inverses = np.linalg.pinv(diagonal, rcond=1e-10, hermitian=True)
    P = sp.csr_matrix(prolongation).tobsr(blocksize=(3, 3))
    return Level(
        (indptr, blocks.indices[left].astype(np.int32), blocks.data[left].astype(dtype)),
        diagonal.astype(dtype),
        inverses.astype(dtype),
        (P.indptr.astype(np.int32), P.indices.astype(np.int32), P.data.astype(dtype)),
        int(P.shape[1]),
    )


class Cycle:
    """A W-cycle, an approximate inverse of the finest matrix.

    Parameters
    ----------
    levels : list of Level
        From the finest to the one above the coarsest.
    coarsest : (n, n) floats
        Inverse of the coarsest matrix.
    """

    def __init__(self, levels: list[Level], coarsest: Floats) -> None:
        self._levels, self._coarsest, self.dtype = levels, coarsest, coarsest.dtype

    @property
    def multiply_adds(self) -> int:
        visits = [VISITS**depth for depth in range(len(self._levels) + 1)]
        own = [level.multiply_adds for level in self._levels] + [self._coarsest.size]
        return int(np.dot(visits, own))

    def __call__(self, b: Floats, depth: int = 0) -> Floats:
        """Return the correction for a residual of the level at this depth."""
        if depth == len(self._levels):
            return np.asarray(self._coarsest @ b)
        level = self._levels[depth]
        x, left = np.empty_like(b), np.empty_like(b)
        sweep_forward(*level.lower, level.inverses, b, x, left)
        coarse = np.empty(level.n_coarse, dtype=b.dtype)
        restrict(*level.prolongation, left, coarse)
        found = self(coarse, depth + 1)
        if depth + 1 < len(self._levels):
            below = self._levels[depth + 1]
            for _ in range(VISITS - 1):
                left_below = coarse.copy()
                subtract_product(*below.lower, below.diagonal, found, left_below)
                found += self(left_below, depth + 1)
        prolong(*level.prolongation, found, x)
        sweep_backward(*level.lower, level.inverses, b, x, left)
        return x
