"""What every method of the suite must do; a new method file is picked up by itself."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save as serialise

import mor_bench
from mor_bench.errors import InvalidInputError, MissingDependencyError, NotFittedError, StoreError
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.model_file import model_digest as file_digest
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import list_suite
from mor_bench.surrogate import Surrogate

CHEAP_UMESH = {
    "channels": 8,
    "steps": 1,
    "iterations": 150,
    "batch_size": 16,
    "learning_rate": 3e-3,
}
CHEAP_PGD = {"n_terms": 20, "position_degree": 2}
CHEAP: dict[str, dict[str, Any]] = {
    "autoencoder": {"iterations": 100},
    "pgd": CHEAP_PGD,
    "pgd-force": CHEAP_PGD,
    "umesh": CHEAP_UMESH,
    "umesh-small": CHEAP_UMESH,
    "umesh-linear": CHEAP_UMESH,
    "pca-gaussian-process": {"n_input_modes": 10, "n_optimised": 60},
    "pca-random-forest": {"n_trees": 10},
    "pca-extra-trees": {"n_trees": 10},
    "pod-nn-force": {"iterations": 300, "n_hidden": 16},
    "pod-nn": {"iterations": 300, "n_hidden": 16},
    "pod-nn-derivative": {"iterations": 300, "n_hidden": 16},
    "deeponet": {"iterations": 20},
    "pod-deeponet": {"iterations": 20},
    "fno": {"channels": 4, "layers": 2, "iterations": 10},
    "mesh-graph-net": {"width": 8, "steps": 2, "iterations": 10},
}
"""Parameters that keep a costly method's battery short."""

NEEDS_NO_SNAPSHOTS = (
    "explicit-dynamics",
    "fem",
    "fem-coarse",
    "fem-jacobi-pcg",
    "fem-pardiso",
    "linear-fem",
    "modal-derivatives",
    "quadratic-manifold",
)

GIVEN_FORCES = sorted(set(list_suite("methods")) - {"gappy-pod"})
"""All but those that complete observed displacements only, for which see `test_observation`."""

FAR_BETTER = {"UMesh": 0.9, "CoarseFEM": 0.3}
"""Bounds, by class, on the mean error over that of no prediction: a short training, and a mesh of 3 cells."""


def make(name: str) -> Surrogate:
    try:
        return mor_bench.load_method(name, **CHEAP.get(name, {}))
    except MissingDependencyError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module", params=GIVEN_FORCES)
def fitted(request: pytest.FixtureRequest, tiny: Dataset) -> Surrogate:
    method = make(request.param)
    reason = method.supports(tiny.scene)
    if reason:
        pytest.skip(reason)
    return method.fit(tiny.scene, tiny.train)


def test_one_query_and_a_batch_agree(fitted: Surrogate, tiny: Dataset) -> None:
    forces = tiny.test.forces[:5]
    batch = fitted.predict(forces)
    assert batch.shape == forces.shape
    assert batch.dtype == np.float64
    single = np.stack([fitted.predict(force) for force in forces])
    assert single.shape == forces.shape
    np.testing.assert_allclose(single, batch, rtol=0, atol=2e-6 * np.abs(batch).max())


def test_supports_do_not_move(fitted: Surrogate, tiny: Dataset) -> None:
    assert (fitted.predict(tiny.test.forces[:5])[:, tiny.scene.fixed_nodes] == 0).all()


def test_zero_force(fitted: Surrogate, tiny: Dataset) -> None:
    if fitted.parameters.get("zero_at_rest") is False:
        pytest.skip(
            "the published U-Mesh has biases and answers no force with a small displacement"
        )
    rms = np.sqrt((tiny.train.displacements**2).mean())
    assert np.linalg.norm(fitted.predict(np.zeros((tiny.scene.mesh.n_nodes, 3)))) <= 1e-3 * rms


def test_prediction_is_far_better_than_none(fitted: Surrogate, tiny: Dataset) -> None:
    if fitted.parameters.get("input") == "force":
        pytest.skip(
            "from the force alone nothing is known of unseen load regions; see the method's limits"
        )
    forces, reference = tiny.train.forces[:40], tiny.train.displacements[:40]
    own = sample_errors(fitted.predict(forces), reference).mean_dof_m.mean()
    none = sample_errors(np.zeros_like(reference), reference).mean_dof_m.mean()
    assert own < FAR_BETTER.get(type(fitted).__name__, 0.2) * none


def test_inputs_are_left_alone(fitted: Surrogate, tiny: Dataset) -> None:
    forces = tiny.test.forces[:3].copy()
    before = forces.copy()
    fitted.predict(forces)
    np.testing.assert_array_equal(forces, before)


def test_other_real_dtypes_and_lists_are_taken(fitted: Surrogate, tiny: Dataset) -> None:
    force = np.round(tiny.test.forces[0], 3)
    np.testing.assert_allclose(fitted.predict(force.tolist()), fitted.predict(force), atol=1e-15)
    assert fitted.predict(force.astype(np.float32)).dtype == np.float64
    assert np.isfinite(fitted.predict(np.ones(force.shape, dtype=int) * 0)).all()


