"""Hexahedral meshes: points, cells, boundary facets and, where there is one, the regular grid under them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

FACES = {
    8: np.array(
        [[0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2], [0, 3, 2, 1], [4, 5, 6, 7]]
    ),
    4: np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
}
"""The faces of a hexahedron and of a tetrahedron in VTK node order, each turned outwards."""

KUHN = np.array(
    [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]]
)
"""Six tetrahedra around a hexahedron's diagonal 0-6; those of neighbouring cells fit together."""


@dataclass(frozen=True)
class Mesh:
    """A mesh of H8 or of T4 cells.

    Attributes
    ----------
    points : (n_nodes, 3) float64
        Reference positions, m.
    cells : (n_cells, 8) or (n_cells, 4) int64
        Node numbers in VTK order.
    grid_shape : (int, int, int) or None
        Nodes per axis of the regular grid in which the mesh lies.
    grid_index : (n_nodes,) int64 or None
        Place of each node in that grid, flattened in C order.
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    grid_shape: tuple[int, int, int] | None = None
    grid_index: NDArray[np.int64] | None = None

    @property
    def n_nodes(self) -> int:
        return len(self.points)

    @property
    def n_cells(self) -> int:
        return len(self.cells)

    @property
    def n_dofs(self) -> int:
        return 3 * len(self.points)

    @cached_property
    def boundary_facets(self) -> NDArray[np.int64]:
        """(n_facets, 4 or 3) node numbers of the faces that belong to one cell only, turned outwards."""
        faces = FACES[self.cells.shape[1]]
        faces = self.cells[:, faces].reshape(-1, faces.shape[1])
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        return np.asarray(faces[np.sort(first[count == 1])])

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest corner, m."""
        return np.array([self.points.min(axis=0), self.points.max(axis=0)])


def box_mesh(
    size_m: tuple[float, float, float], cells: tuple[int, int, int], tetrahedra: bool = False
) -> Mesh:
    """A box of equal H8 cells, or of six T4 in the place of each, with its lowest corner at the origin.

    Nodes are numbered with z fastest and x slowest, which keeps the bandwidth of a beam along x small.

    Parameters
    ----------
    size_m : three floats
        Edge lengths, m.
    cells : three ints
        Cells per axis.
    tetrahedra : bool
    """
    nx, ny, nz = (n + 1 for n in cells)
    axes = [np.linspace(0.0, length, n + 1) for length, n in zip(size_m, cells, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    node = np.arange(nx * ny * nz).reshape(nx, ny, nz)
    low, high = slice(None, -1), slice(1, None)
    corners = [
        (low, low, low),
        (high, low, low),
        (high, high, low),
        (low, high, low),
        (low, low, high),
        (high, low, high),
        (high, high, high),
        (low, high, high),
    ]
    hexes = np.stack([node[corner].ravel() for corner in corners], axis=1)
    cell_nodes = hexes[:, KUHN].reshape(-1, 4) if tetrahedra else hexes
    return Mesh(points, cell_nodes, (nx, ny, nz), np.arange(len(points)))


def l_mesh(
    size_m: tuple[float, float, float],
    cells: tuple[int, int, int],
    cut_cells: tuple[int, int],
    tetrahedra: bool = False,
) -> Mesh:
    """A box without the cells in its corner of highest x and highest z, in the box's regular grid.

    Parameters
    ----------
    size_m, cells, tetrahedra
        Of the box; see `box_mesh`.
    cut_cells : two ints
        Cells that are missing along x and along z.
    """
    box = box_mesh(size_m, cells, tetrahedra)
    x, _, z = np.unravel_index(np.arange(box.n_cells) // (len(KUHN) if tetrahedra else 1), cells)
    return part_of(box, (x < cells[0] - cut_cells[0]) | (z < cells[2] - cut_cells[1]))


def along_longest_axis(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """The order (n,) of points (n, 3) along the longest axis of their bounding box, then the second, then the shortest.

    Nodes of a slender body that are numbered so have a small bandwidth.
    """
    axes = np.argsort(-np.ptp(points, axis=0))
    return np.lexsort(np.round(points / np.ptp(points), 9)[:, axes[::-1]].T)


def part_of(mesh: Mesh, kept: NDArray[np.bool_]) -> Mesh:
    """The cells (n_cells,) that are kept, with their nodes, in the order and the grid that they had."""
    nodes, cells = np.unique(mesh.cells[kept], return_inverse=True)
    index = None if mesh.grid_index is None else mesh.grid_index[nodes]
    return Mesh(mesh.points[nodes], cells.reshape(-1, mesh.cells.shape[1]), mesh.grid_shape, index)
