"""A test set that is generated after all fits, so no method can be tuned to it."""

from __future__ import annotations

import numpy as np

from mor_bench.errors import SolverError
from mor_bench.mechanics.moved_bodies import generator_of
from mor_bench.mechanics.newton import Solution
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.sampling import draw_loads, n_samples_of, path_of_samples
from mor_bench.snapshots.split import split_samples
from mor_bench.specs import DatasetSpec, SplitBy, with_seed

MAX_FRESH = 400
"""Largest number of samples. One process solves them while the run waits."""


def fresh_test_set(spec: DatasetSpec, scene: Scene, by: SplitBy, seed: int, n: int) -> Snapshots:
    """Return a new test set of the same distribution, with other draws in the held-out part.

    This process solves the samples and keeps them in memory only.

    Parameters
    ----------
    spec : DatasetSpec
    scene : Scene
        The dataset's scene.
    by : {"region", "sample", "direction"}
        Property that separates test samples from training samples.
    seed : int
        Seed of the draws, instead of the dataset's.
    n : int
        Largest number of samples, at most `MAX_FRESH` and the number in the plan.

    Raises
    ------
    SolverError
        If none of the loads has a valid equilibrium.
    """
    other = spec.model_copy(update={"loads": with_seed(spec.load_plan, seed)})
    drawn = draw_loads(load_scene(other), 0, n_samples_of(scene))
    split = spec.split.model_copy(update={"by": by})
    paths = path_of_samples(scene, np.arange(len(drawn)))
    n_patches, own_seed = len(scene.patch_nodes), spec.load_plan.seed
    held = drawn[split_samples(drawn, n_patches, split, own_seed, paths).test]
    held = held[: min(n, MAX_FRESH)]
    values = scene.at_free_dofs(held.nodal_forces(scene.patch_weights).reshape(len(held), -1))
    found = generator_of(scene).solve_many(values, held.parameters)
    solved = [(i, answer) for i, answer in enumerate(found) if isinstance(answer, Solution)]
    if not solved:
        raise SolverError(f"{spec.name}: no fresh test load has a valid equilibrium.")
    displacements = np.array([answer.displacement for _, answer in solved])
    min_det_f = np.array([answer.min_det_f for _, answer in solved])
    return Snapshots(scene, held[np.array([i for i, _ in solved])], displacements, min_det_f)
