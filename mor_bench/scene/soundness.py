"""What a mesh that was made elsewhere must be before it is computed with, and its numbering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mor_bench.errors import SpecError
from mor_bench.scene.interpolation import _trilinear
from mor_bench.scene.mesh import FACES, Mesh, along_longest_axis

SAME_PLACE = 1e-9
"""Distance, as a fraction of the bounding box's diagonal, within which two nodes lie in one place."""

IN_GRID = 1e-6
"""Distance, as a fraction of the bounding box's diagonal, within which a node lies at a point of a grid; files are in single precision."""

FLAT = 1e-12
"""det J of a flat cell as a fraction of |J|³: round-off, where an exact result would be zero."""

_GAUSS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3.0)
_TURNED = {4: [1, 0, 2, 3], 8: [4, 5, 6, 7, 0, 1, 2, 3]}
"""The order of a cell's corners that turns it inside out."""


def tidied(points: NDArray[np.float64], cells: NDArray[np.int64]) -> tuple[Mesh, NDArray[np.int64]]:
    """A mesh without unused nodes, its cells turned outwards, numbered for a small bandwidth.

    Parameters
    ----------
    points : (n_points, 3) float64
        m.
    cells : (n_cells, 8) or (n_cells, 4) int64

    Returns
    -------
    mesh : Mesh
    place : (n_points,) int64
        The new number of each point; -1 for one that no cell uses.

    Raises
    ------
    SpecError
        If positions are not finite, nodes are doubled or not there, a cell is flat, inside out or there twice, or the
        cells do not hang together through faces.
    """
    check_numbers(points, cells)
    used = np.unique(cells)
    place = np.full(len(points), -1, dtype=np.int64)
    place[used] = np.arange(len(used))
    points, cells = points[used], place[cells]
    cells = sound_cells(points, cells)
    order = _numbering(points, cells)
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    place[used] = number
    return in_grid(Mesh(points[order], number[cells])), place


def in_grid(mesh: Mesh) -> Mesh:
    """The mesh with the regular grid, along the axes, that it lies in; as it is if there is none.

    It lies in one if each node is at a point of it, all are at different ones, and no cell is larger than the spacing.
    """
    low, size = mesh.points.min(axis=0), np.ptp(mesh.points, axis=0)
    near = IN_GRID * float(np.linalg.norm(size))
    gaps = [np.diff(np.sort(x)) for x in mesh.points.T]
    steps = np.array([gap[gap > near].mean() for gap in gaps])
    index = np.rint((mesh.points - low) / steps).astype(np.int64)
    off = np.abs(mesh.points - low - index * steps).max()
    if (
        off > near
        or np.ptp(index[mesh.cells], axis=1).max() > 1
        or len(np.unique(index, axis=0)) < mesh.n_nodes
    ):
        return mesh
    nx, ny, nz = (int(n) + 1 for n in index.max(axis=0))
    return replace(
        mesh, grid_shape=(nx, ny, nz), grid_index=np.ravel_multi_index(tuple(index.T), (nx, ny, nz))
    )


def check_numbers(points: NDArray[np.float64], cells: NDArray[np.int64]) -> None:
    """Raise `SpecError` if there is nothing, a position is not finite, or a cell has too few nodes or one that is not there."""
    if not len(points) or not len(cells):
        raise SpecError("there must be points and cells; got none.")
    if cells.ndim != 2 or cells.shape[1] not in FACES:
        raise SpecError(
            f"cells must have shape (n_cells, 8) for H8 or (n_cells, 4) for T4; got {cells.shape}."
        )
    if not np.isfinite(points).all():
        raise SpecError(
            f"positions must be finite; point {int(np.argwhere(~np.isfinite(points))[0, 0])} (counted from 0) is not."
        )
    if cells.min() < 0 or cells.max() >= len(points):
        raise SpecError(
            f"cells must have nodes in [0, {len(points) - 1}]; got {cells.min()} to {cells.max()}."
        )


