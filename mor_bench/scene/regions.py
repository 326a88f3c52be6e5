"""Regions of a mesh by name or shape: a face of the bounding box, the surface, a box, a sphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.mesh import Mesh
from mor_bench.specs import BoxRegion, Region, SphereRegion

ON_FACE = 1e-9
"""How far from a face of the bounding box a node may lie, as a fraction of the box's diagonal."""


def region_nodes(mesh: Mesh, region: Region) -> NDArray[np.int64]:
    """Numbers of the nodes in a region, sorted.

    Raises
    ------
    SpecError
        If the region holds no node.
    """
    low, high = mesh.bounds
    near = ON_FACE * float(np.linalg.norm(high - low))
    if isinstance(region, BoxRegion):
        inside = np.all((mesh.points >= np.array(region.box_m[0]) - near) & (mesh.points <= np.array(region.box_m[1]) + near), axis=1)
    elif isinstance(region, SphereRegion):
        centre, radius = region.sphere_m
        inside = np.linalg.norm(mesh.points - np.array(centre), axis=1) <= radius + near
    elif region == "surface":
        inside = np.zeros(mesh.n_nodes, dtype=bool)
        inside[mesh.boundary_facets] = True
    else:
        axis = "xyz".index(region[0])
        bound = low if region.endswith("min") else high
        inside = np.abs(mesh.points[:, axis] - bound[axis]) <= near
    if not inside.any():
        shown = region if isinstance(region, str) else region.model_dump()
        raise SpecError(f"region {shown} holds no node of the mesh, whose bounds are {low.tolist()} to {high.tolist()} m.")
    return np.flatnonzero(inside)


def region_facets(mesh: Mesh, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n_facets, 4 or 3) boundary facets all of whose nodes are among ``nodes``."""
    inside = np.zeros(mesh.n_nodes, dtype=bool)
    inside[nodes] = True
    facets = mesh.boundary_facets
    return facets[inside[facets].all(axis=1)]
