"""Multigrid cycles on symmetric matrices of 3x3 blocks, of which only the lower half is stored.

A cycle starts from zero: one forward sweep of damped block Gauss-Seidel, the correction of the next
level, and one backward sweep. Each sweep reads half of the matrix once, since a block also acts
transposed. The coarsest level has an explicit inverse.

Trottenberg, Oosterlee & Schüller, "Multigrid", Academic Press, 2001, section 2.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

from mor_bench.mechanics.slabs import Slabs, are_apart, slabs_of, whole

Floats = NDArray[np.floating[Any]]

RELAXATION = 0.75
"""Damping of the sweeps.

Undamped sweeps need 10 % more iterations at a Poisson's ratio of 0.4, and 20 % more at 0.49.
"""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def sweep_forward(indptr, indices, starts, blocks, b, x, r, first, last):
    """Solve rows of (L + D / RELAXATION) x = b, and add b - (L + D + Lᵀ) x to r."""
    for i in range(first, last):
        begin, n = indptr[i], indptr[i + 1] - indptr[i]
        row = blocks[starts[i] : starts[i] + n + 2]
        s0, s1, s2 = b[3 * i], b[3 * i + 1], b[3 * i + 2]
        for k in range(n):
            K, j = row[k], 3 * indices[begin + k]
            x0, x1, x2 = x[j], x[j + 1], x[j + 2]
            s0 -= K[0, 0] * x0 + K[0, 1] * x1 + K[0, 2] * x2
            s1 -= K[1, 0] * x0 + K[1, 1] * x1 + K[1, 2] * x2
            s2 -= K[2, 0] * x0 + K[2, 1] * x1 + K[2, 2] * x2
        D = row[n + 1]
        x0 = D[0, 0] * s0 + D[0, 1] * s1 + D[0, 2] * s2
        x1 = D[1, 0] * s0 + D[1, 1] * s1 + D[1, 2] * s2
        x2 = D[2, 0] * s0 + D[2, 1] * s1 + D[2, 2] * s2
        x[3 * i], x[3 * i + 1], x[3 * i + 2] = x0, x1, x2
        D = row[n]
        r[3 * i] += s0 - (D[0, 0] * x0 + D[0, 1] * x1 + D[0, 2] * x2)
        r[3 * i + 1] += s1 - (D[1, 0] * x0 + D[1, 1] * x1 + D[1, 2] * x2)
        r[3 * i + 2] += s2 - (D[2, 0] * x0 + D[2, 1] * x1 + D[2, 2] * x2)
        for k in range(n):
            K, j = row[k], 3 * indices[begin + k]
            r[j] -= K[0, 0] * x0 + K[1, 0] * x1 + K[2, 0] * x2
            r[j + 1] -= K[0, 1] * x0 + K[1, 1] * x1 + K[2, 1] * x2
            r[j + 2] -= K[0, 2] * x0 + K[1, 2] * x1 + K[2, 2] * x2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def sweep_backward(indptr, indices, starts, blocks, b, x, above, first, last):
    """Improve x by one damped sweep of block Gauss-Seidel over rows, from the last to the first.

    Lᵀ x of the new x is added to ``above``.
    """
    for i in range(last - 1, first - 1, -1):
        begin, n = indptr[i], indptr[i + 1] - indptr[i]
        row = blocks[starts[i] : starts[i] + n + 2]
        s0, s1, s2 = b[3 * i], b[3 * i + 1], b[3 * i + 2]
        s0, s1, s2 = s0 - above[3 * i], s1 - above[3 * i + 1], s2 - above[3 * i + 2]
        for k in range(n):
            K, j = row[k], 3 * indices[begin + k]
            x0, x1, x2 = x[j], x[j + 1], x[j + 2]
            s0 -= K[0, 0] * x0 + K[0, 1] * x1 + K[0, 2] * x2
            s1 -= K[1, 0] * x0 + K[1, 1] * x1 + K[1, 2] * x2
            s2 -= K[2, 0] * x0 + K[2, 1] * x1 + K[2, 2] * x2
        D, x0, x1, x2 = row[n], x[3 * i], x[3 * i + 1], x[3 * i + 2]
        s0, s1, s2 = (
            s0 - (D[0, 0] * x0 + D[0, 1] * x1 + D[0, 2] * x2),
            s1 - (D[1, 0] * x0 + D[1, 1] * x1 + D[1, 2] * x2),
            s2 - (D[2, 0] * x0 + D[2, 1] * x1 + D[2, 2] * x2),
        )
        D = row[n + 1]
        x0 += D[0, 0] * s0 + D[0, 1] * s1 + D[0, 2] * s2
        x1 += D[1, 0] * s0 + D[1, 1] * s1 + D[1, 2] * s2
        x2 += D[2, 0] * s0 + D[2, 1] * s1 + D[2, 2] * s2
        x[3 * i], x[3 * i + 1], x[3 * i + 2] = x0, x1, x2
        for k in range(n):
            K, j = row[k], 3 * indices[begin + k]
            above[j] += K[0, 0] * x0 + K[1, 0] * x1 + K[2, 0] * x2
            above[j + 1] += K[0, 1] * x0 + K[1, 1] * x1 + K[2, 1] * x2
            above[j + 2] += K[0, 2] * x0 + K[1, 2] * x1 + K[2, 2] * x2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def complete_product(indptr, indices, starts, blocks, x, product, first, last):
    """Add rows of (L + D) x to Lᵀ x, which a backward sweep leaves."""
    for i in range(first, last):
        begin, n = indptr[i], indptr[i + 1] - indptr[i]
        row = blocks[starts[i] : starts[i] + n + 1]
        D, x0, x1, x2 = row[n], x[3 * i], x[3 * i + 1], x[3 * i + 2]
        s0 = D[0, 0] * x0 + D[0, 1] * x1 + D[0, 2] * x2
        s1 = D[1, 0] * x0 + D[1, 1] * x1 + D[1, 2] * x2
        s2 = D[2, 0] * x0 + D[2, 1] * x1 + D[2, 2] * x2
        for k in range(n):
            K, j = row[k], 3 * indices[begin + k]
            y0, y1, y2 = x[j], x[j + 1], x[j + 2]
            s0 += K[0, 0] * y0 + K[0, 1] * y1 + K[0, 2] * y2
            s1 += K[1, 0] * y0 + K[1, 1] * y1 + K[1, 2] * y2
            s2 += K[2, 0] * y0 + K[2, 1] * y1 + K[2, 2] * y2
        product[3 * i] += s0
        product[3 * i + 1] += s1
        product[3 * i + 2] += s2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def restrict(indptr, indices, starts, blocks, fine, coarse, first, last):
    """Add Pᵀ fine of some rows to ``coarse``."""
    for i in range(first, last):
        begin, n = indptr[i], indptr[i + 1] - indptr[i]
        row = blocks[starts[i] : starts[i] + n]
        x0, x1, x2 = fine[3 * i], fine[3 * i + 1], fine[3 * i + 2]
        for k in range(n):
            P, j = row[k], 3 * indices[begin + k]
            coarse[j] += P[0, 0] * x0 + P[1, 0] * x1 + P[2, 0] * x2
            coarse[j + 1] += P[0, 1] * x0 + P[1, 1] * x1 + P[2, 1] * x2
            coarse[j + 2] += P[0, 2] * x0 + P[1, 2] * x1 + P[2, 2] * x2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def prolong(indptr, indices, starts, blocks, coarse, fine, first, last):
    """Add P coarse to some rows of ``fine``."""
    for i in range(first, last):
        begin, n = indptr[i], indptr[i + 1] - indptr[i]
        row = blocks[starts[i] : starts[i] + n]
        s0, s1, s2 = fine[3 * i], fine[3 * i + 1], fine[3 * i + 2]
        for k in range(n):
            P, j = row[k], 3 * indices[begin + k]
            x0, x1, x2 = coarse[j], coarse[j + 1], coarse[j + 2]
            s0 += P[0, 0] * x0 + P[0, 1] * x1 + P[0, 2] * x2
            s1 += P[1, 0] * x0 + P[1, 1] * x1 + P[1, 2] * x2
            s2 += P[2, 0] * x0 + P[2, 1] * x1 + P[2, 2] * x2
        fine[3 * i], fine[3 * i + 1], fine[3 * i + 2] = s0, s1, s2


Rows = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], Floats]
"""Row pointers (n + 1,), columns (n_entries,), where each row's blocks begin (n,), and blocks."""

