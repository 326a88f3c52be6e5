"""Checks of an imported mesh, and its renumbering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.interpolation import quadratic, trilinear
from mor_bench.scene.mesh import (
    FACES,
    HEX_CORNERS,
    TET_EDGES,
    Mesh,
    along_longest_axis,
    corners_of,
    inverse_of,
)
from mor_bench.scene.nearest import tree_of

SAME_PLACE = 1e-9
"""Distance below which two nodes coincide, as a fraction of the bounding box's diagonal."""

IN_GRID = 1e-6
"""Tolerance of grid points as a fraction of the diagonal; files have single precision."""

MAX_LISTED = 1_000_000
"""Largest number of coinciding pairs that are listed; n equal nodes have about n² pairs."""

FARTHEST_M, SMALLEST_M = 1e9, 1e-9
"""Largest coordinate and smallest size of a body, m, for which double precision suffices."""

FLAT = 1e-12
"""det J / |J|³ below which a cell is flat: the round-off of an exact zero."""

_GAUSS = (2.0 * HEX_CORNERS - 1.0) / np.sqrt(3.0)
_CURVED = np.concatenate([np.full((4, 3), 0.138) + 0.447 * np.eye(4, 3, -1), np.eye(4, 3, -1)])
"""Gauss points and corners of a tetrahedron, where T10 are checked."""

_TURNED = {
    4: [1, 0, 2, 3],
    8: [4, 5, 6, 7, 0, 1, 2, 3],
    10: [1, 0, 2, 3, 4, 6, 5, 8, 7, 9],
}
"""Order of a cell's nodes that inverts its orientation."""


def tidied(points: NDArray[np.float64], cells: NDArray[np.int64]) -> tuple[Mesh, NDArray[np.int64]]:
    """Return a mesh without unused nodes, with oriented cells and a small bandwidth.

    Parameters
    ----------
    points : (n_points, 3) float64
        Positions, m.
    cells : (n_cells, 8), (n_cells, 4) or (n_cells, 10) int64

    Returns
    -------
    mesh : Mesh
    place : (n_points,) int64
        The new number of each point; -1 if no cell uses it.

    Raises
    ------
    SpecError
        If a number is out of range, see `check_numbers`, or the body is not sound, see
        `sound_cells`.
    """
    check_numbers(points, cells)
    n_points, (used, inverse) = len(points), np.unique(cells, return_inverse=True)
    points, cells = points[used], inverse.reshape(cells.shape)
    cells = sound_cells(points, cells)
    order = _numbering(points, cells)
    number = inverse_of(order)
    place = np.full(n_points, -1, dtype=np.int64)
    place[used] = number
    return in_grid(Mesh(points[order], number[cells])), place


def in_grid(mesh: Mesh) -> Mesh:
    """Return the mesh with its axis-parallel regular grid, if it has one.

    Each node must have its own grid point, and no edge may be longer than the spacing.
    """
    step = 2 if mesh.cells.shape[1] == 10 else 1
    low, size = mesh.points.min(axis=0), np.ptp(mesh.points, axis=0)
    near = IN_GRID * float(np.linalg.norm(size))
    gaps = [np.diff(np.sort(x)) for x in mesh.points.T]
    steps = np.array([gap[gap > near].mean() for gap in gaps])
    index = np.rint((mesh.points - low) / steps).astype(np.int64)
    off = np.abs(mesh.points - low - index * steps).max()
    one_step = np.ptp(index[mesh.cells], axis=1).max() <= step
    if off > near or not one_step or len(np.unique(index, axis=0)) < mesh.n_nodes:
        return mesh
    nx, ny, nz = (int(n) + 1 for n in index.max(axis=0))
    flat = np.ravel_multi_index(tuple(index.T), (nx, ny, nz))
    return replace(mesh, grid_shape=(nx, ny, nz), grid_index=flat)


def check_numbers(points: NDArray[np.float64], cells: NDArray[np.int64]) -> None:
    """Raise `SpecError` if a mesh is empty or not finite, or a cell has a wrong node number."""
    if not len(points) or not len(cells):
        raise SpecError("there must be points and cells; got none.")
    if cells.ndim != 2 or cells.shape[1] not in FACES:
        raise SpecError(
            "cells must have shape (n_cells, 8) for H8, (n_cells, 4) for T4 or (n_cells, 10) for "
            f"T10; got {cells.shape}."
        )
    if not np.isfinite(points).all():
        first = int(np.argwhere(~np.isfinite(points))[0, 0])
        raise SpecError(f"positions must be finite; point {first} (counted from 0) is not.")
    if np.abs(points).max() > FARTHEST_M or np.ptp(points, axis=0).max() < SMALLEST_M:
        raise SpecError(
            f"positions must be in [-{FARTHEST_M:g}, {FARTHEST_M:g}] m and at least "
            f"{SMALLEST_M:g} m apart; got {points.min():g} to {points.max():g} m."
        )
    if cells.min() < 0 or cells.max() >= len(points):
        raise SpecError(
            f"cells must have nodes in [0, {len(points) - 1}]; got {cells.min()} to {cells.max()}."
        )


