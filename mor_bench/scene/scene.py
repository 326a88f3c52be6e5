"""A scene: mesh, material, supports, load patches and needs; what every method is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from math import pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.loads import Facets, Patches, cut_patches, spread_out
from mor_bench.scene.materials import Material, make_material
from mor_bench.scene.mesh import Mesh, box_mesh, l_mesh
from mor_bench.scene.regions import Cloud, region_points
from mor_bench.scene.snapshot_file import ImportedArrays, read_arrays
from mor_bench.scene.subdivision import subdivide
from mor_bench.specs import (
    AnyDatasetSpec,
    BoxGeometry,
    DatasetSpec,
    FileGeometry,
    ImportedDatasetSpec,
    LShapeGeometry,
    TetrahedraGeometry,
    VoxelsGeometry,
    generated,
    load_dataset_spec,
)


@dataclass(frozen=True)
class Scene:
    """What is simulated.

    Attributes
    ----------
    spec : DatasetSpec or ImportedDatasetSpec
        The validated dataset file.
    mesh : Mesh
    material : Material or None
        None if the snapshots were imported: then the equations are not known, and there are no patches.
    fixed_nodes : (n_fixed,) int64
        Nodes with u = 0.
    embedded_surface : Facets or None
        The smooth surface that a mesh of voxels is filled from, and that loads act on.
    point_sets : mapping of str to (n,) int64
        Named sets of nodes, of a mesh file.
    """

    spec: AnyDatasetSpec
    mesh: Mesh
    material: Material | None
    fixed_nodes: NDArray[np.int64]
    embedded_surface: Facets | None = field(default=None, repr=False)
    point_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def generated(self) -> DatasetSpec:
        """The spec, if the scene's equations are known; raises `UnsupportedSceneError` if they are not."""
        return generated(self.spec)

    @property
    def selective(self) -> bool:
        """Whether the volumetric part of the energy is taken from the cells' mean gradients."""
        return self.generated.discretisation.integration == "selective"

    @cached_property
    def free_dofs(self) -> NDArray[np.int64]:
        """(n_free,) dof = 3 * node + axis, without those of fixed nodes."""
        fixed = dofs_of_nodes(self.fixed_nodes)
        return np.setdiff1d(np.arange(self.mesh.n_dofs), fixed)

    @cached_property
    def _cloud(self) -> Cloud:
        return Cloud(self.mesh.points, np.unique(self.mesh.boundary_facets), self.point_sets)

    @cached_property
    def output_nodes(self) -> NDArray[np.int64]:
        """(n_output_nodes,) the nodes whose displacements are wanted, sorted; raises `SpecError` if the region holds none."""
        outputs = self.spec.needs.outputs
        return (
            np.arange(self.mesh.n_nodes)
            if outputs == "all"
            else region_points(self._cloud, outputs)
        )

    @cached_property
    def observed_nodes(self) -> NDArray[np.int64] | None:
        """(n_observed,) the nodes whose displacements methods are given, sorted; None where they are given the forces.

        Raises
        ------
        SpecError
            If the region holds no node, none of the surface that is free to move, or every node that is.
        """
        if self.spec.observed is None:
            return None
        region = region_points(self._cloud, self.spec.observed.region)
        free = np.setdiff1d(np.arange(self.mesh.n_nodes), self.fixed_nodes)
        seen = np.intersect1d(np.intersect1d(region, self._cloud.on_surface), free)
        if not len(seen):
            raise SpecError(
                "`observed.region` holds no node that lies on the surface and is free to move."
            )
        if len(seen) == len(free):
            raise SpecError(
                "`observed.region` holds every node that is free to move: nothing is left to be found."
            )
        return seen

    @cached_property
    def surface(self) -> Facets:
        """What loads act on: the mesh's own boundary, or the embedded surface."""
        return self.embedded_surface or Facets(self.mesh.points, self.mesh.boundary_facets)

    @cached_property
    def to_surface(self) -> sp.csr_array:
        """(n_surface_points, n_nodes) takes nodal displacements to the surface's points; its transpose takes forces back."""
        return interpolation_matrix(self.mesh, self.surface.points)

    @cached_property
    def _loaded_points(self) -> NDArray[np.int64]:
        """Numbers of the surface's points in the load region."""
        on_surface, region = np.unique(self.surface.facets), self.generated.loads.region
        found = region_points(
            Cloud(
                self.surface.points, on_surface, {} if self.embedded_surface else self.point_sets
            ),
            region,
        )
        found = np.intersect1d(found, on_surface)
        if not len(found):
            raise SpecError(
                "the load region holds nodes inside the body only, and none of its surface."
            )
        return found

    @cached_property
    def patch_nodes(self) -> NDArray[np.int64]:
        """(n_patches,) the point of the surface at the centre of each load patch; the patch's number is the load-region id.

        On a mesh's own boundary these are numbers of nodes.
        """
        region, loads = self._loaded_points, self.generated.loads
        if loads.n_patches is None:
            return region
        points = self.surface.points[region]
        if len(self.fixed_nodes):
            distance = cKDTree(self.mesh.points[self.fixed_nodes]).query(points)[0]
            region = region[distance > sqrt(loads.patch_area_m2 / pi)]
        if loads.n_patches > len(region):
            raise SpecError(
                f"`n_patches` must be in [1, {len(region)}], the points of the load region that are away from the supports; got {loads.n_patches}."
            )
        return region[spread_out(self.surface.points[region], loads.n_patches)]

    @property
    def patch_centres(self) -> NDArray[np.float64]:
        """(n_patches, 3) m."""
        return self.surface.points[self.patch_nodes]

    @cached_property
    def loaded_facets(self) -> NDArray[np.int64]:
        """(n_facets, 4 or 3) the part of the surface on which patches lie."""
        return self.surface.within(self._loaded_points)

    @cached_property
    def _patches(self) -> Patches:
        return cut_patches(
            self.surface, self.loaded_facets, self.patch_nodes, self.generated.loads.patch_area_m2
        )

    @cached_property
    def patch_normals(self) -> NDArray[np.float64]:
        """(n_patches, 3) outward unit normals, each the mean over its patch."""
        return self._patches.mean_normals()

    def patch_points(self, patches: NDArray[np.int64]) -> tuple[NDArray[np.float64], sp.csr_array]:
        """The traction of some load patches as forces at points of the surface, which is the same on every mesh of the body.

        Parameters
        ----------
        patches : (n,) int
            Numbers of patches.

        Returns
        -------
        points : (n_points, 3) float64
            Positions, m.
        shares : (n, n_points) sparse float64
            Share of the patch's force at each point; rows sum to 1.
        """
        areas = self._patches.areas[patches]
        used = np.unique(areas.indices)
        return self._patches.points[used], _rows_to_one(areas[:, used])

    @cached_property
    def patch_weights(self) -> sp.csr_array:
        """(n_patches, n_nodes) nodal weights of a force on each patch; rows sum to 1.

        The consistent load of a uniform traction; from an embedded surface it goes to the nodes of the cells around it.
        """
        if self.embedded_surface:
            points, shares = self.patch_points(np.arange(len(self.patch_nodes)))
            return _rows_to_one(sp.csr_array(shares @ interpolation_matrix(self.mesh, points)))
        return _rows_to_one(sp.csr_array(self._patches.areas @ self._patches.values))


