"""Regions by name or shape: a face of the bounding box, the surface, a box, a sphere, what is nearest to a point or a surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mor_bench.errors import SpecError
from mor_bench.specs import (
    BoxRegion,
    NearestRegion,
    NearSurfaceRegion,
    PointSetRegion,
    Region,
    SphereRegion,
)

ON_FACE = 1e-9
"""How far from a face of the bounding box a point may lie, as a fraction of the box's diagonal."""


@dataclass(frozen=True)
class Cloud:
    """The points among which regions are sought: the nodes of a mesh, or the points of a surface.

    Attributes
    ----------
    points : (n_points, 3) float64
        m.
    on_surface : (n,) int64
        Numbers of the points that lie on the surface.
    sets : mapping of str to (n,) int64
        Named sets that a mesh file came with.
    """

    points: NDArray[np.float64]
    on_surface: NDArray[np.int64]
    sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)


def region_points(cloud: Cloud, region: Region) -> NDArray[np.int64]:
    """Numbers of the points in a region, sorted.

    Raises
    ------
    SpecError
        If the region holds no point, or names a set that there is not.
    """
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    near = ON_FACE * float(np.linalg.norm(high - low))
    if isinstance(region, PointSetRegion):
        found = _of_set(cloud, region)
    elif isinstance(region, NearestRegion):
        found = _nearest(cloud, region)
    elif isinstance(region, NearSurfaceRegion):
        found = _near_surface(cloud, region, near)
    elif region == "surface":
        found = cloud.on_surface
    else:
        found = np.flatnonzero(_inside(cloud.points, region, low, high, near))
    if not len(found):
        shown = (
            region
            if isinstance(region, str)
            else region.model_dump(exclude={"near_surface": {"sha256"}})
        )
        raise SpecError(
            f"region {shown} holds no node of the mesh, whose bounds are {low.tolist()} to {high.tolist()} m."
        )
    return np.sort(found)


def _inside(
    points: NDArray[np.float64],
    region: Region,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    near: float,
) -> NDArray[np.bool_]:
    if isinstance(region, BoxRegion):
        return np.asarray(
            np.all(
                (points >= np.array(region.box_m[0]) - near)
                & (points <= np.array(region.box_m[1]) + near),
                axis=1,
            )
        )
    if isinstance(region, SphereRegion):
        return np.asarray(
            np.linalg.norm(points - np.array(region.sphere_m[0]), axis=1)
            <= region.sphere_m[1] + near
        )
    assert isinstance(region, str)
    axis = "xyz".index(region[0])
    bound = low if region.endswith("min") else high
    return np.asarray(np.abs(points[:, axis] - bound[axis]) <= near)


def _of_set(cloud: Cloud, region: PointSetRegion) -> NDArray[np.int64]:
    if region.point_set not in cloud.sets:
        known = ", ".join(cloud.sets) or "none, since only a mesh file has them"
        raise SpecError(f"unknown point set {region.point_set!r}. Known: {known}.")
    return np.unique(cloud.sets[region.point_set])


def _nearest(cloud: Cloud, region: NearestRegion) -> NDArray[np.int64]:
    point, n = region.nearest_m
    if n > len(cloud.on_surface):
        raise SpecError(
            f"`nearest_m` must ask for at most {len(cloud.on_surface)} nodes, all of the surface; got {n}."
        )
    return np.asarray(
        cloud.on_surface[
            cKDTree(cloud.points[cloud.on_surface]).query(point, k=[*range(1, n + 1)])[1]
        ]
    )


def _near_surface(cloud: Cloud, region: NearSurfaceRegion, near: float) -> NDArray[np.int64]:
    from mor_bench.scene.files import read_triangles
    from mor_bench.scene.triangle_distance import distances

    corners = read_triangles(region.near_surface.checked(), region.unit_m)
    return np.asarray(
        cloud.on_surface[
            distances(corners, cloud.points[cloud.on_surface]) <= region.within_m + near
        ]
    )
