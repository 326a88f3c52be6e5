"""Uniform refinement of any mesh: each cell becomes eight, and the body stays the same."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.interpolation import quadratic
from mor_bench.scene.mesh import HEX_CORNERS, TET_EDGES, Mesh, along_longest_axis, inverse_of

_THIRDS = list(product(range(3), repeat=3))
"""Positions of the 27 nodes of a divided hexahedron, in half edges along its axes."""

HEX_PARENTS = [
    [
        corner
        for corner, place in enumerate(HEX_CORNERS)
        if all(t in (1, 2 * p) for t, p in zip(third, place, strict=True))
    ]
    for third in _THIRDS
]
"""The corners that are averaged for each of the 27 nodes."""

HEX_CHILDREN = np.array(
    [[_THIRDS.index(tuple(origin + place)) for place in HEX_CORNERS] for origin in HEX_CORNERS]
)

TET_PARENTS = [[0], [1], [2], [3], *TET_EDGES.tolist()]
"""Corners and midpoints of edges of a tetrahedron."""

_TET_CORNERS = [[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3]]
_TET_INNER = {
    (6, 8): [[6, 8, 4, 5], [6, 8, 5, 9], [6, 8, 9, 7], [6, 8, 7, 4]],
    (4, 9): [[4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]],
    (5, 7): [[5, 7, 4, 6], [5, 7, 6, 9], [5, 7, 9, 8], [5, 7, 8, 4]],
}
"""The octahedron between the corners, cut along each of its diagonals."""


def subdivide(mesh: Mesh) -> tuple[Mesh, NDArray[np.int64]]:
    """Return a mesh with eight cells for each cell, without a grid.

    Cutting the corners off a tetrahedron leaves an octahedron. It is cut along its shortest
    diagonal.

    Returns
    -------
    mesh : Mesh
        Nodes are numbered along the body's longest axis, for a small bandwidth.
    parents : (n_nodes, 8) int64
        Each new node is the mean of these old nodes; all occur equally often. Curved edges of
        T10 stay curved, so their new nodes are only near the mean.
    """
    if mesh.cells.shape[1] == 10:
        return _quadratic(mesh)
    hexahedra = mesh.cells.shape[1] == 8
    local = HEX_PARENTS if hexahedra else TET_PARENTS
    padded = np.array([np.repeat(parents, 8 // len(parents)) for parents in local])
    rows = np.sort(mesh.cells[:, padded], axis=2).reshape(-1, 8)
    parents, numbers = np.unique(rows, axis=0, return_inverse=True)
    numbers = numbers.reshape(mesh.n_cells, len(local))
    points = mesh.points[parents].mean(axis=1)
    cells = numbers[:, HEX_CHILDREN].reshape(-1, 8) if hexahedra else _tetrahedra(points, numbers)
    order = along_longest_axis(points)
    return Mesh(points[order], inverse_of(order)[cells]), parents[order]


def _quadratic(mesh: Mesh) -> tuple[Mesh, NDArray[np.int64]]:
    """Divide T10: the old nodes are the new corners, and the new middles lie between two of them.

    A middle's place in the cell is the mean of the places of its two nodes.
    """
    a, b = np.triu_indices(10, 1)
    places = np.array([np.eye(4, 3, -1)[parents].mean(axis=0) for parents in TET_PARENTS])
    shape = quadratic(0.5 * (places[a] + places[b]))[0]
    between = np.einsum("pa,cai->cpi", shape, mesh.points[mesh.cells]).reshape(-1, 3)
    pairs = np.sort(np.stack([mesh.cells[:, a], mesh.cells[:, b]], axis=2), axis=2)
    keys = (pairs @ [mesh.n_nodes, 1]).ravel()
    corners = _tetrahedra(mesh.points, mesh.cells)
    edges = np.sort(corners[:, TET_EDGES], axis=2)
    used, number = np.unique((edges @ [mesh.n_nodes, 1]).ravel(), return_inverse=True)
    known, first = np.unique(keys, return_index=True)
    points = np.concatenate([mesh.points, between[first[np.searchsorted(known, used)]]])
    cells = np.hstack([corners, mesh.n_nodes + number.reshape(-1, len(TET_EDGES))])
    ends = np.stack([used // mesh.n_nodes, used % mesh.n_nodes], axis=1)
    own = np.repeat(np.arange(mesh.n_nodes)[:, None], 8, axis=1)
    parents = np.concatenate([own, np.repeat(ends, 4, axis=1)])
    order = along_longest_axis(points)
    return Mesh(points[order], inverse_of(order)[cells]), parents[order]


def _tetrahedra(points: NDArray[np.float64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the parts (8 n, 4) of tetrahedra with corners and midpoints (n, 10)."""
    ends = [points[numbers[:, [a, b]]] for a, b in _TET_INNER]
    shortest = np.argmin([np.linalg.norm(e[:, 0] - e[:, 1], axis=1) for e in ends], axis=0)
    parts = [numbers[:, _TET_CORNERS].reshape(-1, 4)]
    for i, inner in enumerate(_TET_INNER.values()):
        parts.append(numbers[shortest == i][:, inner].reshape(-1, 4))
    cells = np.concatenate(parts)
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    turned = np.linalg.det(edges) < 0
    cells[turned] = cells[turned][:, [1, 0, 2, 3]]
    return cells
