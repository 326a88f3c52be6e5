"""The mesh of a geometry, with its embedded surface and named sets of nodes."""

from __future__ import annotations

from collections.abc import Mapping
from math import radians

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.loads import Facets
from mor_bench.scene.mesh import Mesh, box_mesh, chambered_mesh, l_mesh
from mor_bench.specs import (
    BoxGeometry,
    ChamberedGeometry,
    DatasetSpec,
    LShapeGeometry,
    TetrahedraGeometry,
    TubeGeometry,
    VoxelsGeometry,
)


def build_body(
    spec: DatasetSpec,
) -> tuple[Mesh, Facets | None, Mapping[str, NDArray[np.int64]]]:
    """Return mesh, embedded surface and named sets of nodes of a geometry.

    Readers and mesh generators are imported on demand, because their import is slow.
    """
    geometry, tetrahedra = spec.geometry, spec.discretisation.element == "tetrahedron"
    if isinstance(geometry, LShapeGeometry):
        return l_mesh(geometry.size_m, geometry.cells, geometry.cut_cells, tetrahedra), None, {}
    if isinstance(geometry, ChamberedGeometry):
        mesh, sets = chambered_mesh(geometry.size_m, geometry.cells, geometry.chambers, tetrahedra)
        return mesh, None, sets
    if isinstance(geometry, BoxGeometry):
        return box_mesh(geometry.size_m, geometry.cells, tetrahedra), None, {}
    if isinstance(geometry, TubeGeometry):
        from mor_bench.scene.tube import tube_mesh

        mesh, sets = tube_mesh(
            geometry.radii_m, geometry.length_m, radians(geometry.angle_deg), geometry.cells
        )
        return mesh, None, sets
    if isinstance(geometry, VoxelsGeometry):
        from mor_bench.scene.liver import liver_surface
        from mor_bench.scene.surfaces import read_surface
        from mor_bench.scene.voxels import voxel_mesh

        if geometry.surface == "liver":
            surface = liver_surface()
        else:
            surface = read_surface(geometry.surface.checked(), geometry.unit_m)
        mesh = voxel_mesh(surface, geometry.cells)
        return mesh, Facets(surface.points, surface.triangles), {}
    if isinstance(geometry, TetrahedraGeometry):
        from mor_bench.scene.liver import liver_tetrahedra

        return liver_tetrahedra(geometry.spacing_m), None, {}
    from mor_bench.scene.files import read_mesh

    mesh, point_sets = read_mesh(geometry.file.checked(), geometry.unit_m)
    return mesh, None, point_sets
