"""Fast answers of fitted networks on processors: back ends behind one interface, and the choice among them.

torch's own convolutions are slow where samples come one at a time: it copies the weights into the layout of oneDNN in every call,
or does without oneDNN. Four ways of computing one network:

- ``eager``: the network as it is.
- ``packed``: a copy whose convolutions are oneDNN's, with weights packed once and the activation within. These are the
  operations that torch.compile puts into frozen graphs; called directly, no compiler is needed, which a method that is
  being compared may not start. Every network with convolutions gains, without any description of its graph.
- ``packed-bfloat16``: the same, weights and activations in bfloat16 with sums in float32.
- ``onnx``: ONNX Runtime, float32.

On one thread of an AVX-512 processor, a single query of the U-Net with c = 16, k = 3 on 32×16×16 points took 71 ms eager, 12.7 ms
packed, 5.0 ms packed in bfloat16 and 30 ms in ONNX Runtime; with c = 8, k = 2 on 16×4×4 points 0.73, 0.55, 0.58 and 0.49 ms, of
which most is spent between the operations. TorchScript's frozen graphs were as fast as ``packed``, which needs no tracing,
and so were those of torch.compile, 15 to 17 ms beside each other on a busy machine, after two minutes of compiling.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from time import perf_counter
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

from mor_bench.errors import FallbackWarning, UnavailableBackendError

Backend = Literal["eager", "packed", "onnx", "packed-bfloat16"]

BACKENDS: tuple[Backend, ...] = get_args(Backend)
"""From the plainest on: each must be clearly faster than what is chosen from those before it."""

CLEAR_GAIN: dict[Backend, float] = {"packed": 1.1, "onnx": 1.5, "packed-bfloat16": 1.2}
"""How many times faster that is, so that noise seldom makes another choice in the next run.

Measured ratios stay away from these: packed was at least 1.2 times as fast as eager, and ONNX Runtime, which brings threads of
its own and is needed wherever the model is loaded, at most 1.25 times as fast as packed.
"""

ADDED_ERROR = 0.1
"""How much a back end may change the answers (root mean square), as a share of the network's own error."""

TURNS, QUERIES = 5, 3
"""Of each back end when they are timed in turns; and queries in each, after one that is not timed."""

SAME = 1e-4
"""Largest difference of a float32 back end, relative to the largest value, that rounding can explain."""


FUSED: dict[type[nn.Module], str] = {nn.ReLU: "relu", nn.SiLU: "swish"}
"""Activations that oneDNN applies within a convolution, and its names for them."""


class Inference:
    """A network as a function of its input, computed by one back end.

    Without gradients; call it inside `torch.inference_mode`. It can be copied and pickled, as its network can: what the back
    end made of the network is made again.

    Parameters
    ----------
    network : nn.Module
        Fitted, on the processor, of one input and one output tensor. Weights that change later are not seen.
    backend : str
        One of `BACKENDS`.

    Raises
    ------
    UnavailableBackendError
        If the back end is not there, on this machine or for such a network; the message says why.
    """

    def __init__(self, network: nn.Module, backend: Backend = "eager") -> None:
        self.network = network
        self.backend = backend
        self._function: Callable[[Tensor], Tensor] = _MAKERS[backend](network)

    def __call__(self, inputs: Tensor) -> Tensor:
        return self._function(inputs)

    def __reduce__(self) -> tuple[Any, ...]:
        return Inference, (self.network, self.backend)


def inference_or_eager(network: nn.Module, backend: Backend) -> Inference:
    """A network by a back end; by torch's own operations, with a `FallbackWarning`, where that is not available."""
    try:
        return Inference(network, backend)
    except UnavailableBackendError as error:
        warnings.warn(
            f"inference by {backend!r} is not available: {error} The network answers by 'eager', more slowly.",
            FallbackWarning,
            stacklevel=2,
        )
        return Inference(network)


@dataclass(frozen=True)
class Choice:
    """The back end that was chosen for a network.

    Attributes
    ----------
    inference : Inference
    milliseconds : dict
        Of a single query on one thread, the shortest of those timed, for each back end that is available.
    left_out : dict
        Why each of the others did not qualify.
    """

    inference: Inference
    milliseconds: dict[str, float]
    left_out: dict[str, str]


