"""Load paths: equal to separate solves, cheaper, kept together by splits, interruptible."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mor_bench.counting import counted
from mor_bench.errors import SolverError, SpecError
from mor_bench.hard_cases.setups import material_table
from mor_bench.measure.discretisation_error import chosen_samples
from mor_bench.mechanics.newton import NewtonOptions, Solution
from mor_bench.mechanics.pressed import full_order_model
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.fresh import fresh_test_set
from mor_bench.snapshots.generate import generate, shard_path
from mor_bench.snapshots.load_paths import solve_paths
from mor_bench.snapshots.sampling import draw_loads, n_samples_of
from mor_bench.snapshots.split import split_samples
from mor_bench.specs import Motion, load_generated_spec

from .test_pressure import content as bar
from .test_several_loads import FORCE, PRESSURE, together

STEPS = 5


def path_scene(steps: int = STEPS, **loads: Any) -> Scene:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    return load_scene({**spec, "loads": {**spec["loads"], "steps": steps, **loads}})


def loads_of(scene: Scene, start: int, stop: int) -> Any:
    forces = draw_loads(scene, start, stop).nodal_forces(scene.patch_weights)
    return scene.at_free_dofs(forces.reshape(stop - start, -1))


def test_steps_are_equal_parts_of_a_load() -> None:
    whole, scene = path_scene(1), path_scene()
    assert n_samples_of(scene) == STEPS * n_samples_of(whole)
    drawn, ends = draw_loads(scene, 0, 4 * STEPS), draw_loads(whole, 0, 4)
    for step in range(STEPS):
        own = drawn[np.arange(4) * STEPS + step]
        np.testing.assert_array_equal(own.patches, ends.patches)
        np.testing.assert_allclose(own.vectors, (step + 1) / STEPS * ends.vectors, rtol=1e-14)
    np.testing.assert_array_equal(drawn[np.arange(4) * STEPS + STEPS - 1].vectors, ends.vectors)
    np.testing.assert_array_equal(draw_loads(scene, 7, 13).vectors, drawn.vectors[7:13])


def test_one_step_is_the_plan_without_steps() -> None:
    assert path_scene(1).spec.digest() == load_generated_spec("beam-tiny").digest()
    assert path_scene(2).spec.digest() != load_generated_spec("beam-tiny").digest()


def following() -> Scene:
    loads = {
        "kind": "pressure",
        "regions": ["z-max"],
        "magnitude_pa": [1.0, 4.0],
        "samples": 8,
        "steps": STEPS,
        "follower": True,
    }
    return load_scene(bar(loads=loads, supports=[{"region": "x-min"}]))


SCENES: dict[str, Callable[[], Scene]] = {
    "force": lambda: path_scene(magnitude_n=[2.0, 4.0]),
    "following pressure": following,
    "several": lambda: together({**PRESSURE, "steps": STEPS}, {**FORCE, "steps": STEPS}),
}


@pytest.mark.parametrize("kind", SCENES)
def test_states_of_a_path_equal_separate_solves_and_cost_less(kind: str) -> None:
    scene = SCENES[kind]()
    loads, model = loads_of(scene, 0, 8 * STEPS), full_order_model(scene)
    model.prepare()
    with counted() as path:
        found = solve_paths(model, loads, 0, STEPS)
    with counted() as separate:
        alone = model.solve_many(loads)
    exact = model.solve_many(loads, NewtonOptions(1e-12))
    for mine, other, best in zip(found, alone, exact, strict=True):
        assert isinstance(mine, Solution)
        assert isinstance(other, Solution)
        assert isinstance(best, Solution)
        size = float(np.abs(best.displacement).max())
        assert np.abs(mine.displacement - best.displacement).max() <= 1e-8 * size
        assert mine.min_det_f == pytest.approx(other.min_det_f, rel=1e-6)
    assert path.multiply_adds < 0.9 * separate.multiply_adds


def test_a_path_that_begins_in_the_middle_has_the_same_states() -> None:
    scene = path_scene(magnitude_n=[2.0, 4.0])
    model = full_order_model(scene)
    whole = solve_paths(model, loads_of(scene, 0, 3 * STEPS), 0, STEPS)
    part = solve_paths(model, loads_of(scene, 2, 3 * STEPS), 2, STEPS)
    for mine, other in zip(part, whole[2:], strict=True):
        assert isinstance(mine, Solution)
        assert isinstance(other, Solution)
        np.testing.assert_allclose(mine.displacement, other.displacement, atol=1e-7)
    # A path that begins in this part does not know where the part begins.
    np.testing.assert_array_equal(part[-1].displacement, whole[-1].displacement)  # type: ignore[union-attr]


def test_a_path_ends_where_no_equilibrium_is_left() -> None:
    # Uniaxial compression of Saint Venant-Kirchhoff has a limit of E / (3 √3), 96 Pa here.
    loads = {
        "kind": "pressure",
        "regions": ["x-max"],
        "magnitude_pa": [50.0, 300.0],
        "samples": 5,
        "steps": 4,
    }
    scene = load_scene(bar(loads=loads, material=material_table("saint-venant-kirchhoff", 500, 0)))
    pressures = np.abs(draw_loads(scene, 0, 20).vectors[:, 0]).max(axis=1)
    found = solve_paths(full_order_model(scene), loads_of(scene, 0, 20), 0, 4)
    refused = np.array([isinstance(one, SolverError) for one in found])
    np.testing.assert_array_equal(refused, pressures > 500.0 / (3 * np.sqrt(3)))
    assert refused.any()
    assert not refused[::4].all()


@pytest.mark.parametrize("by", ["region", "sample", "direction"])
def test_no_path_is_divided_by_a_split(by: Any) -> None:
    scene = path_scene()
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    split = scene.generated.split.model_copy(update={"by": by})
    paths = np.arange(len(drawn)) // STEPS
    parts = split_samples(drawn, len(scene.patch_nodes), split, 0, paths)
    assert sum(map(len, parts)) == len(drawn)
    for part in parts:
        own, counts = np.unique(paths[part], return_counts=True)
        assert len(own) > 0
        assert (counts == STEPS).all()
    if by == "sample":
        shares = [len(part) / len(drawn) for part in parts]
        np.testing.assert_allclose(shares, [0.65, 0.15, 0.2], atol=0.01)


def test_generated_paths_are_whole_and_do_not_depend_on_interruptions(tmp_path: Path) -> None:
    spec = path_scene(3, samples_per_patch=2).generated  # a shard of 100 ends within a path
    data = load_dataset(spec, workers=1, cache=tmp_path / "a", split="sample")
    parts = (data.train, data.validation, data.test)
    assert sum(map(len, parts)) == 126
    for part in parts:
        sizes = np.linalg.norm(part.loads.vectors[:, 0], axis=1).reshape(-1, 3)
        np.testing.assert_allclose(sizes / sizes[:, -1:], [[1 / 3, 2 / 3, 1.0]] * len(sizes))
    whole = generate(spec, workers=1, cache=tmp_path / "a")
    some = generate(spec, 30, workers=1, cache=tmp_path / "b")
    shard_path(some, 0).unlink()
    generate(spec, workers=1, cache=tmp_path / "b")
    for number in range(2):
        assert shard_path(some, number).read_bytes() == shard_path(whole, number).read_bytes()
    again = fresh_test_set(spec, data.scene, "sample", 5, 30)
    assert len(again) == 24  # the test part has a fifth of 42 paths


def test_the_discretisation_error_is_that_of_whole_loads() -> None:
    scene = path_scene()
    np.testing.assert_array_equal(chosen_samples(scene, 3) % STEPS, STEPS - 1)


@pytest.mark.parametrize(
    ("loads", "message"),
    [
        ({"steps": 0}, r"`loads.steps` must be greater than or equal to 1; got 0"),
        ({"steps": 1.5}, r"`loads.steps`"),
        ({"steps": 1000, "samples_per_patch": 10_000_000}, "at most 10,000,000 are allowed"),
        ({"steps": 0, "seed": -1}, r"`loads.seed` must .*`loads.steps` must"),
    ],
)
def test_wrong_steps_are_refused(loads: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        n_samples_of(path_scene(**loads))
    tool = {"kind": "displacement", "region": "x-max", "magnitude_m": [0.0, 0.1], "samples": 20}
    with pytest.raises(SpecError, match=r"`loads.steps`: it must be 1 or left out.*got 2"):
        load_scene(bar(loads={**tool, "steps": 2}))
    assert "steps" not in Motion.model_validate({**tool, "steps": 1}).model_dump()
