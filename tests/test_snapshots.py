"""Splits, named test sets, and the reading of datasets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.report.published_figures import scene_of
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.generate import dataset_folder, read_shards
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import draw_loads, n_samples_of, repeated
from mor_bench.snapshots.split import split_samples
from mor_bench.snapshots.test_sets import available_sets, check_regions, spec_of_set, why_not
from mor_bench.specs import DatasetSpec, Split, list_suite, load_generated_spec


def changed(**loads: Any) -> DatasetSpec:
    """Return beam-tiny with other loads."""
    spec = load_generated_spec("beam-tiny").model_dump()
    return DatasetSpec.model_validate({**spec, "loads": {**spec["loads"], **loads}})


@pytest.mark.parametrize("by", ["region", "direction", "sample"])
@pytest.mark.parametrize("k", [1, 3])
def test_splits_keep_their_parts_apart(by: Any, k: int) -> None:
    spec = changed(samples_per_patch=200) if k == 1 else "beam-coarse-3-forces"
    scene = load_scene(spec)
    drawn = draw_loads(scene, 0, n_samples_of(scene))
    parts = split_samples(drawn, len(scene.patch_nodes), Split(test_fraction=0.2, by=by), 0)
    train, validation, test = parts
    n_used = sum(map(len, parts))
    assert len(set(train) | set(validation) | set(test)) == n_used
    assert 0.1 < len(test) / n_used < 0.35
    assert 0.08 < len(validation) / n_used < 0.25
    if k == 1 or by == "sample":
        assert n_used == len(drawn)
    if by == "region":
        learned, chosen, tested = (set(drawn.patches[part].ravel().tolist()) for part in parts)
        assert not (learned | chosen) & tested
        touched = [set(row.tolist()) - learned for row in drawn.patches[validation]]
        assert all(touched)  # every validation sample has a force where no training sample has one
    if by == "direction":
        directions = drawn.vectors / np.linalg.norm(drawn.vectors, axis=2, keepdims=True)
        axis = directions[test].reshape(-1, 3).mean(axis=0)
        axis /= np.linalg.norm(axis)
        # The axis is estimated from the samples, hence the margin.
        assert (directions[test] @ axis).min() > (directions[train] @ axis).max() - 0.1
        held = {tuple(row) for row in directions[test].reshape(-1, 3)}
        assert not held & {tuple(row) for row in directions[train].reshape(-1, 3)}
        nearest = (directions[validation] @ axis).max(axis=1).min()
        assert nearest > (directions[train] @ axis).max() - 0.1


def test_the_sample_split_of_the_paper_has_its_counts() -> None:
    counts = {
        "beam-coarse": (5120, 1280),
        "beam-coarse-3-forces": (9888, 2472),
        "l-shape": (4800, 1200),
    }
    for name, expected in counts.items():
        scene = load_scene(name)
        n, k = n_samples_of(scene), scene.generated.load_plan.simultaneous
        loads = PatchLoads(np.zeros((n, k), dtype=np.int64), np.zeros((n, k, 3)))
        train, validation, test = split_samples(
            loads, len(scene.patch_nodes), Split(by="sample"), 0
        )
        assert (len(train) + len(validation), len(test)) == expected


def test_test_regions_do_not_depend_on_the_limit() -> None:
    regions = np.arange(640) % 64
    loads = PatchLoads(regions[:, None], np.zeros((640, 1, 3)))
    test = [set(regions[split_samples(loads[:n], 64, Split(), 0).test]) for n in (128, 640)]
    assert test[0] == test[1]


def test_a_dataset_holds_equilibria(tiny: Dataset) -> None:
    model = FullOrderModel(tiny.scene)
    for part in (tiny.train, tiny.validation, tiny.test):
        assert part.forces.shape == part.displacements.shape == (len(part), 63, 3)
        assert part.min_det_f.min() > 0
        for u, f in zip(part.free_displacements[:20], part.free_forces[:20], strict=True):
            assert np.linalg.norm(f - model.force(u).force) <= 1e-8 * np.linalg.norm(f)
    assert sum(map(len, (tiny.train, tiny.validation, tiny.test))) + tiny.n_refused == 210
    assert not set(tiny.train.regions) & set(tiny.test.regions)
    assert len(set(tiny.test.regions)) == 4


@pytest.mark.parametrize("by", ["sample", "region", "direction"])
def test_refused_samples_are_in_no_part_and_others_keep_their_displacements(
    by: Any, cache: Path
) -> None:
    spec = changed(samples_per_patch=3, magnitude_n=[0.0, 40.0])
    data = load_dataset(spec, split=by, cache=cache, workers=1)
    (shard,) = read_shards(dataset_folder(spec, cache), 63)
    valid = np.flatnonzero(shard.status == 0)
    assert data.n_refused == 63 - len(valid) > 0
    answers = {vector.tobytes(): shard.displacements[i] for i, vector in enumerate(shard.vectors)}
    expected = {shard.vectors[i].tobytes() for i in valid}
    parts = (data.train, data.validation, data.test)
    found = [v.tobytes() for part in parts for v in part.loads.vectors]
    assert len(found) == len(expected)
    assert set(found) == expected
    for part in parts:
        for vector, u in zip(part.loads.vectors, part.free_displacements, strict=True):
            np.testing.assert_array_equal(u, answers[vector.tobytes()])
        assert part.min_det_f.min() > 0


def test_other_splits_reach_load_dataset(cache: Path) -> None:
    data = mor_bench.load_dataset("beam-tiny", split="sample", cache=cache)
    assert (len(data.train), len(data.validation), len(data.test)) == (136, 32, 42)
    data = mor_bench.load_dataset("beam-tiny", split="direction", cache=cache)
    assert 20 <= len(data.test) <= 70
    assert sum(map(len, (data.train, data.validation, data.test))) + data.n_refused == 210


def test_wrong_options_are_refused(cache: Path) -> None:
    with pytest.raises(InvalidInputError, match="cannot be split"):
        load_dataset("beam-tiny", limit=1, cache=cache)
    for wrong in (0, 1.5, "3", float("nan"), True):
        options: Any = {"limit": wrong}
        with pytest.raises(InvalidInputError, match=rf"`limit` must be .* >= 1; got {wrong!r}"):
            load_dataset("beam-tiny", cache=cache, **options)
        with pytest.raises(InvalidInputError, match=rf"`workers` must be .* >= 1; got {wrong!r}"):
            load_dataset("beam-tiny", cache=cache, workers=options["limit"])
    with pytest.raises(TypeError, match="unexpected keyword argument 'wrokers'"):
        load_dataset("beam-tiny", wrokers=2)  # type: ignore[call-arg]


@pytest.fixture(scope="module")
def with_sets(cache: Path) -> Dataset:
    tests = available_sets(load_generated_spec("beam-tiny"))
    return load_dataset("beam-tiny", tests=tests, cache=cache, workers=1)


def test_named_sets_of_the_tiny_beam(with_sets: Dataset) -> None:
    sets = with_sets.tests
    assert list(sets) == ["in-range", "2x", "4x", "unseen-regions", "several-forces"]
    one = sets["in-range"].loads
    for name, times in (("2x", 2), ("4x", 4)):
        np.testing.assert_allclose(sets[name].loads.vectors, times * one.vectors, rtol=1e-12)
        np.testing.assert_array_equal(sets[name].loads.patches, one.patches)
    assert sets["several-forces"].loads.patches.shape[1] == 3
    assert np.linalg.norm(one.vectors, axis=2).max() <= 4
    assert sets["4x"].displacements.max() > sets["in-range"].displacements.max()
    parts = [with_sets.train, with_sets.test, *sets.values()]
    loads = [(part.scene, part.loads) for part in parts if isinstance(part.loads, PatchLoads)]
    assert len(loads) == len(parts)
    assert repeated(loads) == 0


def test_the_set_of_the_paper_s_amplitude_has_the_stated_forces() -> None:
    spec = load_generated_spec("beam-tiny")
    assert "`tests.paper_magnitude_n`" in str(why_not(spec, "paper-amplitude"))
    tests = spec.tests.model_copy(update={"paper_magnitude_n": (0.0, 5.0)})
    paper = spec.model_copy(update={"tests": tests})
    assert "paper-amplitude" in available_sets(paper)
    own, usual = (load_scene(spec_of_set(paper, name)) for name in ("paper-amplitude", "in-range"))
    assert own.generated.load_plan.seed == usual.generated.load_plan.seed
    larger, drawn = (draw_loads(scene, 0, n_samples_of(scene)) for scene in (own, usual))
    np.testing.assert_allclose(larger.vectors, 5 / 4 * drawn.vectors, rtol=1e-12)
    assert paper.digest() == spec.digest()


def test_unseen_regions_share_no_facet_with_the_main_set(with_sets: Dataset) -> None:
    main, unseen = with_sets.scene, with_sets.tests["unseen-regions"]
    check_regions(main.generated)
    assert not set(main.patch_nodes) & set(unseen.scene.patch_nodes)
    loaded, other = (np.abs(p.forces).sum(axis=(0, 2)) > 0 for p in (with_sets.train, unseen))
    assert not (loaded & other).any()
    tests = main.generated.tests.model_copy(update={"unseen_region": "y-min"})
    with pytest.raises(InvalidInputError, match=r"they share 0 facets .* and 7 centres"):
        check_regions(main.generated.model_copy(update={"tests": tests}))


def test_missing_sets_give_their_reason() -> None:
    spec = load_generated_spec("beam-tiny")
    message = "beam-tiny has no test set 'unseen-directions': its directions are all over"
    with pytest.raises(InvalidInputError, match=message):
        spec_of_set(spec, "unseen-directions")
    three = load_generated_spec("beam-coarse-3-forces")
    assert "several forces" in str(why_not(three, "several-forces"))
    assert "known: in-range, 2x" in str(why_not(spec, "5x"))  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="has no test set '5x'"):
        load_dataset("beam-tiny", tests=["5x"])  # type: ignore[list-item]
    for n_patches in (1, 2):
        few = changed(n_patches=n_patches)
        assert "several-forces" not in available_sets(few)
        assert "it has no 3 load patches" in str(why_not(few, "several-forces"))


QUICK = {"beam-tiny", "beam-nearly-incompressible", "block-compression"}
OTHERS = {
    "liver-hex-observed",
    "liver-grasped",
    "liver-pressed",
    "artery-pressure",
    "soft-arm",
}  # of liver-hex; no patches
SLOW = {*map(scene_of, list_suite("datasets"))} - QUICK - OTHERS


@pytest.mark.parametrize(
    "name", [*sorted(QUICK), *(pytest.param(n, marks=pytest.mark.slow) for n in sorted(SLOW))]
)
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