@torch.inference_mode()
def choose_inference(
    network: nn.Module, inputs: Tensor, errors: Callable[[Inference], Tensor]
) -> Choice:
    """Choose the fastest back end that is exact enough and clearly faster than plainer ones.

    Timed with single queries on one thread, where time differs between machines but hardly the order. A back end qualifies
    if what it changes of the answers, by the root mean square over all samples and values, is at most `ADDED_ERROR` of the
    network's own error.

    Parameters
    ----------
    network : nn.Module
    inputs : (n, ...) float32
        Samples, each of which may be a timed query.
    errors : callable
        The errors of the network, computed by what it is given, on some samples: an array of any shape.
    """
    plain = Inference(network)
    own = errors(plain)
    able: dict[Backend, Inference] = {"eager": plain}
    left_out: dict[str, str] = {}
    for backend in BACKENDS[1:]:
        try:
            candidate = Inference(network, backend)
            added = _rms(errors(candidate) - own) / max(_rms(own), 1e-30)
        except UnavailableBackendError as error:
            left_out[backend] = str(error)
            continue
        except RuntimeError as error:  # of torch, for an operation that it lacks in this precision
            left_out[backend] = f"{type(error).__name__}: {error}".splitlines()[0]
            continue
        if not added <= ADDED_ERROR:
            left_out[backend] = (
                f"it changes the answers by {added:.1%} of the network's own error; at most {ADDED_ERROR:.0%} would do."
            )
            continue
        able[backend] = candidate
    times = _fastest_ms(able, inputs)
    chosen: Backend = "eager"
    for backend, gain in CLEAR_GAIN.items():
        if backend in times and gain * times[backend] < times[chosen]:
            chosen = backend
    return Choice(able[chosen], times, left_out)


def _fastest_ms(able: dict[Backend, Inference], inputs: Tensor) -> dict[str, float]:
    """Shortest time of a single query by each, in turns, on one thread."""
    shortest: dict[str, float] = dict.fromkeys(able, float("inf"))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for turn in range(TURNS):
            for name, function in able.items():
                for query in range(1 + QUERIES):
                    row = (turn * QUERIES + query) % len(inputs)
                    start = perf_counter()
                    function(inputs[row : row + 1])
                    if query > 0:
                        shortest[name] = min(shortest[name], 1e3 * (perf_counter() - start))
    finally:
        torch.set_num_threads(threads)
    return shortest


def _rms(values: Tensor) -> float:
    return float(values.double().square().mean().sqrt())


class _PackedConvolution(nn.Module):
    """oneDNN's convolution with weights in the layout that it prefers, and the activation that follows."""

    def __init__(self, layer: nn.Conv2d | nn.Conv3d, activation: str | None) -> None:
        super().__init__()
        self.geometry = [
            list(layer.padding),
            list(layer.stride),
            list(layer.dilation),
            layer.groups,
        ]
        self.weight = torch.ops.mkldnn._reorder_convolution_weight(
            layer.weight.detach(), *self.geometry, None
        )
        self.bias = None if layer.bias is None else layer.bias.detach()
        self.activation = activation or "none"

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = torch.ops.mkldnn._convolution_pointwise(
            x, self.weight, self.bias, *self.geometry, self.activation, [], ""
        )
        return y