def test_an_empty_batch_is_answered_with_one(fitted: Surrogate, tiny: Dataset) -> None:
    assert fitted.predict(tiny.test.forces[:0]).shape == (0, tiny.scene.mesh.n_nodes, 3)


@pytest.mark.parametrize("bad", ["nan", "inf", "1e155", "shape", "flat", "complex", "text"])
def test_bad_forces_are_refused(fitted: Surrogate, tiny: Dataset, bad: str) -> None:
    force: object = tiny.test.forces[0].copy()
    assert isinstance(force, np.ndarray)
    if bad in ("nan", "inf", "1e155"):
        force[3, 1] = float(bad)
    force = {
        "shape": force[:-1],
        "flat": force.ravel(),
        "complex": force + 1j,
        "text": force.astype(str),
    }.get(bad, force)
    with pytest.raises(InvalidInputError, match="forces"):
        fitted.predict(force)


def test_saved_and_loaded_predicts_the_same(
    fitted: Surrogate, tiny: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "model.safetensors"
    fitted.save(path)
    loaded = mor_bench.load_surrogate(path)
    assert type(loaded) is type(fitted)
    assert loaded.parameters == fitted.parameters
    np.testing.assert_array_equal(
        loaded.predict(tiny.test.forces[:3]), fitted.predict(tiny.test.forces[:3])
    )


@pytest.mark.parametrize("damage", ["truncated", "foreign", "class", "version", "bit"])
def test_damaged_files_are_refused(fitted: Surrogate, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "model.safetensors"
    fitted.save(path)
    content = path.read_bytes()
    name = f"{type(fitted).__module__}:{type(fitted).__qualname__}".encode()
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


@pytest.mark.parametrize("forgery", ["fewer rows", "nan", "knobs", "scene", "missing"])
def test_forged_files_with_a_valid_checksum_are_refused(
    fitted: Surrogate, tmp_path: Path, forgery: str
) -> None:
    """Nothing reaches a kernel, which checks no bounds, before its shape is checked."""
    path = tmp_path / "model.safetensors"
    fitted.save(path)
    with safe_open(str(path), framework="numpy") as file:
        header, arrays = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if not arrays and forgery in ("fewer rows", "nan", "missing"):
        assert fitted.needs_snapshots is False
        return
    first = (
        sorted(name for name, array in arrays.items() if array.dtype.kind == "f")[0]
        if arrays
        else ""
    )
    if forgery == "fewer rows":
        arrays = {
            name: np.ascontiguousarray(array[: len(array) // 2]) for name, array in arrays.items()
        }
    elif forgery == "nan":
        arrays[first] = np.full_like(arrays[first], np.nan)
    elif forgery == "missing":
        del arrays[first]
    else:
        header[{"knobs": "parameters", "scene": "scene"}[forgery]] = "[1]"
    header["sha256"] = file_digest(header, arrays)
    path.write_bytes(serialise(arrays, metadata=header))
    with pytest.raises(StoreError, match=r"model\.safetensors"):
        mor_bench.load_surrogate(path)


@pytest.mark.parametrize("name", sorted(list_suite("methods")))
def test_unfitted_methods_say_so(name: str, tiny: Dataset, tmp_path: Path) -> None:
    method = make(name)
    with pytest.raises(NotFittedError):
        method.predict(tiny.test.forces[0])
    with pytest.raises(NotFittedError):
        method.save(tmp_path / "model.safetensors")
    assert not (tmp_path / "model.safetensors").exists()


@pytest.mark.parametrize("name", GIVEN_FORCES)
def test_fitting_again_forgets_the_first_fit_and_repeats_it(name: str, tiny: Dataset) -> None:
    first = make(name).fit(tiny.scene, tiny.train).predict(tiny.test.forces[:3])
    again = make(name).fit(tiny.scene, tiny.train[:40])
    assert again.fit(tiny.scene, tiny.train) is again
    np.testing.assert_array_equal(again.predict(tiny.test.forces[:3]), first)


@pytest.mark.parametrize("name", GIVEN_FORCES)
def test_snapshots_with_nan_or_none_at_all_are_refused(name: str, tiny: Dataset) -> None:
    if name in NEEDS_NO_SNAPSHOTS:
        assert np.isfinite(make(name).fit(tiny.scene, None).predict(tiny.test.forces[0])).all()
        return
    spoilt = copy.deepcopy(tiny.train[:20])
    spoilt.free_displacements[3, 4] = np.nan
    method = make(name).fit(tiny.scene, tiny.train)
    for snapshots in (None, tiny.train[:0], spoilt):
        with pytest.raises(InvalidInputError):
            method.fit(tiny.scene, snapshots)
        with pytest.raises(NotFittedError):
            method.predict(tiny.test.forces[0])
