"""Meshes of hexahedra (H8) or tetrahedra (T4, T10), with their regular grid, if any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from string import ascii_lowercase

import numpy as np
from numpy.typing import NDArray

HEX_CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
"""Corners of the unit cube, in VTK order."""

FACES = {
    8: np.array(
        [[0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2], [0, 3, 2, 1], [4, 5, 6, 7]]
    ),
    4: np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
    10: np.array([[0, 2, 1, 6, 5, 4], [0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6]]),
}
"""Faces of a hexahedron (8) and of tetrahedra (4, 10) in VTK order, oriented outwards.

A face of six nodes has its corners first, then the middles of the edges 01, 12 and 20.
"""

TET_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
"""Corners of a tetrahedron's edges, in VTK's order of the middles."""

_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""Four triangles of a facet of six nodes."""

KUHN = np.array(
    [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]]
)
"""Six tetrahedra around a hexahedron's diagonal 0-6. They match across faces of cells."""


@dataclass(frozen=True)
class Mesh:
    """A mesh of H8, of T4 or of T10 cells.

    Attributes
    ----------
    points : (n_nodes, 3) float64
        Reference positions, m.
    cells : (n_cells, 8), (n_cells, 4) or (n_cells, 10) int64
        Node numbers in VTK order.
    grid_shape : (int, int, int) or None
        Nodes per axis of the regular grid that contains the mesh.
    grid_index : (n_nodes,) int64 or None
        Index of each node in that grid, flattened in C order.
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
        """(n_facets, 4, 3 or 6) node numbers of the faces of a single cell, oriented outwards."""
        faces = FACES[self.cells.shape[1]]
        faces = self.cells[:, faces].reshape(-1, faces.shape[1])
        corners, nodes = corners_of(faces), np.zeros((len(faces), 4), dtype=np.int64)
        nodes[:, -corners.shape[1] :] = np.sort(corners, axis=1)
        keys = nodes[:, ::2] * self.n_nodes + nodes[:, 1::2]
        order = np.lexsort(keys.T)
        is_new = np.ones(len(faces) + 1, dtype=bool)
        is_new[1:-1] = (keys[order[1:]] != keys[order[:-1]]).any(axis=1)
        return np.asarray(faces[np.sort(order[is_new[:-1] & is_new[1:]])])

    @property
    def drawn_facets(self) -> NDArray[np.int64]:
        """(n_facets, 4 or 3) boundary facets as polygons; those of six nodes become four."""
        facets = self.boundary_facets
        return facets[:, _QUARTERS].reshape(-1, 3) if facets.shape[1] == 6 else facets

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest corner of the bounding box, m."""
        return np.array([self.points.min(axis=0), self.points.max(axis=0)])


def corners_of(facets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the corners (n, 4 or 3) of facets (n, 4, 3 or 6)."""
    return facets[:, :3] if facets.shape[1] == 6 else facets


def box_mesh(
    size_m: tuple[float, float, float], cells: tuple[int, int, int], tetrahedra: bool = False
) -> Mesh:
    """Return a box of equal cells with its lowest corner at the origin.

    Nodes are numbered with z fastest and x slowest. This keeps the bandwidth of a beam along x
    small.

    Parameters
    ----------
    size_m : three floats
        Edge lengths, m.
    cells : three ints
        Hexahedra per axis.
    tetrahedra : bool, default False
        Cut each hexahedron into six T4.

    Examples
    --------
    >>> mesh = box_mesh((4.0, 1.0, 1.0), (4, 1, 1))
    >>> mesh.n_nodes, len(mesh.cells)
    (20, 4)
    """
    shape = cells[0] + 1, cells[1] + 1, cells[2] + 1
    axes = [np.linspace(0.0, length, n) for length, n in zip(size_m, shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    node = np.arange(len(points)).reshape(shape)
    corners = [tuple(slice(c, c + n) for c, n in zip(at, cells, strict=True)) for at in HEX_CORNERS]
    hexes = np.stack([node[corner].ravel() for corner in corners], axis=1)
    cell_nodes = hexes[:, KUHN].reshape(-1, 4) if tetrahedra else hexes
    return Mesh(points, cell_nodes, shape, np.arange(len(points)))


def l_mesh(
    size_m: tuple[float, float, float],
    cells: tuple[int, int, int],
    cut_cells: tuple[int, int],
    tetrahedra: bool = False,
) -> Mesh:
    """Return a box without the cells in its corner of highest x and highest z.

    Parameters
    ----------
    size_m, cells, tetrahedra
        See `box_mesh`. The box's regular grid is kept.
    cut_cells : two ints
        Hexahedra to remove along x and along z.
    """
    box = box_mesh(size_m, cells, tetrahedra)
    x, _, z = np.unravel_index(np.arange(box.n_cells) // (len(KUHN) if tetrahedra else 1), cells)
    return part_of(box, (x < cells[0] - cut_cells[0]) | (z < cells[2] - cut_cells[1]))


def chambered_mesh(
    size_m: tuple[float, float, float],
    cells: tuple[int, int, int],
    chambers: Sequence[tuple[tuple[int, int, int], tuple[int, int, int]]],
    tetrahedra: bool = False,
) -> tuple[Mesh, dict[str, NDArray[np.int64]]]:
    """Return a box without the cells of its chambers, and the nodes on the walls of each.

    Parameters
    ----------
    size_m, cells, tetrahedra
        See `box_mesh`. The box's regular grid is kept.
    chambers : sequence of two times three ints
        Numbers of cells before the begin and up to the end of each chamber, per axis.
    """
    box = box_mesh(size_m, cells, tetrahedra)
    at = np.indices(cells).reshape(3, -1).T.repeat(len(KUHN) if tetrahedra else 1, axis=0)
    hollow = [((at >= low) & (at < high)).all(axis=1) for low, high in chambers]
    mesh = part_of(box, ~np.any(hollow, axis=0))
    assert mesh.grid_index is not None
    # The nodes of a chamber's cells that are left are those on its walls.
    return mesh, {
        f"chamber-{letter}": np.flatnonzero(np.isin(mesh.grid_index, box.cells[own]))
        for letter, own in zip(ascii_lowercase, hollow, strict=False)
    }


def along_longest_axis(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the order (n,) of points (n, 3), sorted along the longest axis first.

    This numbering gives a slender body a small bandwidth.
    """
    axes = np.argsort(-np.ptp(points, axis=0))
    return np.lexsort(np.round(points / np.ptp(points), 9)[:, axes[::-1]].T)


def inverse_of(order: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the inverse (n,) of a permutation (n,)."""
    inverse = np.empty_like(order)
    inverse[order] = np.arange(len(order))
    return inverse


def part_of(mesh: Mesh, kept: NDArray[np.bool_]) -> Mesh:
    """Return some cells (n_cells,) of a mesh with their nodes, in the same order and grid."""
    nodes, cells = np.unique(mesh.cells[kept], return_inverse=True)
    index = None if mesh.grid_index is None else mesh.grid_index[nodes]
    return Mesh(mesh.points[nodes], cells.reshape(-1, mesh.cells.shape[1]), mesh.grid_shape, index)
