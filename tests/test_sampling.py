"""Sampling plans: their distributions, combinations of patches, and independence of the order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import kstest

from mor_bench.errors import SpecError
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import draw_loads, far_apart, n_samples_of, repeated
from mor_bench.specs import load_generated_spec

PLANS = ("random", "latin-hypercube", "sobol")


def tiny(**loads: Any) -> Scene:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    return load_scene({**spec, "loads": {**spec["loads"], **loads}})


def several(**loads: Any) -> Scene:
    plan = {"samples_per_patch": None, "samples": 300, "simultaneous": 3, "min_distance_m": 0.7}
    return tiny(**{**plan, **loads})


def all_loads(scene: Scene) -> PatchLoads:
    return draw_loads(scene, 0, n_samples_of(scene))


def coordinates(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coordinates (n, 3), uniform in [0, 1] if directions and sizes in [1, 4] are."""
    size = np.linalg.norm(vectors, axis=1)
    x, y, z = (vectors / size[:, None]).T
    return np.stack([(z + 1) / 2, np.arctan2(y, x) / (2 * np.pi) % 1, (size - 1) / 3], axis=1)


@pytest.mark.parametrize("sampling", PLANS)
def test_directions_and_magnitudes_are_uniform_on_the_whole_and_on_each_patch(
    sampling: str,
) -> None:
    drawn = all_loads(tiny(sampling=sampling, samples_per_patch=64, magnitude_n=[1.0, 4.0]))
    unit = coordinates(drawn.vectors[:, 0])
    assert unit.min() >= 0
    assert unit.max() <= 1
    for axis in range(3):
        assert kstest(unit[:, axis], "uniform").pvalue > 1e-3
    for patch in range(21):
        own = unit[drawn.patches[:, 0] == patch]
        assert len(own) == 64
        # The mean of 64 draws, compared with 6 of its standard deviations.
        assert np.abs(own.mean(axis=0) - 0.5).max() < 6 * np.sqrt(1 / 12 / 64)


@pytest.mark.parametrize(("sampling", "n"), [("latin-hypercube", 50), ("sobol", 64)])
def test_a_design_puts_one_sample_of_a_patch_into_each_interval_and_differs_between_patches(
    sampling: str, n: int
) -> None:
    drawn = all_loads(tiny(sampling=sampling, samples_per_patch=n, magnitude_n=[1.0, 4.0]))
    units = [coordinates(drawn.vectors[drawn.patches[:, 0] == p, 0]) for p in range(21)]
    for unit in units:
        for axis in range(3):
            counts = np.bincount((unit[:, axis] * n).astype(int), minlength=n)
            np.testing.assert_array_equal(counts, 1)
    random = all_loads(tiny(samples_per_patch=n, magnitude_n=[1.0, 4.0]))
    unit = coordinates(random.vectors[np.arange(n) * 21, 0])
    assert (np.bincount((unit[:, 0] * n).astype(int), minlength=n) == 0).any()
    every = np.concatenate(units)
    assert len(np.unique(np.round(every, 9), axis=0)) == len(every)


@pytest.mark.parametrize("sampling", PLANS)
@pytest.mark.parametrize("make", [tiny, several])
def test_a_sample_depends_on_seed_and_number_only(
    sampling: str, make: Callable[..., Scene]
) -> None:
    scene = make(sampling=sampling)
    whole, part = draw_loads(scene, 0, 200), draw_loads(scene, 137, 150)
    np.testing.assert_array_equal(whole.vectors[137:150], part.vectors)
    np.testing.assert_array_equal(whole.patches[137:150], part.patches)
    other = draw_loads(make(sampling=sampling, seed=1), 0, 200)
    assert not np.isclose(other.vectors, whole.vectors).all(axis=2).any()


@pytest.mark.parametrize("kind", ["normal", "tangential"])
@pytest.mark.parametrize("sampling", PLANS)
def test_normal_and_tangential_forces_have_their_directions(kind: str, sampling: str) -> None:
    loads = {"kind": kind, "sampling": sampling, "region": "surface", "samples_per_patch": 20}
    scene = tiny(**loads, magnitude_n=[1.0, 4.0], patch_area_m2=0.05)
    np.testing.assert_allclose(np.linalg.norm(scene.patch_normals, axis=1), 1, rtol=1e-12)
    drawn = all_loads(scene)
    along = (drawn.vectors[:, 0] * scene.patch_normals[drawn.patches[:, 0]]).sum(axis=1)
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


def least_gap(scene: Scene, loads: PatchLoads) -> float:
    centres = scene.patch_centres[loads.patches]
    return float(np.linalg.norm(centres - np.roll(centres, 1, axis=1), axis=2).min())