SAME = 3e-5
"""Largest difference of equal rows, relative to their largest entry."""
PARALLEL_FROM = 20_000
"""Rows from which a level is divided into slabs."""
N_KEYS = 3
"""Combinations that find equal rows; with one, many rows are compared with the wrong one."""


@dataclass(frozen=True)
class Level:
    """One level above the coarsest.

    On a regular grid most rows have equal blocks, which are stored once: they stay in the cache.

    Attributes
    ----------
    lower : tuple of arrays
        Rows left of the diagonal. Behind the blocks of a row are that of the diagonal, and its
        inverse times `RELAXATION`.
    prolongation : tuple of arrays
        Rows of P.
    n_coarse : int
        Number of columns of P.
    slabs, restriction : Slabs
        Rows that sweeps, and the restriction, take at the same time. "Left of the diagonal" is
        what a forward sweep meets first.
    """

    lower: Rows
    prolongation: Rows
    n_coarse: int
    slabs: Slabs
    restriction: Slabs

    @property
    def multiply_adds(self) -> int:
        """Work of the two sweeps and the transfers of a cycle."""
        n, lower, P = len(self.lower[2]), 9 * len(self.lower[1]), 9 * len(self.prolongation[1])
        return 4 * lower + 36 * n + 2 * P

    @property
    def product_multiply_adds(self) -> int:
        """Work of completing a product with the level's matrix."""
        return 9 * (len(self.lower[1]) + len(self.lower[2]))


