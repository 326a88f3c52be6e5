"""Sampling plans, splits and named test sets: what is drawn, that nothing is drawn twice, and what is kept apart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import kstest

import mor_bench
from mor_bench.errors import InvalidInputError, SpecError
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.sampling import PatchLoads, draw_loads, far_apart, n_samples_of, repeated
from mor_bench.snapshots.split import split_samples
from mor_bench.snapshots.test_sets import available_sets, check_regions, spec_of_set, why_not
from mor_bench.specs import Split, list_suite, load_generated_spec

PLANS = ("random", "latin-hypercube", "sobol")


def tiny(**loads: Any) -> Scene:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    return load_scene({**spec, "loads": {**spec["loads"], **loads}})


def several(**loads: Any) -> Scene:
    return tiny(
        **{
            "samples_per_patch": None,
            "samples": 300,
            "simultaneous": 3,
            "min_distance_m": 0.7,
            **loads,
        }
    )


def coordinates(vectors: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    """What is uniform in the unit cube if directions are on the sphere and magnitudes in their range, (n, 3)."""
    size = np.linalg.norm(vectors, axis=1)
    x, y, z = (vectors / size[:, None]).T
    return np.stack(
        [(z + 1) / 2, np.arctan2(y, x) / (2 * np.pi) % 1, (size - low) / (high - low)], axis=1
    )


@pytest.mark.parametrize("sampling", PLANS)
def test_directions_and_magnitudes_are_uniform_on_the_whole_and_on_each_patch(
    sampling: str,
) -> None:
    scene = tiny(sampling=sampling, samples_per_patch=64, magnitude_n=[1.0, 4.0])
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    unit = coordinates(drawn.vectors[:, 0], 1.0, 4.0)
    assert unit.min() >= 0
    assert unit.max() <= 1
    for axis in range(3):
        assert kstest(unit[:, axis], "uniform").pvalue > 1e-3
    for patch in range(21):
        own = unit[drawn.patches[:, 0] == patch]
        assert len(own) == 64
        # The mean of 64 draws, against 6 of its standard deviations.
        assert np.abs(own.mean(axis=0) - 0.5).max() < 6 * np.sqrt(1 / 12 / 64)


@pytest.mark.parametrize(("sampling", "n"), [("latin-hypercube", 50), ("sobol", 64)])
def test_designs_put_one_sample_of_a_patch_into_each_stretch_of_each_coordinate(
    sampling: str, n: int
) -> None:
    scene = tiny(sampling=sampling, samples_per_patch=n, magnitude_n=[1.0, 4.0])
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    for patch in (0, 7, 20):
        unit = coordinates(drawn.vectors[drawn.patches[:, 0] == patch, 0], 1.0, 4.0)
        for axis in range(3):
            np.testing.assert_array_equal(
                np.bincount((unit[:, axis] * n).astype(int), minlength=n), 1
            )
    random = tiny(samples_per_patch=n, magnitude_n=[1.0, 4.0])
    unit = coordinates(draw_loads(random, 0, 21 * n)[np.arange(n) * 21].vectors[:, 0], 1.0, 4.0)
    assert (np.bincount((unit[:, 0] * n).astype(int), minlength=n) == 0).any()


@pytest.mark.parametrize("sampling", PLANS)
@pytest.mark.parametrize("make", [tiny, several])
def test_no_sample_depends_on_where_the_drawing_begins(sampling: str, make: Any) -> None:
    scene = make(sampling=sampling)
    whole, part = draw_loads(scene, 0, 200), draw_loads(scene, 137, 150)
    np.testing.assert_array_equal(whole.vectors[137:150], part.vectors)
    np.testing.assert_array_equal(whole.patches[137:150], part.patches)
    other = draw_loads(make(sampling=sampling, seed=1), 0, 200)
    assert not np.isclose(other.vectors, whole.vectors).all(axis=2).any()


@pytest.mark.parametrize("kind", ["normal", "tangential"])
@pytest.mark.parametrize("sampling", PLANS)
def test_normal_and_tangential_forces_are_what_they_say(kind: str, sampling: str) -> None:
    scene = tiny(
        kind=kind,
        sampling=sampling,
        region="surface",
        samples_per_patch=20,
        magnitude_n=[1.0, 4.0],
        patch_area_m2=0.05,
    )
    np.testing.assert_allclose(np.linalg.norm(scene.patch_normals, axis=1), 1, rtol=1e-12)
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    normals = scene.patch_normals[drawn.patches[:, 0]]
    along = (drawn.vectors[:, 0] * normals).sum(axis=1)
    size = np.linalg.norm(drawn.vectors[:, 0], axis=1)
    assert size.min() >= 1
    assert size.max() <= 4
    if kind == "normal":
        np.testing.assert_allclose(np.abs(along), size, rtol=1e-12)
        assert 0.4 < (along > 0).mean() < 0.6
    else:
        np.testing.assert_allclose(along / size, 0, atol=1e-12)


def test_normals_point_out_of_the_body() -> None:
    scene = tiny(kind="normal", region="z-min", patch_area_m2=0.05)
    np.testing.assert_allclose(scene.patch_normals, np.tile([0.0, 0.0, -1.0], (21, 1)), atol=1e-15)


@pytest.mark.parametrize("sampling", PLANS)
def test_combinations_come_once_each_and_far_apart(sampling: str) -> None:
    scene = several(sampling=sampling)
    centres = scene.patch_centres
    listed = [
        (a, b, c)
        for a in range(21)
        for b in range(a)
        for c in range(b)
        if min(np.linalg.norm(centres[p] - centres[q]) for p, q in ((a, b), (b, c), (a, c)))
        >= 0.7 - 1e-9
    ]
    scene = several(sampling=sampling, samples=len(listed) + 5)
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    assert {
        tuple(sorted(row, reverse=True)) for row in drawn.patches[: len(listed)].tolist()
    } == set(listed)
    assert len(np.unique(drawn.patches[: len(listed)], axis=0)) == len(listed)
    np.testing.assert_array_equal(drawn.patches[len(listed) :], drawn.patches[:5])
    assert repeated([(scene, drawn)]) == 0
    total = drawn.nodal_forces(scene.patch_weights).sum(axis=1)
    np.testing.assert_allclose(total, drawn.vectors.sum(axis=1), rtol=0, atol=1e-12)


def test_the_three_forces_of_the_paper() -> None:
    scene = load_scene("beam-coarse-3-forces")
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    assert drawn.vectors.shape == (12_360, 3, 3)
    assert len(np.unique(drawn.patches, axis=0)) == 12_360
    centres = scene.patch_centres[drawn.patches]
    gaps = np.linalg.norm(centres - np.roll(centres, 1, axis=1), axis=2)
    assert gaps.min() >= 1 - 1e-9
    assert np.linalg.norm(drawn.vectors, axis=2).max() <= 1


@pytest.mark.parametrize(
    ("loads", "message"),
    [
        (
            {"min_distance_m": 5.0},
            r"must leave some 3 of the 21 patches that far apart; 5 leaves none",
        ),
        ({"min_distance_m": None}, r"`min_distance_m` must be given with `simultaneous` > 1"),
        (
            {"samples": None, "samples_per_patch": 3},
            r"with `simultaneous` > 1 `samples` must be given",
        ),
        ({"samples": None}, r"exactly one of `samples_per_patch` and `samples`"),
        ({"samples_per_patch": 3}, r"exactly one of `samples_per_patch` and `samples`"),
        ({"simultaneous": 9}, r"`loads.simultaneous` must be less than or equal to 8; got 9"),
        (
            {"simultaneous": 1},
            r"`min_distance_m` must be given with `simultaneous` > 1 and only then",
        ),
        (
            {"kind": "normal", "magnitude_n": [1.0, 1.0]},
            r"`magnitude_n` of normal forces must be a range",
        ),
        (
            {"sampling": "halton"},
            r"`loads.sampling` must be 'random', 'latin-hypercube' or 'sobol'; got 'halton'",
        ),
        (
            {"n_patches": 22},
            r"`n_patches` must be in \[1, \d+\], the number of points of the load region away from the supports; got 22",
        ),
    ],
)
def test_plans_that_cannot_be_drawn(loads: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        draw_loads(several(**loads), 0, 1)


def test_combinations_too_many_to_list_are_drawn_far_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mor_bench.snapshots.sampling.MAX_COMBINATIONS", 20)
    far_apart.cache_clear()
    scene = several(seed=5)
    drawn, part = draw_loads(scene, 0, 200), draw_loads(scene, 150, 160)
    far_apart.cache_clear()
    np.testing.assert_array_equal(drawn.patches[150:160], part.patches)
    centres = scene.patch_centres[drawn.patches]
    assert np.linalg.norm(centres - np.roll(centres, 1, axis=1), axis=2).min() >= 0.7 - 1e-9
    assert (np.diff(drawn.patches, axis=1) > 0).all()
    assert len(np.unique(drawn.patches)) == 21


@pytest.mark.parametrize("n_patches", [1, 2])
def test_too_few_patches_for_several_forces_are_said(n_patches: int) -> None:
    spec = tiny(n_patches=n_patches).generated
    assert "several-forces" not in available_sets(spec)
    assert "it has no 3 load patches" in str(why_not(spec, "several-forces"))


def test_patches_are_spread_over_the_region_and_away_from_the_supports() -> None:
    scene = tiny(n_patches=6)
    assert len(scene.patch_nodes) == 6
    assert scene.patch_centres[:, 0].min() > np.sqrt(0.2 / np.pi)
    gaps = np.linalg.norm(scene.patch_centres[:, None] - scene.patch_centres, axis=2)[
        np.triu_indices(6, 1)
    ]
    assert gaps.min() > 0.49


def test_repeated_samples_are_counted() -> None:
    scene, others = tiny(), several()
    drawn = draw_loads(scene, 0, 50)
    assert repeated([(scene, drawn), (scene, drawn[np.arange(40, 50)])]) == 10
    assert repeated([(scene, drawn), (others, draw_loads(others, 0, 50))]) == 0
    below = tiny(region="z-min")
    assert repeated([(scene, drawn), (below, draw_loads(below, 0, 50))]) == 0


@pytest.mark.parametrize("by", ["region", "direction", "sample"])
@pytest.mark.parametrize("k", [1, 3])
def test_splits_keep_apart_what_they_say(by: Any, k: int) -> None:
    scene = tiny(samples_per_patch=200) if k == 1 else load_scene("beam-coarse-3-forces")
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    train, test = split_samples(drawn, len(scene.patch_nodes), Split(test_fraction=0.2, by=by), 0)
    assert not set(train) & set(test)
    assert 0.1 < len(test) / (len(train) + len(test)) < 0.35
    if k == 1 or by == "sample":
        assert len(train) + len(test) == len(drawn)
    if by == "region":
        assert not set(drawn.patches[train].ravel()) & set(drawn.patches[test].ravel())
    if by == "direction":
        directions = drawn.vectors / np.linalg.norm(drawn.vectors, axis=2, keepdims=True)
        axis = directions[test].reshape(-1, 3).mean(axis=0)
        axis /= np.linalg.norm(axis)
        lowest, highest = (directions[test] @ axis).min(), (directions[train] @ axis).max()
        # The axis is found from the samples, hence roughly.
        assert lowest > highest - 0.1
        held = {tuple(row) for row in directions[test].reshape(-1, 3)}
        assert not held & {tuple(row) for row in directions[train].reshape(-1, 3)}


def test_the_sample_split_of_the_paper_has_its_counts() -> None:
    counts = {
        "beam-coarse": (5120, 1280),
        "beam-coarse-3-forces": (9888, 2472),
        "l-shape": (4800, 1200),
        "liver-hex": (1600, 400),
    }
    for name, expected in counts.items():
        scene = load_scene(name)
        drawn = draw_loads(scene, 0, n_samples_of(scene))
        train, test = split_samples(drawn, len(scene.patch_nodes), Split(by="sample"), 0)
        assert (len(train), len(test)) == expected


@pytest.fixture(scope="module")
def with_sets(cache: Path) -> Dataset:
    return load_dataset(
        "beam-tiny", tests=available_sets(load_generated_spec("beam-tiny")), cache=cache, workers=1
    )


def test_named_sets_of_the_tiny_beam(with_sets: Dataset) -> None:
    sets = with_sets.tests
    assert list(sets) == ["in-range", "2x", "4x", "unseen-regions", "several-forces"]
    one = sets["in-range"].loads
    for name, times in (("2x", 2), ("4x", 4)):
        n = len(sets[name])
        assert n <= len(one)
        if n == len(one):
            np.testing.assert_allclose(sets[name].loads.vectors, times * one.vectors, rtol=1e-12)
            np.testing.assert_array_equal(sets[name].loads.patches, one.patches)
    assert sets["several-forces"].loads.patches.shape[1] == 3
    sizes = np.linalg.norm(one.vectors, axis=2)
    assert sizes.max() <= 4
    assert (
        with_sets.tests["4x"].displacements.max() > with_sets.tests["in-range"].displacements.max()
    )


def test_unseen_regions_share_no_facet_with_the_main_set(with_sets: Dataset) -> None:
    main, other = with_sets.scene, with_sets.tests["unseen-regions"].scene
    check_regions(main.generated)
    assert not set(main.patch_nodes) & set(other.patch_nodes)
    loaded = np.abs(with_sets.train.forces).sum(axis=(0, 2)) > 0
    unseen = np.abs(with_sets.tests["unseen-regions"].forces).sum(axis=(0, 2)) > 0
    assert not (loaded & unseen).any()
    spec = main.generated.model_copy(
        update={"tests": main.generated.tests.model_copy(update={"unseen_region": "y-min"})}
    )
    with pytest.raises(
        InvalidInputError,
        match=r"must lie apart from `loads.region`; they share 0 facets of the surface and 7 centres",
    ):
        check_regions(spec)


def test_no_named_set_repeats_a_sample(with_sets: Dataset) -> None:
    sets = [with_sets.train, with_sets.test, *with_sets.tests.values()]
    parts = [(part.scene, part.loads) for part in sets if isinstance(part.loads, PatchLoads)]
    assert len(parts) == len(sets)
    assert repeated(parts) == 0


def test_sets_that_a_dataset_has_not_say_why() -> None:
    spec = load_generated_spec("beam-tiny")
    with pytest.raises(
        InvalidInputError,
        match=r"beam-tiny has no test set 'unseen-directions': its directions are all over the sphere",
    ):
        spec_of_set(spec, "unseen-directions")
    assert "several forces" in str(
        why_not(load_generated_spec("beam-coarse-3-forces"), "several-forces")
    )
    assert "known: in-range, 2x" in str(why_not(spec, "5x"))  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="has no test set '5x'"):
        load_dataset("beam-tiny", tests=["5x"])  # type: ignore[list-item]


@pytest.mark.parametrize("name", sorted(list_suite("datasets")))
def test_every_shipped_dataset_has_sound_test_sets(name: str) -> None:
    spec = load_generated_spec(name)
    sets = available_sets(spec)
    assert {"in-range", "2x", "4x", "unseen-regions"} <= set(sets)
    check_regions(spec)
    whole = load_scene(spec)
    training = (whole, draw_loads(whole, 0, 200))
    for other in sets:
        scene = load_scene(spec_of_set(spec, other))
        assert repeated([(scene, draw_loads(scene, 0, n_samples_of(scene))), training]) == 0


def test_the_direction_split_reaches_load_dataset(cache: Path) -> None:
    data = mor_bench.load_dataset("beam-tiny", split="direction", cache=cache)
    assert 20 <= len(data.test) <= 70
    assert len(data.train) + len(data.test) + data.n_refused == 210


def test_patch_loads_of_several_forces_add_up() -> None:
    scene = several()
    loads = draw_loads(scene, 0, 4)
    single = [
        PatchLoads(loads.patches[:, [j]], loads.vectors[:, [j]]).nodal_forces(scene.patch_weights)
        for j in range(3)
    ]
    np.testing.assert_allclose(
        loads.nodal_forces(scene.patch_weights), sum(single), rtol=0, atol=1e-15
    )
