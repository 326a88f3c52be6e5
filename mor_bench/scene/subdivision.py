"""Uniform refinement of any mesh: eight cells in the place of one, the body unchanged."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.mesh import Mesh, along_longest_axis

_HEX = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
"""Places of a hexahedron's corners along its own axes, in VTK order."""

_THIRDS = list(product(range(3), repeat=3))

HEX_PARENTS = [
    [
        c
        for c, place in enumerate(_HEX)
        if all(t == 1 or t == 2 * p for t, p in zip(third, place, strict=True))
    ]
    for third in _THIRDS
]
"""The corners whose mean each of the 27 nodes of a hexahedron cut in eight is."""

HEX_CHILDREN = np.array(
    [
        [_THIRDS.index(tuple(o + p for o, p in zip(origin, place, strict=True))) for place in _HEX]
        for origin in _HEX
    ]
)

TET_PARENTS = [[0], [1], [2], [3], [0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]]
"""Corners and midpoints of edges of a tetrahedron."""

_TET_CORNERS = [[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3]]
_TET_INNER = {
    (6, 8): [[6, 8, 4, 5], [6, 8, 5, 9], [6, 8, 9, 7], [6, 8, 7, 4]],
    (4, 9): [[4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]],
    (5, 7): [[5, 7, 4, 6], [5, 7, 6, 9], [5, 7, 9, 8], [5, 7, 8, 4]],
}
"""The octahedron between the corners, cut along each of its diagonals."""


def subdivide(mesh: Mesh) -> tuple[Mesh, NDArray[np.int64]]:
    """A mesh with eight cells in the place of each, in no grid.

    Tetrahedra are cut along the shortest diagonal of the octahedron that is left when the corners are cut off.

    Returns
    -------
    mesh : Mesh
        Nodes are numbered along the body's longest axis, which keeps the bandwidth small.
    parents : (n_nodes, 8) int64
        For each new node the old ones whose mean it is, each as often as the others.
    """
    hexahedra = mesh.cells.shape[1] == 8
    local = HEX_PARENTS if hexahedra else TET_PARENTS
    padded = np.array([np.repeat(parents, 8 // len(parents)) for parents in local])
    rows = np.sort(mesh.cells[:, padded], axis=2).reshape(-1, 8)
    parents, numbers = np.unique(rows, axis=0, return_inverse=True)
    numbers = numbers.reshape(mesh.n_cells, len(local))
    points = mesh.points[parents].mean(axis=1)
    cells = numbers[:, HEX_CHILDREN].reshape(-1, 8) if hexahedra else _tetrahedra(points, numbers)
    order = along_longest_axis(points)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return Mesh(points[order], place[cells]), parents[order]


def _tetrahedra(points: NDArray[np.float64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """(8 n, 4) the parts of tetrahedra, from the numbers (n, 10) of their corners and midpoints."""
    diagonals = list(_TET_INNER)
    lengths = np.stack(
        [
            np.linalg.norm(points[numbers[:, a]] - points[numbers[:, b]], axis=1)
            for a, b in diagonals
        ],
        axis=1,
    )
    shortest = lengths.argmin(axis=1)
    parts = [numbers[:, _TET_CORNERS].reshape(-1, 4)]
    parts += [
        numbers[shortest == i][:, inner].reshape(-1, 4)
        for i, inner in enumerate(_TET_INNER.values())
    ]
    cells = np.concatenate(parts)
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    turned = np.linalg.det(edges) < 0
    cells[turned] = cells[turned][:, [1, 0, 2, 3]]
    return cells