def _stored_once(counts: NDArray[np.int64], blocks: Floats) -> tuple[NDArray[np.int32], Floats]:
    """Return where the blocks of each row begin, and the blocks of the rows that differ.

    Parameters
    ----------
    counts : (n,) int
        Number of blocks of each row.
    blocks : (n_blocks, 3, 3) floats
        Row after row.
    """
    n, begins = len(counts), np.cumsum(counts) - counts
    rows = np.repeat(np.arange(n), counts)
    within = np.arange(len(blocks)) - begins[rows]
    size = np.zeros(n)
    np.maximum.at(size, rows, np.abs(blocks).max(axis=(1, 2), initial=0.0))
    size[size == 0] = 1.0
    # Random combinations of the entries find candidates, which are compared entry by entry.
    random = np.random.default_rng(0)
    of_entry = random.uniform(-1, 1, (9, N_KEYS))
    of_place = random.uniform(-1, 1, (int(counts.max(initial=0)), N_KEYS))
    parts = (blocks.reshape(-1, 9) @ of_entry) * of_place[within] / size[rows, None]
    sums = [np.log(size), *(np.bincount(rows, part, n) for part in parts.T)]
    keys = np.stack([counts, *(np.round(values / (10 * SAME)) for values in sums)])
    _, first, group = np.unique(keys, axis=1, return_index=True, return_inverse=True)
    equal = first[group.ravel()]
    others = blocks[begins[equal][rows] + within]
    differs = rows[np.abs(blocks - others).max(axis=(1, 2), initial=0.0) > SAME * size[rows]]
    equal[differs] = differs
    kept, kind = np.unique(equal, return_inverse=True)
    new_begins = np.cumsum(counts[kept]) - counts[kept]
    places = np.repeat(begins[kept] - new_begins, counts[kept])
    return new_begins[kind].astype(np.int32), blocks[places + np.arange(len(places))]


def columns_of(matrix: Any, first: int, last: int) -> NDArray[np.int32]:
    """Return the columns of a sparse matrix' blocks in some rows."""
    return np.asarray(matrix.indices[matrix.indptr[first] : matrix.indptr[last]])


