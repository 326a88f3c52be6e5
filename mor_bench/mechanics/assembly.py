"""Assembly of internal force and tangent into a sparsity pattern that is computed once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.elements import H8, element_of, shape_gradients
from mor_bench.mechanics.kernels import (
    ADVANCE_MULTIPLY_ADDS,
    FORCE_MULTIPLY_ADDS,
    LANES,
    RUNNING,
    TANGENT_MULTIPLY_ADDS,
    advance,
    internal_force,
    internal_force_and_tangent,
    relax,
)
from mor_bench.mechanics.laws import general_force, general_multiply_adds
from mor_bench.scene.materials import Material, SaintVenantKirchhoff

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pattern:
    """Upper triangle (diagonal included) of a symmetric sparse matrix in CSR form, without values."""

    n: int
    indptr: NDArray[np.int64]
    indices: NDArray[np.int32]

    @property
    def rows(self) -> NDArray[np.int64]:
        """(n_nonzeros,) row of each entry."""
        return np.repeat(np.arange(self.n), np.diff(self.indptr))

    @property
    def node_graph(self) -> sp.csr_matrix:
        """(n / 3, n / 3) whether two nodes share a cell; the three dofs of a node are neighbours in the pattern."""
        starts, stops = self.indptr[:-1:3], self.indptr[1::3]
        counts = (stops - starts) // 3
        rows = np.repeat(np.arange(self.n // 3), counts)
        first = np.repeat(starts - 3 * np.append(0, np.cumsum(counts)[:-1]), counts)
        columns = self.indices[first + 3 * np.arange(counts.sum())] // 3
        upper = sp.csr_matrix(
            (np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(self.n // 3, self.n // 3)
        )
        return sp.csr_matrix(upper + upper.T)


@dataclass(frozen=True)
class State:
    """Internal force and what comes with it."""

    force: NDArray[np.float64]
    energy_j: float
    min_det_f: float


def _batched(values: NDArray[Any], fill: float) -> NDArray[Any]:
    """(n_cells, ...) → (n_batches, ..., LANES), padded with ``fill``."""
    n_batches = -(-len(values) // LANES)
    padded = np.full((n_batches * LANES, *values.shape[1:]), fill, dtype=values.dtype)
    padded[: len(values)] = values
    return np.ascontiguousarray(
        np.moveaxis(padded.reshape(n_batches, LANES, *values.shape[1:]), 1, -1)
    )


@dataclass(frozen=True)
class Quadrature:
    """Gradients, weights and law parameters at the quadrature points of every cell.

    Attributes
    ----------
    gradients : (n_cells, n_points, n_nodes, 3) float64
    weights : (n_cells, n_points) float64
    parameters : (n_points, n_parameters) float64
    """

    gradients: Array
    weights: Array
    parameters: Array


def quadrature_of(
    points: Array, cells: NDArray[np.int64], material: Material, selective: bool
) -> Quadrature:
    """Full integration, or selective: the volumetric part from each cell's mean gradient only, the rest at every point.

    Selective integration with mean gradients (Hughes, IJNME 15, 1980: B-bar) of an energy that is a sum of both parts
    keeps a potential and hence a symmetric tangent. The pressure is constant in a cell and may oscillate between cells.
    """
    element = element_of(cells)
    gradients, det_j = shape_gradients(points, cells, element.derivatives)
    weights = det_j * element.weights
    if not selective:
        return Quadrature(
            gradients, weights, np.array([material.parameters] * len(element.weights))
        )
    # The cell's mean gradient, not that at its centre, which fails the patch test on warped cells.
    volume = weights.sum(axis=1)
    mean = np.einsum("cq,cqaj->caj", weights, gradients) / volume[:, None, None]
    parameters = [material.shape_parameters] * len(element.weights) + [material.volume_parameters]
    return Quadrature(
        np.concatenate([gradients, mean[:, None]], axis=1),
        np.hstack([weights, volume[:, None]]),
        np.array(parameters),
    )


def _pattern(
    dof_of_node: NDArray[np.int64], cells: NDArray[np.int64], n_dofs: int
) -> tuple[Pattern, NDArray[np.int32]]:
    """The pattern, and where each upper entry of each element matrix lies in it, (n_cells, n_upper).

    Pairs of nodes are sorted, not pairs of dofs: a ninth of the memory. Nodes with no free dof take no part; those with
    one or two are treated as free first.
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
    # Row 3A holds 3 entries per pair (A, B); rows 3A + 1 and 3A + 2 lack the 1 and 2 entries left of the diagonal.
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
    return Pattern(
        n_dofs, np.append(0, ends[1:][dofs < n_dofs]), dofs[indices[kept]].astype(np.int32)
    ), place[slots]


