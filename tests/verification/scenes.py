"""Scenes with further laws and elements, loads on them, and checks of solutions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import SolverError
from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import discretisation_of
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.sampling import draw_loads

from .laws_and_elements import discretisation

Array = NDArray[np.float64]


def scene_of(
    law: str, kind: tuple[str, bool], poisson: float = 0.4, base: str = "beam-tiny"
) -> Scene:
    """Return a shipped scene with another law, element and Poisson's ratio."""
    spec = mor_bench.load_scene(base).spec.model_dump(mode="json")
    return load_scene(
        {
            **spec,
            "discretisation": discretisation(kind),
            "material": material_table(law, 500.0, poisson),
        }
    )


def patch_load(scene: Scene, patch: int, force: list[float]) -> Array:
    """Return a force, N, on a patch, over the free dofs."""
    on_nodes = scene.patch_weights.toarray()[patch][:, None] * np.array(force)
    return np.asarray(on_nodes.ravel()[scene.free_dofs])


def reactions(scene: Scene, forces: Array, u: Array) -> Array:
    """Return the supports' forces on the body, (n_nodes, 3) N, under forces and displacements."""
    n_dofs = scene.mesh.n_dofs
    body = Assembler(discretisation_of(scene), np.arange(n_dofs).reshape(-1, 3), n_dofs)
    return np.asarray(body.force(u.ravel()).force.reshape(-1, 3) - forces)


def relative_residual(model: FullOrderModel, load: Array, u: Array) -> float:
    """Return the norm of the residual, relative to that of the load."""
    return float(np.linalg.norm(load - model.force(u).force) / np.linalg.norm(load))


def solved(scene: Scene, n: int) -> Snapshots:
    """Return samples of a scene that no dataset holds."""
    loads = draw_loads(scene, 0, n)
    found = FullOrderModel(scene).solve_many(
        loads.nodal_forces(scene.patch_weights).reshape(n, -1)[:, scene.free_dofs]
    )
    answers = [answer for answer in found if not isinstance(answer, SolverError)]
    assert len(answers) == n
    displacements = np.array([answer.displacement for answer in answers])
    return Snapshots(scene, loads, displacements, np.array([a.min_det_f for a in answers]))
