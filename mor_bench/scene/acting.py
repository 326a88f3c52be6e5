"""The loads of one table of a dataset file on the body: where they act, and their nodal weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi, sqrt

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import OutsideMeshError, SpecError, UnsupportedSceneError
from mor_bench.scene.interpolation import interpolation_matrix, rows_to_one
from mor_bench.scene.loads import (
    Facets,
    Patches,
    cut_patches,
    line_patches,
    point_patches,
    pressed_patches,
    spread_out,
)
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.nearest import tree_of
from mor_bench.scene.problems import Problems
from mor_bench.scene.regions import Cloud, region_points
from mor_bench.specs import (
    AnyLoads,
    AnyTable,
    Contact,
    LineLoads,
    Loads,
    Motion,
    PointLoads,
    Pressure,
    Region,
    tables_of,
)


@dataclass(frozen=True)
class Ground:
    """The body that loads act on.

    Attributes
    ----------
    mesh : Mesh
    surface : Facets
        The mesh's boundary, or a smooth surface inside the mesh.
    embedded : bool
        Whether it is such a smooth surface.
    point_sets : mapping of str to (n,) int64
    fixed_nodes : (n_fixed,) int64
    tool_nodes : (n_moved,) int64, optional
        The nodes that a tool moves.
    """

    mesh: Mesh
    surface: Facets
    embedded: bool
    point_sets: Mapping[str, NDArray[np.int64]]
    fixed_nodes: NDArray[np.int64]
    tool_nodes: NDArray[np.int64] | None


HELD = "holds fixed nodes only, which no force can move."


@dataclass(frozen=True)
class Acting:
    """The patches of one table `[loads]`.

    A patch is an area, a point, a line, one component of a pressed region, or a tool. The key is
    that of the table in the file.
    """

    plan: AnyTable
    ground: Ground
    key: str

    def _surface_points(self, region: Region, key: str) -> NDArray[np.int64]:
        """Return the sorted points of the surface in a region; `SpecError` if none."""
        surface = self.ground.surface
        on_surface = np.unique(surface.facets)
        sets = {} if self.ground.embedded else self.ground.point_sets
        cloud = Cloud(surface.points, on_surface, sets)
        found = np.intersect1d(region_points(cloud, region, key), on_surface)
        if not len(found):
            raise SpecError(f"`{key}` holds nodes inside the body only, none on its surface.")
        if isinstance(self.plan, Pressure) and not len(surface.within(found)):
            raise SpecError(
                f"`{key}` holds nodes but no facet of the surface, so no pressure can act on it."
            )
        return found

    @cached_property
    def _regions(self) -> list[NDArray[np.int64]]:
        """The points of the surface in each region; `SpecError` for all regions without any."""
        plan, key, found = self.plan, self.key, []
        assert not isinstance(plan, LineLoads)
        keyed = (
            {f"{key}.region": plan.region}
            if not isinstance(plan, Pressure)
            else {f"{key}.regions[{number}]": region for number, region in enumerate(plan.regions)}
        )
        with Problems() as problems:
            if isinstance(plan, Pressure) and plan.follower and self.ground.embedded:
                problems.found.append(
                    "`loads.follower` must be false where loads act on a smooth surface that the "
                    "mesh only contains."
                )
            for name, region in keyed.items():
                with problems.keep():
                    points = self._surface_points(region, name)
                    exact = isinstance(plan, Pressure | PointLoads) and not self.ground.embedded
                    if exact and np.isin(points, self.ground.fixed_nodes).all():
                        raise SpecError(f"`{name}` {HELD}")
                    found.append(points)
        return found

    @cached_property
    def _loaded_points(self) -> NDArray[np.int64]:
        return np.unique(np.concatenate(self._regions))

    @cached_property
    def nodes(self) -> NDArray[np.int64]:
        """(n_patches,) surface point at the centre of each patch, see `Scene.patch_nodes`."""
        plan, surface = self.plan, self.ground.surface
        if isinstance(plan, Pressure):
            middles = [surface.points[region].mean(axis=0) for region in self._regions]
            return np.repeat(np.concatenate([self.nearest(m) for m in middles]), 3)
        if isinstance(plan, Motion):
            assert self.ground.tool_nodes is not None
            points = self.ground.mesh.points[self.ground.tool_nodes]
            middle = np.linalg.norm(points - points.mean(axis=0), axis=1).argmin()
            return self.nearest(points[middle])
        if isinstance(plan, LineLoads):
            return np.concatenate([self.nearest(np.mean(ends, axis=0)) for ends in plan.lines])
        assert not isinstance(plan, Contact)  # see `Scene.patch_nodes`
        region = self._loaded_points
        if isinstance(plan, PointLoads) and not self.ground.embedded:
            region = np.setdiff1d(region, self.ground.fixed_nodes)
        if plan.n_patches is None:
            return region
        points = surface.points[region]
        if isinstance(plan, Loads) and len(self.ground.fixed_nodes):
            fixed = self.ground.mesh.points[self.ground.fixed_nodes]
            distance = tree_of(fixed).query(points)[0]
            region = region[distance > sqrt(plan.patch_area_m2 / pi)]
        if plan.n_patches > len(region):
            raise SpecError(
                f"`n_patches` must be in [1, {len(region)}], the number of points of the load "
                f"region away from the supports; got {plan.n_patches}."
            )
        return region[spread_out(surface.points[region], plan.n_patches)]

    def nearest(self, position: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the surface point nearest to a position (3,), m, as an array (1,)."""
        return np.array([np.linalg.norm(self.ground.surface.points - position, axis=1).argmin()])

    @property
    def centres(self) -> NDArray[np.float64]:
        """(n_patches, 3) positions of the patches' centres, m."""
        return self.ground.surface.points[self.nodes]

    @cached_property
    def facets(self) -> NDArray[np.int64]:
        """(n_facets, 4, 3 or 6) facets on which patches may lie."""
        if isinstance(self.plan, LineLoads):
            return self.ground.surface.facets[:0]
        return self.ground.surface.within(self._loaded_points)

    @property
    def pressed_facets(self) -> list[NDArray[np.int64]]:
        """The facets (n_facets, 4, 3 or 6) of each region of a pressure."""
        assert isinstance(self.plan, Pressure)
        return [self.ground.surface.within(region) for region in self._regions]

    @cached_property
    def patches(self) -> Patches:
        """The patches as points with areas."""
        plan, surface = self.plan, self.ground.surface
        if isinstance(plan, Motion | Contact):
            raise UnsupportedSceneError("a tool moves the body; it has no patches.")
        if isinstance(plan, Pressure):
            return pressed_patches(surface, self.pressed_facets)
        if isinstance(plan, PointLoads):
            return point_patches(surface, self.nodes)
        if isinstance(plan, LineLoads):
            return line_patches(plan.lines)
        return cut_patches(surface, self.facets, self.nodes, plan.patch_area_m2)

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """(n_patches, 3) outward unit normals, each the mean over its patch."""
        return self.patches.mean_normals()

    def points(self, patches: NDArray[np.int64]) -> tuple[NDArray[np.float64], sp.csr_array]:
        """Return the tractions of some patches as forces at points, see `Scene.patch_points`."""
        found = self.patches
        if isinstance(self.plan, Pressure) and not self.ground.embedded:
            found = pressed_patches(self.ground.surface, self.pressed_facets, fine=True)
        areas = found.areas[patches]
        used = np.unique(areas.indices)
        return found.points[used], self._weights(areas[:, used])

    def _weights(self, areas: sp.csr_array) -> sp.csr_array:
        """Return the weights of patches from their areas: shares, or those of a pressure."""
        return areas if isinstance(self.plan, Pressure) else rows_to_one(areas)

    @cached_property
    def weights(self) -> sp.csr_array:
        """(n_patches, n_nodes) nodal weights of the patches, see `Scene.patch_weights`."""
        mesh = self.ground.mesh
        if isinstance(self.plan, Motion):
            assert self.ground.tool_nodes is not None
            columns = self.ground.tool_nodes, np.array([0, len(self.ground.tool_nodes)])
            moved = np.ones(len(self.ground.tool_nodes)), *columns
            return sp.csr_array(moved, shape=(1, mesh.n_nodes))
        if self.ground.embedded or isinstance(self.plan, LineLoads):
            points, shares = self.points(np.arange(len(self.nodes)))
            try:
                at_nodes = interpolation_matrix(mesh, points)
            except OutsideMeshError as error:
                if not isinstance(self.plan, LineLoads):
                    raise
                raise SpecError(f"`loads.lines` must lie in the body: {error}") from None
            found = sp.csr_array(shares @ at_nodes)
            if isinstance(self.plan, LineLoads):
                for number in range(len(self.nodes)):
                    row: sp.csr_array = found[[number]]
                    if np.isin(row.indices[row.data != 0], self.ground.fixed_nodes).all():
                        raise SpecError(f"`{self.key}.lines[{number}]` {HELD}")
            return self._weights(found)
        return self._weights(sp.csr_array(self.patches.areas @ self.patches.values))


