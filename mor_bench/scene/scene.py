"""A scene: mesh, material, supports, load patches and needs; what every method is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.scene.loads import patch_shares, patch_weights
from mor_bench.scene.materials import Material, make_material
from mor_bench.scene.mesh import Mesh, box_mesh, l_mesh
from mor_bench.scene.regions import region_facets, region_nodes
from mor_bench.specs import DatasetSpec, LShapeGeometry, load_dataset_spec


@dataclass(frozen=True)
class Scene:
    """What is simulated.

    Attributes
    ----------
    spec : DatasetSpec
        The validated dataset file.
    mesh : Mesh
    material : Material
    fixed_nodes : (n_fixed,) int64
        Nodes with u = 0.
    """

    spec: DatasetSpec
    mesh: Mesh
    material: Material
    fixed_nodes: NDArray[np.int64]

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def selective(self) -> bool:
        """Whether the volumetric part of the energy is taken from the cells' mean gradients."""
        return self.spec.discretisation.integration == "selective"

    @cached_property
    def free_dofs(self) -> NDArray[np.int64]:
        """(n_free,) dof = 3 * node + axis, without those of fixed nodes."""
        fixed = (3 * self.fixed_nodes[:, None] + np.arange(3)).ravel()
        return np.setdiff1d(np.arange(self.mesh.n_dofs), fixed)

    @cached_property
    def patch_nodes(self) -> NDArray[np.int64]:
        """(n_patches,) the node at the centre of each load patch; the patch's number is the load-region id."""
        return region_nodes(self.mesh, self.spec.loads.region)

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
        facets = region_facets(self.mesh, self.patch_nodes)
        areas, points, _ = patch_shares(self.mesh, self.patch_nodes[patches], facets, self.spec.loads.patch_area_m2)
        used = np.unique(areas.indices)
        shares = areas[:, used]
        return points[used], sp.csr_array(shares.multiply(1.0 / shares.sum(axis=1)[:, None]))

    @cached_property
    def patch_weights(self) -> sp.csr_array:
        """(n_patches, n_nodes) nodal weights of a force on each patch; rows sum to 1."""
        facets = region_facets(self.mesh, self.patch_nodes)
        return patch_weights(self.mesh, self.patch_nodes, facets, self.spec.loads.patch_area_m2)


def load_scene(source: str | Path | Mapping[str, Any] | DatasetSpec) -> Scene:
    """Build a scene from a dataset's name, the path of a TOML, a dict with the same keys, or a validated spec.

    Raises
    ------
    SpecError
        If the dataset is unknown or not valid, or a region of it is empty.
    """
    spec = source if isinstance(source, DatasetSpec) else load_dataset_spec(source)
    try:
        return _build(spec)
    except SpecError as error:
        raise SpecError(f"{spec.name}: {error}") from None


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
    geometry = scene.spec.geometry
    name = f"{scene.name} with {' x '.join(map(str, cells))} cells"
    changed: dict[str, Any] = {"cells": cells}
    if isinstance(geometry, LShapeGeometry):
        cut = [Fraction(n * new, old) for n, new, old in zip(geometry.cut_cells, cells[::2], geometry.cells[::2], strict=True)]
        if any(n.denominator > 1 for n in cut):
            raise UnsupportedSceneError(f"{name}: the corner of an L that is cut away must consist of whole cells.")
        changed["cut_cells"] = tuple(int(n) for n in cut)
    elif geometry.shape != "box":
        raise UnsupportedSceneError(
            f"{scene.name}: only the mesh of a box or an L can be made finer or coarser; got `geometry.shape` {geometry.shape!r}."
        )
    try:
        return _without_patches(scene.spec.model_copy(update={"geometry": geometry.model_copy(update=changed)}))
    except SpecError as error:
        raise UnsupportedSceneError(f"{name}: {error}") from None


def _mesh(spec: DatasetSpec) -> Mesh:
    geometry, tetrahedra = spec.geometry, spec.discretisation.element == "tetrahedron"
    if isinstance(geometry, LShapeGeometry):
        return l_mesh(geometry.size_m, geometry.cells, geometry.cut_cells, tetrahedra)
    return box_mesh(geometry.size_m, geometry.cells, tetrahedra)


def _without_patches(spec: DatasetSpec) -> Scene:
    mesh = _mesh(spec)
    material = make_material(spec.material)
    fixed = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(region_nodes(mesh, support.region) for support in spec.supports)]))
    if len(fixed) == mesh.n_nodes:
        raise SpecError("the supports fix every node of the mesh: nothing can move.")
    return Scene(spec, mesh, material, fixed)


def _build(spec: DatasetSpec) -> Scene:
    scene = _without_patches(spec)
    _ = scene.patch_weights  # an empty load region is an error of the dataset: raised here, not at the first solve
    return scene
