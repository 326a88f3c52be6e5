"""Kernels on triangles: winding number of a surface, and cells of a grid that triangles meet.

In grid coordinates cell (i, j, k) is the unit cube from (i, j, k) to (i + 1, j + 1, k + 1).
"""

from __future__ import annotations

from math import atan2, floor, pi, sqrt

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def winding_numbers(corners, points):
    """Return the generalised winding number (n,) of triangles (m, 3, 3) around points (n, 3).

    For a closed surface it is 1 inside and 0 outside. It is the sum of the triangles' solid angles.
    Van Oosterom & Strackee (1983), eq. 8: tan(Ω/2) = a·(b × c) / (|a||b||c| + (a·b)|c| + (b·c)|a| +
    (c·a)|b|). Unlike ray casting, it has no special case at edges (Jacobson, Kavan &
    Sorkine-Hornung 2013).
    """
    windings = np.empty(len(points))
    for n in range(len(points)):
        half_angles = 0.0
        for t in range(len(corners)):
            ax = corners[t, 0, 0] - points[n, 0]
            ay = corners[t, 0, 1] - points[n, 1]
            az = corners[t, 0, 2] - points[n, 2]
            bx = corners[t, 1, 0] - points[n, 0]
            by = corners[t, 1, 1] - points[n, 1]
            bz = corners[t, 1, 2] - points[n, 2]
            cx = corners[t, 2, 0] - points[n, 0]
            cy = corners[t, 2, 1] - points[n, 1]
            cz = corners[t, 2, 2] - points[n, 2]
            a = sqrt(ax * ax + ay * ay + az * az)
            b = sqrt(bx * bx + by * by + bz * bz)
            c = sqrt(cx * cx + cy * cy + cz * cz)
            triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            ab = ax * bx + ay * by + az * bz
            bc = bx * cx + by * cy + bz * cz
            ca = cx * ax + cy * ay + cz * az
            half_angles += atan2(triple, a * b * c + ab * c + bc * a + ca * b)
        windings[n] = half_angles / (2 * pi)
    return windings


@njit(inline="always")
def _separated(v, half):
    """Return whether an axis separates a triangle (3, 3) from a cube of half edge `half`.

    The cube is at the origin. The thirteen axes of Akenine-Möller (2001) are the cube's three,
    their nine cross products with the triangle's edges, and the triangle's normal.
    """
    for i in range(3):
        if min(v[0, i], v[1, i], v[2, i]) > half or max(v[0, i], v[1, i], v[2, i]) < -half:
            return True
    for corner in range(3):
        e = v[(corner + 1) % 3] - v[corner]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            p = e[j] * v[corner, k] - e[k] * v[corner, j]
            q = e[j] * v[corner - 1, k] - e[k] * v[corner - 1, j]
            reach = half * (abs(e[j]) + abs(e[k]))
            if min(p, q) > reach or max(p, q) < -reach:
                return True
    normal = np.cross(v[1] - v[0], v[2] - v[0])
    return abs(np.dot(normal, v[0])) > half * np.abs(normal).sum()


@njit(cache=True, nogil=True, error_model="numpy")
def met_cells(corners, shape, half):
    """Return whether each cell (nx, ny, nz) of a grid meets a triangle (m, 3, 3).

    Each cell is replaced by a cube of half edge `half` around its centre.
    """
    met = np.zeros(shape, dtype=np.bool_)
    v = np.empty((3, 3))
    first, last = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for t in range(len(corners)):
        for i in range(3):
            first[i] = max(0, floor(corners[t, :, i].min()) - 1)
            last[i] = min(shape[i] - 1, floor(corners[t, :, i].max()) + 1)
        for x in range(first[0], last[0] + 1):
            for y in range(first[1], last[1] + 1):
                for z in range(first[2], last[2] + 1):
                    if not met[x, y, z]:
                        v[:, 0] = corners[t, :, 0] - (x + 0.5)
                        v[:, 1] = corners[t, :, 1] - (y + 0.5)
                        v[:, 2] = corners[t, :, 2] - (z + 0.5)
                        met[x, y, z] = not _separated(v, half)
    return met
