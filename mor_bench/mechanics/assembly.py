"""Assembly of internal force and tangent into a sparsity pattern that is computed once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.kernels import LANES, internal_force, internal_force_and_tangent
from mor_bench.scene.materials import SaintVenantKirchhoff

_CORNERS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=float)
_GAUSS = _CORNERS / np.sqrt(3.0)


def _upper_entries() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of the 300 upper entries of an element matrix, in the order in which the kernel stores them."""
    rows, columns = [], []
    for a in range(8):
        for b in range(a, 8):
            for i in range(3):
                for j in range(i if a == b else 0, 3):
                    rows.append(3 * a + i)
                    columns.append(3 * b + j)
    return np.array(rows), np.array(columns)


def shape_gradients(points: NDArray[np.float64], cells: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients of the trilinear shape functions at the 2x2x2 Gauss points.

    Returns
    -------
    gradients : (n_cells, 8, 8, 3) float64
        dN_a/dX at each Gauss point, 1/m; axes cell, point, node, direction.
    weights : (n_cells, 8) float64
        det J (the Gauss weights are 1), m³.

    Raises
    ------
    InvalidInputError
        If det J is not positive at some Gauss point: the cell is inverted or degenerate.
    """
    terms = 1 + _GAUSS[:, None, :] * _CORNERS[None, :, :]
    d_reference = 0.125 * np.stack([_CORNERS[:, i] * np.prod(np.delete(terms, i, axis=2), axis=2) for i in range(3)], axis=2)
    jacobian = np.einsum("qai,cak->cqki", d_reference, points[cells])
    weights = np.linalg.det(jacobian)
    if not np.all(weights > 0):
        cell, point = np.argwhere(~(weights > 0))[0]
        raise InvalidInputError(
            f"cell {cell} is inverted or degenerate: det J must be > 0 m³; got {weights[cell, point]:.3g} at Gauss point {point}."
        )
    gradients = np.einsum("qai,cqik->cqak", d_reference, np.linalg.inv(jacobian))
    return gradients, weights


@dataclass(frozen=True)
class Pattern:
    """Upper triangle (diagonal included) of a symmetric sparse matrix in CSR form, without values."""

    n: int
    indptr: NDArray[np.int64]
    indices: NDArray[np.int64]

    @property
    def rows(self) -> NDArray[np.int64]:
        """(n_nonzeros,) row of each entry."""
        return np.repeat(np.arange(self.n), np.diff(self.indptr))


@dataclass(frozen=True)
class State:
    """Internal force and what comes with it."""

    force: NDArray[np.float64]
    energy_j: float
    min_det_f: float


def _batched(values: NDArray[np.generic], fill: float) -> NDArray[np.generic]:
    """(n_cells, ...) → (n_batches, ..., LANES), padded with ``fill``."""
    n_batches = -(-len(values) // LANES)
    padded = np.full((n_batches * LANES, *values.shape[1:]), fill, dtype=values.dtype)
    padded[: len(values)] = values
    return np.ascontiguousarray(np.moveaxis(padded.reshape(n_batches, LANES, *values.shape[1:]), 1, -1))


class Assembler:
    """Internal force and tangent of a set of cells over the dofs that matter.

    Parameters
    ----------
    points : (n_nodes, 3) float64
        Reference positions, m.
    cells : (n_cells, 8) int
        The cells to sum over.
    dof_of_node : (n_nodes, 3) int
        Row of each nodal displacement component in the vectors; ``n_dofs`` for one that is zero (a support).
    n_dofs : int
        Length of the vectors.
    material : SaintVenantKirchhoff
    cell_weights : (n_cells,) float64, optional
        Cubature weights that multiply each cell's energy; 1 by default.

    Raises
    ------
    InvalidInputError
        If a cell is inverted or degenerate.
    """

    def __init__(
        self,
        points: NDArray[np.float64],
        cells: NDArray[np.int64],
        dof_of_node: NDArray[np.int64],
        n_dofs: int,
        material: SaintVenantKirchhoff,
        cell_weights: NDArray[np.float64] | None = None,
    ) -> None:
        gradients, weights = shape_gradients(points, cells)
        if cell_weights is not None:
            weights = weights * cell_weights[:, None]
        dofs = dof_of_node[cells].reshape(len(cells), 24)
        rows, columns = _upper_entries()
        low, high = np.minimum(dofs[:, rows], dofs[:, columns]), np.maximum(dofs[:, rows], dofs[:, columns])
        key = np.where(high < n_dofs, low * n_dofs + high, n_dofs * n_dofs)
        entries, slots = np.unique(key, return_inverse=True)
        entries = entries[entries < n_dofs * n_dofs]
        indptr = np.searchsorted(entries // n_dofs, np.arange(n_dofs + 1))
        self.n_dofs = n_dofs
        self.n_cells = len(cells)
        self.material = material
        self.pattern = Pattern(n_dofs, indptr, entries % n_dofs)
        self._n_values = len(entries) + 1
        n_batches = -(-len(cells) // LANES)
        self._gradients = _batched(gradients.reshape(len(cells), 8, 24), 0.0).reshape(n_batches, 8, 24 * LANES)
        self._weights = _batched(weights, 0.0)
        self._dofs = _batched(dofs.astype(np.int32), n_dofs)
        self._slots = _batched(slots.reshape(len(cells), -1).astype(np.int32), len(entries))

    def force(self, u: NDArray[np.float64]) -> State:
        """Internal force, N, stored energy, J, and min det F at displacements ``u`` (n_dofs,), m."""
        force = np.zeros(self.n_dofs + 1)
        law = self.material
        energy, min_det = internal_force(
            np.append(u, 0.0), self._dofs, self._gradients, self._weights, law.lame_lambda, law.lame_mu, force
        )  # fmt: skip
        return State(force[:-1], energy, min_det)

    def force_and_tangent(self, u: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        """`force`, and the values of the tangent stiffness, N/m, in ``pattern``."""
        force, values = np.zeros(self.n_dofs + 1), np.zeros(self._n_values)
        law = self.material
        energy, min_det = internal_force_and_tangent(
            np.append(u, 0.0), self._dofs, self._gradients, self._weights, law.lame_lambda, law.lame_mu, self._slots, force, values
        )  # fmt: skip
        return State(force[:-1], energy, min_det), values[:-1]

    def cell_forces(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Internal force of each cell on its own, (n_cells, 24), N: what cubature is trained on."""
        out = np.zeros((len(self._dofs) * LANES, 24))
        local = np.arange(24 * LANES, dtype=np.int32).reshape(1, 24, LANES)
        law = self.material
        padded = np.append(u, 0.0)
        for b in range(len(self._dofs)):
            force = np.zeros(24 * LANES + 1)
            displacements = np.append(padded[self._dofs[b]].ravel(), 0.0)
            internal_force(displacements, local, self._gradients[b : b + 1], self._weights[b : b + 1], law.lame_lambda, law.lame_mu, force)
            out[b * LANES : (b + 1) * LANES] = force[:-1].reshape(24, LANES).T
        return out[: self.n_cells]
