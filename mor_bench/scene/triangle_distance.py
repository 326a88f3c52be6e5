"""Kernel for the distance from points to triangles."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, inline="always")
def _minus(u, v):
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


@njit(cache=True, inline="always")
def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True, inline="always")
def _cross(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True, inline="always")
def _to_segment(p, a, b):
    """Squared distance from p to a segment (Ericson, Real-Time Collision Detection, 5.1.2)."""
    d, q = _minus(b, a), _minus(p, a)
    length = _dot(d, d)
    # A segment of zero length is a point.
    t = min(max(_dot(q, d) / length, 0.0), 1.0) if length > 0.0 else 0.0
    r = q[0] - t * d[0], q[1] - t * d[1], q[2] - t * d[2]
    return _dot(r, r)


@njit(cache=True, inline="always")
def _side(p, a, b, normal):
    """Return whether p lies on the inner side of the edge a-b of a triangle."""
    return _dot(_cross(_minus(b, a), _minus(p, a)), normal) >= 0.0


@njit(cache=True)
def _distances(corners, points, out):
    for i in range(len(points)):
        p = points[i, 0], points[i, 1], points[i, 2]
        least = np.inf
        for k in range(len(corners)):
            a = corners[k, 0, 0], corners[k, 0, 1], corners[k, 0, 2]
            b = corners[k, 1, 0], corners[k, 1, 1], corners[k, 1, 2]
            c = corners[k, 2, 0], corners[k, 2, 1], corners[k, 2, 2]
            normal = _cross(_minus(b, a), _minus(c, a))
            size = _dot(normal, normal)
            inner = _side(p, a, b, normal) and _side(p, b, c, normal) and _side(p, c, a, normal)
            if size > 0.0 and inner:
                height = _dot(_minus(p, a), normal)
                least = min(least, height * height / size)
            else:
                edges = min(_to_segment(p, a, b), _to_segment(p, b, c), _to_segment(p, c, a))
                least = min(least, edges)
        out[i] = sqrt(least)


def distances(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance (n,) of points (n, 3) from the nearest triangle (m, 3, 3).

    If the prism over a triangle contains a point, the nearest point is in the triangle's interior.
    Otherwise it is on an edge. A triangle without area counts as its edges.
    """
    out = np.empty(len(points))
    _distances(
        np.ascontiguousarray(corners, dtype=np.float64),
        np.ascontiguousarray(points, dtype=np.float64),
        out,
    )
    return out
