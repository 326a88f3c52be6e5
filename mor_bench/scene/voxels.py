"""Hexahedral meshes of any closed surface: the cells of a regular grid that overlap its body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from mor_bench.errors import SpecError
from mor_bench.scene.mesh import Mesh, box_mesh, part_of
from mor_bench.scene.surfaces import Surface, inside
from mor_bench.scene.triangles import met_cells

TOUCHED = 1e-10
"""How deep, in half edges of a cell, a surface may enter it and still only touch it: well above round-off, and a tenth of
what `interpolation_matrix` lets a point lie outside."""


def _overlapping(
    surface: Surface, cells: tuple[int, int, int], centres: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether each cell (nx, ny, nz) of the surface's bounding box shares volume with the body, for the cells' centres (n_cells, 3)."""
    low, high = surface.bounds
    corners = (surface.points - low) / (high - low) * cells
    entered, touched = (
        np.asarray(met_cells(corners[surface.triangles], cells, 0.5 * (1 + sign * TOUCHED)))
        for sign in (-1, 1)
    )
    # Cells that no triangle touches and that faces join are all inside or all outside: one of each such part is asked.
    part = label(~touched)[0]
    first = np.unique(part, return_index=True)[1][1 if touched.any() else 0 :]
    overlaps = entered | np.append(False, inside(surface, centres[first]))[part]
    # Of those that are touched and not entered each is asked by itself.
    only_touched = touched & ~entered
    overlaps[only_touched] = inside(surface, centres[only_touched.ravel()])
    return np.asarray(overlaps)


def voxel_mesh(surface: Surface, cells: tuple[int, int, int]) -> Mesh:
    """The H8 cells of a regular grid over a surface's bounding box that overlap its body.

    Every point of the surface lies in a cell: near it there are points of the body, and the cell that holds them is kept.
    A cell that the body only touches, as if with a face in a plane of the grid, is not.

    Parameters
    ----------
    surface : Surface
    cells : three ints
        Cells per axis of the whole grid.

    Returns
    -------
    Mesh
        In the grid, its nodes and cells in the order that they have in `box_mesh`; the body's faces are stairs.

    Raises
    ------
    SpecError
        If the cells do not hang together through faces: joined at an edge or a corner, they are a hinge.
    """
    low, high = surface.bounds
    box = box_mesh(tuple((high - low).tolist()), cells)
    box = replace(box, points=box.points + low)
    kept = _overlapping(surface, cells, box.points[box.cells].mean(axis=1))
    n_parts = label(kept)[1]
    if n_parts > 1:
        raise SpecError(
            f"the {kept.sum()} cells that the body has in a grid of {' x '.join(map(str, cells))} fall into {n_parts} parts "
            "that no face joins; use more cells."
        )
    return part_of(box, kept.ravel())
