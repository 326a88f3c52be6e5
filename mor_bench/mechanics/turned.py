"""Assembly over dofs in the frames of oblique supports.

The kernels compute with displacements along x, y and z. A sparse matrix T maps the unknowns q to
them, u = T q. So forces are Tᵀ f and tangents Tᵀ K T. Nodes without a frame have unit rows in T.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.pattern import Pattern
from mor_bench.scene.supports import Frames

Array = NDArray[np.float64]


class TurnedDofs:
    """The dofs that the kernels use, where some nodes have frames.

    Parameters
    ----------
    frames : Frames
    dof_of_node : (n_nodes, 3) int
        Row of each component in the vectors of unknowns; ``n`` at supports.
    n : int
        Number of unknowns.

    Attributes
    ----------
    dof_of_node : (n_nodes, 3) int64
        The same for the kernels: a node with a frame has three dofs along x, y and z.
    n : int
        Number of these dofs.
    """

    def __init__(self, frames: Frames, dof_of_node: NDArray[np.int64], n: int) -> None:
        free = dof_of_node < n
        own = free[frames.nodes].any(axis=1)  # other meshes and parts of it lack some nodes
        self._nodes, self._axes = frames.nodes[own], frames.axes[own]
        whole = free.copy()
        whole[self._nodes] = True
        self.n = int(whole.sum())
        self.dof_of_node = np.where(whole, np.cumsum(whole.ravel()).reshape(-1, 3) - 1, self.n)
        blocks = sp.eye_array(dof_of_node.size, format="lil")
        for node, axes in zip(self._nodes, self._axes, strict=True):
            own_dofs = slice(3 * node, 3 * node + 3)
            blocks[own_dofs, own_dofs] = axes.T
        order = np.argsort(dof_of_node.ravel())[:n]
        self._matrix = sp.csr_array(blocks.tocsr()[whole.ravel()][:, order])
        self._transposed = sp.csr_array(self._matrix.T)
        self._values: sp.csr_array | None = None

    def spread(self, q: Array) -> Array:
        """Return T q, components along x, y and z."""
        count(multiply_adds=self._matrix.nnz)
        return np.asarray(self._matrix @ q)

    def gather(self, forces: Array) -> Array:
        """Return Tᵀ f."""
        count(multiply_adds=self._matrix.nnz)
        return np.asarray(self._transposed @ forces)

    def of_patterns(self, wide: Pattern, narrow: Pattern) -> None:
        """Prepare `tangent` for the patterns of the kernels' dofs and of the unknowns."""
        rows, columns = narrow.rows, narrow.indices.astype(np.int64)
        terms = _padded(self._transposed)
        i, j = terms[0][rows][:, :, None], terms[0][columns][:, None, :]
        factors = terms[1][rows][:, :, None] * terms[1][columns][:, None, :]
        entry, a, b = np.nonzero(factors)
        i, j = np.broadcast_arrays(i, j)
        i, j = i[entry, a, b], j[entry, a, b]
        keys = wide.rows * wide.n + wide.indices
        slots = np.searchsorted(keys, np.minimum(i, j) * wide.n + np.maximum(i, j))
        self._values = sp.csr_array(
            (factors[entry, a, b], (entry, slots)), shape=(len(rows), len(keys))
        )

    def tangent(self, values: Array) -> Array:
        """Return the values of Tᵀ K T in the pattern of the unknowns."""
        assert self._values is not None
        count(multiply_adds=self._values.nnz)
        return np.asarray(self._values @ values)

    def matrix(self, matrix: sp.csr_array) -> sp.csr_array:
        """Return Tᵀ K T for a K that need not be symmetric."""
        return sp.csr_array(self._transposed @ matrix @ self._matrix)

    def cell_forces(self, forces: Array, cells: NDArray[np.int64]) -> Array:
        """Return the forces (n_cells, 3 n_nodes) of cells, N, in the frames of their nodes."""
        out = forces.reshape(*cells.shape, 3).copy()
        for node, axes in zip(self._nodes, self._axes, strict=True):
            at = np.nonzero(cells == node)
            out[at] = out[at] @ axes.T
        return out.reshape(forces.shape)


def along_axes(u: Array, nodes: NDArray[np.int64], axes: Array) -> Array:
    """Turn the displacements (n, 3) of some nodes from their frames to x, y and z, in place."""
    u[nodes] = np.einsum("nji,nj->ni", axes, u[nodes])
    return u


def in_frames(rotations: Array, nodes: NDArray[np.int64], axes: Array) -> Array:
    """Turn rotations (n, 3, 3) of some nodes to A R Aᵀ, their matrices in the frames, in place."""
    rotations[nodes] = axes @ rotations[nodes] @ axes.swapaxes(1, 2)
    return rotations


def _padded(matrix: sp.csr_array) -> tuple[NDArray[np.int64], Array]:
    """Return columns and values (n, 3) of a matrix with up to three entries in a row."""
    counts = np.diff(matrix.indptr)
    rows = np.repeat(np.arange(matrix.shape[0]), counts)
    rank = np.arange(matrix.nnz) - matrix.indptr[rows]
    columns = np.zeros((matrix.shape[0], 3), dtype=np.int64)
    values = np.zeros((matrix.shape[0], 3))
    columns[rows, rank], values[rows, rank] = matrix.indices, matrix.data
    return columns, values