class _Upsampling(nn.Module):
    """A transposed convolution whose kernels do not overlap: one matrix product, whose rows are then put in their places."""

    def __init__(self, layer: nn.ConvTranspose2d | nn.ConvTranspose3d) -> None:
        super().__init__()
        c_in, self.c_out, *self.kernel = layer.weight.shape
        self.weight = layer.weight.detach().movedim((0, 1), (-1, -2)).reshape(-1, c_in).contiguous()
        self.bias = (
            None
            if layer.bias is None
            else layer.bias.detach().repeat(len(self.weight) // self.c_out)
        )

    def forward(self, x: Tensor) -> Tensor:
        n, c_in, *shape = x.shape
        d = len(shape)
        y = nn.functional.linear(x.movedim(1, -1).reshape(-1, c_in), self.weight, self.bias).view(
            n, *shape, *self.kernel, self.c_out
        )
        interleaved = [axis for i in range(1, d + 1) for axis in (i, i + d)]
        y = y.permute(0, *interleaved, 2 * d + 1).reshape(
            n, *(a * b for a, b in zip(shape, self.kernel, strict=True)), self.c_out
        )
        return y.movedim(-1, 1)


class _Rounded(nn.Module):
    """A network of bfloat16 between tensors of float32."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.network(x.bfloat16())
        return y.float()


def _packed(network: nn.Module, dtype: torch.dtype = torch.float32) -> nn.Module:
    reason = _reason_against_packing(dtype)
    if reason is not None:
        raise UnavailableBackendError(reason)
    copied = deepcopy(network).eval().requires_grad_(False).to(dtype)
    if _pack_layers(copied) == 0:
        raise UnavailableBackendError("the network has no convolutions that could be packed.")
    return copied


def _packed_bfloat16(network: nn.Module) -> nn.Module:
    if any(parameter.is_complex() for parameter in network.parameters()):
        raise UnavailableBackendError("there are no complex numbers of two bfloat16.")
    return _Rounded(_packed(network, torch.bfloat16))


def _pack_layers(module: nn.Module) -> int:
    """Replace the convolutions within a module, each with the activation behind it in an `nn.Sequential`; how many."""
    n_packed = 0
    children = list(module.named_children())
    following = [child for _, child in children[1:]] if isinstance(module, nn.Sequential) else []
    for i, (name, child) in enumerate(children):
        if (
            isinstance(child, nn.Conv2d | nn.Conv3d)
            and child.padding_mode == "zeros"
            and not isinstance(child.padding, str)
        ):
            activation = FUSED.get(type(following[i])) if i < len(following) else None
            setattr(module, name, _PackedConvolution(child, activation))
            if activation is not None:
                setattr(module, children[i + 1][0], nn.Identity())
            n_packed += 1
        elif isinstance(child, nn.ConvTranspose2d | nn.ConvTranspose3d) and _is_upsampling(child):
            setattr(module, name, _Upsampling(child))
        else:
            n_packed += _pack_layers(child)
    return n_packed


def _is_upsampling(layer: nn.ConvTranspose2d | nn.ConvTranspose3d) -> bool:
    """Whether every output depends on one input point."""
    plain = (
        layer.groups == 1
        and not any(layer.padding)
        and not any(layer.output_padding)
        and set(layer.dilation) == {1}
    )
    return plain and layer.kernel_size == layer.stride


@cache
def _reason_against_packing(dtype: torch.dtype) -> str | None:
    """None if oneDNN's operations are there, do as they should, and are in this precision those of the processor."""
    if not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        return "this torch is built without oneDNN."
    if dtype == torch.bfloat16 and not _processor_has_bfloat16():
        return "this processor has no bfloat16 instructions."
    generator = torch.Generator().manual_seed(0)
    layer = nn.Conv3d(2, 3, 3, padding=1).requires_grad_(False)
    x = torch.randn(1, 2, 4, 3, 3, generator=generator).to(dtype)
    for parameter in layer.parameters():
        parameter.copy_(torch.randn(parameter.shape, generator=generator))
    expected = layer(x.float()).relu()
    try:
        found = _PackedConvolution(layer.to(dtype), "relu")(x)
    except (
        AttributeError,
        RuntimeError,
        TypeError,
    ) as error:  # torch's operations for its own compiler may change with its versions
        return f"torch {torch.__version__} does not offer oneDNN's convolutions as expected: {type(error).__name__}."
    allowed = SAME if dtype == torch.float32 else 2e-2
    if not float((found.float() - expected).abs().max()) <= allowed * float(expected.max()):
        return f"oneDNN's convolution in {dtype} gives something else than torch's."
    return None


def _processor_has_bfloat16() -> bool:
    """Whether it multiplies bfloat16 by itself; oneDNN emulates it elsewhere, and then it is slower than float32."""
    capabilities: dict[str, Any] = getattr(
        torch.cpu, "get_capabilities", dict
    )()  # torch 2.10 and later
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


class _OnnxSession:
    """ONNX Runtime, with as many threads as torch has at the time of the call."""

    def __init__(self, network: nn.Module) -> None:
        from mor_bench.learning.onnx_graph import network_model

        try:
            import onnxruntime
        except ImportError as error:
            raise UnavailableBackendError(
                f"ONNX needs pip install 'mor-bench[onnx]' ({error})."
            ) from None
        self._runtime = onnxruntime
        self._model = network_model(network).SerializeToString()
        self._sessions: dict[int, Any] = {}
        self._session()

    def _session(self) -> Any:
        threads = torch.get_num_threads()
        if threads not in self._sessions:
            options = self._runtime.SessionOptions()
            options.intra_op_num_threads = threads
            options.add_session_config_entry(
                "session.intra_op.allow_spinning", "0"
            )  # idle threads would slow what comes next
            self._sessions[threads] = self._runtime.InferenceSession(
                self._model, options, providers=["CPUExecutionProvider"]
            )
        return self._sessions[threads]

    def __call__(self, inputs: Tensor) -> Tensor:
        (output,) = self._session().run(None, {"input": np.ascontiguousarray(inputs.numpy())})
        return torch.from_numpy(output)


def _eager(network: nn.Module) -> nn.Module:
    return network


_MAKERS: dict[Backend, Callable[[nn.Module], Callable[[Tensor], Tensor]]] = {
    "eager": _eager,
    "packed": _packed,
    "onnx": _OnnxSession,
    "packed-bfloat16": _packed_bfloat16,
}
