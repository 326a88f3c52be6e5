"""Unbend a linear response, so that a solve under a large load starts near its equilibrium.

A linear response has no large rotations: a bent body gets longer, and its internal forces are a
hundred times the load. Its gradient in a cell is a strain ε and a spin ω. The deformation gradient
exp(ω) (I + ε) has the same strain with a true rotation. Poisson's equation finds the displacements
whose gradients come closest to it.

Rotation-strain coordinates: Huang et al., "Interactive shape interpolation through controllable
dynamic deformation", IEEE TVCG 17, 2011. The result only starts an iteration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf

from mor_bench.counting import cholesky_multiply_adds, count
from mor_bench.mechanics.banded import SingleBandedFactor, inverted_columns
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.pattern import Pattern

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WarpedCells:
    """The cells of a body, as warping needs them.

    Attributes
    ----------
    nodes : (n_cells, n_cell_nodes) int32
        Index of each cell's nodes among the n_free_nodes with a free dof; n_free_nodes at supports.
    gradients : (n_cells, n_cell_nodes, 3) float64
        dN_a/dX at the cells' centres, 1/m.
    integrals : (n_cells, n_cell_nodes, 3) float64
        ∫ ∇N_a dV, m².
    laplacians : (n_cells, n_cell_nodes, n_cell_nodes) float64
        ∫ ∇N_a · ∇N_b dV, m.
    """

    nodes: NDArray[np.int32]
    gradients: Array
    integrals: Array
    laplacians: Array


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def add_targets(u, nodes, gradients, integrals, laplacians, out):
    """Add ∫ (F - I) ∇N_a dV of the wanted deformation gradient F to ``out`` (n_free_nodes + 1, 3).

    The spin is constant in a cell, the strain is not. So F - I = R - I - R ω + R H with R = exp(ω).
    The displacements u (n_free_nodes + 1, 3), m, of supports are zero.
    """
    eye = np.eye(3)
    H, R, target = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    n = nodes.shape[1]
    for k in range(len(nodes)):
        at, G, I, K = nodes[k], gradients[k], integrals[k], laplacians[k]
        H[:] = 0.0
        for a in range(n):
            for i in range(3):
                for j in range(3):
                    H[i, j] += u[at[a], i] * G[a, j]
        x, y, z = 0.5 * (H[2, 1] - H[1, 2]), 0.5 * (H[0, 2] - H[2, 0]), 0.5 * (H[1, 0] - H[0, 1])
        square = x * x + y * y + z * z
        angle = np.sqrt(square)
        # Taylor's series where the quotients would lose digits
        s = np.sin(angle) / angle if angle > 1e-4 else 1.0 - square / 6.0
        c = (1.0 - np.cos(angle)) / square if angle > 1e-4 else 0.5
        R[0, 0], R[0, 1], R[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
        R[1, 0], R[1, 1], R[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
        R[2, 0], R[2, 1], R[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)
        for i in range(3):
            target[i, 0] = R[i, 0] - eye[i, 0] - (R[i, 1] * z - R[i, 2] * y)
            target[i, 1] = R[i, 1] - eye[i, 1] - (R[i, 2] * x - R[i, 0] * z)
            target[i, 2] = R[i, 2] - eye[i, 2] - (R[i, 0] * y - R[i, 1] * x)
        for a in range(n):
            p0, p1, p2 = 0.0, 0.0, 0.0
            for b in range(n):
                p0 += K[a, b] * u[at[b], 0]
                p1 += K[a, b] * u[at[b], 1]
                p2 += K[a, b] * u[at[b], 2]
            for i in range(3):
                out[at[a], i] += R[i, 0] * p0 + R[i, 1] * p1 + R[i, 2] * p2
                out[at[a], i] += target[i, 0] * I[a, 0] + target[i, 1] * I[a, 1]
                out[at[a], i] += target[i, 2] * I[a, 2]


class Warp:
    """Maps linear responses to bent ones; see the module.

    Parameters
    ----------
    cells : WarpedCells
    held : (n_free_nodes, 3) bool
        Components that supports hold at nodes with a free dof.
    place : (n_free_nodes,) int64
        Position of each node in an order with a small band.

    Raises
    ------
    NotPositiveDefiniteError
        If springs alone hold a part of the body along an axis.
    """

    def __init__(
        self, cells: WarpedCells, held: NDArray[np.bool_], place: NDArray[np.int64]
    ) -> None:
        self._cells, self._held, self._place = cells, held, place
        n = len(held)
        shape = cells.laplacians.shape
        rows, columns = (
            np.broadcast_to(one, shape).ravel()
            for one in (cells.nodes[:, :, None], cells.nodes[:, None, :])
        )
        whole = sp.csr_array((cells.laplacians.ravel(), (rows, columns)), shape=(n + 1, n + 1))
        upper = sp.triu(sp.csr_array(whole[:n][:, :n])).tocoo()
        low, high = np.sort(np.stack([place[upper.row], place[upper.col]]), axis=0)
        self._factors: list[SingleBandedFactor] = []
        for axis in range(3):
            if axis > 0 and not (held[:, axis] != held[:, axis - 1]).any():
                self._factors.append(self._factors[-1])
                continue
            loose = ~(held[upper.row, axis] | held[upper.col, axis]) | (low == high)
            width = int((high - low).max())
            band = np.zeros((width + 1, n), order="F")
            band[width + low[loose] - high[loose], high[loose]] = upper.data[loose]
            count(factorisations=1, multiply_adds=cholesky_multiply_adds(n, width))
            band, failed = dpbtrf(band, overwrite_ab=1)
            if failed:
                raise NotPositiveDefiniteError
            self._factors.append(SingleBandedFactor(inverted_columns(band), place))

    def __call__(self, u: Array) -> Array:
        """Return bent displacements (n_free_nodes, 3) of linear ones (n_free_nodes + 1, 3), m."""
        targets, cells = np.zeros_like(u), self._cells
        add_targets(u, cells.nodes, cells.gradients, cells.integrals, cells.laplacians, targets)
        # Per cell: gradient and targets, the products with K, and the rotation with its functions.
        per_cell = cells.nodes.shape[1] * (27 + 3 * cells.nodes.shape[1]) + 60
        count(multiply_adds=len(cells.nodes) * per_cell)
        bent = np.empty((len(self._held), 3))
        targets = np.where(self._held, 0.0, targets[:-1])
        scale = float(np.abs(targets).max()) or 1.0
        work = np.empty((3, len(bent)), dtype=np.float32)
        work[:, self._place] = (targets / scale).T
        if self._factors[0] is self._factors[2] is self._factors[1]:
            self._factors[0].solve_in_place(work)
        else:
            for axis in range(3):
                self._factors[axis].solve_in_place(work[axis : axis + 1])
        bent[:] = scale * work[:, self._place].T
        return bent


def warp_of(
    points: Array,
    cells: NDArray[np.int64],
    turning: tuple[NDArray[np.int32], Array, Array],
    pattern: Pattern,
    place: NDArray[np.int64],
) -> Warp | None:
    """Return the warp of a body, or None if springs alone hold a part of it along an axis.

    Parameters
    ----------
    points : (n_nodes, 3) float64
        Positions at rest, m.
    cells : (n_cells, n_cell_nodes) int
    turning : tuple of arrays
        Nodes, gradients at the centres and volumes of the cells; see `RotatedRest`.
    pattern : Pattern
        Pattern of the stiffness.
    place : (n_free_nodes,) int64
        Position of each node in an order with a small band.
    """
    element = element_of(cells)
    gradients, det_j = shape_gradients(points, cells, element.derivatives)
    weighted = gradients * (det_j * element.weights)[:, :, None, None]
    n_cells, n_own = cells.shape
    left, right = (
        each.swapaxes(1, 2).reshape(n_cells, n_own, -1) for each in (weighted, gradients)
    )
    laplacians = left @ right.swapaxes(1, 2)
    held = pattern.pad(np.ones(pattern.n)).reshape(-1, 3) == 0.0
    try:
        return Warp(WarpedCells(*turning[:2], weighted.sum(axis=1), laplacians), held, place)
    except NotPositiveDefiniteError:
        return None