class Assembler:
    """Internal force and tangent of a set of cells over the dofs that matter.

    Parameters
    ----------
    points : (n_nodes, 3) float64
        Reference positions, m.
    cells : (n_cells, 8) or (n_cells, 4) int
        The cells to sum over: H8 or T4.
    dof_of_node : (n_nodes, 3) int
        Row of each nodal displacement component in the vectors; ``n_dofs`` for one that is zero (a support).
    n_dofs : int
        Length of the vectors.
    material : Material
    cell_weights : (n_cells,) float64, optional
        Cubature weights that multiply each cell's energy; 1 by default.
    selective : bool
        Take the volumetric part of the energy from the cells' mean gradients, which cures volumetric locking of H8.

    Raises
    ------
    InvalidInputError
        If a cell is inverted or degenerate, or no element has as many nodes.
    """

    def __init__(
        self,
        points: Array,
        cells: NDArray[np.int64],
        dof_of_node: NDArray[np.int64],
        n_dofs: int,
        material: Material,
        cell_weights: Array | None = None,
        selective: bool = False,
    ) -> None:
        quadrature = quadrature_of(points, cells, material, selective)
        weights = (
            quadrature.weights
            if cell_weights is None
            else quadrature.weights * cell_weights[:, None]
        )
        n_cells, n_points, n_nodes, _ = quadrature.gradients.shape
        dofs = dof_of_node[cells].reshape(n_cells, 3 * n_nodes)
        self.pattern, slots = _pattern(dof_of_node, cells, n_dofs)
        self.n_dofs = n_dofs
        self.n_cells = n_cells
        self.extent_m = float(np.ptp(points, axis=0).max())
        self.material = material
        self._n_values = len(self.pattern.indices) + 1
        self._vectorised = isinstance(material, SaintVenantKirchhoff) and n_nodes == H8.n_nodes
        if self._vectorised:
            self._gradients = _batched(
                quadrature.gradients.reshape(n_cells, n_points, 24), 0.0
            ).reshape(-1, n_points, 24 * LANES)
            self._w_lam = _batched(weights * quadrature.parameters[:, 0], 0.0)
            self._w_mu = _batched(weights * quadrature.parameters[:, 1], 0.0)
            self._dofs = _batched(dofs.astype(np.int32), n_dofs)
            self._slots = _batched(slots, len(self.pattern.indices))
            per_point = FORCE_MULTIPLY_ADDS, FORCE_MULTIPLY_ADDS + TANGENT_MULTIPLY_ADDS
        else:
            self._gradients, self._weights, self._parameters = (
                quadrature.gradients,
                weights,
                quadrature.parameters,
            )
            self._dofs, self._slots = dofs.astype(np.int32), slots
            per_point = general_multiply_adds(material.law, quadrature.parameters.shape[1], n_nodes)
        self._multiply_adds = n_cells * n_points * per_point[0], n_cells * n_points * per_point[1]

    def _sum(
        self, u: Array, dofs: NDArray[np.int32], force: Array, values: Array
    ) -> tuple[float, float]:
        """Add the cells' forces and, where ``values`` is not empty, tangents; returns energy and min det F."""
        count(element_evaluations=self.n_cells, multiply_adds=self._multiply_adds[len(values) > 0])
        if not self._vectorised:
            law, parameters = self.material.law, self._parameters
            return general_force(
                u, dofs, self._gradients, self._weights, law, parameters, self._slots, force, values
            )  # type: ignore[no-any-return]
        if len(values) == 0:
            return internal_force(u, dofs, self._gradients, self._w_lam, self._w_mu, force)  # type: ignore[no-any-return]
        return internal_force_and_tangent(
            u, dofs, self._gradients, self._w_lam, self._w_mu, self._slots, force, values
        )  # type: ignore[no-any-return]

    def force(self, u: Array) -> State:
        """Internal force, N, stored energy, J, and min det F at displacements ``u`` (n_dofs,), m."""
        force = np.zeros(self.n_dofs + 1)
        return State(force[:-1], *self._sum(np.append(u, 0.0), self._dofs, force, np.zeros(0)))

    def force_and_tangent(self, u: Array) -> tuple[State, Array]:
        """`force`, and the values of the tangent stiffness, N/m, in ``pattern``."""
        force, values = np.zeros(self.n_dofs + 1), np.zeros(self._n_values)
        return State(force[:-1], *self._sum(np.append(u, 0.0), self._dofs, force, values)), values[
            :-1
        ]

    def cell_forces(self, u: Array) -> Array:
        """Internal force of each cell on its own, (n_cells, 3 n_nodes), N: what cubature is trained on."""
        local = np.arange(self._dofs.size, dtype=np.int32).reshape(self._dofs.shape)
        force = np.zeros(local.size + 1)
        self._sum(np.append(np.append(u, 0.0)[self._dofs].ravel(), 0.0), local, force, np.zeros(0))
        own = force[:-1].reshape(self._dofs.shape)
        return np.moveaxis(own, 2, 1).reshape(-1, 24)[: self.n_cells] if self._vectorised else own

    def relax(
        self, u: Array, load: Array, mass: Array, control: Array, n_steps: int
    ) -> tuple[int, int, float]:
        """Steps of dynamic relaxation from u (n_dofs,), m, which they change, with no velocity; see `kernels.advance`.

        Returns their number, how the last ended, and min det F there.
        """
        padded, v, before = np.append(u, 0.0), np.zeros(self.n_dofs), np.zeros(self.n_dofs)
        done, status, min_det = 0, RUNNING, np.inf
        if self._vectorised:
            cells = self._dofs, self._gradients, self._w_lam, self._w_mu
            done, status, min_det = relax(padded, v, before, load, mass, control, n_steps, *cells)
            count(
                element_evaluations=done * self.n_cells,
                multiply_adds=done * self._multiply_adds[0],
            )
        else:
            force, none = np.zeros(self.n_dofs + 1), np.zeros(0)
            while done < n_steps and status == RUNNING:
                min_det = self._sum(padded, self._dofs, force, none)[1]
                status = advance(padded, v, force, before, load, mass, control)
                done += 1
        count(multiply_adds=done * ADVANCE_MULTIPLY_ADDS * self.n_dofs)
        u[:] = padded[:-1]
        return done, status, min_det
