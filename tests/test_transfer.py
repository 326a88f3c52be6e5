"""A training starts from a saved model of its class and architecture, in the new samples' bases."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.model_file import read_model, weights_to_start_from, write_model
from mor_bench.scene.mesh import box_mesh
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import list_suite, load_method_spec
from mor_bench.surrogate import Surrogate
from mor_bench.training_options import TrainingOptions
from tests.relative_errors import median_error

pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.surrogates.autoencoder import Autoencoder
from mor_bench.surrogates.network_manifold import NetworkManifold

SMALL: dict[str, dict[str, Any]] = {
    "deeponet": {"width": 8, "depth": 2, "n_functions": 8, "n_input_modes": 8},
    "pod-deeponet": {"width": 8, "depth": 2, "n_functions": 8, "n_input_modes": 8},
    "fno": {"channels": 2, "modes": 2, "layers": 1},
    "mesh-graph-net": {"width": 4, "steps": 1},
    "graph-u-net": {"width": 4, "levels": 2, "steps": 1},
    "transolver": {"width": 4, "heads": 2, "slices": 2, "layers": 1, "mlp_ratio": 1},
    "pod-nn": {"n_hidden": 4, "n_input_modes": 8, "n_output_modes": 8, "input": "force"},
    "umesh-small": {"channels": 2, "steps": 1, "validation_fraction": 0.0},
}


def make(name: str, **knobs: Any) -> Any:
    return mor_bench.load_method(name, **{**SMALL[name], "iterations": 1, **knobs})


def started(method: Surrogate, path: Path, samples: Snapshots) -> Surrogate:
    method.training = TrainingOptions(start_from=path)
    return method.fit(samples.scene, samples)


@pytest.fixture(scope="module")
def files(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A model of each method, trained for one step."""
    folder = tmp_path_factory.mktemp("models")
    for name in SMALL:
        make(name).fit(tiny.scene, tiny.train[:12]).save(folder / f"{name}.safetensors")
    return {name: folder / f"{name}.safetensors" for name in SMALL}


@pytest.mark.filterwarnings("ignore:.* modes were requested")
@pytest.mark.parametrize("name", ["deeponet", "pod-deeponet"])
def test_the_branch_is_transformed_to_the_bases_of_other_samples(
    name: str, tiny: Dataset, tmp_path: Path
) -> None:
    knobs = {"width": 32, "n_functions": 64, "n_input_modes": 200}
    first = make(name, **knobs, iterations=300).fit(tiny.scene, tiny.train[:48:2])
    others = tiny.train[1:48:2]
    first.save(tmp_path / "model.safetensors")
    second = make(name, **knobs, seed=3, learning_rate=1e-12)
    random, own = median_error(second.fit(tiny.scene, others), others), median_error(first, others)
    assert own < 0.8 * random
    again = started(second, tmp_path / "model.safetensors", others)
    assert median_error(again, others) == pytest.approx(own, rel=0.02)


def test_a_model_of_another_class_is_refused(files: dict[str, Path], tiny: Dataset) -> None:
    with pytest.raises(InvalidInputError, match="must be a model of class"):
        started(make("fno"), files["mesh-graph-net"], tiny.train[:12])


@pytest.mark.parametrize(
    "name", ["fno", "mesh-graph-net", "graph-u-net", "transolver", "umesh-small"]
)
def test_a_training_on_the_same_scene_starts_from_the_same_weights(
    name: str, files: dict[str, Path], tiny: Dataset
) -> None:
    second = started(make(name, seed=5, learning_rate=1e-30), files[name], tiny.train[:12])
    first = mor_bench.load_surrogate(files[name])
    for key, array in first.arrays_.items():
        if key.startswith("network."):
            np.testing.assert_allclose(second.arrays_[key], array, rtol=1e-6, atol=1e-20)


def test_every_trained_method_names_its_architecture() -> None:
    classes = {load_method_spec(file).load_class() for file in list_suite("methods").values()}
    # No training can start from the files of these, which lack an encoder.
    alone = (Autoencoder, NetworkManifold)
    trained = [item for item in classes if item.trains() and not issubclass(item, alone)]
    for surrogate in trained:
        assert surrogate.architecture
        assert set(surrogate.architecture) <= surrogate().parameters.keys()


@pytest.mark.parametrize(
    ("name", "knob", "value"),
    [
        ("mesh-graph-net", "width", 8),
        ("mesh-graph-net", "steps", 2),
        ("mesh-graph-net", "hidden_layers", 2),
        ("mesh-graph-net", "input", "linear-response"),
        ("graph-u-net", "width", 8),
        ("graph-u-net", "levels", 1),
        ("graph-u-net", "steps", 2),
        ("graph-u-net", "input", "linear-response"),
        ("transolver", "width", 8),
        ("transolver", "heads", 1),
        ("transolver", "slices", 3),
        ("transolver", "layers", 2),
        ("transolver", "mlp_ratio", 2),
        ("transolver", "input", "linear-response"),
        ("fno", "channels", 4),
        ("fno", "modes", 3),
        ("fno", "layers", 2),
        ("fno", "input", "linear-response"),
        ("deeponet", "trunk", "pod"),
        ("deeponet", "depth", 3),
        ("pod-deeponet", "trunk", "network"),
        ("pod-deeponet", "n_functions", 4),
        ("pod-nn", "input", "linear-response"),
        ("pod-nn", "n_hidden", 8),
        ("umesh-small", "input", "linear-response"),
        ("umesh-small", "activation", "relu"),
        ("umesh-small", "zero_at_rest", False),
        ("umesh-small", "normalisation", "max"),
        ("umesh-small", "steps", 2),
    ],
)
def test_another_architecture_is_refused(
    name: str, knob: str, value: Any, files: dict[str, Path], tiny: Dataset
) -> None:
    saved = getattr(make(name), knob)
    with pytest.raises(InvalidInputError) as raised:
        started(make(name, **{knob: value}), files[name], tiny.train[:12])
    wanted, got = (f"`{knob}` {number!r}" for number in (value, saved))
    message = f"{files[name]}: `start_from` must be a model with {wanted}; got one with {got}."
    assert str(raised.value) == message


