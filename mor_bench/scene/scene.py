"""A scene: mesh, material, supports, load patches and needs. Every method is given a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.scene.acting import Acting, Ground, acting_on, points_of, weights_of
from mor_bench.scene.body import build_body
from mor_bench.scene.constant_pressures import HeldPressure, held_pressures
from mor_bench.scene.contact_surface import ContactSurface, contact_surface, touched_nodes
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.loads import Facets
from mor_bench.scene.materials import Material, make_material
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.observed_regions import moved_nodes, observed_nodes
from mor_bench.scene.problems import Problems
from mor_bench.scene.regions import Cloud, region_points
from mor_bench.scene.second_order import in_elements
from mor_bench.scene.snapshot_file import ImportedArrays, read_arrays
from mor_bench.scene.springs import Springs, foundations, matrix_of
from mor_bench.scene.supports import NOTHING_HELD, Frames, held_by
from mor_bench.specs import (
    AnyDatasetSpec,
    Contact,
    DatasetSpec,
    ImportedDatasetSpec,
    Motion,
    Pressure,
    as_spec,
    generated,
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
    frames : Frames or None
        Axes of the nodes with oblique supports. Along the first of them, u = 0.
    embedded_surface : Facets or None
        The smooth surface from which a mesh of voxels was made. Loads act on it.
    point_sets : mapping of str to (n,) int64
        Named sets of nodes from a mesh file.
    springs : tuple of Springs
        Foundations.
    constant_pressures : tuple of HeldPressure
        Pressures that are part of the pre-load.
    memo : dict of str to float64
        Arrays that are computed once for a scene, such as its rest state.

    Examples
    --------
    >>> scene = load_scene("beam-tiny")
    >>> scene.spec.material.law, len(scene.fixed_nodes), len(scene.patch_nodes)
    ('saint-venant-kirchhoff', 9, 21)
    """

    spec: AnyDatasetSpec
    mesh: Mesh
    material: Material | None
    fixed_nodes: NDArray[np.int64]
    held_dofs: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    frames: Frames | None = field(default=None, kw_only=True)
    embedded_surface: Facets | None = None
    point_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    springs: tuple[Springs, ...] = ()
    constant_pressures: tuple[HeldPressure, ...] = ()
    memo: dict[str, NDArray[np.float64]] = field(init=False, default_factory=dict, compare=False)

    def __repr__(self) -> str:
        return f"<Scene {self.name}: {self.mesh.n_nodes} nodes, {self.mesh.n_cells} cells>"

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
        """(n_free,) dofs, 3 * node + axis, that no support holds.

        The axes are x, y and z, or those of the node's frame.
        """
        free = np.setdiff1d(np.arange(self.mesh.n_dofs), self.fixed_dofs)
        return free if self.frames is None else np.setdiff1d(free, self.frames.held_dofs)

    @property
    def fixed_dofs(self) -> NDArray[np.int64]:
        """Sorted dofs along x, y and z with u = 0: those of the fixed nodes, and the held ones."""
        return np.union1d(dofs_of_nodes(self.fixed_nodes), self.held_dofs)

    def at_free_dofs(self, fields: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return nodal vectors (n, n_dofs), along x, y and z, at the free dofs, (n, n_free)."""
        if self.frames is not None:
            fields = self.frames.to_local(fields)
        return fields[:, self.free_dofs]

    def at_all_dofs(self, free: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return nodal vectors (n, n_dofs), along x, y and z, from (n, n_free); 0 at supports."""
        fields = np.zeros((len(free), self.mesh.n_dofs))
        fields[:, self.free_dofs] = free
        return fields if self.frames is None else self.frames.to_global(fields)

    def columns_at_all_dofs(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return columns (n_dofs, m), along x, y and z, from (n_free, m); 0 at supports."""
        return np.ascontiguousarray(self.at_all_dofs(columns.T).T)

    def hold(self, fields: NDArray[np.float64]) -> None:
        """Remove what supports hold from displacements (n, n_dofs), m, in place."""
        fields[:, self.fixed_dofs] = 0.0
        if self.frames is not None:
            local = self.frames.to_local(fields)
            local[:, self.frames.held_dofs] = 0.0
            fields[:] = self.frames.to_global(local)

    @cached_property
    def spring_matrix(self) -> sp.csr_array | None:
        """(n_dofs, n_dofs) stiffness of the springs, N/m; None without springs."""
        return matrix_of(self.springs, self.mesh)

    @cached_property
    def _cloud(self) -> Cloud:
        return Cloud(self.mesh.points, np.unique(self.mesh.boundary_facets), self.point_sets)

    @cached_property
    def output_nodes(self) -> NDArray[np.int64]:
        """(n_output_nodes,) sorted nodes with wanted displacements; `SpecError` if none."""
        outputs = self.spec.needs.outputs
        if outputs == "all":
            return np.arange(self.mesh.n_nodes)
        return region_points(self._cloud, outputs, "needs.outputs")

    @cached_property
    def observed_nodes(self) -> NDArray[np.int64] | None:
        """(n_observed,) sorted nodes with given displacements; None if forces are given.

        Where an instrument presses, its displacement is given at the nodes that it may touch.

        Raises
        ------
        SpecError
            If the region has no free node of the surface, or contains every free node; if a moved
            region has a node of a support; or for problems of an instrument.
        """
        if self.contact:
            return touched_nodes(self.contact, self.contact_surface, self.fixed_dofs)
        if self.motion:
            return moved_nodes(self._cloud, self.motion, self.fixed_dofs)
        if self.spec.observed is None:
            return None
        return observed_nodes(self._cloud, self.spec.observed, self.fixed_nodes)

    @property
    def motion(self) -> Motion | None:
        """The plan of prescribed displacements; None if the scene has another or no plan."""
        return self.spec.motion if isinstance(self.spec, DatasetSpec) else None

    @property
    def contact(self) -> Contact | None:
        """The plan of an instrument that presses; None if the scene has another or no plan."""
        loads = self.spec.loads if isinstance(self.spec, DatasetSpec) else None
        return loads if isinstance(loads, Contact) else None

    @cached_property
    def contact_surface(self) -> ContactSurface:
        """The surface that an instrument may touch; `SpecError` for problems of the instrument."""
        if self.contact is None or self.material is None:
            raise UnsupportedSceneError(f"{self.name}: no instrument presses it.")
        young, facets = self.material.young_at_rest, self.loaded_facets
        return contact_surface(self.contact, self.surface, facets, self.mesh, young)

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
        """The plan of pressures; None if the scene has another, several or no plan."""
        loads = self.spec.loads if isinstance(self.spec, DatasetSpec) else None
        return loads if isinstance(loads, Pressure) else None

    @property
    def follows(self) -> bool:
        """True if the scene's pressures follow the deformed surface."""
        return self.pressure is not None and self.pressure.follower

    @cached_property
    def acting(self) -> tuple[Acting, ...]:
        """The loads of each table `[loads]`; `SpecError` if there is none."""
        ground = Ground(
            self.mesh,
            self.surface,
            self.embedded_surface is not None,
            self.point_sets,
            self.fixed_nodes,
            self.observed_nodes if self.motion else None,
        )
        return acting_on(ground, self.generated.load_plan)

    @property
    def pressed_facets(self) -> list[NDArray[np.int64]]:
        """The facets (n_facets, 4, 3 or 6) of each region of a pressure."""
        if self.pressure is None:
            raise UnsupportedSceneError(f"{self.name}: no pressure acts on it.")
        return self.acting[0].pressed_facets

    @cached_property
    def patch_nodes(self) -> NDArray[np.int64]:
        """(n_patches,) surface point at the centre of each load patch.

        The index of a patch is its load-region id. On a mesh's own boundary the points are nodes.
        A moved tool counts as one patch, at one of its nodes; a pressure as three, at the
        middle of its region; a line as one, at the point nearest to its middle; an instrument as
        one, at the point nearest to it. The patches of several tables follow one another.
        """
        if self.contact:
            return self.acting[0].nearest(self.contact_surface.nearest)
        return np.concatenate([acting.nodes for acting in self.acting])

    @property
    def patch_centres(self) -> NDArray[np.float64]:
        """(n_patches, 3) positions of the patches' centres, m."""
        return self.surface.points[self.patch_nodes]

    @property
    def patch_normals(self) -> NDArray[np.float64]:
        """(n_patches, 3) outward unit normals, each the mean over its patch."""
        return np.concatenate([acting.normals for acting in self.acting])

    @cached_property
    def loaded_facets(self) -> NDArray[np.int64]:
        """(n_facets, 4, 3 or 6) facets on which patches may lie."""
        return np.concatenate([acting.facets for acting in self.acting])

    @cached_property
    def patch_scales(self) -> NDArray[np.float64]:
        """(n_patches,) largest load of each patch, relative to the largest of all tables."""
        ends = np.array([np.abs(acting.plan.magnitude).max() for acting in self.acting])
        numbers = [1] if self.contact else [len(acting.nodes) for acting in self.acting]
        return np.repeat(ends / ends.max(), numbers)

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
        return points_of(self.acting, patches)

    @cached_property
    def patch_weights(self) -> sp.csr_array:
        """(n_patches, n_nodes) nodal weights of a force on each patch; rows sum to 1.

        They are the consistent load of a uniform traction. An embedded surface passes it to the
        nodes of the surrounding cells. For a tool they are 1 at each of its nodes, for an
        instrument at each that it may touch. For a pressure they are components of areas, m².
        """
        if self.generated.loads is None:
            return sp.csr_array((0, self.mesh.n_nodes))
        if self.contact:
            touched = np.zeros((1, self.mesh.n_nodes))
            touched[:, self.observed_nodes] = 1.0
            return sp.csr_array(touched)
        return weights_of(self.acting)

    def prepare(self) -> Scene:
        """Find all regions now, so empty regions raise one `SpecError` here; return the scene."""
        loaded = ("patch_weights",) if isinstance(self.spec, DatasetSpec) else ()
        with Problems() as problems:
            for name in (*loaded, "output_nodes", "observed_nodes"):
                with problems.keep():
                    getattr(self, name)
        return self


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

    Examples
    --------
    >>> scene = load_scene("beam-tiny")
    >>> scene.name, scene.mesh.n_nodes
    ('beam-tiny', 63)
    """
    spec = as_spec(source)
    try:
        if isinstance(spec, DatasetSpec):
            with Problems() as problems:
                scene = _with_supports(spec, problems)
                with problems.keep():
                    scene.prepare()
            return scene
        return imported_scene(spec, read_arrays(spec.snapshots.file))
    except SpecError as error:
        raise SpecError(f"{spec.name}: {error}") from None


def imported_scene(spec: ImportedDatasetSpec, arrays: ImportedArrays) -> Scene:
    """Return the scene of imported snapshots: mesh and supports, but no equations."""
    return Scene(spec, arrays.mesh, None, arrays.fixed_nodes).prepare()


def scene_without_patches(spec: DatasetSpec) -> Scene:
    """Build a scene without searching its load region."""
    with Problems() as problems:
        return _with_supports(spec, problems)


def _with_supports(spec: DatasetSpec, problems: Problems) -> Scene:
    """Build the same scene, but leave out supports and such with errors, which are kept."""
    mesh, surface, point_sets = build_body(spec)
    mesh, point_sets = in_elements(spec, mesh, point_sets)
    cloud = Cloud(mesh.points, np.unique(mesh.boundary_facets), point_sets)
    held = NOTHING_HELD
    springs: tuple[Springs, ...] = ()
    pressures: tuple[HeldPressure, ...] = ()
    smooth = surface or Facets(mesh.points, mesh.boundary_facets)
    with problems.keep():
        held = held_by(spec.supports, cloud)
    with problems.keep():
        springs = foundations(spec, smooth, point_sets)
    with problems.keep():
        pressures = held_pressures(spec, smooth, point_sets, embedded=surface is not None)
    return Scene(
        spec,
        mesh,
        make_material(spec.material),
        held.fixed_nodes,
        held.held_dofs,
        surface,
        point_sets,
        springs,
        pressures,
        frames=held.frames,
    )
