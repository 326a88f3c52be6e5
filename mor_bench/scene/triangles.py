"""Kernels on triangles: the winding number of a triangulated surface, and the cells of a grid that its triangles meet.

A grid's cells are unit cubes here, with cell (i, j, k) from (i, j, k) to (i + 1, j + 1, k + 1).
"""

from __future__ import annotations

from math import atan2, floor, pi, sqrt

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def winding_numbers(corners, points):
    """Generalised winding number (n,) of triangles (m, 3, 3) around points (n, 3); for a closed surface the 1 or 0 of in or out.

    It sums the solid angles of the triangles, each by van Oosterom & Strackee (1983), eq. 8: tan(Ω/2) is
    a·(b × c) / (|a||b||c| + (a·b)|c| + (b·c)|a| + (c·a)|b|). No ray is cast, so no ray can hit an edge; see Jacobson,
    Kavan & Sorkine-Hornung (2013).
    """
    windings = np.empty(len(points))
    for n in range(len(points)):
        half_angles = 0.0
        for t in range(len(corners)):
            ax, ay, az = (
                corners[t, 0, 0] - points[n, 0],
                corners[t, 0, 1] - points[n, 1],
                corners[t, 0, 2] - points[n, 2],
            )
            bx, by, bz = (
                corners[t, 1, 0] - points[n, 0],
                corners[t, 1, 1] - points[n, 1],
                corners[t, 1, 2] - points[n, 2],
            )
            cx, cy, cz = (
                corners[t, 2, 0] - points[n, 0],
                corners[t, 2, 1] - points[n, 1],
                corners[t, 2, 2] - points[n, 2],
            )
            a, b, c = (
                sqrt(ax * ax + ay * ay + az * az),
                sqrt(bx * bx + by * by + bz * bz),
                sqrt(cx * cx + cy * cy + cz * cz),
            )
            triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            ab, bc, ca = (
                ax * bx + ay * by + az * bz,
                bx * cx + by * cy + bz * cz,
                cx * ax + cy * ay + cz * az,
            )
            half_angles += atan2(triple, a * b * c + ab * c + bc * a + ca * b)
        windings[n] = half_angles / (2 * pi)
    return windings


@njit(inline="always")
def _separated(v, half):
    """Whether an axis separates a triangle (3, 3) from the cube of half-edge `half` around the origin.

    The thirteen axes of Akenine-Möller (2001): three of the cube, nine crossed with the triangle's edges, its normal.
    """
    for i in range(3):
        if min(v[0, i], v[1, i], v[2, i]) > half or max(v[0, i], v[1, i], v[2, i]) < -half:
            return True
    for corner in range(3):
        e = v[(corner + 1) % 3] - v[corner]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            p, q = (
                e[j] * v[corner, k] - e[k] * v[corner, j],
                e[j] * v[corner - 1, k] - e[k] * v[corner - 1, j],
            )
            if min(p, q) > half * (abs(e[j]) + abs(e[k])) or max(p, q) < -half * (
                abs(e[j]) + abs(e[k])
            ):
                return True
    normal = np.cross(v[1] - v[0], v[2] - v[0])
    return abs(np.dot(normal, v[0])) > half * np.abs(normal).sum()


@njit(cache=True, nogil=True, error_model="numpy")
def met_cells(corners, shape, half):
    """Which cells of a grid (nx, ny, nz) the triangles (m, 3, 3) meet, where each cell is a cube of half-edge `half` about its centre."""
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
                        v[:, 0], v[:, 1], v[:, 2] = (
                            corners[t, :, 0] - (x + 0.5),
                            corners[t, :, 1] - (y + 0.5),
                            corners[t, :, 2] - (z + 0.5),
                        )
                        met[x, y, z] = not _separated(v, half)
    return met
