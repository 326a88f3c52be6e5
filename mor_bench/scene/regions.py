"""Regions by name or shape, as sets of points of a body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.nearest import tree_of
from mor_bench.specs import (
    BoxRegion,
    NearestRegion,
    NearSurfaceRegion,
    PlaneRegion,
    PointSetRegion,
    Region,
    SphereRegion,
)

ON_FACE = 1e-9
"""Tolerance of regions, as a fraction of the bounding box's diagonal."""


@dataclass(frozen=True)
class Cloud:
    """The candidate points of regions: the nodes of a mesh, or the points of a surface.

    Attributes
    ----------
    points : (n_points, 3) float64
        Positions, m.
    on_surface : (n,) int64
        Numbers of the points on the surface.
    sets : mapping of str to (n,) int64
        Named sets of a mesh file.
    """

    points: NDArray[np.float64]
    on_surface: NDArray[np.int64]
    sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)


def region_points(cloud: Cloud, region: Region, key: str) -> NDArray[np.int64]:
    """Return the sorted numbers of the points in a region, which a file gives under a key.

    Raises
    ------
    SpecError
        If the region holds no point, or names an unknown set.
    """
    try:
        return np.sort(_some_points(cloud, region))
    except SpecError as error:
        raise SpecError(f"`{key}`: {error}") from None


def _some_points(cloud: Cloud, region: Region) -> NDArray[np.int64]:
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    near = ON_FACE * float(np.linalg.norm(high - low))
    if isinstance(region, PointSetRegion):
        found = _in_set(cloud, region)
    elif isinstance(region, NearestRegion):
        found = _nearest(cloud, region)
    elif isinstance(region, NearSurfaceRegion):
        found = _near_surface(cloud, region, near)
    elif region == "surface":
        found = cloud.on_surface
    else:
        found = np.flatnonzero(_inside(cloud.points, region, near))
    if not len(found):
        shown: object = region
        if not isinstance(region, str):
            shown = region.model_dump(exclude={"near_surface": {"sha256"}})
        raise SpecError(
            f"region {shown} holds no node of the mesh; the mesh extends from "
            f"{low.tolist()} to {high.tolist()} m."
        )
    return found


def _inside(points: NDArray[np.float64], region: Region, near: float) -> NDArray[np.bool_]:
    if isinstance(region, BoxRegion):
        low, high = np.array(region.box_m)
        return np.asarray(((points >= low - near) & (points <= high + near)).all(axis=1))
    if isinstance(region, SphereRegion):
        centre, radius = region.sphere_m
        distance = np.linalg.norm(points - np.array(centre), axis=1)
        return np.asarray(distance <= radius + near)
    if isinstance(region, PlaneRegion):
        point, normal = (np.array(vector) for vector in region.plane_m)
        normal = normal / np.abs(normal).max()
        distance = np.abs((points - point) @ (normal / np.linalg.norm(normal)))
        return np.asarray(distance <= (region.within_m or near))
    assert isinstance(region, str)
    x = points[:, "xyz".index(region[0])]
    bound = x.min() if region.endswith("min") else x.max()
    return np.asarray(np.abs(x - bound) <= near)


def _in_set(cloud: Cloud, region: PointSetRegion) -> NDArray[np.int64]:
    if region.point_set not in cloud.sets:
        known = (
            ", ".join(cloud.sets)
            or "none; only mesh files, tubes and chambered boxes have point sets"
        )
        raise SpecError(f"unknown point set {region.point_set!r}. Known: {known}.")
    return np.unique(cloud.sets[region.point_set])


def _nearest(cloud: Cloud, region: NearestRegion) -> NDArray[np.int64]:
    point, n = region.nearest_m
    if n > len(cloud.on_surface):
        raise SpecError(
            f"`nearest_m` must ask for at most {len(cloud.on_surface)} nodes, the number "
            f"of nodes on the surface; got {n}."
        )
    tree = tree_of(cloud.points[cloud.on_surface])
    return np.asarray(cloud.on_surface[tree.query(point, k=[*range(1, n + 1)])[1]])


def _near_surface(cloud: Cloud, region: NearSurfaceRegion, near: float) -> NDArray[np.int64]:
    from mor_bench.scene.files import read_triangles
    from mor_bench.scene.triangle_distance import distances

    corners = read_triangles(region.near_surface.checked(), region.unit_m)
    found = distances(corners, cloud.points[cloud.on_surface]) <= region.within_m + near
    return np.asarray(cloud.on_surface[found])
