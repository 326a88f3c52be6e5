"""A tube of H8 cells, or a sector of one."""

from __future__ import annotations

from math import tau

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.mesh import HEX_CORNERS, Mesh
from mor_bench.scene.soundness import tidied


def tube_mesh(
    radii_m: tuple[float, float], length_m: float, angle: float, cells: tuple[int, int, int]
) -> tuple[Mesh, dict[str, NDArray[np.int64]]]:
    """Return a tube along the z axis and its sets of nodes `inner` and `outer`.

    Parameters
    ----------
    radii_m : two floats
        Inner and outer radius, m.
    length_m : float
    angle : float
        Angle of the sector from the x axis on, rad; 2 π closes the tube.
    cells : three ints
        Cells across the wall, around and along the axis.
    """
    closed = angle >= tau * (1 - 1e-12)
    n_across, n_around, n_along = cells
    shape = n_across + 1, n_around + (not closed), n_along + 1
    turns = angle * np.arange(shape[1]) / n_around
    axes = np.linspace(*radii_m, shape[0]), turns, np.linspace(0.0, length_m, shape[2])
    radius, turn, height = np.meshgrid(*axes, indexing="ij")
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=-1)
    # cos(π/2) is not zero; nodes on the axes of a quarter must lie in their planes.
    points[np.abs(points) < 1e-14 * radii_m[1]] = 0.0
    node = np.arange(radius.size).reshape(shape)
    corner = np.indices(cells).reshape(3, -1)
    at = corner[:, :, None] + HEX_CORNERS.T[:, None, :]
    at[1] %= shape[1]
    mesh, place = tidied(points.reshape(-1, 3), node[tuple(at)])
    return mesh, {
        "inner": np.sort(place[node[0].ravel()]),
        "outer": np.sort(place[node[-1].ravel()]),
    }
