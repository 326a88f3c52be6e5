"""Hexahedral mesh of any closed surface: the grid cells that overlap its body."""

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
"""Largest depth of a mere contact between a surface and a cell, in half edges of the cell.

It is well above round-off, and a tenth of the tolerance of `interpolation_matrix`.
"""


def _overlapping(
    surface: Surface, cells: tuple[int, int, int], centres: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return whether each cell (nx, ny, nz) of the bounding box shares volume with the body.

    `centres` are the cells' centres (n_cells, 3).
    """
    low, high = surface.bounds
    corners = ((surface.points - low) / (high - low) * cells)[surface.triangles]
    entered, touched = (
        np.asarray(met_cells(corners, cells, 0.5 * (1 + sign * TOUCHED))) for sign in (-1, 1)
    )
    # Connected cells that no triangle touches are all inside or all outside. So one test for each
    # connected part is enough.
    part = label(~touched)[0]
    first = np.unique(part, return_index=True)[1][1 if touched.any() else 0 :]
    overlaps = entered | np.append(False, inside(surface, centres[first]))[part]
    # Each cell that is touched but not entered needs its own test.
    only_touched = touched & ~entered
    overlaps[only_touched] = inside(surface, centres[only_touched.ravel()])
    return np.asarray(overlaps)


def voxel_mesh(surface: Surface, cells: tuple[int, int, int]) -> Mesh:
    """Return the H8 cells of a regular grid over a surface's bounding box that overlap its body.

    Every point of the surface lies in a cell, because points of the body are near it. A cell that
    only touches the body, such as along a grid plane, is left out.

    Parameters
    ----------
    surface : Surface
    cells : three ints
        Cells per axis of the whole grid.

    Returns
    -------
    Mesh
        A mesh in the grid, with nodes and cells in the order of `box_mesh`. Its surface has steps.

    Raises
    ------
    SpecError
        If some cells are not connected through faces. A single edge or corner would be a hinge.
    """
    low, high = surface.bounds
    box = box_mesh(tuple((high - low).tolist()), cells)
    box = replace(box, points=box.points + low)
    kept = _overlapping(surface, cells, box.points[box.cells].mean(axis=1))
    n_parts = label(kept)[1]
    if n_parts > 1:
        raise SpecError(
            f"the {kept.sum()} cells of the body in a grid of "
            f"{' x '.join(map(str, cells))} form {n_parts} parts that share no face; use "
            "more cells."
        )
    return part_of(box, kept.ravel())
