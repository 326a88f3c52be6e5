"""Steps and queries of a network on a graphics processor, recorded once and replayed.

A step with few samples has hundreds of short kernels. Launched one by one from Python, they wait
for their launches. A CUDA graph launches all of them at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from threading import Lock, RLock

import torch
from torch import Tensor, nn

from mor_bench.errors import UnavailableBackendError

N_UNRECORDED = 3
"""Steps or queries before the recording; they choose algorithms and allocate workspace."""

ALONE = RLock()
"""Held by a thread that records, or that computes without replay beside threads that may record.

The search for a convolution's algorithm frees memory, and the start of a recording waits for the
whole device. Neither is allowed while another thread records.
"""


class FastConvolutions:
    """The search for the fastest deterministic convolutions, switched on while a thread needs it.

    PyTorch has one such setting for all threads. The last thread to leave restores it.
    """

    def __init__(self) -> None:
        self._lock, self._n_inside = Lock(), 0
        self._before = False, False

    def __enter__(self) -> None:
        cudnn = torch.backends.cudnn
        with self._lock:
            if self._n_inside == 0:
                self._before = cudnn.benchmark, cudnn.deterministic
                cudnn.benchmark, cudnn.deterministic = True, True
            self._n_inside += 1

    def __exit__(self, *_: object) -> None:
        cudnn = torch.backends.cudnn
        with self._lock:
            self._n_inside -= 1
            if self._n_inside == 0:
                cudnn.benchmark, cudnn.deterministic = self._before


_FAST_CONVOLUTIONS = FastConvolutions()


@contextmanager
def own_stream() -> Iterator[None]:
    """Compute in a stream of its own, with the fastest deterministic convolutions.

    Recording needs a stream that is not the default one. Trainings in several threads run side by
    side, each in its own stream.
    """
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with _FAST_CONVOLUTIONS:
        try:
            with torch.cuda.stream(stream):
                yield
        finally:
            stream.synchronize()


def volumes_last(network: nn.Module) -> nn.Module:
    """Store the weights of 3D convolutions with the channels last, which tensor cores read.

    Values are the same. A network with other weights than those of 3D convolutions is unchanged.
    """
    if {parameter.dim() for parameter in network.parameters()} <= {1, 5}:
        network.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
    return network


class RecordedStep:
    """A training step that is replayed with other samples.

    Parameters
    ----------
    step : callable
        Changes the weights by the gradient of the loss of the given samples, and returns the loss.
        Its operations may not depend on the samples. It must have run `N_UNRECORDED` times.
    rows : (n,) int64 tensor
        Samples of a step, on the graphics processor. Recording does not take the step.
    """

    def __init__(self, step: Callable[[Tensor], Tensor], rows: Tensor) -> None:
        self._rows = rows.clone()
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(
            self._graph,
            stream=torch.cuda.current_stream(),
            capture_error_mode="thread_local",
        ):
            self._loss = step(self._rows)

    def __call__(self, rows: Tensor) -> Tensor:
        self._rows.copy_(rows)
        self._graph.replay()
        return self._loss


class ReplayedNetwork:
    """A copy of a network on a graphics processor, for inputs and answers on the processor.

    Single queries replay a graph, which includes both copies. The copies pass through memory that
    the operating system does not move.

    Raises
    ------
    UnavailableBackendError
        If PyTorch finds no CUDA device.
    """

    def __init__(self, network: nn.Module) -> None:
        if not torch.cuda.is_available():
            raise UnavailableBackendError("PyTorch finds no CUDA device here.")
        self._network = volumes_last(deepcopy(network).to("cuda"))
        self._graph: torch.cuda.CUDAGraph | None = None
        self._given = self._answer = torch.empty(0)

    def __call__(self, inputs: Tensor) -> Tensor:
        if len(inputs) != 1:
            answers: Tensor = self._network(inputs.to("cuda")).cpu()
            return answers
        if self._graph is None or self._given.shape != inputs.shape:
            self._record(inputs)
        assert self._graph is not None
        self._given.copy_(inputs)
        self._graph.replay()
        torch.cuda.current_stream().synchronize()
        return self._answer.clone()

    def _record(self, inputs: Tensor) -> None:
        with ALONE, own_stream():
            self._given = torch.empty_like(inputs, pin_memory=True)
            for _ in range(N_UNRECORDED):
                answer = self._network(inputs.to("cuda"))
            self._answer = torch.empty_like(answer, device="cpu", pin_memory=True)
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(
                self._graph,
                stream=torch.cuda.current_stream(),
                capture_error_mode="thread_local",
            ):
                answer = self._network(self._given.to("cuda", non_blocking=True))
                self._answer.copy_(answer, non_blocking=True)
