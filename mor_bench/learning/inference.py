"""Back ends that compute a network's answers, and the choice of the fastest one.

torch's own convolutions are slow for single samples. Every call copies the weights into oneDNN's
layout, or does not use oneDNN. The back ends are:

- ``eager``: the network unchanged.
- ``packed``: a copy with oneDNN's convolutions, fused activations and weights packed once.
  torch.compile emits these operations for frozen graphs; called directly, they need no compiler.
- ``packed-bfloat16``: the same with weights and activations in bfloat16 and sums in float32.
- ``onnx``: ONNX Runtime, float32.
- ``cuda``: the first graphics processor, with the products of its tensor cores (TF32). It is never
  chosen automatically, because other methods answer on a processor.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from mor_bench.errors import FallbackWarning, UnavailableBackendError
from mor_bench.learning.cuda_graphs import ReplayedNetwork
from mor_bench.learning.onnx_graph import OnnxSession
from mor_bench.learning.packed_network import packed

Backend = Literal["eager", "packed", "onnx", "packed-bfloat16", "cuda"]

BACKENDS: tuple[Backend, ...] = get_args(Backend)[:-1]
"""Back ends of processors, from simple to complex. Each must be clearly faster than the choice
before it."""

CLEAR_GAIN: dict[Backend, float] = {"packed": 1.1, "onnx": 1.5, "packed-bfloat16": 1.2}
"""Required speed-up over the simpler choice. Measured ratios are far from it, so noise seldom
changes the choice."""

ADDED_ERROR = 0.1
"""Largest change of the answers (root mean square), as a fraction of the network's own error."""

TURNS, QUERIES = 5, 3
"""Timed rounds of each back end, and timed queries per round, after one warm-up query."""


class Inference:
    """A network as a function of its input, computed by one back end.

    Call it inside `torch.inference_mode`. It can be copied and pickled if the network can.

    Parameters
    ----------
    network : nn.Module
        A fitted network on the processor, with one input and one output tensor. Later changes of
        its weights have no effect.
    backend : str
        One of `BACKENDS`, or "cuda".

    Raises
    ------
    UnavailableBackendError
        If this machine or this network does not support the back end.
    """

    def __init__(self, network: nn.Module, backend: Backend = "eager") -> None:
        self.network = network
        self.backend = backend
        self._function: Callable[[Tensor], Tensor] = network
        if backend == "onnx":
            self._function = OnnxSession(network)
        elif backend == "cuda":
            self._function = ReplayedNetwork(network)
        elif backend != "eager":
            self._function = packed(
                network, torch.float32 if backend == "packed" else torch.bfloat16
            )

    def __call__(self, inputs: Tensor) -> Tensor:
        return self._function(inputs)

    def __reduce__(self) -> tuple[Any, ...]:
        return Inference, (self.network, self.backend)


def inference_or_eager(network: nn.Module, backend: Backend) -> Inference:
    """Return a network with a back end; if that is not available, warn and use "eager"."""
    try:
        return Inference(network, backend)
    except UnavailableBackendError as error:
        warnings.warn(
            f"the inference back end {backend!r} is not available: {error} The slower back "
            "end 'eager' is used instead.",
            FallbackWarning,
            stacklevel=2,
        )
        return Inference(network)


@dataclass(frozen=True)
class Choice:
    """The back end chosen for a network.

    Attributes
    ----------
    inference : Inference
    milliseconds : dict
        Shortest time of a single query on one thread, ms, for each back end that qualified.
    left_out : dict
        Reasons why the others did not qualify.
    """

    inference: Inference
    milliseconds: dict[str, float]
    left_out: dict[str, str]


@torch.inference_mode()
def choose_inference(
    network: nn.Module, inputs: Tensor, errors: Callable[[Inference], Tensor]
) -> Choice:
    """Choose the fastest back end that is accurate enough and clearly faster than simpler ones.

    Back ends are timed with single queries on one thread. A back end qualifies if it changes the
    answers by at most `ADDED_ERROR` of the network's own error. Both are root mean squares over all
    samples and values.

    Parameters
    ----------
    network : nn.Module
    inputs : (n, ...) float32
        Samples to draw the timed queries from.
    errors : callable
        Returns the errors of a back end's answers on some samples, as an array of any shape.
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
        except RuntimeError as error:  # torch lacks an operation in this precision
            left_out[backend] = f"{type(error).__name__}: {error}".splitlines()[0]
            continue
        if not added <= ADDED_ERROR:
            left_out[backend] = (
                f"it changes the answers by {added:.1%} of the network's own error; "
                f"the limit is {ADDED_ERROR:.0%}."
            )
            continue
        able[backend] = candidate
    times = fastest_ms(able, inputs)
    chosen: Backend = "eager"
    for backend, gain in CLEAR_GAIN.items():
        if backend in times and gain * times[backend] < times[chosen]:
            chosen = backend
    return Choice(able[chosen], times, left_out)


def fastest_ms(able: dict[Backend, Inference], inputs: Tensor) -> dict[str, float]:
    """Return the shortest time of a single query per back end, timed in turns on one thread, ms."""
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
