"""Sparsity pattern of the stiffness, computed once per mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray


@dataclass(frozen=True)
class Pattern:
    """Upper triangle, diagonal included, of a symmetric sparse matrix in CSR form, without values.

    The dofs of a node are neighbours. Where a node has one or two free dofs, `completion` adds its
    held ones, so that solvers by blocks see three dofs of every node.
    """

    n: int
    indptr: NDArray[np.int64]
    indices: NDArray[np.int32]
    completion: Completion | None = None

    @property
    def whole(self) -> Pattern:
        """The pattern with three dofs of every node."""
        return self if self.completion is None else self.completion.pattern

    def complete(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values in the whole pattern; an added dof is coupled to itself alone."""
        if self.completion is None:
            return values
        whole, kept = self.completion.pattern, self.completion.kept
        full = np.where(whole.rows == whole.indices, np.abs(values).max(), 0.0)
        full[kept] = values
        return full

    def pad(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return vectors (n,) or (n, m) with zeros at the added dofs."""
        if self.completion is None:
            return x
        padded = np.zeros((self.completion.pattern.n, *x.shape[1:]))
        padded[self.completion.dofs] = x
        return padded

    def cut(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return vectors without the added dofs."""
        return x if self.completion is None else x[self.completion.dofs]

    @property
    def rows(self) -> NDArray[np.int64]:
        """Row of each entry, (n_nonzeros,)."""
        return np.repeat(np.arange(self.n), np.diff(self.indptr))

    @property
    def node_graph(self) -> sp.csr_matrix:
        """Adjacency of the nodes that share a cell, (n / 3, n / 3)."""
        starts, stops = self.indptr[:-1:3], self.indptr[1::3]
        counts = (stops - starts) // 3
        rows = np.repeat(np.arange(self.n // 3), counts)
        first = np.repeat(starts - 3 * np.append(0, np.cumsum(counts)[:-1]), counts)
        columns = self.indices[first + 3 * np.arange(counts.sum())] // 3
        upper = sp.csr_matrix(
            (np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(self.n // 3, self.n // 3)
        )
        return sp.csr_matrix(upper + upper.T)

    def symmetric(self, values: NDArray[np.float64]) -> sp.csr_array:
        """Return the whole symmetric matrix with these values of its upper triangle."""
        upper = sp.csr_array((values, self.indices, self.indptr), shape=(self.n, self.n))
        return sp.csr_array(upper + sp.triu(upper, 1).T)


@dataclass(frozen=True)
class Completion:
    """A pattern with three dofs of every node, of a pattern that lacks some of them.

    Attributes
    ----------
    pattern : Pattern
    dofs : (n,) int64
        Number of each dof in it.
    kept : (n_nonzeros,) int64
        Number of each entry in it.
    """

    pattern: Pattern
    dofs: NDArray[np.int64]
    kept: NDArray[np.int64]


def build_pattern(
    dof_of_node: NDArray[np.int64], cells: NDArray[np.int64], n_dofs: int
) -> tuple[Pattern, NDArray[np.int32]]:
    """Return the pattern, and the indices (n_cells, n_upper) of the cells' upper entries in it.

    Sorting pairs of nodes takes a ninth of the memory of sorting pairs of dofs. Nodes without a
    free dof are left out. Nodes with one or two free dofs are first treated as free.
    """
    active = np.flatnonzero((dof_of_node < n_dofs).any(axis=1))
    active = active[np.argsort(dof_of_node[active].min(axis=1))]
    n_nodes = len(active)
    number = np.full(len(dof_of_node), n_nodes)
    number[active] = np.arange(n_nodes)
    nodes = number[cells]
    a, b = np.triu_indices(cells.shape[1])
    low, high = np.minimum(nodes[:, a], nodes[:, b]), np.maximum(nodes[:, a], nodes[:, b])
    pairs, pair_of = np.unique(
        np.where(high < n_nodes, low * n_nodes + high, n_nodes * n_nodes), return_inverse=True
    )
    pairs, pair_of = pairs[pairs < n_nodes * n_nodes], pair_of.reshape(low.shape)
    rows, columns = pairs // n_nodes, pairs % n_nodes
    # Row 3A holds 3 entries per pair (A, B). Rows 3A + 1 and 3A + 2 lack the 1 and 2 entries left
    # of the diagonal.
    counts = 3 * np.bincount(rows, minlength=n_nodes)
    indptr = np.append(0, np.cumsum(np.stack([counts, counts - 1, counts - 2], axis=1)))
    rank = np.arange(len(pairs)) - np.searchsorted(rows, rows)
    indices, starts = np.empty(indptr[-1], dtype=np.int32), np.full((len(pairs) + 1, 3), indptr[-1])
    for i in range(3):
        starts[:-1, i] = indptr[3 * rows + i] + 3 * rank - i
        for j in range(3):
            right = (rank > 0) | (j >= i)
            indices[(starts[:-1, i] + j)[right]] = (3 * columns + j)[right]
    slots = np.empty((len(cells), 9 * len(a) - 3 * cells.shape[1]), dtype=np.int32)
    p = 0
    for pair, (m, n) in enumerate(zip(a, b, strict=True)):
        swapped, start = nodes[:, m] > nodes[:, n], starts[pair_of[:, pair]]
        for i in range(3):
            for j in range(i if m == n else 0, 3):
                slots[:, p] = np.where(
                    start[:, 0] == indptr[-1],
                    indptr[-1],
                    np.where(swapped, start[:, j] + i, start[:, i] + j),
                )
                p += 1
    dofs = dof_of_node[active].ravel()
    if len(dofs) == n_dofs:
        return Pattern(n_dofs, indptr, indices), slots
    kept = (dofs < n_dofs)[indices] & np.repeat(dofs < n_dofs, np.diff(indptr))
    place = np.append(np.where(kept, np.cumsum(kept) - 1, kept.sum()), kept.sum()).astype(np.int32)
    ends = np.append(0, np.cumsum(kept))[indptr]
    completion = Completion(
        Pattern(len(dofs), indptr, indices), np.flatnonzero(dofs < n_dofs), np.flatnonzero(kept)
    )
    return Pattern(
        n_dofs,
        np.append(0, ends[1:][dofs < n_dofs]),
        dofs[indices[kept]].astype(np.int32),
        completion,
    ), place[slots]