def test_another_architecture_is_refused_before_anything_runs(
    files: dict[str, Path], tmp_path: Path
) -> None:
    with pytest.raises(
        InvalidInputError, match=r"`activation` 'relu'.*; got one with .*`activation` 'silu'"
    ):
        mor_bench.fit(
            "beam-tiny",
            "umesh-linear",
            {"channels": 2, "steps": 1, "activation": "relu"},
            out=tmp_path / "a",
            start_from=files["umesh-small"],
            cache=tmp_path / "cache",
        )
    assert not any(tmp_path.iterdir())


def test_training_hyperparameters_may_differ(files: dict[str, Path], tiny: Dataset) -> None:
    for name, path in files.items():
        started(make(name, iterations=2, seed=1), path, tiny.train[12:24])


@pytest.mark.parametrize("name", SMALL)
def test_another_mesh_takes_only_weights_that_keep_their_meaning(
    name: str, files: dict[str, Path], tiny: Dataset, tmp_path: Path
) -> None:
    mesh = box_mesh((2.0, 1.0, 1.0), (3, 1, 1))
    scene = replace(tiny.scene, mesh=mesh, fixed_nodes=np.flatnonzero(mesh.points[:, 0] == 0))
    displacements = np.random.default_rng(0).normal(size=(8, len(scene.free_dofs)))
    samples = Snapshots(scene, draw_loads(scene, 0, 8), displacements, np.ones(8))
    if name in ("mesh-graph-net", "graph-u-net", "transolver", "umesh-small", "fno"):
        started(make(name), files[name], samples)
    if name in ("mesh-graph-net", "graph-u-net", "transolver", "umesh-small"):
        return
    knobs, path = {}, files[name]
    if name == "fno":  # for a grid with more wave numbers
        knobs, path = {"modes": 4}, tmp_path / "fno.safetensors"
        make(name, **knobs).fit(tiny.scene, tiny.train[:12]).save(path)
    with pytest.raises(
        InvalidInputError, match=r"`start_from`: the array `\S+` must be of shape \(.*\); got \("
    ):
        started(make(name, **knobs), path, samples)


ARRAYS = {
    "pod-nn": ["network.second", "axes", "modes"],
    "fno": ["network.lift.weight"],
    "mesh-graph-net": ["network.decoder.0.weight"],
    "graph-u-net": ["network.decoder.0.weight"],
    "transolver": ["network.blocks.0.attention.assign.weight"],
    "umesh-small": ["network.head.weight"],
    "deeponet": ["network.branch.2.weight", "constant.axes"],
    "pod-deeponet": ["network.branch.2.weight", "constant.modes"],
}


@pytest.mark.parametrize("name", SMALL)
def test_missing_or_invalid_weights_are_refused(
    name: str, files: dict[str, Path], tiny: Dataset, tmp_path: Path
) -> None:
    method, path = mor_bench.load_surrogate(files[name]), tmp_path / "forged.safetensors"
    whole = dict(method.arrays_)
    forgeries: list[tuple[dict[str, Any], str]] = [({}, "it is missing")]
    for key in ARRAYS[name]:
        array = whole[key]
        rest = {item: value for item, value in whole.items() if item != key}
        forgeries += [
            (rest, f"`{key}` must be float.*; it is missing"),
            ({**whole, key: array.astype(np.uint8)}, f"`{key}` must be float.*; got uint8"),
            ({**whole, key: np.full_like(array, np.nan)}, f"`{key}` holds NaN or infinity"),
            ({**whole, key: array.ravel()}, f"`{key}` must be of shape"),
            ({**whole, key: array[:0]}, f"`{key}` must be of shape"),
        ]
    if "scales" in whole:
        wrong = {**whole, "scales": np.array([1.0, 0.0])}
        forgeries += [(wrong, "`scales` must be greater than 0")]
    for arrays, message in forgeries:
        method.arrays_ = arrays
        method.save(path)
        with pytest.raises((StoreError, InvalidInputError), match=message) as raised:
            started(make(name), path, tiny.train[:12])
        assert str(raised.value).startswith(f"{path}: ")
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("knobs", ["nothing", "[1]", "{", '{"width": 0}', '{"depths": 3}'])
def test_forged_parameters_are_refused(knobs: str, files: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "forged.safetensors"
    write_model(path, replace(read_model(files["mesh-graph-net"]), parameters=knobs))
    with pytest.raises(
        StoreError, match="its parameters do not match the class MeshGraphNet"
    ) as raised:
        weights_to_start_from(path, make("mesh-graph-net"))
    assert "\n" not in str(raised.value)
