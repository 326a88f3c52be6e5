"""Choice of training loads: the greedy rule, its error estimates, designs, and bad input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import spearmanr

import mor_bench
from mor_bench.errors import InvalidInputError, MorBenchError, UnsupportedSceneError
from mor_bench.reduction.greedy import FIRST, GreedySampling, training_loads, worst
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.specs import load_generated_spec
from tests.benchmarks.adaptive_sampling import DESIGNS, SimplexSampling, designed_loads
from tests.relative_errors import relative_l2

Array = NDArray[np.float64]
EVERY = 1000
"""Candidates for each choice that are all loads of beam-tiny."""


def open_loads(tiny: Dataset) -> PatchLoads:
    assert isinstance(tiny.train.loads, PatchLoads)
    return tiny.train.loads


def sampling(tiny: Dataset, n_modes: int = 10, candidates: int = 4, seed: int = 0) -> Any:
    method = mor_bench.load_method("pod", n_modes=n_modes, tolerance=1e-8)
    return GreedySampling(method, tiny.scene, open_loads(tiny), candidates, seed)


def keys(loads: PatchLoads | NodalLoads) -> list[tuple[float, ...]]:
    """Return one comparable key for each load."""
    assert isinstance(loads, PatchLoads)
    rows = np.hstack([loads.patches, loads.vectors.reshape(len(loads), -1)])
    return [tuple(row) for row in rows.tolist()]


def test_the_chosen_load_has_the_largest_indicated_error_of_all(tiny: Dataset) -> None:
    greedy = sampling(tiny, candidates=EVERY)
    before = greedy.grow(20)
    after = greedy.grow(21)
    (chosen,) = keys(after.loads)[20:]
    method = mor_bench.load_method("pod", n_modes=10, tolerance=1e-8).fit(tiny.scene, before)
    forces, seen = tiny.train.forces, set(keys(before.loads))
    found = method.indicate_error(forces, method.predict(forces)).relative_correction
    open_errors = {
        key: error
        for key, error in zip(keys(tiny.train.loads), found, strict=True)
        if key not in seen
    }
    assert len(open_errors) == len(tiny.train) - 20
    assert max(open_errors, key=lambda key: open_errors[key]) == chosen


def test_a_batch_takes_the_largest_part_that_those_before_do_not_explain() -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(30, 8)) * rng.uniform(0.1, 3.0, size=(30, 1))
    rest, expected = errors.copy(), []
    for _ in range(6):
        expected.append(int(np.linalg.norm(rest, axis=1).argmax()))
        axis = rest[expected[-1]] / np.linalg.norm(rest[expected[-1]])
        rest -= np.outer(rest @ axis, axis)
    assert worst(errors, 6).tolist() == expected
    assert worst(np.array([[3.0, 0.0], [2.9, 0.1], [0.0, 1.0]]), 2).tolist() == [0, 2]


def test_loads_without_a_prediction_are_chosen_first() -> None:
    errors = np.array([[9.0, 0.0], [np.nan, 0.0], [0.0, 1.0], [np.inf, 1.0]])
    assert worst(errors, 3).tolist() == [1, 3, 0]
    assert sorted(worst(errors, 10).tolist()) == [0, 1, 2, 3]
    assert worst(errors[[1]], 1).tolist() == [0]


def test_the_estimated_error_vanishes_at_snapshots_in_the_basis_and_nowhere_else(
    tiny: Dataset,
) -> None:
    greedy = sampling(tiny, n_modes=30)
    greedy.fit(greedy.grow(30))
    inside = np.linalg.norm(greedy.estimated_errors(greedy.snapshots.loads), axis=1)
    outside = np.linalg.norm(greedy.estimated_errors(tiny.test.loads), axis=1)
    assert inside.max() < 1e-5
    assert np.median(outside) > 1e-3


def test_the_estimated_error_field_is_that_of_the_prediction(tiny: Dataset) -> None:
    greedy = sampling(tiny)
    greedy.fit(greedy.grow(30))
    u = tiny.test.free_displacements
    predicted = tiny.scene.at_free_dofs(
        greedy.predicted(tiny.test.forces).reshape(len(tiny.test), -1)
    )
    true = (u - predicted) / np.linalg.norm(predicted, axis=1, keepdims=True)
    estimated = greedy.estimated_errors(tiny.test.loads)
    sizes = [np.linalg.norm(fields, axis=1) for fields in (true, estimated)]
    assert spearmanr(*sizes)[0] > 0.95
    cosines = (true * estimated).sum(axis=1) / (sizes[0] * sizes[1])
    assert np.median(cosines) > 0.9


def test_only_chosen_training_loads_are_solved_for_and_each_once(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mor_bench.mechanics.model import FullOrderModel

    solve = FullOrderModel.solve_many
    rows: list[int] = []

    def counting(self: FullOrderModel, loads: Array, *more: Any) -> Any:
        rows.append(len(loads))
        return solve(self, loads, *more)

    monkeypatch.setattr(FullOrderModel, "solve_many", counting)
    method = mor_bench.load_method("pca-regression-linear", n_input_modes=5)
    chosen = mor_bench.choose_snapshots(method, "beam-tiny", 40)
    assert sum(rows) == len(chosen) == 40
    assert rows[0] == FIRST
    of_key = {key: row for row, key in enumerate(keys(tiny.train.loads))}
    numbers = [of_key[key] for key in keys(chosen.loads)]
    assert len(set(numbers)) == 40
    np.testing.assert_allclose(
        chosen.free_displacements, tiny.train.free_displacements[numbers], rtol=0, atol=1e-6
    )
    assert not hasattr(method, "scene_"), "the caller's method must stay as it is"


def test_equal_seeds_repeat_a_choice_and_others_differ(tiny: Dataset) -> None:
    first, again, other = (keys(sampling(tiny, seed=s).grow(25).loads) for s in (3, 3, 4))
    assert first == again
    assert first != other
    split = sampling(tiny, seed=3)
    split.grow(FIRST)
    assert keys(split.grow(25).loads)[:FIRST] == first[:FIRST]


def test_the_greedy_choice_lowers_the_worst_error_of_random_loads(tiny: Dataset) -> None:
    def worst_error(snapshots: Snapshots) -> float:
        method = mor_bench.load_method("pod", n_modes=25).fit(tiny.scene, snapshots)
        errors = relative_l2(method.predict(tiny.train.forces), tiny.train.displacements)
        return float(np.percentile(errors, 95))

    pairs = []
    for seed in range(3):
        rows = np.random.default_rng(seed).permutation(len(tiny.train))[:25]
        greedy = sampling(tiny, n_modes=25, candidates=EVERY, seed=seed).grow(25)
        pairs.append((worst_error(greedy), worst_error(tiny.train[np.sort(rows)])))
    ours, theirs = np.mean(pairs, axis=0)
    assert ours < theirs, pairs


def test_the_training_loads_are_those_of_the_dataset(tiny: Dataset) -> None:
    assert keys(training_loads(load_scene("beam-tiny"))) == keys(tiny.train.loads)


@pytest.mark.parametrize("kind", DESIGNS)
def test_a_design_keeps_the_range_and_the_patches_and_fills_both(
    kind: Any, tiny_scene: Scene
) -> None:
    patches, n = np.array([1, 4, 5, 11, 17]), 40
    drawn = designed_loads(tiny_scene, patches, kind, n, 0)
    assert set(np.unique(drawn.patches)) == set(patches)
    size = np.linalg.norm(drawn.vectors[:, 0], axis=1)
    low, high = tiny_scene.generated.load_plan.magnitude
    assert low <= size.min()
    assert size.max() <= high
    loads = np.bincount((size / high * n).astype(int), minlength=n)
    per_patch = np.bincount(drawn.patches[:, 0])[patches]
    if kind == "latin-hypercube":  # one load in each interval of magnitude and of rank
        np.testing.assert_array_equal(loads, 1)
        np.testing.assert_array_equal(per_patch, n // len(patches))
    if kind == "random":
        assert (loads == 0).any()
    again, other = (designed_loads(tiny_scene, patches, kind, n, seed) for seed in (0, 1))
    assert keys(again) == keys(drawn)
    assert keys(other) != keys(drawn)


def test_simplices_place_loads_inside_the_range_of_those_before(tiny: Dataset) -> None:
    method = mor_bench.load_method("pca-regression-linear", n_input_modes=5)
    simplices = SimplexSampling(method, tiny.scene, open_loads(tiny), seed=0)
    before = simplices.grow(12).loads
    after = simplices.grow(20).loads
    assert keys(after)[:12] == keys(before)
    assert set(np.unique(after.patches)) <= set(np.unique(tiny.train.loads.patches))
    sizes = np.linalg.norm(after.vectors[:, 0], axis=1)
    assert sizes[12:].max() <= sizes[:12].max()
    assert len(set(keys(after))) == 20


POD = mor_bench.load_method("pod", n_modes=5)
WRONG: list[tuple[dict[str, Any], type[MorBenchError], str]] = [
    ({"n": 0}, InvalidInputError, r"`n` must be an integer in \[1, 140\].*; got 0\."),
    ({"n": 141}, InvalidInputError, r"`n` must be an integer in \[1, 140\].*; got 141\."),
    ({"n": 2.5}, InvalidInputError, r"`n` must be an integer in \[1, 140\].*; got 2\.5\."),
    ({"candidates": 0}, InvalidInputError, r"`candidates` must be an integer >= 1; got 0\."),
    ({"seed": -1}, InvalidInputError, r"`seed` must be an integer >= 0; got -1\."),
    ({"method": "pod"}, InvalidInputError, r"`method` must be a method, such as .*got str 'pod'"),
    ({"method": type(POD)}, InvalidInputError, r"`method` must be a method, such as"),
    (
        {"method": mor_bench.load_method("linear-fem")},
        InvalidInputError,
        "`method` must learn from snapshots; LinearFEM learns from none",
    ),
    ({"source": "liver-grasped"}, UnsupportedSceneError, "its forces are not known"),
    ({"source": "liver-pressed"}, UnsupportedSceneError, "an instrument presses it"),
    ({"source": "beam-stiffness"}, UnsupportedSceneError, "sampled parameters"),
]


@pytest.mark.parametrize(("changed", "error", "text"), WRONG)
def test_bad_input_gets_one_clear_error(
    changed: dict[str, Any], error: type[MorBenchError], text: str
) -> None:
    arguments: dict[str, Any] = {"method": POD, "source": "beam-tiny", "n": 3, **changed}
    options = {name: arguments.pop(name) for name in ("candidates", "seed") if name in arguments}
    with pytest.raises(error, match=text):
        mor_bench.choose_snapshots(**arguments, **options)


@pytest.mark.parametrize(
    ("table", "key", "value", "text"),
    [
        ("loads", "steps", 2, "its loads act in steps"),
        ("needs", "outputs", "x-max", "`needs.outputs` names a part of the nodes"),
    ],
)
def test_scenes_without_estimates_are_refused(table: str, key: str, value: Any, text: str) -> None:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    spec[table][key] = value
    with pytest.raises(UnsupportedSceneError, match=text):
        mor_bench.choose_snapshots(POD, spec, 3)


def test_loads_without_an_equilibrium_are_left_out_and_counted(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mor_bench.errors import NoEquilibriumError
    from mor_bench.mechanics.model import FullOrderModel

    solve = FullOrderModel.solve_many

    def refusing(self: FullOrderModel, loads: Array, *more: Any) -> Any:
        found = solve(self, loads, *more)
        return [NoEquilibriumError("no"), *found[1:]] if len(found) > 1 else found

    monkeypatch.setattr(FullOrderModel, "solve_many", refusing)
    greedy = sampling(tiny)
    assert len(greedy.grow(20)) == 20
    assert greedy.n_refused >= 2
    few = GreedySampling(POD, tiny.scene, open_loads(tiny)[:12], 4, 0)
    with pytest.raises(InvalidInputError, match="`n` must be at most 11: 1 of the 12 training"):
        few.grow(12)
    assert len(few.snapshots) + few.n_refused == 12
