"""A scene: mesh, material, supports, load patches and needs. Every method is given a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.scene.body import build_body
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.loads import Facets, Patches, cut_patches, pressed_patches, spread_out
from mor_bench.scene.materials import Material, make_material
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.observed_regions import moved_nodes, observed_nodes
from mor_bench.scene.regions import Cloud, region_points
from mor_bench.scene.snapshot_file import ImportedArrays, read_arrays
from mor_bench.scene.springs import Springs, foundations
from mor_bench.specs import (
    AXES,
    AnyDatasetSpec,
    DatasetSpec,
    ImportedDatasetSpec,
    Motion,
    Pressure,
    Region,
    generated,
    load_dataset_spec,
)


@dataclass(frozen=True)
class Scene:
    """A body with its material, supports, loads and needs.

    Attributes
    ----------
    spec : DatasetSpec or ImportedDatasetSpec
        The validated dataset file.
    mesh : Mesh
    material : Material or None
        None for imported snapshots, whose equations are unknown. Such a scene has no patches.
    fixed_nodes : (n_fixed,) int64
        Nodes with u = 0.
    held_dofs : (n_held,) int64
        Components of other nodes with u = 0, as on rollers and planes of symmetry.
    embedded_surface : Facets or None
        The smooth surface from which a mesh of voxels was made. Loads act on it.
    point_sets : mapping of str to (n,) int64
        Named sets of nodes from a mesh file.
    springs : tuple of Springs
        Foundations.
    memo : dict of str to float64
        Arrays that are computed once for a scene, such as its rest state under gravity.
    """

    spec: AnyDatasetSpec
    mesh: Mesh
    material: Material | None
    fixed_nodes: NDArray[np.int64]
    held_dofs: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    embedded_surface: Facets | None = field(default=None, repr=False)
    point_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict, repr=False)

    springs: tuple[Springs, ...] = field(default=(), repr=False)
    memo: dict[str, NDArray[np.float64]] = field(
        init=False, default_factory=dict, repr=False, compare=False
    )

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def generated(self) -> DatasetSpec:
        """The spec of a scene with known equations; `UnsupportedSceneError` for any other."""
        return generated(self.spec)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """The names of the sampled parameters; empty if samples differ in their loads only."""
        table = self.spec.parameters if isinstance(self.spec, DatasetSpec) else None
        return () if table is None else table.names

    @property
    def selective(self) -> bool:
        """True if the volumetric energy is computed from the cells' mean gradients."""
        return self.generated.discretisation.integration == "selective"

    @cached_property
    def free_dofs(self) -> NDArray[np.int64]:
        """(n_free,) dofs, 3 * node + axis, that no support holds."""
        return np.setdiff1d(np.arange(self.mesh.n_dofs), self.fixed_dofs)

    @property
    def fixed_dofs(self) -> NDArray[np.int64]:
        """Sorted dofs with u = 0: those of the fixed nodes, and the held ones."""
        return np.union1d(dofs_of_nodes(self.fixed_nodes), self.held_dofs)

    @cached_property
    def spring_matrix(self) -> sp.csr_array | None:
        """(n_dofs, n_dofs) stiffness of the springs, N/m; None without springs."""
        matrices = [springs.matrix(self.mesh) for springs in self.springs]
        return sp.csr_array(sum(matrices[1:], matrices[0])) if matrices else None

    @cached_property
    def _cloud(self) -> Cloud:
        return Cloud(self.mesh.points, np.unique(self.mesh.boundary_facets), self.point_sets)

    @cached_property
    def output_nodes(self) -> NDArray[np.int64]:
        """(n_output_nodes,) sorted nodes with wanted displacements; `SpecError` if none."""
        outputs = self.spec.needs.outputs
        if outputs == "all":
            return np.arange(self.mesh.n_nodes)
        return region_points(self._cloud, outputs)

    @cached_property
    def observed_nodes(self) -> NDArray[np.int64] | None:
        """(n_observed,) sorted nodes with given displacements; None if forces are given.

        Raises
        ------
        SpecError
            If the region has no free node of the surface, or contains every free node; or if a
            moved region has a node of a support.
        """
        if self.motion:
            return moved_nodes(self._cloud, self.motion, self.fixed_dofs)
        if self.spec.observed is None:
            return None
        return observed_nodes(self._cloud, self.spec.observed, self.fixed_nodes)

    @property
    def motion(self) -> Motion | None:
        """The plan of prescribed displacements; None if the scene has another or no plan."""
        return self.spec.motion if isinstance(self.spec, DatasetSpec) else None

    @cached_property
    def surface(self) -> Facets:
        """The loaded surface: the embedded surface, or else the mesh's boundary."""
        return self.embedded_surface or Facets(self.mesh.points, self.mesh.boundary_facets)

    @cached_property
    def to_surface(self) -> sp.csr_array:
        """(n_surface_points, n_nodes) map of nodal displacements to the surface's points.

        Its transpose maps forces back.
        """
        return interpolation_matrix(self.mesh, self.surface.points)

    @property
    def pressure(self) -> Pressure | None:
        """The plan of pressures; None if the scene has another or no plan."""
        loads = self.spec.loads if isinstance(self.spec, DatasetSpec) else None
        return loads if isinstance(loads, Pressure) else None

    @property
    def follows(self) -> bool:
        """True if the scene's pressures follow the deformed surface."""
        return self.pressure is not None and self.pressure.follower

    @property
    def pressed_facets(self) -> list[NDArray[np.int64]]:
        """The facets (n_facets, 4 or 3) of each region of a pressure."""
        if self.pressure is None:
            raise UnsupportedSceneError(f"{self.name}: no pressure acts on it.")
        return [self.surface.within(self._surface_points(r)) for r in self.pressure.regions]

    @cached_property
    def _loaded_points(self) -> NDArray[np.int64]:
        plan = self.generated.load_plan
        regions = plan.regions if isinstance(plan, Pressure) else (plan.region,)
        return np.unique(np.concatenate([self._surface_points(region) for region in regions]))

    def _surface_points(self, region: Region) -> NDArray[np.int64]:
        on_surface = np.unique(self.surface.facets)
        sets = {} if self.embedded_surface else self.point_sets
        cloud = Cloud(self.surface.points, on_surface, sets)
        found = np.intersect1d(region_points(cloud, region), on_surface)
        if not len(found):
            raise SpecError(
                "the load region holds nodes inside the body only, none on its surface."
            )
        return found

    @cached_property
    def patch_nodes(self) -> NDArray[np.int64]:
        """(n_patches,) surface point at the centre of each load patch.

        The index of a patch here is its load-region id. On a mesh's own boundary the points are
        nodes. A moved tool counts as one patch, at one of its nodes; a pressure as three, at the
        middle of its region.
        """
        loads = self.generated.load_plan
        if isinstance(loads, Pressure):
            regions = [self._surface_points(region) for region in loads.regions]
            middles = [self.surface.points[region].mean(axis=0) for region in regions]
            return np.repeat(np.concatenate([self._surface_point(m) for m in middles]), 3)
        if isinstance(loads, Motion):
            assert self.observed_nodes is not None
            points = self.mesh.points[self.observed_nodes]
            middle = np.linalg.norm(points - points.mean(axis=0), axis=1).argmin()
            return self._surface_point(points[middle])
        region = self._loaded_points
        if loads.n_patches is None:
            return region
        points = self.surface.points[region]
        if len(self.fixed_nodes):
            distance = cKDTree(self.mesh.points[self.fixed_nodes]).query(points)[0]
            region = region[distance > sqrt(loads.patch_area_m2 / pi)]
        if loads.n_patches > len(region):
            raise SpecError(
                f"`n_patches` must be in [1, {len(region)}], the number of points of the load "
                f"region away from the supports; got {loads.n_patches}."
            )
        return region[spread_out(self.surface.points[region], loads.n_patches)]

    def _surface_point(self, position: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.array([np.linalg.norm(self.surface.points - position, axis=1).argmin()])

    @property
    def patch_centres(self) -> NDArray[np.float64]:
        """(n_patches, 3) positions of the patches' centres, m."""
        return self.surface.points[self.patch_nodes]

    @cached_property
    def loaded_facets(self) -> NDArray[np.int64]:
        """(n_facets, 4 or 3) facets on which patches may lie."""
        return self.surface.within(self._loaded_points)

    @cached_property
    def patches(self) -> Patches:
        """The load patches as points of the surface with areas."""
        plan = self.generated.load_plan
        if isinstance(plan, Motion):
            raise UnsupportedSceneError(f"{self.name}: a tool moves the body; it has no patches.")
        if isinstance(plan, Pressure):
            return pressed_patches(self.surface, self.pressed_facets)
        return cut_patches(self.surface, self.loaded_facets, self.patch_nodes, plan.patch_area_m2)

    @cached_property
    def patch_normals(self) -> NDArray[np.float64]:
        """(n_patches, 3) outward unit normals, each the mean over its patch."""
        return self.patches.mean_normals()

    def patch_points(self, patches: NDArray[np.int64]) -> tuple[NDArray[np.float64], sp.csr_array]:
        """Return the tractions of patches as forces at surface points, the same on every mesh.

        Parameters
        ----------
        patches : (n,) int
            Numbers of patches.

        Returns
        -------
        points : (n_points, 3) float64
            Positions, m.
        shares : (n, n_points) sparse float64
            Share of the patch's force at each point; rows sum to 1. Of a pressure: the component
            of the area vector at each point, m².
        """
        areas = self.patches.areas[patches]
        used = np.unique(areas.indices)
        return self.patches.points[used], self._weights(areas[:, used])

    def _weights(self, areas: sp.csr_array) -> sp.csr_array:
        """Return the weights of patches from their areas: shares, or those of a pressure."""
        return areas if self.pressure else _rows_to_one(areas)

    @cached_property
    def patch_weights(self) -> sp.csr_array:
        """(n_patches, n_nodes) nodal weights of a force on each patch; rows sum to 1.

        They are the consistent load of a uniform traction. An embedded surface passes it to the
        nodes of the surrounding cells. For a moved tool they are 1 at each of its nodes. For a
        pressure they are components of area vectors, m².
        """
        if self.motion:
            assert self.observed_nodes is not None
            columns = self.observed_nodes, np.array([0, len(self.observed_nodes)])
            moved = np.ones(len(self.observed_nodes)), *columns
            return sp.csr_array(moved, shape=(1, self.mesh.n_nodes))
        if self.embedded_surface:
            points, shares = self.patch_points(np.arange(len(self.patch_nodes)))
            return self._weights(sp.csr_array(shares @ interpolation_matrix(self.mesh, points)))
        return self._weights(sp.csr_array(self.patches.areas @ self.patches.values))

    def prepare(self) -> Scene:
        """Find all regions now, so empty regions raise one `SpecError` here; return the scene."""
        sampled = isinstance(self.spec, DatasetSpec) and self.spec.loads is not None
        problems = []
        if self.follows and self.embedded_surface:
            problems.append(
                "`loads.follower` must be false where loads act on a smooth surface that the mesh "
                "only contains."
            )
        for name in (*(("patch_weights",) if sampled else ()), "output_nodes", "observed_nodes"):
            try:
                getattr(self, name)
            except SpecError as problem:
                problems.append(str(problem))
        if problems:
            raise SpecError(" ".join(problems))
        return self


def _rows_to_one(matrix: sp.csr_array) -> sp.csr_array:
    return sp.csr_array(matrix.multiply(1.0 / matrix.sum(axis=1)[:, None]))


def as_spec(source: str | Path | Mapping[str, Any] | AnyDatasetSpec) -> AnyDatasetSpec:
    """Return the spec of a dataset, given by name, path, dict or spec."""
    if isinstance(source, DatasetSpec | ImportedDatasetSpec):
        return source
    return load_dataset_spec(source)


def load_scene(source: str | Path | Mapping[str, Any] | AnyDatasetSpec) -> Scene:
    """Build a scene.

    Parameters
    ----------
    source : str, Path, dict, DatasetSpec or ImportedDatasetSpec
        Name of a dataset in the suite, path of a TOML, a dict with the same keys, or a spec.

    Raises
    ------
    SpecError
        If the dataset is unknown or not valid, or one of its regions is empty.
    """
    spec = as_spec(source)
    try:
        if isinstance(spec, DatasetSpec):
            return scene_without_patches(spec).prepare()
        return imported_scene(spec, read_arrays(spec.snapshots.file))
    except SpecError as error:
        raise SpecError(f"{spec.name}: {error}") from None


def imported_scene(spec: ImportedDatasetSpec, arrays: ImportedArrays) -> Scene:
    """Return the scene of imported snapshots: mesh and supports, but no equations."""
    return Scene(spec, arrays.mesh, None, arrays.fixed_nodes).prepare()


def scene_without_patches(spec: DatasetSpec) -> Scene:
    """Build a scene without searching its load region."""
    mesh, surface, point_sets = build_body(spec)
    element = "tetrahedron" if mesh.cells.shape[1] == 4 else "hexahedron"
    if element != spec.discretisation.element:
        raise SpecError(
            f"`discretisation.element` must be {element!r}, as in the mesh; "
            f"got {spec.discretisation.element!r}."
        )
    cloud = Cloud(mesh.points, np.unique(mesh.boundary_facets), point_sets)
    still = np.zeros((mesh.n_nodes, 3), dtype=bool)
    for support in spec.supports:
        nodes = region_points(cloud, support.region)
        still[nodes[:, None], [AXES.index(axis) for axis in support.components]] = True
    if still.all():
        raise SpecError("the supports fix every node of the mesh: nothing can move.")
    material, held = make_material(spec.material), by_node(still)
    springs = foundations(spec, surface or Facets(mesh.points, mesh.boundary_facets), point_sets)
    return Scene(spec, mesh, material, *held, surface, point_sets, springs)


def by_node(still: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return nodes without a free component, and held dofs of the others, from (n_nodes, 3)."""
    fixed = np.all(still, axis=1, keepdims=True)
    return np.flatnonzero(fixed), np.flatnonzero(still & ~fixed)
