"""Back ends of networks answer as torch does, the choice among them is by error and time, ONNX files too, and files can do no harm."""

from __future__ import annotations

import copy
import json
import os
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save as serialise

import mor_bench
from mor_bench.errors import (
    FallbackWarning,
    InvalidInputError,
    MorBenchError,
    StoreError,
    UnavailableBackendError,
)
from mor_bench.export.onnx_file import export_onnx
from mor_bench.model_file import model_digest as _digest
from mor_bench.model_file import read_header_and_arrays as _read_model
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogate import Surrogate

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from mor_bench.learning import inference, packed_network  # noqa: E402 - after the check that torch is there
from mor_bench.learning.inference import Inference, choose_inference, inference_or_eager  # noqa: E402
from mor_bench.surrogates.umesh.network import Activation, UNet, new_network  # noqa: E402

TINY = {"channels": 4, "steps": 1, "iterations": 3, "batch_size": 8}
EXACT = {"packed": 1e-5, "onnx": 1e-5, "packed-bfloat16": 5e-2}


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def data(cache: Path) -> Dataset:
    return mor_bench.load_dataset("beam-tiny", split="sample", cache=cache, workers=1)


@pytest.fixture(scope="module")
def fitted(data: Dataset) -> Surrogate:
    return mor_bench.load_method("umesh", **TINY).fit(data.scene, data.train)


