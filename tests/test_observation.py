"""Methods with displacements of a part of the surface instead of forces as input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import (
    InvalidInputError,
    SpecError,
    UnknownRangeError,
    UnsupportedSceneError,
)
from mor_bench.export.npz_file import export_numpy
from mor_bench.export.onnx_file import export_onnx
from mor_bench.export.vtu_files import export_vtu
from mor_bench.options import RunOptions
from mor_bench.runs.configurations import OBSERVATION_METHODS, checked_specs
from mor_bench.runs.training_data import TrainingData
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.specs import NO_FORCES
from mor_bench.surrogate import Surrogate
from tests.observed_scenes import TOP, scene_of, written
from tests.relative_errors import relative_l2
from tests.small_runs import PLAIN, method_file, short_timing
from tests.suite_methods import SPECS, cheap_method

QUICK = {"fem", "gappy-pod", "linear-fem", "pca-regression-linear"}
"""Methods of the quick tests; all others join the slow ones."""


@pytest.fixture(scope="module")
def data(tiny: Dataset, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """beam-tiny, loaded on its top face, with the displacements of that face instead of forces."""
    return mor_bench.load_dataset(written(tmp_path_factory.mktemp("observed"), TOP), cache=cache)


@pytest.fixture(scope="module")
def whole(data: Dataset, cache: Path) -> Dataset:
    """The same, with all samples but those of the test for training."""
    content = data.scene.generated.model_dump(mode="json")
    split = {**content["split"], "validation_fraction": 0.01}
    return mor_bench.load_dataset({**content, "split": split}, cache=cache)


@pytest.fixture(scope="module")
def linear(data: Dataset) -> Surrogate:
    return mor_bench.load_method("linear-fem").fit(data.scene)


@pytest.fixture(scope="module")
def gappy(data: Dataset) -> Surrogate:
    return mor_bench.load_method("gappy-pod").fit(data.scene, data.train)


def test_gappy_pod_reproduces_displacements_in_the_span_of_its_modes(data: Dataset) -> None:
    """Without regularisation, as many modes as samples reproduce each sample."""
    few = data.train[:12]
    method = mor_bench.load_method("gappy-pod", n_modes=12, regularisation=0.0).fit(data.scene, few)
    mixed = np.tensordot([0.5, -1.0, 2.0], few.displacements[[1, 4, 9]], 1)
    seen = np.full(mixed.shape, np.nan)
    seen[data.scene.observed_nodes] = mixed[data.scene.observed_nodes]
    given = data.test.given.with_values(seen)
    np.testing.assert_allclose(method.predict(given), mixed, atol=1e-8 * np.abs(mixed).max())


def test_regularisation_reduces_the_effect_of_noise_on_gappy_pod(data: Dataset) -> None:
    noise = (
        0.01
        * np.sqrt((data.test.displacements**2).mean())
        * np.random.default_rng(0).normal(size=data.test.displacements.shape)
    )
    noisy = data.test.given.with_values(data.test.given.values + noise)
    errors = {}
    for regularisation in (0.0, 0.01):
        method = mor_bench.load_method("gappy-pod", n_modes=80, regularisation=regularisation).fit(
            data.scene, data.train
        )
        errors[regularisation] = np.median(
            relative_l2(method.predict(noisy), data.test.displacements)
        )
    assert errors[0.01] < 0.5 * errors[0.0]


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in sorted(SPECS)]
)
def test_a_method_completes_observed_displacements_or_says_that_it_needs_forces(
    name: str, whole: Dataset
) -> None:
    data = whole
    method = cheap_method(name, observed=True)
    if method.supports(data.scene) is not None:
        with pytest.raises(UnsupportedSceneError):
            method.fit(data.scene, data.train)
        return
    assert method.takes_observations
    method.fit(data.scene, data.train)
    given, reference = data.test.given, data.test.displacements
    predicted = method.predict(given)
    bound = SPECS[name].battery.observed_error
    assert np.median(relative_l2(predicted, reference)) < bound
    single = np.stack([method.predict(given[i]) for i in range(3)])
    np.testing.assert_allclose(single, predicted[:3], rtol=0, atol=2e-6 * np.abs(single).max())
    assert (predicted[:, data.scene.fixed_nodes] == 0).all()
    if method.parameters.get("zero_at_rest") is not False:
        assert not method.predict(given.with_values(np.zeros_like(reference[0]))).any()
    assert method.predict(given[:0]).shape == reference[:0].shape


def test_most_methods_complete_observed_displacements() -> None:
    """The test above would also pass if every method refused."""
    scene = scene_of({"region": "z-max"})
    for name in QUICK | (set(OBSERVATION_METHODS) - {"umesh"}):  # which needs torch
        assert cheap_method(name, observed=True).supports(scene) is None
    for name in ("pod", "hpod", "fem-coarse", "hybrid", "pgd-snapshots"):
        assert NO_FORCES in str(cheap_method(name).supports(scene))


def test_values_at_hidden_nodes_are_ignored(linear: Surrogate, data: Dataset) -> None:
    nodes = data.scene.observed_nodes
    assert nodes is not None
    given = data.test.given[:2]
    expected = linear.predict(given)
    for hidden in (np.nan, np.inf, 3.0):
        seen = np.full_like(given.values, hidden)
        seen[:, nodes] = given.values[:, nodes]
        before = seen.copy()
        np.testing.assert_array_equal(linear.predict(given.with_values(seen)), expected)
        np.testing.assert_array_equal(seen, before)
    seen[1, nodes[3], 2] = np.nan
    with pytest.raises(InvalidInputError, match=r"must be finite .* m at the observed nodes"):
        linear.predict(given.with_values(seen))


def test_a_loaded_model_knows_its_observed_nodes(
    gappy: Surrogate, data: Dataset, tmp_path: Path
) -> None:
    gappy.save(tmp_path / "model.safetensors")
    loaded = mor_bench.load_surrogate(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(loaded.scene_.observed_nodes, data.scene.observed_nodes)
    given = data.test.given[:3]
    np.testing.assert_array_equal(loaded.predict(given), gappy.predict(given))


class Forgetful(Surrogate):
    """A method older than such scenes, which claims to support everything."""

    def supports(self, scene: Scene) -> str | None:
        return None

    def answer(self, forces: np.ndarray) -> np.ndarray:
        return forces


def test_a_method_gets_displacements_only_if_it_declares_support(
    data: Dataset, tiny: Dataset
) -> None:
    with pytest.raises(UnsupportedSceneError, match=NO_FORCES):
        Forgetful().fit(data.scene, data.train)
    Forgetful().fit(tiny.scene, tiny.train)


def test_forces_and_displacements_are_never_confused(
    linear: Surrogate, data: Dataset, tiny: Dataset
) -> None:
    given = data.test.given
    with pytest.raises(InvalidInputError, match="must be forces"):
        mor_bench.load_method("linear-fem").fit(tiny.scene).predict(given)
    with pytest.raises(InvalidInputError, match="must be displacements of observed nodes"):
        linear.predict(given.values)
    with pytest.raises(InvalidInputError, match="belong to other nodes"):
        linear.predict(ObservedDisplacements(given.values, np.arange(5)))


def test_gappy_pod_requires_observed_displacements(tiny: Dataset) -> None:
    with pytest.raises(UnsupportedSceneError, match="the scene gives forces"):
        mor_bench.load_method("gappy-pod").fit(tiny.scene, tiny.train)


def test_without_forces_no_error_is_indicated_and_no_range_is_known(
    linear: Surrogate, gappy: Surrogate, data: Dataset
) -> None:
    with pytest.raises(UnsupportedSceneError, match="the error cannot be estimated"):
        linear.indicate_error(data.test.given[0], data.test.displacements[0])
    with pytest.raises(UnknownRangeError, match=NO_FORCES):
        gappy.out_of_range(data.test.given)


@pytest.mark.slow
def test_a_run_has_rows_of_supported_methods_and_reasons_for_the_others(
    data: Dataset, cache: Path, tmp_path: Path
) -> None:
    path = written(tmp_path, TOP)
    pod = method_file(tmp_path, "pod", "mor_bench.surrogates.pod:PODGalerkin")
    with short_timing():
        comparison = mor_bench.run([path], [*PLAIN, pod], out=tmp_path / "out", cache=cache)
    rows = {row.label: row for row in comparison.rows}
    assert set(rows) == {"linear-fem", "pca-regression", "pod"}
    direct = (
        mor_bench.load_method("pca-regression").fit(data.scene, data.train).predict(data.test.given)
    )
    error = rows["pca-regression"].error
    assert error is not None
    assert error.rel_l2_median == pytest.approx(
        np.median(relative_l2(direct, data.test.displacements))
    )
    for label, row in rows.items():
        assert row.status == ("skipped" if label == "pod" else "ok"), row.reason
        if row.status == "skipped":
            assert NO_FORCES in (row.reason or "")
        else:
            assert row.latency_ms is not None
            assert row.latency_ms.median > 0
            assert row.indicator is None
    assert comparison.datasets["beam-tiny-observed"]["observed"] == {"region": "z-max"}


def test_the_cache_does_not_return_a_model_of_other_observed_nodes(
    data: Dataset, tiny: Dataset, tmp_path: Path
) -> None:
    corner = scene_of({"region": {"nearest_m": [[2.0, 1.0, 1.0], 20]}})
    digests = {
        TrainingData(scene, tiny.train, tiny.validation, {}, tmp_path).digest
        for scene in (tiny.scene, data.scene, corner)
    }
    assert len(digests) == 3


@pytest.mark.slow
def test_all_supported_methods_run_by_default(tmp_path: Path) -> None:
    path = written(tmp_path, TOP)
    chosen = [method.name for method in checked_specs([path], None, RunOptions()).methods]
    assert chosen == list(OBSERVATION_METHODS)


def test_exported_predictions_use_the_observed_displacements(
    gappy: Surrogate, data: Dataset, tiny: Dataset, tmp_path: Path
) -> None:
    import meshio

    gappy.save(tmp_path / "gappy.safetensors")
    paths = export_vtu(data, 2, tmp_path / "vtu", models=[tmp_path / "gappy.safetensors"])
    found = meshio.read(paths[1]).point_data
    np.testing.assert_array_equal(found["displacement"], gappy.predict(data.test.given[2]))
    np.testing.assert_array_equal(found["force"], data.test.forces[2])
    with pytest.raises(InvalidInputError, match="the model was fitted to"):
        export_vtu(tiny, 2, tmp_path / "vtu", models=[tmp_path / "gappy.safetensors"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["umesh-small", "umesh-linear"])
def test_an_onnx_file_ignores_hidden_nodes(name: str, data: Dataset, tmp_path: Path) -> None:
    onnx, runtime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    pytest.importorskip("torch")
    method = mor_bench.load_method(name, channels=2, steps=1, iterations=3).fit(
        data.scene, data.train
    )
    method.save(tmp_path / "model.safetensors")
    path, _ = export_onnx(tmp_path / "model.safetensors", tmp_path / "model.onnx")
    assert (
        "displacements of the observed nodes in m"
        in {entry.key: entry.value for entry in onnx.load(path).metadata_props}["units"]
    )
    observed = data.scene.observed_nodes
    assert observed is not None
    given = data.test.given[:3].values.astype(np.float32)
    given[:, np.setdiff1d(np.arange(given.shape[1]), observed)] = np.nan
    (found,) = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run(
        None, {"forces": given}
    )
    expected = method.predict(data.test.given[:3])
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


def test_imported_snapshots_can_be_completed(data: Dataset, tmp_path: Path) -> None:
    _, path = export_numpy(data, tmp_path / "mine.npz")
    path.write_text(path.read_text() + TOP)
    mine = mor_bench.load_dataset(path)
    own, first = (
        mor_bench.load_method("gappy-pod").fit(each.scene, each.train) for each in (mine, data)
    )
    np.testing.assert_allclose(
        own.predict(data.test.given), first.predict(data.test.given), atol=1e-9
    )
    assert mor_bench.load_method("fem").supports(mine.scene) is not None
    path.write_text(path.read_text().replace('"z-max"', '"x-min"'))
    with pytest.raises(SpecError, match="free to move"):
        mor_bench.load_dataset(path)
