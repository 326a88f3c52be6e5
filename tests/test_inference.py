"""Back ends and ONNX files agree with torch, and the choice depends on error and time."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import (
    FallbackWarning,
    InvalidInputError,
    MorBenchError,
    UnavailableBackendError,
)
from mor_bench.export.onnx_file import export_onnx
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogate import Surrogate

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning import inference, packed_network  # noqa: E402 - torch is there
from mor_bench.learning.inference import Inference, choose_inference, inference_or_eager  # noqa: E402
from mor_bench.surrogates.umesh.network import Activation, UNet, new_network  # noqa: E402

TINY = {"channels": 4, "steps": 1, "iterations": 3, "batch_size": 8}
EXACT = {"packed": 1e-5, "onnx": 1e-5, "packed-bfloat16": 5e-2}


@pytest.fixture(scope="module")
def data(cache: Path) -> Dataset:
    return mor_bench.load_dataset("beam-tiny", split="sample", cache=cache, workers=1)


@pytest.fixture(scope="module")
def fitted(data: Dataset) -> Surrogate:
    return mor_bench.load_method("umesh", **TINY).fit(data.scene, data.train)


def network(activation: Activation = "relu") -> UNet:
    """Return a network with non-zero biases."""
    generator = torch.Generator().manual_seed(1)
    made = new_network(4, 2, generator, activation).eval().requires_grad_(False)
    for parameter in made.parameters():
        if parameter.dim() == 1:
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return made


def available(net: Any, backend: Any) -> Inference:
    try:
        return Inference(net, backend)
    except UnavailableBackendError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("backend", list(EXACT))
@pytest.mark.parametrize("activation", ["relu", "silu"])
@torch.inference_mode()  # type: ignore[untyped-decorator]
def test_a_back_end_agrees_with_torch_and_a_batch_with_its_samples(
    backend: str, activation: Activation
) -> None:
    net = network(activation)
    weights = {name: value.clone() for name, value in net.state_dict().items()}
    function = available(net, backend)
    x = torch.randn(5, 12, 8, 4, 3, generator=torch.Generator().manual_seed(0)).permute(
        0, 4, 1, 2, 3
    )  # channels-last
    expected = net(x)
    answer = function(x)
    assert answer.dtype == torch.float32
    largest = float(expected.abs().max())
    assert float((answer - expected).abs().max()) <= EXACT[backend] * largest
    if backend == "packed-bfloat16":
        assert float((answer - expected).abs().max()) > 1e-5 * largest  # or it is something else
    for i in range(5):
        assert float((function(x[i : i + 1]) - answer[i : i + 1]).abs().max()) <= 2e-6 * largest
    for copied in (copy.deepcopy(function), pickle.loads(pickle.dumps(function))):
        assert torch.equal(copied(x), answer)
    assert all(torch.equal(value, weights[name]) for name, value in net.state_dict().items())


@torch.inference_mode()  # type: ignore[untyped-decorator]
def test_back_ends_keep_the_geometry_of_convolutions() -> None:
    """Strides, dilations, groups, 2D, no bias; overlapping transposed kernels are not replaced."""
    generator = torch.Generator().manual_seed(0)
    nn = torch.nn
    layers = nn.Sequential(
        nn.Conv2d(4, 6, 3, stride=2, padding=(1, 2), bias=False),
        nn.ReLU(),
        nn.Conv2d(6, 4, 3, dilation=2, groups=2),
        nn.ConvTranspose2d(4, 5, (2, 3), stride=(2, 3), bias=False),
        nn.ConvTranspose2d(5, 2, 3, stride=2),
        nn.Tanh(),
    )
    x = torch.randn(2, 4, 17, 19, generator=generator)
    torch.testing.assert_close(available(layers, "packed")(x), layers(x), rtol=1e-4, atol=1e-5)
    with pytest.raises(UnavailableBackendError, match="no convolutions"):
        Inference(nn.Linear(3, 3), "packed")
    available(network(), "onnx")  # or skip
    with pytest.raises(UnavailableBackendError, match=r"Conv2d.* has no translation"):
        Inference(layers, "onnx")


def choose(
    monkeypatch: pytest.MonkeyPatch, times: dict[str, float], own_error: float
) -> inference.Choice:
    """Return the choice for given query times and a given relative error of the network."""
    monkeypatch.setattr(
        inference, "fastest_ms", lambda able, inputs: {name: times[name] for name in able}
    )
    net = network()
    x = torch.randn(4, 3, 8, 4, 4, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        answer = net(x)
    target = answer + own_error * answer.square().mean().sqrt() * torch.randn(
        answer.shape, generator=torch.Generator().manual_seed(2)
    )
    return choose_inference(net, x, lambda function: function(x) - target)


def test_the_choice_depends_on_the_error_and_on_clear_gains(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for backend in EXACT:
        available(network(), backend)
    times = {"eager": 10.0, "packed": 5.0, "onnx": 4.5, "packed-bfloat16": 2.0}
    assert choose(monkeypatch, times, 1.0).inference.backend == "packed-bfloat16"
    exact = choose(monkeypatch, times, 1e-3)  # bfloat16 has a larger error of its own
    assert exact.inference.backend == "packed"
    assert "own error" in exact.left_out["packed-bfloat16"]
    assert exact.milliseconds == {"eager": 10.0, "packed": 5.0, "onnx": 4.5}
    assert choose(monkeypatch, {**times, "packed-bfloat16": 4.9}, 1.0).inference.backend == "packed"
    assert (
        choose(
            monkeypatch, {**times, "packed": 9.5, "onnx": 9.0, "packed-bfloat16": 9.0}, 1.0
        ).inference.backend
        == "eager"
    )


def test_the_choice_and_its_measurements_are_saved_and_not_repeated(
    data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    method: Any = mor_bench.load_method("umesh", **{**TINY, "inference": "auto"}).fit(
        data.scene, data.train
    )
    assert method.sizes_ == {"inference": method.inference_.backend}
    assert method.timings_ms_["eager"] > 0
    path = tmp_path / "model.safetensors"
    method.save(path)
    monkeypatch.delattr(inference, "fastest_ms")
    loaded: Any = mor_bench.load_surrogate(path)
    assert (loaded.sizes_, loaded.timings_ms_, loaded.inference_.backend) == (
        method.sizes_,
        method.timings_ms_,
        method.inference_.backend,
    )
    np.testing.assert_array_equal(
        loaded.predict(data.test.forces), method.predict(data.test.forces)
    )


def test_another_machine_uses_torch_with_a_warning(
    fitted: Surrogate, data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.safetensors"
    other: Any = copy.copy(fitted)
    other.inference = "packed-bfloat16"
    other.save(path)
    monkeypatch.setattr(packed_network, "processor_has_bfloat16", lambda: False)
    packed_network.reason_against_packing.cache_clear()
    try:
        with pytest.warns(FallbackWarning, match="packed-bfloat16.*no bfloat16"):
            loaded: Any = mor_bench.load_surrogate(path)
    finally:
        packed_network.reason_against_packing.cache_clear()
    assert loaded.inference_.backend == "eager"
    other.inference_ = Inference(other.network_)
    np.testing.assert_array_equal(
        loaded.predict(data.test.forces[0]), other.predict(data.test.forces[0])
    )
    with pytest.warns(FallbackWarning, match="no convolutions"):
        assert inference_or_eager(torch.nn.Linear(3, 3), "packed").backend == "eager"


@pytest.mark.parametrize(
    "knobs", [{}, {"input": "linear-response", "zero_at_rest": True, "activation": "silu"}]
)
def test_an_onnx_file_predicts_the_same_as_the_method(
    data: Dataset, tmp_path: Path, knobs: dict[str, Any]
) -> None:
    onnx, runtime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    method = mor_bench.load_method("umesh", **{**TINY, **knobs, "inference": "eager"}).fit(
        data.scene, data.train
    )
    method.save(tmp_path / "model.safetensors")
    path, difference = export_onnx(tmp_path / "model.safetensors", tmp_path / "new" / "model.onnx")
    assert difference is not None
    assert difference <= 1e-5
    model = onnx.load(path)
    described = {entry.key: entry.value for entry in model.metadata_props}
    assert described["scene"] == "beam-tiny"
    assert "forces in N" in described["units"]
    assert {node.domain for node in model.graph.node} == {""}
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for n in (1, 7):
        forces = data.test.forces[:n]
        (found,) = session.run(["displacements"], {"forces": forces.astype(np.float32)})
        expected = method.predict(forces)
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())
        assert (found[:, data.scene.fixed_nodes] == 0).all()
    (at_rest,) = session.run(
        ["displacements"], {"forces": np.zeros((3, *forces.shape[1:]), np.float32)}
    )
    assert at_rest.any() != method.parameters["zero_at_rest"]
    with pytest.raises(InvalidInputError, match="not overwritten"):
        export_onnx(tmp_path / "model.safetensors", path)


def test_models_that_onnx_cannot_express_are_refused(
    data: Dataset, fitted: Surrogate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mor_bench.load_method("linear-fem").fit(data.scene, None).save(tmp_path / "linear.safetensors")
    with pytest.raises(MorBenchError, match="LinearFEM has no network"):
        export_onnx(tmp_path / "linear.safetensors", tmp_path / "linear.onnx")
    with pytest.raises(InvalidInputError, match=r"\.onnx"):
        export_onnx(tmp_path / "linear.safetensors", tmp_path / "linear.txt")
    pytest.importorskip("onnxruntime")
    fitted.save(tmp_path / "umesh.safetensors")
    real = type(fitted).onnx_model

    def wrong(self: Any) -> Any:
        other = copy.copy(self)
        other.output_scale_ = 1.001 * self.output_scale_
        return real(other)

    monkeypatch.setattr(type(fitted), "onnx_model", wrong)
    with pytest.raises(MorBenchError, match="differ from the method's"):
        export_onnx(tmp_path / "umesh.safetensors", tmp_path / "umesh.onnx")
    assert not (tmp_path / "umesh.onnx").exists()