def network(activation: Activation = "relu") -> UNet:
    """With biases other than zero."""
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
def test_a_back_end_answers_as_torch_and_a_batch_as_its_samples(
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
def test_geometry_of_convolutions_is_kept() -> None:
    """Strides, dilations, groups, two dimensions, no bias; and a transposed one whose kernels overlap is left alone."""
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
    with pytest.raises(UnavailableBackendError, match="Conv2d.* has no translation"):
        Inference(layers, "onnx")


def choose(
    monkeypatch: pytest.MonkeyPatch, times: dict[str, float], own_error: float
) -> inference.Choice:
    """The choice where queries take these times and the network errs so much, relative to its output."""
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


def test_the_choice_is_by_error_and_clear_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    for backend in EXACT:
        available(network(), backend)
    times = {"eager": 10.0, "packed": 5.0, "onnx": 4.5, "packed-bfloat16": 2.0}
    assert choose(monkeypatch, times, 1.0).inference.backend == "packed-bfloat16"
    exact = choose(monkeypatch, times, 1e-3)  # bfloat16 alone errs more than this network
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


def test_what_was_chosen_and_measured_is_saved_and_not_measured_again(
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


def test_another_machine_answers_by_torch_with_a_warning(
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
def test_an_onnx_file_answers_as_the_method(
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


def test_what_cannot_be_written_as_onnx(
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


KNOBS: list[dict[str, Any]] = [
    {"channels": 10**9},
    {"channels": 10**30},
    {"channels": 512},
    {"steps": 10**9},
    {"steps": 6},
    {"channels": "4"},
    {"steps": True},
    {"unknown": 1},
    {"inference": "os.system"},
    {"inference": ["packed"]},
    {"iterations": float("nan")},
]


@pytest.fixture(scope="module")
def parts(
    fitted: Surrogate, tmp_path_factory: pytest.TempPathFactory
) -> tuple[bytes, dict[str, str], dict[str, np.ndarray]]:
    """A model's file, its header and its arrays."""
    path = tmp_path_factory.mktemp("hostile") / "model.safetensors"
    fitted.save(path)
    return (path.read_bytes(), *_read_model(path))


def refused(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(StoreError, match=r"model\.safetensors") as error:
        mor_bench.load_surrogate(path)
    assert "\n" not in str(error.value)


def forged(header: dict[str, str], arrays: dict[str, np.ndarray]) -> bytes:
    """With a checksum that is right."""
    return serialise(arrays, metadata={**header, "sha256": _digest(header, arrays)})


@pytest.mark.parametrize("knobs", KNOBS, ids=str)
def test_forged_knobs(
    parts: Any, tmp_path: Path, knobs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, header, arrays = parts

    def allocated(*_: Any, **__: Any) -> None:
        raise AssertionError("weights were allocated before shapes were compared")

    monkeypatch.setattr(torch.nn.Module, "to_empty", allocated)
    knobs = {**json.loads(header["parameters"]), **knobs}
    refused(
        tmp_path / "model.safetensors", forged({**header, "parameters": json.dumps(knobs)}, arrays)
    )


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "{", "null", "[]", '{"channels":' + "9" * 5000 + "}"],
    ids=lambda text: text[:12],
)
def test_forged_json(parts: Any, tmp_path: Path, text: str) -> None:
    _, header, arrays = parts
    for key in ("parameters", "scene"):
        refused(tmp_path / "model.safetensors", forged({**header, key: text}, arrays))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with a name")
def test_a_forged_scene_whose_file_never_ends(parts: Any, tmp_path: Path) -> None:
    _, header, arrays = parts
    os.mkfifo(tmp_path / "pipe")
    for path in ("/dev/zero", str(tmp_path / "pipe")):
        scene = {
            **json.loads(header["scene"]),
            "geometry": {"shape": "file", "file": {"path": path, "sha256": "0" * 64}},
        }
        refused(
            tmp_path / "model.safetensors", forged({**header, "scene": json.dumps(scene)}, arrays)
        )


@pytest.mark.parametrize(
    "name",
    ["../../evil:Evil", "/etc/passwd", "os:system", "mor_bench.surrogates.umesh.method:_scale", ""],
)
def test_forged_class(parts: Any, tmp_path: Path, name: str) -> None:
    _, header, arrays = parts
    refused(tmp_path / "model.safetensors", forged({**header, "surrogate": name}, arrays))


def test_forged_arrays(parts: Any, tmp_path: Path) -> None:
    _, header, arrays = parts
    path, weight = tmp_path / "model.safetensors", "network.encoder.0.2.weight"
    changes: list[dict[str, np.ndarray | None]] = [
        {name: None} for name in arrays if not name.startswith("range.")
    ]
    for name in (weight, "network.head.bias", "scales", "loss_curve", "iterations"):
        other = np.float64 if arrays[name].dtype == np.float32 else np.float32
        changes += [
            {name: arrays[name].astype(dtype)} for dtype in (other, np.int32, np.float16, np.uint8)
        ]
        changes += [
            {name: arrays[name].reshape(1, -1)},
            {name: arrays[name][:0]} if name != "loss_curve" else {name: arrays[name][None]},
        ]
        if arrays[name].dtype.kind == "f":
            changes += [{name: np.full_like(arrays[name], bad)} for bad in (np.nan, -np.inf)]
    changes += [
        {name: np.ones(1, np.float32)}
        for name in ("evil", "network.evil", "size.channels", "size.evil", "range.evil")
    ]
    changes += [
        {"size.inference": np.frombuffer(word, np.uint8)} for word in (b"packed", b"\xff\xfe", b"")
    ]
    changes += [{"scales": np.zeros(2)}, {"scales": -np.ones(2)}, {"iterations": np.array([-1])}]
    changes += [{"timing.eager": np.array([-1.0])}, {"timing.eager": np.ones(3)}]
    for change in changes:
        refused(
            path,
            forged(
                header,
                {name: array for name, array in {**arrays, **change}.items() if array is not None},
            ),
        )


def test_damaged_bytes_and_headers(parts: Any, tmp_path: Path) -> None:
    content, _, _ = parts
    path, length = tmp_path / "model.safetensors", int.from_bytes(content[:8], "little")
    for end in {
        0,
        1,
        7,
        8,
        9,
        length // 2,
        length + 7,
        length + 8,
        length + 9,
        len(content) // 2,
        len(content) - 1,
    }:
        refused(path, content[:end])
    generator = np.random.default_rng(0)
    for place in [
        *range(8),
        *generator.integers(8, 8 + length, 30),
        *generator.integers(8 + length, len(content), 10),
    ]:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(generator.integers(8))
        refused(path, bytes(flipped))
    table, body = json.loads(content[8 : 8 + length]), content[8 + length :]
    name = "network.encoder.0.2.weight"
    begin, end = table[name]["data_offsets"]
    entries: list[dict[str, Any]] = [
        {"dtype": "BF16", "shape": [(end - begin) // 2]},
        {"dtype": "F8_E4M3", "shape": [end - begin]},
        {"shape": [10**9] * 3},
        {"shape": [10**12, 0]},
        {"data_offsets": [0, 10**12]},
        {"dtype": "object"},
    ]
    for entry in entries:
        forgery = json.dumps({**table, name: {**table[name], **entry}}).encode()
        refused(path, len(forgery).to_bytes(8, "little") + forgery + body)
    refused(path, (2**62).to_bytes(8, "little") + content[8:])
