"""Irregular meshes made from boxes, and samples on one of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import mor_bench
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import load_dataset_spec


def irregular_box(
    size_m: tuple[float, float, float],
    cells: tuple[int, int, int],
    tetrahedra: bool,
    jitter: float = 0.25,
    seed: int = 0,
) -> Mesh:
    """Return a box with nodes in random order, moved by up to ``jitter`` cells; faces stay flat."""
    generator = np.random.default_rng(seed)
    box = box_mesh(size_m, cells, tetrahedra)
    free = (box.points > box.bounds[0]) & (box.points < box.bounds[1])
    moves = generator.uniform(-jitter, jitter, box.points.shape) * np.divide(size_m, cells) * free
    order = generator.permutation(box.n_nodes)
    return Mesh((box.points + moves)[order], np.argsort(order)[box.cells])


def irregular_samples(n: int) -> Snapshots:
    """Solve beam-tiny on irregular tetrahedra."""
    spec = load_dataset_spec("beam-tiny").model_dump(mode="json", exclude_none=True)
    scene = load_scene({**spec, "discretisation": {"element": "tetrahedron"}})
    mesh = irregular_box((2.0, 1.0, 1.0), (6, 2, 2), tetrahedra=True)
    scene = replace(scene, mesh=mesh, fixed_nodes=np.flatnonzero(mesh.points[:, 0] == 0))
    loads = draw_loads(scene, 0, n)
    forces = loads.nodal_forces(scene.patch_weights)
    displacements = mor_bench.load_method("fem", tolerance=1e-4).fit(scene, None).predict(forces)
    free = displacements.reshape(n, -1)[:, scene.free_dofs]
    return Snapshots(scene, loads, free, np.ones(n))