def acting_on(ground: Ground, loads: AnyLoads) -> tuple[Acting, ...]:
    """Return the loads of each table of a plan on a body."""
    tables = tables_of(loads)
    if len(tables) == 1:
        return (Acting(tables[0], ground, "loads"),)
    return tuple(Acting(table, ground, f"loads[{k}]") for k, table in enumerate(tables))


def weights_of(acting: Sequence[Acting]) -> sp.csr_array:
    """Return the nodal weights of all patches, see `Scene.patch_weights`."""
    parts = []
    with Problems() as problems:
        for table in acting:
            with problems.keep():
                parts.append(table.weights)
    return parts[0] if len(parts) == 1 else sp.csr_array(sp.vstack(parts))


def points_of(
    acting: Sequence[Acting], patches: NDArray[np.int64]
) -> tuple[NDArray[np.float64], sp.csr_array]:
    """Return the tractions of patches of several tables, see `Scene.patch_points`."""
    if len(acting) == 1:
        return acting[0].points(patches)
    ends = np.cumsum([len(table.nodes) for table in acting])
    number = np.searchsorted(ends, patches, side="right")
    rows = [np.flatnonzero(number == k) for k in range(len(ends))]
    parts = [
        table.points(patches[own] - (ends[k - 1] if k else 0))
        for k, (table, own) in enumerate(zip(acting, rows, strict=True))
    ]
    shares = sp.csr_array(sp.block_diag([shares for _, shares in parts]))
    order = np.argsort(np.concatenate(rows))
    return np.concatenate([points for points, _ in parts]), shares[order]
