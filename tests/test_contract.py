"""The requirements for every method of the suite. A new method file is tested automatically."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import (
    InvalidInputError,
    MorBenchError,
    NotFittedError,
    SpecError,
    StoreError,
    UnknownRangeError,
    UnsupportedSceneError,
)
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.method_loading import make_surrogate
from mor_bench.model_arrays import take_array, take_indices
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.surrogate import Surrogate
from tests.model_files import rewrite
from tests.suite_methods import SPECS, cheap_method
from tests.third_party import Plain, Recorder, Zero

GIVEN_FORCES = sorted(set(SPECS) - {"gappy-pod"})
"""All methods but the one that only completes observed displacements."""

QUICK = {
    spec.surrogate: name
    for name, spec in reversed(SPECS.items())
    if "iterations" not in {*spec.parameters, *spec.battery.parameters}
}
"""The first method of each class that does not train. All others join the slow tests."""

BATTERY = [
    name if name in QUICK.values() else pytest.param(name, marks=pytest.mark.slow)
    for name in GIVEN_FORCES
]


@pytest.fixture(params=BATTERY)
def fitted(request: pytest.FixtureRequest, fitted_by_name: Callable[[str], Surrogate]) -> Surrogate:
    return fitted_by_name(request.param)


@pytest.fixture(scope="module")
def pod(tiny: Dataset) -> Surrogate:
    return mor_bench.load_method("pod", n_modes=5).fit(tiny.scene, tiny.train)


def test_a_query_has_the_same_answer_alone_and_in_a_batch(fitted: Surrogate, tiny: Dataset) -> None:
    forces = tiny.test.forces[:4].copy()
    before = forces.copy()
    batch = fitted.predict(forces)
    np.testing.assert_array_equal(forces, before)
    assert batch.shape == forces.shape
    assert batch.dtype == np.float64
    assert (batch[:, tiny.scene.fixed_nodes] == 0).all()
    single = np.stack([fitted.predict(force) for force in forces])
    np.testing.assert_allclose(single, batch, rtol=0, atol=2e-6 * np.abs(batch).max())
    assert fitted.predict(forces[:0]).shape == (0, *forces.shape[1:])


def test_zero_force_gives_zero_displacement(fitted: Surrogate, tiny: Dataset) -> None:
    if fitted.parameters.get("zero_at_rest") is False:
        pytest.skip("the published U-Mesh has biases, so that it moves a little without a force")
    rms = np.sqrt((tiny.train.displacements**2).mean())
    assert np.linalg.norm(fitted.predict(np.zeros((tiny.scene.mesh.n_nodes, 3)))) <= 1e-3 * rms


def test_a_prediction_is_far_better_than_zero_displacement(
    request: pytest.FixtureRequest, fitted: Surrogate, tiny: Dataset
) -> None:
    if fitted.parameters.get("input") == "force":
        pytest.skip("the force alone says nothing about unseen load regions")
    bound = SPECS[request.node.callspec.params["fitted"]].battery.error
    forces, reference = tiny.train.forces[:40], tiny.train.displacements[:40]
    own = sample_errors(fitted.predict(forces), reference).mean_dof_m.mean()
    none = sample_errors(np.zeros_like(reference), reference).mean_dof_m.mean()
    assert own < bound * none


def test_a_loaded_model_predicts_the_same_bits(
    fitted: Surrogate, tiny: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "model.safetensors"
    fitted.save(path)
    loaded = mor_bench.load_surrogate(path)
    assert type(loaded) is type(fitted)
    assert loaded.parameters == fitted.parameters
    forces = tiny.test.forces[:3]
    np.testing.assert_array_equal(loaded.predict(forces), fitted.predict(forces))


@pytest.mark.parametrize("forgery", ["fewer rows", "NaN", "missing"])
def test_wrong_arrays_with_a_valid_checksum_are_refused(
    fitted: Surrogate, tmp_path: Path, forgery: str
) -> None:
    """Kernels check no bounds, so `prepare` must check them."""

    def forge(arrays: dict[str, NDArray[Any]]) -> None:
        first = min(name for name, array in arrays.items() if array.dtype.kind == "f")
        if forgery == "missing":
            del arrays[first]
        elif forgery == "NaN":
            arrays[first] = np.full_like(arrays[first], np.nan)
        else:
            for name, array in arrays.items():
                arrays[name] = np.ascontiguousarray(array[: len(array) // 2])

    if not fitted.arrays_:
        assert fitted.needs_snapshots is False
        return
    path = tmp_path / "model.safetensors"
    fitted.save(path)
    rewrite(path, forge)
    with pytest.raises(StoreError, match=r"model\.safetensors"):
        mor_bench.load_surrogate(path)


def test_fitting_again_discards_the_first_fit_and_is_repeatable(
    fitted: Surrogate, tiny: Dataset
) -> None:
    expected = fitted.predict(tiny.test.forces[:3])
    again = make_surrogate(type(fitted), fitted.parameters)
    if again.needs_snapshots and not again.trains():
        again.fit(tiny.scene, tiny.train[:40])
    assert again.fit(tiny.scene, tiny.train) is again
    np.testing.assert_array_equal(again.predict(tiny.test.forces[:3]), expected)


@pytest.mark.parametrize("name", sorted(SPECS))
def test_every_method_inherits_checks_and_files_from_the_base_class(name: str) -> None:
    """The tests below use one method, and hold for all because of this."""
    surrogate = type(cheap_method(name))
    for verb in ("fit", "predict", "restore", "save", "forget", "out_of_range", "indicate_error"):
        assert getattr(surrogate, verb) is getattr(Surrogate, verb), verb


@pytest.mark.parametrize("bad", ["nan", "inf", "1e155", "shape", "flat", "complex", "text"])
def test_bad_forces_are_refused(pod: Surrogate, tiny: Dataset, bad: str) -> None:
    force: NDArray[Any] = tiny.test.forces[0].copy()
    if bad in ("nan", "inf", "1e155"):
        force[3, 1] = float(bad)
    force = {
        "shape": force[:-1],
        "flat": force.ravel(),
        "complex": force + 1j,
        "text": force.astype(str),
    }.get(bad, force)
    with pytest.raises(InvalidInputError, match="forces"):
        pod.predict(force)


def test_lists_and_other_real_dtypes_are_accepted(pod: Surrogate, tiny: Dataset) -> None:
    force = np.round(tiny.test.forces[0], 3)
    np.testing.assert_allclose(pod.predict(force.tolist()), pod.predict(force), atol=1e-15)
    assert pod.predict(force.astype(np.float32)).dtype == np.float64
    assert np.isfinite(pod.predict(np.zeros(force.shape, dtype=int))).all()


@pytest.mark.parametrize("damage", ["truncated", "foreign", "class", "version", "bit"])
def test_damaged_files_are_refused(pod: Surrogate, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "model.safetensors"
    pod.save(path)
    content = path.read_bytes()
    name = f"{type(pod).__module__}:{type(pod).__qualname__}".encode()
    changed = {
        "truncated": content[: len(content) // 3],
        "foreign": b"something else entirely",
        "class": content.replace(name, b"os:" + b"x" * (len(name) - 3)),
        "bit": content[:-3] + bytes([content[-3] ^ 4]) + content[-2:],
        "version": content.replace(b'"schema_version":"1"', b'"schema_version":"9"'),
    }[damage]
    assert changed != content
    path.write_bytes(changed)
    with pytest.raises(StoreError, match=r"model\.safetensors"):
        mor_bench.load_surrogate(path)


@pytest.mark.parametrize("key", ["parameters", "scene"])
def test_a_forged_header_is_refused(pod: Surrogate, tmp_path: Path, key: str) -> None:
    path = tmp_path / "model.safetensors"
    pod.save(path)
    rewrite(path, lambda arrays: None, **{key: "[1]"})
    with pytest.raises(StoreError, match=r"model\.safetensors"):
        mor_bench.load_surrogate(path)


def test_unfitted_methods_raise_an_error_that_says_so(tiny: Dataset, tmp_path: Path) -> None:
    method = mor_bench.load_method("pod")
    with pytest.raises(NotFittedError):
        method.predict(tiny.test.forces[0])
    with pytest.raises(NotFittedError):
        method.save(tmp_path / "model.safetensors")
    assert not list(tmp_path.iterdir())


def test_bad_snapshots_are_refused_and_leave_the_method_unfitted(tiny: Dataset) -> None:
    spoilt = copy.deepcopy(tiny.train[:20])
    spoilt.free_displacements[3, 4] = np.nan
    method = mor_bench.load_method("pod", n_modes=3)
    for snapshots in (None, tiny.train[:0], spoilt):
        method.fit(tiny.scene, tiny.train)
        with pytest.raises(InvalidInputError):
            method.fit(tiny.scene, snapshots)
        with pytest.raises(NotFittedError):
            method.predict(tiny.test.forces[0])


@dataclass(eq=False)
class Hoarder(Zero):
    """Keeps attributes under many names, and fails or learns nonsense on request."""

    how: str = "well"

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        self._own, self.other, self.learned_ = 1, 2, 3
        if self.how == "fails":
            raise InvalidInputError("on purpose")
        return {"a": np.array([np.nan if self.how == "nan" else 1.0])}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        self._prepared = model["a"]


@pytest.mark.parametrize("how", ["fails", "nan"])
def test_a_failed_fit_leaves_nothing_but_hyperparameters_and_options(
    how: str, tiny: Dataset
) -> None:
    method = Hoarder().fit(tiny.scene)
    method.time_limit_s, method.how = 5.0, how
    assert {"_own", "other", "learned_", "_prepared", "scene_"} <= vars(method).keys()
    with pytest.raises(InvalidInputError):
        method.fit(tiny.scene)
    assert vars(method) == {"how": how, "time_limit_s": 5.0}


def test_a_plain_class_with_fit_and_predict_is_adapted(tiny: Dataset, tmp_path: Path) -> None:
    method = make_surrogate(Plain, {"factor": 2.0})
    assert method.parameters == {"factor": 2.0}
    with pytest.raises(NotFittedError):
        method.predict(tiny.test.forces[0])
    method.fit(tiny.scene, tiny.train)
    np.testing.assert_array_equal(method.predict(tiny.test.forces[:2]), 2 * tiny.test.forces[:2])
    np.testing.assert_array_equal(method.predict(tiny.test.forces[0]), 2 * tiny.test.forces[0])
    assert method.out_of_range(100 * tiny.test.forces).all()
    with pytest.raises(MorBenchError, match="cannot be saved"):
        method.save(tmp_path / "model.safetensors")
    observed = tiny.scene.spec.model_dump(mode="json") | {"observed": {"region": "z-max"}}
    with pytest.raises(UnsupportedSceneError):
        method.fit(mor_bench.load_scene(observed), tiny.train)
    with pytest.raises(SpecError, match="faktor"):
        make_surrogate(Plain, {"faktor": 2.0})
    with pytest.raises(MorBenchError, match="has no methods `fit` and `predict`"):
        make_surrogate(dict, {})


def test_a_class_that_overrides_fit_and_predict_has_no_load_range_and_cannot_be_saved(
    tiny: Dataset, tmp_path: Path
) -> None:
    method = make_surrogate(Recorder, {"notes": str(tmp_path / "notes"), "spoil": "nothing"})
    method.fit(tiny.scene, tiny.train)
    assert method.predict(tiny.test.forces[:2].copy()).shape == (2, *tiny.test.forces.shape[1:])
    with pytest.raises(UnknownRangeError):
        method.out_of_range(tiny.test.forces)
    with pytest.raises(NotFittedError):
        method.save(tmp_path / "model.safetensors")


def test_invalid_arrays_of_a_model_are_refused() -> None:
    model = {"a": np.zeros((2, 3)).T, "i": np.array([0, 4])}
    assert take_array(model, "a", (3, None)).flags.c_contiguous
    for name, shape, dtype in (
        ("b", (3, 2), float),
        ("a", (2, 3), float),
        ("a", (3,), float),
        ("a", (3, 2), np.float32),
    ):
        with pytest.raises(InvalidInputError, match=f"`{name}`"):
            take_array(model, name, shape, dtype)
    with pytest.raises(InvalidInputError, match="`a`"):
        take_array({"a": np.array([np.inf])}, "a", (None,))
    assert take_indices(model, "i", 5).tolist() == [0, 4]
    for wrong in ([0, 5], [-1, 2], [1, 1], [0.0, 1.0], []):
        with pytest.raises(InvalidInputError, match=r"`i` must be different integers in \[0, 4\]"):
            take_indices({"i": np.array(wrong)}, "i", 5)
