"""Sampling, splits, and datasets as they are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.sampling import PatchLoads, draw_loads
from mor_bench.snapshots.split import split_samples
from mor_bench.specs import Split


def test_patch_weights_are_a_partition_of_the_force_and_mesh_independent(tiny_scene: Scene) -> None:
    weights = tiny_scene.patch_weights.toarray()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-14)
    assert (weights >= 0).all()
    mesh = tiny_scene.mesh
    assert not weights[:, mesh.points[:, 2] < 1.0].any()
    finer = mor_bench.load_scene(
        {
            **tiny_scene.spec.model_dump(mode="json"),
            "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [12, 4, 4]},
        }
    )
    fine_weights = finer.patch_weights.toarray()
    for row, node in enumerate(tiny_scene.patch_nodes):
        same = int(
            np.linalg.norm(
                finer.mesh.points[finer.patch_nodes] - mesh.points[node], axis=1
            ).argmin()
        )
        np.testing.assert_allclose(
            weights[row] @ mesh.points, fine_weights[same] @ finer.mesh.points, atol=5e-3
        )


def test_the_centroid_of_an_inner_patch_is_its_node(tiny_scene: Scene) -> None:
    points = tiny_scene.mesh.points
    for row, node in enumerate(tiny_scene.patch_nodes):
        if 0.3 < points[node, 0] < 1.7 and points[node, 1] == 0.5:
            np.testing.assert_allclose(
                tiny_scene.patch_weights.toarray()[row] @ points, points[node], atol=1e-12
            )


def test_directions_are_uniform_and_magnitudes_in_range() -> None:
    drawn = draw_loads(mor_bench.load_scene("beam-coarse"), 0, 6400)
    vectors = drawn.vectors[:, 0]
    size = np.linalg.norm(vectors, axis=1)
    assert size.min() >= 0
    assert size.max() <= 1
    assert np.histogram(size, bins=4, range=(0, 1))[0].min() > 1450
    directions = vectors / size[:, None]
    assert np.abs(directions.mean(axis=0)).max() < 0.03
    np.testing.assert_allclose(directions.T @ directions / 6400, np.eye(3) / 3, atol=0.02)
    np.testing.assert_array_equal(np.bincount(drawn.patches[:, 0]), 100)
    assert len(np.unique(vectors, axis=0)) == 6400


def test_a_sample_depends_on_seed_and_index_only() -> None:
    scene = mor_bench.load_scene("beam-tiny")
    whole = draw_loads(scene, 0, 50)
    part = draw_loads(scene, 17, 23)
    np.testing.assert_array_equal(whole.vectors[17:23], part.vectors)
    np.testing.assert_array_equal(whole.patches[17:23], part.patches)
    loads = scene.generated.loads.model_copy(update={"seed": 1})
    other = draw_loads(load_scene(scene.generated.model_copy(update={"loads": loads})), 0, 50)
    assert not np.isclose(other.vectors, whole.vectors).any()


def test_dataset_holds_equilibria(tiny: Dataset) -> None:
    model = FullOrderModel(tiny.scene)
    for part in (tiny.train, tiny.test):
        assert part.forces.shape == part.displacements.shape == (len(part), 63, 3)
        assert part.min_det_f.min() > 0
        for u, f in zip(part.free_displacements[:20], part.free_forces[:20], strict=True):
            assert np.linalg.norm(f - model.force(u).force) <= 1e-8 * np.linalg.norm(f)
    assert len(tiny.train) + len(tiny.test) + tiny.n_refused == 210


def test_region_split_shares_no_region(tiny: Dataset) -> None:
    assert not set(tiny.train.regions) & set(tiny.test.regions)
    assert len(set(tiny.test.regions)) == 4


def test_sample_split_shares_no_sample(cache: Path) -> None:
    data = mor_bench.load_dataset("beam-tiny", split="sample", cache=cache)
    assert (len(data.train), len(data.test)) == (168, 42)
    together = np.concatenate([data.train.loads.vectors, data.test.loads.vectors])
    assert len(np.unique(together, axis=0)) == 210


def test_test_regions_do_not_depend_on_the_limit() -> None:
    regions = np.arange(640) % 64
    loads = PatchLoads(regions[:, None], np.zeros((640, 1, 3)))
    test = [set(regions[split_samples(loads[:n], 64, Split(), 0)[1]]) for n in (128, 640)]
    assert test[0] == test[1]


def test_too_few_samples_to_split(cache: Path) -> None:
    with pytest.raises(InvalidInputError, match="cannot be split"):
        mor_bench.load_dataset("beam-tiny", limit=1, cache=cache)
    with pytest.raises(InvalidInputError, match=r"`limit` must be an integer >= 1; got 0"):
        mor_bench.load_dataset("beam-tiny", limit=0, cache=cache)
