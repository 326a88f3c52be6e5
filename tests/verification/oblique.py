"""A block on planes of symmetry, and the same block in a position where they are oblique."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.pressed import full_order_model
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.regions import Cloud
from mor_bench.scene.scene import Scene
from mor_bench.scene.supports import held_by
from mor_bench.specs import DatasetSpec, PointSetRegion, Support

Array = NDArray[np.float64]
TIGHT = NewtonOptions(1e-12)
ANGLE = pi / 6
TURN = np.array([[cos(ANGLE), -sin(ANGLE), 0.0], [sin(ANGLE), cos(ANGLE), 0.0], [0.0, 0.0, 1.0]])
TILT = np.array([[1.0, 0.0, 0.0], [0.0, cos(0.4), -sin(0.4)], [0.0, sin(0.4), cos(0.4)]])
ROTATION = TILT @ TURN
"""A rotation about two axes, so that no plane of the turned block stays across an axis."""
PLANES = [{"region": f"{axis}-min", "components": [axis]} for axis in "xyz"]
SPEC: dict[str, Any] = {
    "name": "block",
    "title": "Block on planes of symmetry",
    "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [4, 2, 2]},
    "material": material_table("neo-hookean", 500.0, 0.4),
    "supports": PLANES,
    "loads": {
        "region": "x-max",
        "kind": "force",
        "patch_area_m2": 0.3,
        "samples_per_patch": 4,
        "magnitude_n": [5.0, 40.0],
    },
}


def turned(scene: Scene, rotation: Array = ROTATION) -> Scene:
    """Return the same block in another position, on oblique planes of symmetry."""
    mesh = Mesh(scene.mesh.points @ rotation.T, scene.mesh.cells)
    sets = {f"{a}": np.flatnonzero(scene.mesh.points[:, k] == 0.0) for k, a in enumerate("xyz")}
    cloud = Cloud(mesh.points, np.unique(mesh.boundary_facets), sets)
    supports = [
        Support(region=PointSetRegion(point_set=a), direction=tuple((7.0 * normal).tolist()))
        for a, normal in zip("xyz", rotation.T, strict=True)
    ]
    held = held_by(supports, cloud)
    assert held.frames is not None
    assert len(held.fixed_nodes) == 1
    matrix = np.kron(np.eye(mesh.n_nodes), rotation)
    content = scene.generated.model_dump(mode="json")
    end = {"plane_m": [(rotation @ [2.0, 0.0, 0.0]).tolist(), rotation[:, 0].tolist()]}
    content["loads"]["region"] = end
    if "observed" in content:
        content["observed"]["region"] = end
    springs: Any = ()
    if scene.spring_matrix is not None:
        springs = (_Turned(matrix @ scene.spring_matrix.toarray() @ matrix.T),)
    return replace(
        scene,
        spec=DatasetSpec.model_validate(content),
        mesh=mesh,
        fixed_nodes=held.fixed_nodes,
        held_dofs=held.held_dofs,
        frames=held.frames,
        springs=springs,
    )


class _Turned:
    """Springs given by their matrix."""

    def __init__(self, matrix: Array) -> None:
        self._matrix = matrix

    def matrix(self, mesh: Mesh) -> csr_array:
        return csr_array(self._matrix)


def loads(scene: Scene, n: int = 1, size: float = 30.0) -> Array:
    """Return forces (n, n_nodes, 3), N, on patches."""
    vectors = np.random.default_rng(3).normal(size=(n, 3))
    vectors *= size / np.linalg.norm(vectors, axis=1)[:, None]
    on_nodes = scene.patch_weights.toarray()[np.arange(n) % len(scene.patch_nodes)]
    return np.asarray(on_nodes[:, :, None] * vectors[:, None])


def solved(scene: Scene, forces: Array, solver: Any = None) -> Array:
    """Return displacements (n, n_nodes, 3), m."""
    values = scene.at_free_dofs(forces.reshape(len(forces), -1))
    found = full_order_model(scene, solver).solve_many(values, TIGHT)
    return scene.at_all_dofs(np.array([one.displacement for one in found])).reshape(forces.shape)  # type: ignore[union-attr]
