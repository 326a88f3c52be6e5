"""Sampling, splits and the store: nothing lost, nothing doubled, nothing damaged unnoticed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.generate import dataset_folder, generate, generation_seconds
from mor_bench.snapshots.sampling import PatchLoads, draw_loads
from mor_bench.snapshots.split import split_samples
from mor_bench.snapshots.store import Shard, read_shard, write_shard
from mor_bench.specs import DatasetSpec, Split, load_generated_spec


def shards(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("shard-*.h5"))}


def test_patch_weights_are_a_partition_of_the_force_and_mesh_independent(tiny_scene: Scene) -> None:
    weights = tiny_scene.patch_weights.toarray()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-14)
    assert (weights >= 0).all()
    mesh = tiny_scene.mesh
    assert not weights[:, mesh.points[:, 2] < 1.0].any()
    finer = mor_bench.load_scene(
        {**tiny_scene.spec.model_dump(mode="json"), "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [12, 4, 4]}}
    )
    fine_weights = finer.patch_weights.toarray()
    for row, node in enumerate(tiny_scene.patch_nodes):
        same = int(np.linalg.norm(finer.mesh.points[finer.patch_nodes] - mesh.points[node], axis=1).argmin())
        np.testing.assert_allclose(weights[row] @ mesh.points, fine_weights[same] @ finer.mesh.points, atol=5e-3)


def test_the_centroid_of_an_inner_patch_is_its_node(tiny_scene: Scene) -> None:
    points = tiny_scene.mesh.points
    for row, node in enumerate(tiny_scene.patch_nodes):
        if 0.3 < points[node, 0] < 1.7 and points[node, 1] == 0.5:
            np.testing.assert_allclose(tiny_scene.patch_weights.toarray()[row] @ points, points[node], atol=1e-12)


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
    other = draw_loads(load_scene(scene.spec.model_copy(update={"loads": loads})), 0, 50)
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


def test_worker_count_changes_no_bit(tmp_path: Path, cache: Path, tiny: Dataset) -> None:
    spec = load_generated_spec("beam-tiny")
    parallel = generate(spec, workers=2, cache=tmp_path)
    assert shards(parallel) == shards(dataset_folder(spec, cache))
    assert len(shards(parallel)) == 3
    assert generation_seconds(spec, tmp_path, 210) is not None


def test_a_limit_is_a_prefix(tmp_path: Path, cache: Path, tiny: Dataset) -> None:
    spec = load_generated_spec("beam-tiny")
    first = generate(spec, limit=100, cache=tmp_path)
    assert list(shards(first)) == ["shard-00000.h5"]
    again = generate(spec, cache=tmp_path)
    assert shards(again) == shards(dataset_folder(spec, cache))


def test_any_flipped_byte_is_noticed(tmp_path: Path, cache: Path, tiny: Dataset) -> None:
    source = dataset_folder(load_generated_spec("beam-tiny"), cache) / "shard-00002.h5"
    content = source.read_bytes()
    rng = np.random.default_rng(0)
    path = tmp_path / source.name
    for place in [*range(0, 512, 16), *rng.integers(0, len(content), 300)]:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        with pytest.raises(StoreError, match="shard-00002"):
            read_shard(path)


@pytest.mark.parametrize(
    ("name", "message"), [("truncated", "checksum"), ("foreign", "not a shard"), ("empty", "not a shard"), ("newer", "schema version 7")]
)
def test_damaged_files_say_what_they_are_and_are_made_again(tmp_path: Path, name: str, message: str) -> None:
    spec = load_generated_spec("beam-tiny")
    folder = generate(spec, cache=tmp_path)
    before = shards(folder)
    path = folder / "shard-00001.h5"
    content = path.read_bytes()
    path.write_bytes(
        {
            "truncated": content[:-9],
            "foreign": b"PK" + content,
            "empty": b"",
            "newer": content.replace(b'"schema_version": 2', b'"schema_version": 7'),
        }[name]
    )
    with pytest.raises(StoreError, match=message):
        read_shard(path)
    untouched = (folder / "shard-00000.h5").stat().st_mtime_ns
    generate(spec, cache=tmp_path)
    assert shards(folder) == before
    assert (folder / "shard-00000.h5").stat().st_mtime_ns == untouched


def test_a_failed_write_leaves_no_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shard = Shard(0, np.zeros((1, 1), dtype=np.int64), np.zeros((1, 1, 3)), np.zeros((1, 6)), np.ones(1), np.zeros(1, dtype=np.uint8))
    write_shard(tmp_path / "shard.h5", shard)
    before = (tmp_path / "shard.h5").read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_shard(tmp_path / "shard.h5", shard)
    assert [path.name for path in tmp_path.iterdir()] == ["shard.h5"]
    assert (tmp_path / "shard.h5").read_bytes() == before


GENERATE = """
import sys
from pathlib import Path
from mor_bench.snapshots.generate import generate
from mor_bench.specs import DatasetSpec
generate(DatasetSpec.model_validate_json(sys.argv[1]), workers=2, cache=Path(sys.argv[2]), progress=lambda done, total: print(done, flush=True))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_killed_ten_times_and_resumed_is_bit_identical(tmp_path: Path) -> None:
    """The script has no main guard, as a student's would not."""
    spec = load_generated_spec("beam-tiny")
    longer = DatasetSpec.model_validate({**spec.model_dump(), "loads": {**spec.loads.model_dump(), "samples_per_patch": 100}})
    undisturbed = shards(generate(longer, workers=2, cache=tmp_path / "undisturbed"))
    rng = np.random.default_rng(int(time.time()))
    command = [sys.executable, "-c", GENERATE, longer.model_dump_json(), str(tmp_path / "disturbed")]
    folder = dataset_folder(longer, tmp_path / "disturbed")
    partial = 0
    for _ in range(10):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(float(rng.uniform(0.0, 0.4)))
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        there = shards(folder)
        assert all(undisturbed[name] == content for name, content in there.items())
        partial += len(there) < len(undisturbed)
    assert partial >= 3
    subprocess.run(command, check=True, capture_output=True)
    assert shards(folder) == undisturbed
