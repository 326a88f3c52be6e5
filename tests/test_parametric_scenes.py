"""Scenes with sampled parameters: their files, queries, stored samples, range flags and runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import (
    DamagedFileWarning,
    InvalidInputError,
    SpecError,
    StoreError,
    UnsupportedSceneError,
)
from mor_bench.export.npz_file import export_numpy
from mor_bench.measure.discretisation_error import refine
from mor_bench.measure.query_cost import cost_of
from mor_bench.model_file import read_model, write_model
from mor_bench.sandbox.handover import read_snapshots, write_snapshots
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.fresh import fresh_test_set
from mor_bench.snapshots.generate import dataset_folder, generate, shard_path
from mor_bench.snapshots.load_range import LoadRange
from mor_bench.snapshots.store import read_shard, shard_bytes, write_shard
from mor_bench.snapshots.test_sets import available_sets, spec_of_set, why_not
from mor_bench.specs import DatasetSpec, list_suite, load_generated_spec, load_method_spec

BOTH: dict[str, Any] = {
    "young_pa": [300.0, 800.0],
    "poisson": [0.35, 0.45],
    "scale": {"x": [0.9, 1.2]},
}

TAKE: dict[str, dict[str, Any]] = {
    "pod": {"n_modes": 6},
    "hpod": {"n_modes": 6, "cubature_tolerance": 0.01},
    "fem": {},
    "linear-fem": {},
    "pca-regression-linear": {"n_input_modes": 4, "n_output_modes": 6},
    "pca-regression": {"n_input_modes": 6, "n_output_modes": 6},
}
"""Methods that take all parameters."""


def content(parameters: dict[str, Any] | None = BOTH, **changed: Any) -> dict[str, Any]:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json", exclude_none=True)
    table = {} if parameters is None else {"parameters": parameters}
    return {**spec, "name": "several-bodies", **table, **changed}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("parametric")


@pytest.fixture(scope="module")
def data(cache: Path) -> Dataset:
    return load_dataset(content(), cache=cache, workers=1, tests=["unseen-parameters"])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"young_pa": [800.0, 300.0]}, "`parameters.young_pa`: the lower end .* less"),
        ({"young_pa": [300.0]}, "`parameters.young_pa"),
        ({"poisson": [0.3, 0.6]}, r"`parameters.poisson` must stay in .*0.499999.* to 0.6 would"),
        (
            {"c10_pa": [1.0, 2.0]},
            "`parameters.c10_pa` .*saint-venant.* no such .*young_pa, poisson",
        ),
        ({"yung_pa": [1.0, 2.0]}, "unknown key `parameters.yung_pa`; did you mean 'young_pa'"),
        ({"scale": {"x": [0.0, 1.0]}}, r"`parameters.scale.x` must stay in \[0.01, 100\]"),
        ({"scale": {}}, "`parameters` must hold at least one range"),
        ({}, "`parameters` must hold at least one range"),
    ],
)
def test_a_wrong_table_is_refused_with_key_range_and_value(
    table: dict[str, Any], message: str
) -> None:
    with pytest.raises(SpecError, match=message):
        mor_bench.load_scene(content(table))


def test_a_law_checks_its_parameters_together() -> None:
    yeoh = {"law": "yeoh", "c10_pa": 10.0, "c20_pa": -1.0, "c30_pa": 1.0, "bulk_pa": 500.0}
    mor_bench.load_scene(content({"c20_pa": [-5.0, 1.0]}, material=yeoh))
    with pytest.raises(
        SpecError, match=r"`parameters` must stay in the range of the law yeoh: .*c20"
    ):
        mor_bench.load_scene(content({"c20_pa": [-6.0, 1.0]}, material=yeoh))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"observed": {"region": "z-max"}}, "`parameters` must be absent where `observed`"),
        (
            {"springs": [{"region": "z-min", "stiffness_n_m3": 2.0}]},
            "`parameters.scale` must be absent where `springs`",
        ),
    ],
)
def test_what_parameters_exclude_is_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        mor_bench.load_scene(content(**changed))


def test_parameters_belong_to_the_digest_and_other_scenes_keep_theirs() -> None:
    plain = DatasetSpec.model_validate(content(None))
    assert plain.digest() == load_generated_spec("beam-tiny").digest()
    assert "parameters" not in plain.model_dump(mode="json")
    assert "unseen_parameters" not in plain.model_dump(mode="json")["tests"]
    assert DatasetSpec.model_validate(content()).digest() != plain.digest()


def test_every_other_method_says_that_it_takes_no_parameters() -> None:
    scene = mor_bench.load_scene(content({"young_pa": [300.0, 800.0]}))
    taking = set()
    for name, path in list_suite("methods").items():
        surrogate = load_method_spec(path).load_class()
        if surrogate.takes_parameters:
            taking.add(name)
            continue
        with pytest.raises(UnsupportedSceneError, match=r"sampled parameters|forces|observed"):
            mor_bench.load_method(name).fit(scene)
    assert {*TAKE, "pod-tensor"} <= taking


def test_the_polynomial_takes_no_shapes() -> None:
    scene = mor_bench.load_scene(content())
    with pytest.raises(UnsupportedSceneError, match=r"exact in λ and μ only.*scale_x"):
        mor_bench.load_method("pod-tensor").fit(scene)


@pytest.mark.parametrize("name", TAKE)
def test_a_saved_model_gives_the_same_answers(name: str, data: Dataset, tmp_path: Path) -> None:
    method = mor_bench.load_method(name, **TAKE[name]).fit(data.scene, data.train)
    method.save(tmp_path / "model.safetensors")
    loaded = mor_bench.load_surrogate(tmp_path / "model.safetensors")
    forces, parameters = data.test.forces[:4], data.test.parameters[:4]
    expected = method.predict(forces, parameters)
    assert np.array_equal(loaded.predict(forces, parameters), expected)
    one = method.predict(forces[2], parameters[2])
    assert np.abs(one - expected[2]).max() <= 1e-12 * np.abs(expected[2]).max()
    same = method.predict(forces, parameters[0])
    assert np.abs(same[0] - expected[0]).max() <= 1e-12 * np.abs(expected[0]).max()
    assert cost_of(method, data.test[:3].given) is not None


def test_a_saved_polynomial_gives_the_same_answers(cache: Path, tmp_path: Path) -> None:
    found = load_dataset(content({"young_pa": [300.0, 800.0]}), cache=cache, workers=1)
    method = mor_bench.load_method("pod-tensor", n_modes=5).fit(found.scene, found.train)
    path = tmp_path / "model.safetensors"
    method.save(path)
    query = found.test.forces[:4], found.test.parameters[:4]
    assert np.array_equal(mor_bench.load_surrogate(path).predict(*query), method.predict(*query))
    model = read_model(path)
    del model.arrays["both_cubic"]
    write_model(path, model)
    with pytest.raises(StoreError, match="does not describe a TensorPOD"):
        mor_bench.load_surrogate(path)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (None, r"a query must have `parameters` .*\(3,\) or \(n, 3\): young_pa, poisson, scale_x"),
        ([500.0, 0.4], r"shape \(3,\) or \(4, 3\), young_pa.*got float64 of shape \(2,\)"),
        (np.ones((3, 3)), r"got float64 of shape \(3, 3\)"),
        ([500.0, 0.6, 1.0], r"poisson must be in \[-0.999999, 0.499999\]; got 0.6"),
        ([np.nan, 0.4, 1.0], "young_pa must be in .*got nan"),
        (["a", "b", "c"], "must hold real numbers"),
        ([[1.0], [1.0, 2.0]], "`parameters` must be an array"),
    ],
)
def test_wrong_parameters_of_a_query_give_one_clear_error(
    parameters: Any, message: str, data: Dataset
) -> None:
    method = mor_bench.load_method("linear-fem").fit(data.scene)
    for ask in (method.predict, method.out_of_range):
        with pytest.raises(InvalidInputError, match=message):
            ask(data.test.forces[:4], parameters)


def test_a_scene_without_parameters_refuses_all_but_an_array_without_columns() -> None:
    scene = mor_bench.load_scene("beam-tiny")
    method = mor_bench.load_method("linear-fem").fit(scene)
    with pytest.raises(InvalidInputError, match="`parameters` must be absent"):
        method.predict(np.zeros((scene.mesh.n_nodes, 3)), [500.0])
    forces = np.ones((2, scene.mesh.n_nodes, 3))
    none = np.zeros((2, 0))  # as `Snapshots.parameters` of such a scene
    np.testing.assert_array_equal(method.predict(forces, none), method.predict(forces))
    np.testing.assert_array_equal(method.out_of_range(forces, none), [False, False])


def test_the_error_indicator_says_that_it_knows_one_body_only(data: Dataset) -> None:
    method = mor_bench.load_method("linear-fem").fit(data.scene)
    with pytest.raises(UnsupportedSceneError, match="sampled parameters"):
        method.indicate_error(data.test.forces[0], data.test.displacements[0])


def test_parameters_out_of_range_are_flagged_and_others_are_not(data: Dataset) -> None:
    method = mor_bench.load_method("pod", n_modes=4).fit(data.scene, data.train)
    outside = data.tests["unseen-parameters"]
    assert method.out_of_range(outside.forces, outside.parameters).mean() > 0.95
    assert method.out_of_range(data.test.forces, data.test.parameters).mean() < 0.1
    inside = np.repeat(data.train.parameters[:1], len(outside), axis=0)
    assert not method.out_of_range(outside.forces, inside).any()


def test_a_forged_range_of_parameters_is_refused(data: Dataset) -> None:
    arrays = LoadRange.of(data.train).arrays()
    n_nodes = data.scene.mesh.n_nodes
    assert LoadRange.from_arrays(arrays, n_nodes, 3).parameters.shape == (2, 3)
    ends = arrays["parameters"]
    for wrong in (ends[::-1], ends[:, :2], ends * np.nan, ends.astype(np.float32)):
        with pytest.raises(InvalidInputError, match="`parameters` of the range"):
            LoadRange.from_arrays({**arrays, "parameters": wrong}, n_nodes, 3)
    with pytest.raises(InvalidInputError, match="must consist of the arrays"):
        LoadRange.from_arrays(arrays, n_nodes, 0)


def test_the_set_out_of_range_lies_outside_by_the_stated_factor(data: Dataset) -> None:
    spec = DatasetSpec.model_validate(content())
    assert "unseen-parameters" in available_sets(spec)
    assert "no table `parameters`" in str(
        why_not(load_generated_spec("beam-tiny"), "unseen-parameters")
    )
    table = spec_of_set(spec, "unseen-parameters").parameters
    assert table is not None
    low, high = np.array(list(table.ranges.values())).T
    from_middle = np.abs(data.tests["unseen-parameters"].parameters - 0.5 * (low + high))
    multiple = from_middle / (0.5 * (high - low))
    assert multiple.min() >= 1
    assert multiple.max() <= 1.5
    assert multiple.max() > 1.45


def test_a_set_whose_parameters_would_not_be_valid_does_not_exist() -> None:
    spec = DatasetSpec.model_validate(content({"poisson": [0.4, 0.49]}))
    assert "`tests.unseen_parameters` is too large" in str(why_not(spec, "unseen-parameters"))
    with pytest.raises(SpecError, match=r"`tests.unseen_parameters` must be absent"):
        mor_bench.load_scene(content(None, tests={"unseen_parameters": 2.0}))


def test_stored_parameters_survive_and_damaged_ones_are_made_again(
    data: Dataset, cache: Path
) -> None:
    spec = DatasetSpec.model_validate(content())
    path = shard_path(dataset_folder(spec, cache), 0)
    whole, shard = path.read_bytes(), read_shard(path)
    assert shard.parameters.shape == (100, 3)
    other = shard.parameters.copy()
    other[3, 1] += 1e-3
    for wrong in (other, shard.parameters[:, :2], np.zeros((100, 0)), shard.parameters * np.nan):
        write_shard(path, replace(shard, parameters=wrong))
        with pytest.warns(DamagedFileWarning, match="holds the wrong samples"):
            load_dataset(spec, cache=cache, workers=1)
        assert path.read_bytes() == whole


def test_shards_without_parameters_keep_their_bytes(cache: Path) -> None:
    shard = read_shard(shard_path(generate(load_generated_spec("beam-tiny"), 100, 1, cache), 0))
    assert shard.parameters.shape == (len(shard.patches), 0)
    assert b"parameters" not in shard_bytes(shard)


def test_parameters_reach_the_process_of_a_method(data: Dataset, tmp_path: Path) -> None:
    write_snapshots(tmp_path / "train", data.train)
    found = read_snapshots(tmp_path / "train", data.scene)
    assert np.array_equal(found.parameters, data.train.parameters)


def test_a_fresh_test_set_has_parameters_of_its_own(data: Dataset) -> None:
    spec = DatasetSpec.model_validate(content())
    fresh = fresh_test_set(spec, data.scene, "region", 11, 5)
    assert fresh.parameters.shape == (5, 3)
    method = mor_bench.load_method("fem").fit(data.scene)
    predicted = method.predict(fresh.forces, fresh.parameters)
    assert np.abs(predicted - fresh.displacements).max() < 1e-6 * np.abs(predicted).max()


def test_the_discretisation_error_is_refused() -> None:
    with pytest.raises(UnsupportedSceneError, match="for one body only"):
        refine(DatasetSpec.model_validate(content()))


def test_samples_with_parameters_have_no_numpy_file(data: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UnsupportedSceneError, match="cannot hold the sampled parameters"):
        export_numpy(data, tmp_path / "mine.npz")
    assert not list(tmp_path.iterdir())