def sound_cells(points: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the oriented cells of a sound body, see `outwards`.

    Raises
    ------
    SpecError
        If nodes coincide; a cell is flat, inverted or repeated; more than two cells share a face;
        two cells lie on the same side of a face; some cells are not connected through faces; or
        an edge of T10 has several middles, or another cell's corner in the middle.
    """
    near = SAME_PLACE * float(np.linalg.norm(np.ptp(points, axis=0)))
    tree = tree_of(points)
    if (n_near := int(tree.count_neighbors(tree, near)) - len(points)) > MAX_LISTED:
        raise SpecError(f"{n_near:,} pairs of nodes coincide; merge them.")
    if n_near:
        pairs = tree.query_pairs(near, output_type="ndarray")
        raise SpecError(
            f"{len(np.unique(pairs[:, 1]))} nodes coincide with others, as at "
            f"{points[pairs[:, 0].min()].tolist()} m; merge them."
        )
    cells = outwards(points, cells)
    if cells.shape[1] == 10:
        _check_middles(cells)
    faces = _face_numbers(cells)
    _check_overlap(cells, faces.ravel())
    _check_parts(faces)
    return cells


def outwards(points: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Orient the cells: reverse inverted tetrahedra, but hexahedra only if all are inverted.

    Raises
    ------
    SpecError
        If a cell is flat, or some but not all hexahedra are inverted, at least partly.
    """
    low, high = _extreme_volumes(points[cells])
    turned = high < -FLAT
    bad = ~(turned | (low > FLAT))
    if bad.any():
        raise SpecError(
            f"cell {int(bad.argmax())} (counted from 0) is flat or folded: "
            "its volume must not vanish anywhere."
        )
    if cells.shape[1] == 8 and turned.any() and not turned.all():
        raise SpecError(
            f"{int(turned.sum())} of {len(cells)} hexahedra are inside out, "
            f"the first is cell {int(turned.argmax())} (counted from 0)."
        )
    out = cells.copy()
    out[turned] = cells[turned][:, _TURNED[cells.shape[1]]]
    return out


def _extreme_volumes(
    corners: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and greatest det J / |J|³ of cells (n, 4, 8 or 10, 3) at Gauss points.

    T10 are also checked at their corners.
    """
    if corners.shape[1] == 4:
        jacobian = corners[:, None, 1:] - corners[:, None, :1]
    else:
        slopes = trilinear(_GAUSS)[1] if corners.shape[1] == 8 else quadratic(_CURVED)[1]
        jacobian = np.einsum("cai,qad->cqdi", corners, slopes)
    size = np.maximum(np.linalg.norm(jacobian, axis=(2, 3)) ** 3, np.finfo(float).tiny)
    volumes = np.linalg.det(jacobian) / size
    return volumes.min(axis=1), volumes.max(axis=1)


def _check_overlap(cells: NDArray[np.int64], numbers: NDArray[np.int64]) -> None:
    if len(np.unique(np.sort(cells, axis=1), axis=0)) < len(cells):
        raise SpecError("some cells occur twice.")
    shared = np.bincount(numbers)
    if shared.max() > 2:
        raise SpecError(
            f"{int((shared > 2).sum())} faces belong to more than two cells: cells overlap."
        )
    # Seen from outside, the two cells at a face number its corners in opposite directions.
    corners = corners_of(FACES[cells.shape[1]])
    faces = cells[:, corners].reshape(-1, corners.shape[1])
    second = faces[np.arange(len(faces)), (faces.argmin(axis=1) + 1) % faces.shape[1]]
    n_sides = len(np.unique(np.stack([numbers, second], axis=1), axis=0))
    if n_sides < len(faces):
        raise SpecError(
            f"{len(faces) - n_sides} faces have both of their cells on one side: cells overlap."
        )


def _check_middles(cells: NDArray[np.int64]) -> None:
    """Raise `SpecError` if the cells at an edge do not share one node in its middle."""
    edges = np.sort(cells[:, TET_EDGES], axis=2).reshape(-1, 2)
    whole = np.unique(np.column_stack([edges, cells[:, 4:].ravel()]), axis=0)
    n_wrong = len(whole) - len(np.unique(edges, axis=0))
    n_wrong += len(whole) - len(np.unique(whole[:, 2]))
    n_wrong += len(np.intersect1d(cells[:, :4], cells[:, 4:]))
    if n_wrong:
        raise SpecError(
            "every edge of tetrahedra with ten nodes must have one middle of its own, which all of "
            f"its cells share and no cell has as a corner; {n_wrong} have not."
        )


def _check_parts(faces: NDArray[np.int64]) -> None:
    """Raise `SpecError` if some cells are not connected through faces. An edge is a hinge."""
    from scipy.sparse.csgraph import connected_components  # slow to import; datasets are sound

    cell = np.repeat(np.arange(len(faces)), faces.shape[1])
    belongs = sp.csr_array((np.ones(faces.size), (cell, faces.ravel())))
    n_parts = connected_components(sp.csr_array(belongs @ belongs.T), directed=False)[0]
    if n_parts > 1:
        raise SpecError(f"the mesh must be one body; it has {n_parts} parts that share no face.")


def _face_numbers(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number the faces (n_cells, 6 or 4) of cells; equal faces have the same number."""
    corners = corners_of(FACES[cells.shape[1]])
    faces = np.sort(cells[:, corners].reshape(-1, corners.shape[1]), axis=1)
    return np.unique(faces, axis=0, return_inverse=True)[1].reshape(len(cells), len(corners))


def _numbering(points: NDArray[np.float64], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the order along the longest axis if it reduces the bandwidth, else the present order.

    The banded solver uses this order or reverse Cuthill-McKee, whichever has less bandwidth.
    """
    order = along_longest_axis(points)
    new, old = np.ptp(inverse_of(order)[cells], axis=1).max(), np.ptp(cells, axis=1).max()
    return order if new < old else np.arange(len(order))
