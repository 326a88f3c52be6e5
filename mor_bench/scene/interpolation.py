"""Interpolation from the nodes of a mesh to points of its body, by the shape functions of the cells that hold them."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mor_bench.errors import OutsideMeshError
from mor_bench.scene.mesh import Mesh

OUTSIDE = 1e-9
"""How far outside its cell a point may lie, in the cell's own coordinates; round-off is far less."""

NEWTON_STEPS = 30
ROUND_OFF = 1e-14
FIRST_CANDIDATES = 8

_CORNERS = np.array(
    [
        [-1, -1, -1],
        [1, -1, -1],
        [1, 1, -1],
        [-1, 1, -1],
        [-1, -1, 1],
        [1, -1, 1],
        [1, 1, 1],
        [-1, 1, 1],
    ],
    dtype=float,
)


def _tetrahedron(
    corners: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Barycentric coordinates (n, 4) of points (n, 3) in tetrahedra (n, 4, 3), and how far outside each lies."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    inner = np.linalg.solve(edges, (points - corners[:, 0])[:, :, None])[:, :, 0]
    shape = np.concatenate([1 - inner.sum(axis=1, keepdims=True), inner], axis=1)
    return shape, np.maximum(-shape.min(axis=1), 0)


def _trilinear(xi: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shape functions (n, 8) of a hexahedron at xi (n, 3), and their derivatives (n, 8, 3)."""
    terms = 1 + xi[:, None, :] * _CORNERS
    others = np.stack(
        [
            terms[:, :, 1] * terms[:, :, 2],
            terms[:, :, 0] * terms[:, :, 2],
            terms[:, :, 0] * terms[:, :, 1],
        ],
        axis=2,
    )
    return terms.prod(axis=2) / 8, _CORNERS * others / 8


def _hexahedron(
    corners: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shape functions (n, 8) at points (n, 3) of hexahedra (n, 8, 3), by Newton's method, and how far outside each lies."""
    xi = np.zeros_like(points)
    size = np.linalg.norm(np.ptp(corners, axis=1), axis=1)
    for _ in range(NEWTON_STEPS):
        shape, derivatives = _trilinear(xi)
        miss = points - np.einsum("na,nai->ni", shape, corners)
        jacobian = np.einsum("nai,nad->nid", corners, derivatives)
        # Outside its cell, where the map may fold, a point must only be seen to be outside.
        folded = np.abs(np.linalg.det(jacobian)) <= 1e-12 * size**3
        jacobian[folded] = np.eye(3) * size[folded, None, None]
        step = np.linalg.solve(jacobian, miss[:, :, None])[:, :, 0]
        xi = np.clip(xi + step, -2, 2)
        if (np.abs(step) <= ROUND_OFF).all():
            break
    shape, _ = _trilinear(xi)
    missed = np.linalg.norm(points - np.einsum("na,nai->ni", shape, corners), axis=1) / size
    return shape, np.where(missed > 1e-12, np.inf, np.maximum(np.abs(xi).max(axis=1) - 1, 0))


def interpolation_matrix(mesh: Mesh, points: NDArray[np.float64]) -> sp.csr_array:
    """The matrix that takes nodal values of a mesh to values at points.

    Its transpose takes forces at the points to nodal forces with the same sum and the same moment.

    Parameters
    ----------
    mesh : Mesh
        Of H8 or T4.
    points : (n_points, 3) float64
        Positions in the body, m.

    Returns
    -------
    (n_points, n_nodes) sparse float64
        Shape functions; each row sums to 1.

    Raises
    ------
    OutsideMeshError
        If a point lies in no cell.
    """
    locate = _tetrahedron if mesh.cells.shape[1] == 4 else _hexahedron
    corners = mesh.points[mesh.cells]
    low, high = corners.min(axis=1), corners.max(axis=1)
    margin = 1e-6 * np.linalg.norm(high - low, axis=1).max()
    centres = corners.mean(axis=1)
    reach = float(np.linalg.norm(corners - centres[:, None], axis=2).max()) + margin
    tree = cKDTree(centres)
    cell_of = np.zeros(len(points), dtype=np.int64)
    shape_of = np.zeros((len(points), mesh.cells.shape[1]))
    searched = np.arange(len(points))
    n_candidates = min(FIRST_CANDIDATES, mesh.n_cells)
    while len(searched):
        distance, candidates = (
            np.asarray(found)
            for found in tree.query(points[searched], k=[*range(1, n_candidates + 1)])
        )
        x = points[searched][:, None]
        row, column = np.nonzero(
            ((x >= low[candidates] - margin) & (x <= high[candidates] + margin)).all(axis=2)
        )
        cells = candidates[row, column]
        shape, outside = locate(corners[cells], points[searched[row]])
        # Of the cells that hold a point the one that holds it best; the last written wins.
        order = np.argsort(-outside, kind="stable")
        order = order[outside[order] <= OUTSIDE]
        cell_of[searched[row[order]]], shape_of[searched[row[order]]] = cells[order], shape[order]
        found = np.zeros(len(searched), dtype=bool)
        found[row[order]] = True
        lost = ~found & ((distance[:, -1] > reach) | (n_candidates == mesh.n_cells))
        if lost.any():
            raise OutsideMeshError(
                f"{'a point lies' if lost.sum() == 1 else f'{lost.sum()} points lie'} outside the mesh, whose bounds are "
                f"{mesh.bounds[0].tolist()} to {mesh.bounds[1].tolist()} m; the first is {points[searched[lost][0]].tolist()} m."
            )
        searched = searched[~found]
        n_candidates = min(4 * n_candidates, mesh.n_cells)
    shape_of[np.abs(shape_of) <= ROUND_OFF] = 0
    rows = np.repeat(np.arange(len(points)), mesh.cells.shape[1])
    matrix = sp.csr_array(
        (shape_of.ravel(), (rows, mesh.cells[cell_of].ravel())), shape=(len(points), mesh.n_nodes)
    )
    matrix.eliminate_zeros()
    return matrix