@pytest.mark.parametrize("sampling", PLANS)
def test_every_combination_of_distant_patches_is_used_once_before_any_repeats(
    sampling: str,
) -> None:
    centres = several().patch_centres
    gap = np.linalg.norm(centres[:, None] - centres, axis=2)
    triples = [(a, b, c) for c in range(21) for b in range(c) for a in range(b)]
    listed = {t for t in triples if min(gap[t[0], t[1]], gap[t[1], t[2]], gap[t[0], t[2]]) >= 0.7}
    n = len(listed)
    scene = several(sampling=sampling, samples=n + 5)
    drawn = all_loads(scene)
    assert {tuple(row) for row in drawn.patches[:n].tolist()} == listed
    np.testing.assert_array_equal(drawn.patches[n:], drawn.patches[:5])
    assert repeated([(scene, drawn)]) == 0
    nodal = drawn.nodal_forces(scene.patch_weights)
    sums = drawn.vectors.sum(axis=1)
    np.testing.assert_allclose(nodal.sum(axis=1), sums, rtol=0, atol=1e-12)
    single = [PatchLoads(drawn.patches[:4, [j]], drawn.vectors[:4, [j]]) for j in range(3)]
    parts = sum(loads.nodal_forces(scene.patch_weights) for loads in single)
    np.testing.assert_allclose(nodal[:4], parts, rtol=0, atol=1e-15)


def test_the_plan_of_three_forces_is_that_of_the_paper() -> None:
    scene = load_scene("beam-coarse-3-forces")
    drawn = all_loads(scene)
    assert drawn.vectors.shape == (12_360, 3, 3)
    assert len(np.unique(drawn.patches, axis=0)) == 12_360
    assert least_gap(scene, drawn) >= 1 - 1e-9
    assert np.linalg.norm(drawn.vectors, axis=2).max() <= 1


ONE_OF = r"exactly one of `samples_per_patch` and `samples`"
TOO_MANY = r"`n_patches` must be in \[1, \d+\], the number of points of the load region away"


@pytest.mark.parametrize(
    ("loads", "message"),
    [
        ({"min_distance_m": 5.0}, r"no 3 of the 21 patches are 5 m apart"),
        ({"min_distance_m": None}, r"`min_distance_m` must be given with `simultaneous` > 1"),
        ({"samples": None, "samples_per_patch": 3}, r"with `simultaneous` > 1 `samples` must be"),
        ({"samples": None}, ONE_OF),
        ({"samples": None, "min_distance_m": None}, ONE_OF + ".*; `min_distance_m` must be given"),
        ({"samples_per_patch": 3}, ONE_OF),
        ({"simultaneous": 9}, r"`loads.simultaneous` must be less than or equal to 8; got 9"),
        ({"simultaneous": 1}, r"must be given with `simultaneous` > 1 and only then"),
        ({"kind": "normal", "magnitude_n": [1.0, 1.0]}, r"of normal forces must be a range"),
        ({"sampling": "halton"}, r"'random', 'latin-hypercube' or 'sobol'; got 'halton'"),
        ({"n_patches": 22}, TOO_MANY),
    ],
)
def test_impossible_plans_are_refused(loads: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        draw_loads(several(**loads), 0, 1)


def test_combinations_too_many_to_list_are_drawn_far_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mor_bench.snapshots.sampling.MAX_COMBINATIONS", 20)
    far_apart.cache_clear()
    scene = several(seed=5)
    drawn, part = draw_loads(scene, 0, 200), draw_loads(scene, 150, 160)
    far_apart.cache_clear()
    np.testing.assert_array_equal(drawn.patches[150:160], part.patches)
    assert least_gap(scene, drawn) >= 0.7 - 1e-9
    assert (np.diff(drawn.patches, axis=1) > 0).all()
    assert len(np.unique(drawn.patches)) == 21


def test_patches_are_spread_over_the_region_and_away_from_the_supports() -> None:
    scene = tiny(n_patches=6)
    assert len(scene.patch_nodes) == 6
    assert scene.patch_centres[:, 0].min() > np.sqrt(0.2 / np.pi)
    gaps = np.linalg.norm(scene.patch_centres[:, None] - scene.patch_centres, axis=2)
    assert gaps[np.triu_indices(6, 1)].min() > 0.49


def test_patch_weights_do_not_depend_on_the_mesh() -> None:
    scene = tiny()
    weights, points = scene.patch_weights.toarray(), scene.mesh.points
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-14)
    assert (weights >= 0).all()
    assert not weights[:, points[:, 2] < 1.0].any()
    geometry = {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [12, 4, 4]}
    finer = load_scene({**scene.spec.model_dump(mode="json"), "geometry": geometry})
    centroids, fine = weights @ points, finer.patch_weights @ finer.mesh.points
    for centroid, centre in zip(centroids, scene.patch_centres, strict=True):
        same = int(np.linalg.norm(finer.patch_centres - centre, axis=1).argmin())
        np.testing.assert_allclose(centroid, fine[same], atol=5e-3)
        if 0.3 < centre[0] < 1.7 and centre[1] == 0.5:  # away from all edges
            np.testing.assert_allclose(centroid, centre, atol=1e-12)


def test_repeated_samples_are_counted() -> None:
    scene, others, below = tiny(), several(), tiny(region="z-min")
    drawn = draw_loads(scene, 0, 50)
    assert repeated([(scene, drawn), (scene, drawn[np.arange(40, 50)])]) == 10
    assert repeated([(scene, drawn), (others, draw_loads(others, 0, 50))]) == 0
    assert repeated([(scene, drawn), (below, draw_loads(below, 0, 50))]) == 0