def sound_cells(points: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cells turned outwards, see `outwards`, of a body that is sound.

    Raises
    ------
    SpecError
        If nodes are doubled, a cell is flat, inside out or there twice, more than two share a face, two lie on one side of it, or they do not hang
        together through faces.
    """
    _check_doubled(points)
    cells = outwards(points, cells)
    _check_overlap(cells)
    _check_parts(cells)
    return cells


def outwards(points: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cells with inverted ones turned over: any tetrahedra; hexahedra if all are, as in a file of the other orientation.

    Raises
    ------
    SpecError
        If a cell is flat, or some hexahedra and not all are inside out, in whole or in part.
    """
    low, high = _extreme_volumes(points[cells])
    turned = high < -FLAT
    bad = ~(turned | (low > FLAT))
    if bad.any():
        raise SpecError(
            f"cell {int(bad.argmax())} (counted from 0) is flat or folded: its volume must not vanish anywhere."
        )
    if cells.shape[1] == 8 and turned.any() and not turned.all():
        raise SpecError(
            f"{int(turned.sum())} of {len(cells)} hexahedra are inside out, the first is cell {int(turned.argmax())} (counted from 0)."
        )
    out = cells.copy()
    out[turned] = cells[turned][:, _TURNED[cells.shape[1]]]
    return out


def _extreme_volumes(
    corners: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and greatest det J / |J|³ (n_cells,) at the quadrature points of cells with corners (n_cells, 4 or 8, 3)."""
    edges = corners[:, None, 1:] - corners[:, None, :1]
    jacobian = (
        edges
        if corners.shape[1] == 4
        else np.einsum("cai,qad->cqdi", corners, _trilinear(_GAUSS)[1])
    )
    size = np.maximum(np.linalg.norm(jacobian, axis=(2, 3)) ** 3, np.finfo(float).tiny)
    volumes = np.linalg.det(jacobian) / size
    return volumes.min(axis=1), volumes.max(axis=1)


def _check_doubled(points: NDArray[np.float64]) -> None:
    near = SAME_PLACE * float(np.linalg.norm(np.ptp(points, axis=0)))
    pairs = cKDTree(points).query_pairs(near, output_type="ndarray")
    if len(pairs):
        raise SpecError(
            f"{len(np.unique(pairs[:, 1]))} nodes lie in the place of others, as at {points[pairs[:, 0].min()].tolist()} m; merge them."
        )


def _check_overlap(cells: NDArray[np.int64]) -> None:
    if len(np.unique(np.sort(cells, axis=1), axis=0)) < len(cells):
        raise SpecError("some cells are there twice.")
    numbers = _face_numbers(cells).ravel()
    shared = np.bincount(numbers)
    if shared.max() > 2:
        raise SpecError(
            f"{int((shared > 2).sum())} faces belong to more than two cells: cells overlap."
        )
    # Seen from outside, cells on either side of a face go round it in opposite senses.
    corners = FACES[cells.shape[1]]
    faces = cells[:, corners].reshape(-1, corners.shape[1])
    second = faces[np.arange(len(faces)), (faces.argmin(axis=1) + 1) % faces.shape[1]]
    n_sides = len(np.unique(np.stack([numbers, second], axis=1), axis=0))
    if n_sides < len(faces):
        raise SpecError(
            f"{len(faces) - n_sides} faces have both of their cells on one side: cells overlap."
        )


def _check_parts(cells: NDArray[np.int64]) -> None:
    """Raise `SpecError` if the cells do not hang together through faces: joined at an edge or a node, they are a hinge."""
    faces = _face_numbers(cells)
    belongs = sp.csr_array(
        (np.ones(faces.size), (np.repeat(np.arange(len(cells)), faces.shape[1]), faces.ravel()))
    )
    n_parts = connected_components(sp.csr_array(belongs @ belongs.T), directed=False)[0]
    if n_parts > 1:
        raise SpecError(f"the mesh must be one body; it is {n_parts} parts that no face joins.")


def _face_numbers(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each face of each cell (n_cells, 6 or 4) a number, which is the same for the faces that have the same nodes."""
    corners = FACES[cells.shape[1]]
    faces = np.sort(cells[:, corners].reshape(-1, corners.shape[1]), axis=1)
    return np.unique(faces, axis=0, return_inverse=True)[1].reshape(len(cells), len(corners))


def _numbering(points: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The nodes in the order in which they are numbered: along the longest axis if that makes the bandwidth smaller, else as they are.

    The banded solver takes this order or reverse Cuthill-McKee's, whichever is better.
    """
    order = along_longest_axis(points)
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return (
        order
        if np.ptp(number[cells], axis=1).max() < np.ptp(cells, axis=1).max()
        else np.arange(len(order))
    )
