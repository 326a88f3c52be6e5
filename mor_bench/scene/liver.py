"""The suite's liver: a smooth body with two lobes, defined by an equation, for any mesh size.

Two ellipsoids, a large right lobe and a flat left lobe, are blended. A third ellipsoid between them
is cut out. Each ellipsoid has a quadratic form q = |A(x - c)|² - 1, which is negative inside. The
softened minimum is min_k(q) = -log Σ exp(-k q) / k. The body is where
max_k(min_k(q_right, q_left), -q_notch) < 0. This function and its surface are smooth everywhere.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mor_bench.scene.mesh import Mesh
from mor_bench.scene.surfaces import Surface
from mor_bench.scene.tetrahedra import tetrahedral_mesh

_UNIT_M = 0.0101966
"""Unit of the lengths below, m. It makes the body 0.2 m long."""

_ELLIPSOIDS = np.array(
    [
        [-5.89, 0.81, -0.16, 5.77, 5.13, 3.12, 8.42, 1.26, 17.52],
        [6.6, -0.09, 0.6, 8.33, 3.55, 2.4, 10.52, -2.03, -6.45],
        [1.05, -5.38, -2.55, 2.0, 3.19, 4.21, 2.05, 2.15, -18.29],
    ]
)
"""Right lobe, left lobe and notch: centre, semi-axes, and rotations about x, y and z in degrees."""

_POSE = np.array([-28.36, -26.55, -38.02])
"""Rotations of the whole body about x, y and z, degrees."""

_SHARPNESS = 1.5
"""k of the blends. Larger values give sharper blends."""

_BOUNDS = np.array([[-0.13] * 3, [0.13] * 3])
_SURFACE_SPACING_M = 0.0092


def liver_level(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a smooth function of positions (n, 3), m: negative inside, 0 on the surface.

    It has no unit and is not a distance.
    """
    pose = Rotation.from_euler("xyz", _POSE, degrees=True).as_matrix()
    own = points / _UNIT_M @ pose
    turns = Rotation.from_euler("xyz", _ELLIPSOIDS[:, 6:], degrees=True).as_matrix()
    right, left, notch = (
        (((own - ellipsoid[:3]) @ turn / ellipsoid[3:6]) ** 2).sum(axis=1) - 1
        for ellipsoid, turn in zip(_ELLIPSOIDS, turns, strict=True)
    )
    lobes = -np.logaddexp(-_SHARPNESS * right, -_SHARPNESS * left) / _SHARPNESS
    return np.asarray(np.logaddexp(_SHARPNESS * lobes, -_SHARPNESS * notch) / _SHARPNESS)


@lru_cache(maxsize=1)
def liver_surface() -> Surface:
    """Return the closed surface of the liver, 0.2 m long along x.

    It is the boundary of a mesh of finer tetrahedra without slivers. Its vertices lie on the level
    set to round-off. A grid of 15 x 14 x 15 cells gives 726 H8 and 1,118 nodes; U-Mesh's liver has
    732 and 1,109.
    """
    mesh = tetrahedral_mesh(liver_level, _BOUNDS, _SURFACE_SPACING_M)
    used, number = np.unique(mesh.boundary_facets, return_inverse=True)
    return Surface(mesh.points[used], number.reshape(-1, 3))


@lru_cache(maxsize=1)
def liver_tetrahedra(spacing_m: float) -> Mesh:
    """Return the liver in T4 cells made from cubes with an edge of this length, m.

    0.013 m gives 4,567 cells with 1,118 nodes. U-Mesh's liver has 4,859 and 1,059.
    """
    return tetrahedral_mesh(liver_level, _BOUNDS, spacing_m)
