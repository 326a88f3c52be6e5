"""The out-of-range flag: flagged loads, accepted loads, and storage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import InvalidInputError, NotFittedError, StoreError, UnknownRangeError
from mor_bench.snapshots import load_range
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.snapshots.load_range import LoadRange
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.surrogate import Surrogate
from tests.model_files import rewrite

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def with_sets(cache: Path) -> Dataset:
    return mor_bench.load_dataset(
        "beam-tiny",
        tests=["in-range", "2x", "4x", "unseen-regions", "several-forces"],
        cache=cache,
        workers=1,
    )


@pytest.fixture(scope="module")
def pod(tiny: Dataset) -> Surrogate:
    return mor_bench.load_method("pod", n_modes=5).fit(tiny.scene, tiny.train)


def nodal(snapshots: Snapshots) -> Snapshots:
    """Return the same samples in the form that another program would give."""
    return replace(snapshots, loads=NodalLoads(snapshots.forces, snapshots.loads.patches))


def test_the_range_flags_separate_the_named_test_sets(pod: Surrogate, with_sets: Dataset) -> None:
    assert not pod.out_of_range(with_sets.train.forces).any()
    assert pod.out_of_range(with_sets.test.forces).mean() < 0.02
    sets = with_sets.tests
    assert pod.out_of_range(sets["in-range"].forces).mean() < 0.02
    assert pod.out_of_range(sets["unseen-regions"].forces).all()
    assert pod.out_of_range(sets["several-forces"].forces).mean() > 0.95
    largest = np.linalg.norm(with_sets.train.forces, axis=2).sum(axis=1).max()
    for name in ("2x", "4x"):
        larger = np.linalg.norm(sets[name].forces, axis=2).sum(axis=1) > 1.01 * largest
        assert 0 < larger.sum() < len(larger)
        np.testing.assert_array_equal(pod.out_of_range(sets[name].forces), larger)


def test_unseen_directions_are_flagged(tmp_path: Path) -> None:
    spec = mor_bench.load_scene("beam-tiny").spec.model_dump(mode="json")
    pressed = {**spec, "loads": {**spec["loads"], "kind": "normal"}}
    data = mor_bench.load_dataset(
        pressed, tests=["in-range", "unseen-directions"], cache=tmp_path, workers=1
    )
    method = mor_bench.load_method("pod", n_modes=5).fit(data.scene, data.train)
    assert method.out_of_range(data.tests["unseen-directions"].forces).all()
    assert not method.out_of_range(data.tests["in-range"].forces).any()


def test_the_strangeness_follows_its_definition(tiny: Dataset) -> None:
    forces = tiny.train.forces
    known = LoadRange.of(tiny.train)
    for load in (tiny.test.forces[3], np.random.default_rng(0).normal(size=forces.shape[1:])):
        expected = total = 0.0
        for node, force in enumerate(load):
            size = float(np.linalg.norm(force))
            at_node = forces[:, node]
            moment = at_node.T @ at_node / max(float((at_node**2).sum()), 1e-300)
            if size > 0:
                direction = force / size
                expected += (
                    size
                    * direction
                    @ np.linalg.solve(moment + load_range.REGULARISATION * np.eye(3), direction)
                )
                total += size
        assert known.strangeness(load[None]) == pytest.approx([expected / total], rel=1e-12)


def test_patches_and_nodal_forces_have_the_same_range_with_or_without_chunks(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = LoadRange.of(tiny.train)
    monkeypatch.setattr(load_range, "CHUNK", 7)
    for snapshots in (tiny.train, nodal(tiny.train)):
        assert isinstance(snapshots.loads, PatchLoads) == (snapshots is tiny.train)
        found = LoadRange.of(snapshots)
        np.testing.assert_allclose(
            [found.size_n, found.width], [whole.size_n, whole.width], rtol=1e-12
        )
        np.testing.assert_array_equal(found.nodes, whole.nodes)
        np.testing.assert_allclose(found.moments, whole.moments, atol=1e-14)


def test_the_nodal_forces_of_all_samples_are_never_stored_at_once(tiny: Dataset) -> None:
    fresh = replace(tiny.train)
    LoadRange.of(fresh)
    assert "forces" not in vars(fresh)


def test_forces_of_any_valid_shape_are_accepted_and_bad_input_is_refused(
    pod: Surrogate, tiny: Dataset
) -> None:
    one, batch = tiny.test.forces[0], tiny.test.forces[:5]
    assert pod.out_of_range(one).shape == ()
    assert pod.out_of_range(batch).shape == (5,)
    assert pod.out_of_range(batch[:0]).shape == (0,)
    assert pod.out_of_range(batch).dtype == bool
    assert not pod.out_of_range(0 * one)
    assert pod.out_of_range(100 * one)
    np.testing.assert_array_equal(
        pod.out_of_range(batch), [pod.out_of_range(force) for force in batch]
    )
    with pytest.raises(InvalidInputError, match="forces"):
        pod.out_of_range(one * np.nan)
    with pytest.raises(NotFittedError):
        mor_bench.load_method("pod").out_of_range(one)


def test_methods_that_need_no_snapshots_flag_nothing(tiny: Dataset) -> None:
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    assert not linear.out_of_range(1e6 * tiny.test.forces).any()


def test_fitting_again_forgets_the_first_range(tiny: Dataset) -> None:
    method = mor_bench.load_method("pod", n_modes=3).fit(tiny.scene, tiny.train)
    weak = np.flatnonzero(np.linalg.norm(tiny.train.loads.vectors, axis=2).max(axis=1) < 2.0)
    method.fit(tiny.scene, tiny.train[weak])
    assert method.out_of_range(tiny.train.forces).any()


def test_after_training_on_zeros_every_force_is_out_of_range(tiny: Dataset) -> None:
    loads = PatchLoads(tiny.train.loads.patches, 0 * tiny.train.loads.vectors)
    nothing = LoadRange.of(replace(tiny.train, loads=loads))
    assert nothing.excludes(tiny.test.forces).all()
    assert not nothing.excludes(0 * tiny.test.forces).any()


def test_the_range_survives_a_file(pod: Surrogate, with_sets: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    pod.save(path)
    loaded = mor_bench.load_surrogate(path)
    for snapshots in (with_sets.test, *with_sets.tests.values()):
        np.testing.assert_array_equal(
            loaded.out_of_range(snapshots.forces), pod.out_of_range(snapshots.forces)
        )


def test_a_file_without_a_range_is_read_with_a_warning(
    pod: Surrogate, tiny: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "model.safetensors"
    pod.save(path)
    rewrite(
        path,
        lambda arrays: [arrays.pop(name) for name in list(arrays) if name.startswith("range.")],
    )
    loaded = mor_bench.load_surrogate(path)
    np.testing.assert_array_equal(
        loaded.predict(tiny.test.forces[0]), pod.predict(tiny.test.forces[0])
    )
    with pytest.raises(UnknownRangeError, match="older version"):
        loaded.out_of_range(tiny.test.forces[0])
    loaded.save(path)
    assert mor_bench.load_surrogate(path).parameters == pod.parameters


DAMAGE: dict[str, Callable[[dict[str, NDArray[Any]]], object]] = {
    "one missing": lambda arrays: arrays.pop("range.moments"),
    "one more": lambda arrays: arrays.update({"range.more": np.zeros(1)}),
    "NaN limit": lambda arrays: arrays.update({"range.limits": np.array([np.nan, 1.0])}),
    "negative limit": lambda arrays: arrays.update({"range.limits": np.array([-1.0, 1.0])}),
    "nodes beyond the mesh": lambda arrays: arrays.update(
        {"range.nodes": arrays["range.nodes"] + 1000}
    ),
    "negative nodes": lambda arrays: arrays.update({"range.nodes": arrays["range.nodes"] - 1000}),
    "nodes twice": lambda arrays: arrays.update({"range.nodes": 0 * arrays["range.nodes"]}),
    "fewer moments": lambda arrays: arrays.update({"range.moments": arrays["range.moments"][1:]}),
    "NaN moment": lambda arrays: arrays.update({"range.moments": arrays["range.moments"] * np.nan}),
    "moments negative": lambda arrays: arrays.update({"range.moments": -arrays["range.moments"]}),
    "moments not symmetric": lambda arrays: arrays.update(
        {"range.moments": arrays["range.moments"] + np.eye(3, k=1)}
    ),
    "moments not of unit trace": lambda arrays: arrays.update(
        {"range.moments": 2 * arrays["range.moments"]}
    ),
}


@pytest.mark.parametrize("damage", list(DAMAGE))
def test_a_damaged_range_is_refused(pod: Surrogate, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "model.safetensors"
    pod.save(path)
    rewrite(path, DAMAGE[damage])
    with pytest.raises(StoreError, match="range"):
        mor_bench.load_surrogate(path)