def _rows_to_one(matrix: sp.csr_array) -> sp.csr_array:
    return sp.csr_array(matrix.multiply(1.0 / matrix.sum(axis=1)[:, None]))


def load_scene(source: str | Path | Mapping[str, Any] | AnyDatasetSpec) -> Scene:
    """Build a scene from a dataset's name, the path of a TOML, a dict with the same keys, or a validated spec.

    Raises
    ------
    SpecError
        If the dataset is unknown or not valid, or a region of it is empty.
    """
    spec = (
        source
        if isinstance(source, DatasetSpec | ImportedDatasetSpec)
        else load_dataset_spec(source)
    )
    try:
        return (
            _build(spec)
            if isinstance(spec, DatasetSpec)
            else imported_scene(spec, read_arrays(spec.snapshots.file))
        )
    except SpecError as error:
        raise SpecError(f"{spec.name}: {error}") from None


def imported_scene(spec: ImportedDatasetSpec, arrays: ImportedArrays) -> Scene:
    """The scene of imported snapshots, of which the mesh and the supports are known and the equations are not."""
    scene = Scene(spec, arrays.mesh, None, arrays.fixed_nodes)
    _ = scene.observed_nodes
    return scene


def with_cells(scene: Scene, cells: tuple[int, int, int]) -> Scene:
    """The same body and supports on another mesh; its load patches are not looked at, and may not exist.

    Parameters
    ----------
    scene : Scene
        Of a box or an L.
    cells : three ints
        Cells per axis.

    Raises
    ------
    UnsupportedSceneError
        If the scene is neither, or has no such mesh.
    """
    geometry = scene.generated.geometry
    name = f"{scene.name} with {' x '.join(map(str, cells))} cells"
    changed: dict[str, Any] = {"cells": cells}
    if isinstance(geometry, LShapeGeometry):
        cut = [
            Fraction(n * new, old)
            for n, new, old in zip(geometry.cut_cells, cells[::2], geometry.cells[::2], strict=True)
        ]
        if any(n.denominator > 1 for n in cut):
            raise UnsupportedSceneError(
                f"{name}: the corner of an L that is cut away must consist of whole cells."
            )
        changed["cut_cells"] = tuple(int(n) for n in cut)
    elif not isinstance(geometry, BoxGeometry):
        raise UnsupportedSceneError(
            f"{scene.name}: only the mesh of a box or an L can be made finer or coarser; got `geometry.shape` {geometry.shape!r}."
        )
    try:
        return _without_patches(
            scene.generated.model_copy(update={"geometry": geometry.model_copy(update=changed)})
        )
    except SpecError as error:
        raise UnsupportedSceneError(f"{name}: {error}") from None


