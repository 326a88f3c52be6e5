"""Kernel for the distance from points to triangles."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, inline="always")
def _dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@njit(cache=True, inline="always")
def _to_segment(px, py, pz, ax, ay, az, bx, by, bz):
    """Squared distance from p to a segment (Ericson, Real-Time Collision Detection, 5.1.2)."""
    dx, dy, dz = bx - ax, by - ay, bz - az
    length = _dot(dx, dy, dz, dx, dy, dz)
    t = _dot(px - ax, py - ay, pz - az, dx, dy, dz)
    # A segment of zero length is a point.
    t = min(max(t / length, 0.0), 1.0) if length > 0.0 else 0.0
    rx, ry, rz = px - ax - t * dx, py - ay - t * dy, pz - az - t * dz
    return _dot(rx, ry, rz, rx, ry, rz)


@njit(cache=True, inline="always")
def _side(px, py, pz, a, b, nx, ny, nz):
    """Whether p lies on the inner side of the edge a-b of a triangle with normal n."""
    ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    qx, qy, qz = px - a[0], py - a[1], pz - a[2]
    return _dot(ey * qz - ez * qy, ez * qx - ex * qz, ex * qy - ey * qx, nx, ny, nz) >= 0.0


@njit(cache=True)
def _distances(corners, points, out):
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        least = np.inf
        for k in range(len(corners)):
            a, b, c = corners[k, 0], corners[k, 1], corners[k, 2]
            ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            size = _dot(nx, ny, nz, nx, ny, nz)
            if (
                size > 0.0
                and _side(px, py, pz, a, b, nx, ny, nz)
                and _side(px, py, pz, b, c, nx, ny, nz)
                and _side(px, py, pz, c, a, nx, ny, nz)
            ):
                height = _dot(px - a[0], py - a[1], pz - a[2], nx, ny, nz)
                least = min(least, height * height / size)
            else:
                least = min(
                    least,
                    _to_segment(px, py, pz, a[0], a[1], a[2], b[0], b[1], b[2]),
                    _to_segment(px, py, pz, b[0], b[1], b[2], c[0], c[1], c[2]),
                    _to_segment(px, py, pz, c[0], c[1], c[2], a[0], a[1], a[2]),
                )
        out[i] = sqrt(least)


def distances(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance (n,) of points (n, 3) from the nearest triangle (m, 3, 3).

    The nearest point of a triangle is in its interior if the prism over it contains the point, and
    otherwise on an edge. A triangle without area counts as its edges.
    """
    out = np.empty(len(points))
    _distances(
        np.ascontiguousarray(corners, dtype=np.float64),
        np.ascontiguousarray(points, dtype=np.float64),
        out,
    )
    return out
