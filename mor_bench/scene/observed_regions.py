"""Nodes of the surface whose displacements are observed, or prescribed by a tool."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.regions import Cloud, region_points
from mor_bench.specs import Motion, Observed

Nodes = NDArray[np.int64]


def observed_nodes(cloud: Cloud, observed: Observed, fixed_nodes: Nodes) -> Nodes:
    """Return the sorted free nodes of the surface in an observed region.

    Raises
    ------
    SpecError
        If there is none, or the region contains every free node.
    """
    free = np.setdiff1d(np.arange(len(cloud.points)), fixed_nodes)
    region = region_points(cloud, observed.region, "observed.region")
    seen = np.intersect1d(np.intersect1d(region, cloud.on_surface), free)
    if not len(seen):
        raise SpecError(
            "`observed.region` holds no node that lies on the surface and is free to move."
        )
    if len(seen) == len(free):
        raise SpecError(
            "`observed.region` holds every node that is free to move: no displacement "
            "is left to compute."
        )
    return seen


def moved_nodes(cloud: Cloud, motion: Motion, fixed_dofs: Nodes) -> Nodes:
    """Return the sorted nodes of the surface that a tool holds.

    Raises
    ------
    SpecError
        If there is none, if one of them is supported, or if no free node is left.
    """
    region = region_points(cloud, motion.region, "loads.region")
    moved = np.intersect1d(region, cloud.on_surface)
    if not len(moved):
        raise SpecError("`loads.region` holds no node of the surface, so no tool can move it.")
    supported, components = np.unique(fixed_dofs // 3, return_counts=True)
    if n_still := len(np.intersect1d(moved, supported)):
        raise SpecError(
            f"`loads.region` of a moved tool must be apart from all supports; {n_still} of its "
            f"{len(moved)} nodes are supported."
        )
    if len(moved) + np.count_nonzero(components == 3) == len(cloud.points):
        raise SpecError("`loads.region` holds every free node: nothing is left to compute.")
    return moved
