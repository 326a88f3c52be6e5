"""Interpolation from the nodes of a mesh to points in its body, by shape functions of the cells."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import OutsideMeshError
from mor_bench.scene.mesh import HEX_CORNERS, TET_EDGES, Mesh
from mor_bench.scene.nearest import tree_of

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

OUTSIDE = 1e-9
"""Tolerance for a point outside its cell, in reference coordinates; far above round-off."""

NEWTON_STEPS = 30
ROUND_OFF = 1e-14
FIRST_CANDIDATES = 8


def trilinear(xi: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a hexahedron's shape functions (n, 8) at xi (n, 3), and derivatives (n, 8, 3)."""
    corners = 2.0 * HEX_CORNERS - 1.0
    x, y, z = np.moveaxis(1 + xi[:, None, :] * corners, 2, 0)
    return x * y * z / 8, corners * np.stack([y * z, x * z, x * y], axis=2) / 8


def quadratic(xi: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return shape functions (n, 10) of T10 at xi (n, 3), and derivatives (n, 10, 3).

    With barycentric coordinates λ: λ_a (2 λ_a - 1) at corners, and 4 λ_a λ_b at middles of edges.
    """
    at = np.concatenate([1 - xi.sum(axis=1, keepdims=True), xi], axis=1)
    slopes = np.concatenate([-np.ones((1, 3)), np.eye(3)])
    a, b = at[:, TET_EDGES[:, 0]], at[:, TET_EDGES[:, 1]]
    values = np.concatenate([at * (2 * at - 1), 4 * a * b], axis=1)
    middles = a[:, :, None] * slopes[TET_EDGES[:, 1]] + b[:, :, None] * slopes[TET_EDGES[:, 0]]
    return values, np.concatenate([(4 * at - 1)[:, :, None] * slopes, 4 * middles], axis=1)


def _tetrahedron(
    corners: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return barycentric coordinates of points in tetrahedra (n, 4, 3), and distances outside."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    inner = np.linalg.solve(edges, (points - corners[:, 0])[:, :, None])[:, :, 0]
    shape = np.concatenate([1 - inner.sum(axis=1, keepdims=True), inner], axis=1)
    return shape, np.maximum(-shape.min(axis=1), 0)


def _hexahedron(
    corners: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return shape functions (n, 8) at points in hexahedra (n, 8, 3), and distances outside.

    Newton's method finds the reference coordinates.
    """
    shape, xi, missed = _inverted(trilinear, corners, points, np.zeros_like(points))
    return shape, np.where(missed, np.inf, np.maximum(np.abs(xi).max(axis=1) - 1, 0))


def reference_positions(
    corners: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the reference coordinates (n, 3) of points (n, 3) in hexahedra (n, 8, 3), or near."""
    return _inverted(trilinear, corners, points, np.zeros_like(points))[1]


def _quadratic_tetrahedron(
    nodes: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return shape functions (n, 10) at points in T10 (n, 10, 3), and distances outside.

    Newton's method starts from the tetrahedron with straight edges, where it ends at once.
    """
    start = np.clip(_tetrahedron(nodes[:, :4], points)[0][:, 1:], -2, 2)
    shape, xi, missed = _inverted(quadratic, nodes, points, start)
    least = np.minimum(xi.min(axis=1), 1 - xi.sum(axis=1))
    return shape, np.where(missed, np.inf, np.maximum(-least, 0))


def _inverted(
    functions: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]],
    corners: NDArray[np.float64],
    points: NDArray[np.float64],
    xi: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return shape functions and reference coordinates of points, and where there are none."""
    size = np.linalg.norm(np.ptp(corners, axis=1), axis=1)
    for _ in range(NEWTON_STEPS):
        shape, derivatives = functions(xi)
        miss = points - np.einsum("na,nai->ni", shape, corners)
        jacobian = np.einsum("nai,nad->nid", corners, derivatives)
        # The map may fold outside the cell. There, only the fact that the point is outside matters.
        folded = np.abs(np.linalg.det(jacobian)) <= 1e-12 * size**3
        jacobian[folded] = np.eye(3) * size[folded, None, None]
        step = np.linalg.solve(jacobian, miss[:, :, None])[:, :, 0]
        xi = np.clip(xi + step, -2, 2)
        if (np.abs(step) <= ROUND_OFF).all():
            break
    shape, _ = functions(xi)
    missed = np.linalg.norm(points - np.einsum("na,nai->ni", shape, corners), axis=1) / size
    return shape, xi, missed > 1e-12


_LOCATE = {4: _tetrahedron, 8: _hexahedron, 10: _quadratic_tetrahedron}


class _Cells(NamedTuple):
    """Nodes (n_cells, 4, 8 or 10, 3) of cells, bounding boxes with a margin, and centres."""

    corners: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    tree: cKDTree
    reach: float


def _searchable(mesh: Mesh) -> _Cells:
    corners = mesh.points[mesh.cells]
    hull = corners
    if corners.shape[1] == 10:  # a curved edge lies between its ends and its control point
        ends = corners[:, TET_EDGES].sum(axis=2)
        hull = np.concatenate([corners, 2 * corners[:, 4:] - 0.5 * ends], axis=1)
    low, high = hull.min(axis=1), hull.max(axis=1)
    margin = 1e-6 * np.linalg.norm(high - low, axis=1).max()
    centres = corners.mean(axis=1)
    reach = float(np.linalg.norm(hull - centres[:, None], axis=2).max()) + margin
    return _Cells(corners, low - margin, high + margin, tree_of(centres), reach)


def interpolation_matrix(mesh: Mesh, points: NDArray[np.float64]) -> sp.csr_array:
    """Return the matrix that maps nodal values of a mesh to values at points.

    Its transpose maps forces at the points to nodal forces with the same sum and the same moment.

    Parameters
    ----------
    mesh : Mesh
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
    cells = _searchable(mesh)
    locate = _LOCATE[mesh.cells.shape[1]]
    cell_of = np.zeros(len(points), dtype=np.int64)
    shape_of = np.zeros((len(points), mesh.cells.shape[1]))
    searched = np.arange(len(points))
    n_candidates = min(FIRST_CANDIDATES, mesh.n_cells)
    while len(searched):
        wanted = range(1, n_candidates + 1)
        distance, candidates = map(np.asarray, cells.tree.query(points[searched], k=[*wanted]))
        x = points[searched][:, None]
        in_box = (x >= cells.low[candidates]) & (x <= cells.high[candidates])
        row, column = np.nonzero(in_box.all(axis=2))
        tried = candidates[row, column]
        shape, outside = locate(cells.corners[tried], points[searched[row]])
        # If several cells contain a point, the best one is written last and remains.
        order = np.argsort(-outside, kind="stable")
        order = order[outside[order] <= OUTSIDE]
        cell_of[searched[row[order]]], shape_of[searched[row[order]]] = tried[order], shape[order]
        found = np.zeros(len(searched), dtype=bool)
        found[row[order]] = True
        exhausted = (distance[:, -1] > cells.reach) | (n_candidates == mesh.n_cells)
        if (lost := ~found & exhausted).any():
            raise _outside(mesh, points[searched[lost]])
        searched = searched[~found]
        n_candidates = min(4 * n_candidates, mesh.n_cells)
    shape_of[np.abs(shape_of) <= ROUND_OFF] = 0
    rows = np.repeat(np.arange(len(points)), mesh.cells.shape[1])
    at = rows, mesh.cells[cell_of].ravel()
    matrix = sp.csr_array((shape_of.ravel(), at), shape=(len(points), mesh.n_nodes))
    matrix.eliminate_zeros()
    return matrix


def _outside(mesh: Mesh, lost: NDArray[np.float64]) -> OutsideMeshError:
    low, high = mesh.bounds.tolist()
    which = "a point lies" if len(lost) == 1 else f"{len(lost)} points lie"
    return OutsideMeshError(
        f"{which} outside the mesh, whose bounds are {low} to {high} m; "
        f"the first is {lost[0].tolist()} m."
    )


def rows_to_one(matrix: sp.csr_array) -> sp.csr_array:
    """Return a matrix whose rows are divided by their sums."""
    return sp.csr_array(matrix.multiply(1.0 / matrix.sum(axis=1)[:, None]))