def level_of(matrix: Any, prolongation: Any, dtype: Any) -> Level:
    """Return the level of a symmetric sparse matrix and its prolongation, in a precision."""
    found = sp.csr_matrix(matrix).tobsr(blocksize=(3, 3))
    found.sort_indices()
    n = len(found.indptr) - 1
    slabs = whole(n)
    if n >= PARALLEL_FROM:
        slabs = slabs_of(n, lambda first, last: columns_of(found, first, last))
    turn = np.empty(n, dtype=np.int64)
    turn[np.concatenate(slabs.run_all(np.arange))] = np.arange(n)
    rows = np.repeat(np.arange(n), np.diff(found.indptr))
    left, on = turn[found.indices] < turn[rows], found.indices == rows
    counts = np.bincount(rows[left], minlength=n)
    indptr = np.append(0, np.cumsum(counts))
    blocks = np.zeros((indptr[-1] + 2 * n, 3, 3))
    blocks[np.arange(indptr[-1]) + 2 * rows[left]] = found.data[left]
    blocks[indptr[1:][rows[on]] + 2 * rows[on]] = found.data[on]
    begins, stored = _stored_once(counts + 2, blocks)
    diagonals = np.unique(begins + counts)
    # An aggregate of one or two nodes has fewer than six motions; the others have zero rows.
    inverses = np.linalg.pinv(stored[diagonals], rcond=1e-10, hermitian=True)
    stored[diagonals + 1] = RELAXATION * inverses
    P = sp.csr_matrix(prolongation).tobsr(blocksize=(3, 3))
    P.sort_indices()
    P_begins, P_stored = _stored_once(np.diff(P.indptr), P.data)
    apart = all(
        are_apart(group, lambda first, last: columns_of(P, first, last)) for group in slabs.groups
    )
    return Level(
        (
            indptr.astype(np.int32),
            found.indices[left].astype(np.int32),
            begins,
            stored.astype(dtype),
        ),
        (P.indptr.astype(np.int32), P.indices.astype(np.int32), P_begins, P_stored.astype(dtype)),
        int(P.shape[1]),
        slabs,
        slabs if apart else whole(n),
    )


class Inverse(Protocol):
    """An exact or approximate inverse of a symmetric matrix."""

    @property
    def multiply_adds(self) -> int: ...
    def __call__(self, b: Floats) -> Floats: ...


@dataclass(frozen=True)
class Exact:
    """The inverse (n, n) itself, of the coarsest matrix."""

    matrix: Floats

    @property
    def multiply_adds(self) -> int:
        return self.matrix.size

    def __call__(self, b: Floats) -> Floats:
        return np.asarray(self.matrix @ b)


@dataclass(frozen=True)
class Cycle:
    """A cycle, an approximate inverse of the matrix K of a level.

    All eigenvalues of (cycle) K are in (0, 1] if those of ``coarse`` and its matrix are.

    Parameters
    ----------
    level : Level
    coarse : Inverse
        An approximate inverse of the next level's matrix.
    """

    level: Level
    coarse: Inverse

    @property
    def n(self) -> int:
        """Number of rows of K."""
        return 3 * len(self.level.lower[2])

    @property
    def multiply_adds(self) -> int:
        return self.level.multiply_adds + self.coarse.multiply_adds

    def __call__(self, b: Floats) -> Floats:
        """Return the correction x (n,) for a residual b (n,)."""
        return self._correction(b)[0]

    def with_product(self, b: Floats) -> tuple[Floats, Floats]:
        """Return the correction x (n,) for a residual b (n,), and K x (n,)."""
        x, product = self._correction(b)
        lower = self.level.lower
        self.level.slabs.run_all(lambda *rows: complete_product(*lower, x, product, *rows))
        return x, product

    def _correction(self, b: Floats) -> tuple[Floats, Floats]:
        """Return x (n,), and Lᵀ x (n,)."""
        level = self.level
        x, left, above = np.empty_like(b), np.zeros_like(b), np.zeros_like(b)
        coarse = np.zeros(level.n_coarse, dtype=b.dtype)
        level.slabs.run(lambda *rows: sweep_forward(*level.lower, b, x, left, *rows))
        level.restriction.run(lambda *rows: restrict(*level.prolongation, left, coarse, *rows))
        found = self.coarse(coarse)
        level.slabs.run_all(lambda *rows: prolong(*level.prolongation, found, x, *rows))
        level.slabs.run(
            lambda *rows: sweep_backward(*level.lower, b, x, above, *rows), backward=True
        )
        return x, above