def refined(scene: Scene) -> Scene:
    """The same body and supports on a mesh of eight cells in the place of one; its load patches are not looked at.

    Of an embedded surface's voxels the steps stay as they are.
    """
    geometry = scene.generated.geometry
    if isinstance(geometry, BoxGeometry) and scene.mesh.grid_shape is not None:
        nx, ny, nz = (2 * n for n in geometry.cells)
        return with_cells(scene, (nx, ny, nz))
    mesh, parents = subdivide(scene.mesh)
    fixed = np.isin(parents, scene.fixed_nodes).all(axis=1)
    return replace(scene, mesh=mesh, fixed_nodes=np.flatnonzero(fixed), point_sets={})


@dataclass(frozen=True)
class _Body:
    """What a geometry yields."""

    mesh: Mesh
    surface: Facets | None = None
    point_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)


def _body(spec: DatasetSpec) -> _Body:
    geometry, tetrahedra = spec.geometry, spec.discretisation.element == "tetrahedron"
    if isinstance(geometry, LShapeGeometry):
        return _Body(l_mesh(geometry.size_m, geometry.cells, geometry.cut_cells, tetrahedra))
    if isinstance(geometry, BoxGeometry):
        return _Body(box_mesh(geometry.size_m, geometry.cells, tetrahedra))
    if isinstance(geometry, VoxelsGeometry):
        return _voxels(geometry)
    if isinstance(geometry, TetrahedraGeometry):
        from mor_bench.scene.liver import liver_tetrahedra

        return _Body(liver_tetrahedra())
    return _from_file(geometry)


def _voxels(geometry: VoxelsGeometry) -> _Body:
    from mor_bench.scene.liver import liver_surface
    from mor_bench.scene.surfaces import read_surface
    from mor_bench.scene.voxels import voxel_mesh

    surface = (
        liver_surface()
        if geometry.surface == "liver"
        else read_surface(geometry.surface.checked(), geometry.unit_m)
    )
    return _Body(voxel_mesh(surface, geometry.cells), Facets(surface.points, surface.triangles))


def _from_file(geometry: FileGeometry) -> _Body:
    from mor_bench.scene.files import read_mesh

    mesh, point_sets = read_mesh(geometry.file.checked(), geometry.unit_m)
    return _Body(mesh, point_sets=point_sets)


def _without_patches(spec: DatasetSpec) -> Scene:
    body = _body(spec)
    mesh = body.mesh
    _check_element(spec, mesh)
    cloud = Cloud(mesh.points, np.unique(mesh.boundary_facets), body.point_sets)
    fixed = np.unique(
        np.concatenate(
            [
                np.zeros(0, dtype=np.int64),
                *(region_points(cloud, support.region) for support in spec.supports),
            ]
        )
    )
    if len(fixed) == mesh.n_nodes:
        raise SpecError("the supports fix every node of the mesh: nothing can move.")
    return Scene(spec, mesh, make_material(spec.material), fixed, body.surface, body.point_sets)


def _check_element(spec: DatasetSpec, mesh: Mesh) -> None:
    """The element of a body that is not made here must be that of the file."""
    found = "tetrahedron" if mesh.cells.shape[1] == 4 else "hexahedron"
    if found != spec.discretisation.element:
        raise SpecError(
            f"`discretisation.element` must be {found!r}, as in the mesh; got {spec.discretisation.element!r}."
        )


def _build(spec: DatasetSpec) -> Scene:
    scene = _without_patches(spec)
    # An empty region is an error of the dataset: raised here, not at the first solve.
    _ = scene.patch_weights, scene.output_nodes, scene.observed_nodes
    return scene
