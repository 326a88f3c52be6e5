"""Speed of this machine in the operations that methods consist of, beside recorded machines.

Each operation runs on one thread, and its processor time counts, so other load hardly matters.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict

from mor_bench.machine import pinned_threads
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.scene import load_scene

RECORDED_FILE = Path(__file__).with_name("recorded_machines.json")

SCENE = "beam-coarse"
"""The scene of the residual and the back-solve."""

STEP_S = 0.25
"""Time for repeating each operation, s."""


class MachineSpeed(BaseModel):
    """Times of typical operations on one thread; each is the median of repetitions.

    Attributes
    ----------
    interpreter_ms : float
        A loop of 200,000 additions in Python.
    residual_us : float
        Internal force and tangent of beam-coarse.
    back_solve_us : float
        Back-solve with its stiffness at rest.
    convolution_ms : float or None
        Forward and backward pass of a convolution with 16 channels on its grid, 32 samples; None
        without PyTorch.
    bandwidth_gb_s : float
        Bytes read and written by a copy of a large array.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    interpreter_ms: float
    residual_us: float
    back_solve_us: float
    convolution_ms: float | None
    bandwidth_gb_s: float

    @classmethod
    def measure(cls, networks: bool = True) -> Self:
        """Measure this machine, in about two seconds if kernels are compiled.

        Without `networks`, the convolution is left out and PyTorch is not imported.
        """
        with pinned_threads(1):
            model = FullOrderModel(load_scene(SCENE))
            q = np.zeros(model.scene.mesh.n_dofs)[model.scene.free_dofs]
            factor, force = model.rest_factor, np.ones(len(q))
            source = np.ones(4_000_000)
            target = np.empty_like(source)
            times = [
                _seconds(_interpret),
                _seconds(lambda: model.linearise(q)),
                _seconds(lambda: factor.solve(force)),
                _seconds(lambda: np.copyto(target, source)),
            ]
        return cls(
            interpreter_ms=1e3 * times[0],
            residual_us=1e6 * times[1],
            back_solve_us=1e6 * times[2],
            convolution_ms=_convolution_ms() if networks else None,
            bandwidth_gb_s=2e-9 * source.nbytes / times[3],
        )


class RecordedMachine(BaseModel):
    """A machine whose speed was recorded.

    Attributes
    ----------
    name : str
        Processor, instructions and number of cores.
    cores : int
    speed : MachineSpeed
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    cores: int
    speed: MachineSpeed


def recorded_machines() -> list[RecordedMachine]:
    """Return the recorded machines; method files state times on the first one."""
    content: list[dict[str, Any]] = json.loads(RECORDED_FILE.read_bytes())
    return [RecordedMachine.model_validate(item) for item in content]


def _seconds(operation: Callable[[], Any]) -> float:
    """Return the median time of an operation that is repeated for `STEP_S`, after one untimed.

    A sample is a batch of at least a millisecond, because the clock of processor time is slow.
    """
    operation()
    start = process_time()
    operation()
    n = 1 + int(1e-3 / max(process_time() - start, 1e-6))
    times: list[float] = []
    until = perf_counter() + STEP_S
    while len(times) < 3 or perf_counter() < until:
        start = process_time()
        for _ in range(n):
            operation()
        times.append((process_time() - start) / n)
    return median(times)


def _interpret() -> int:
    total = 0
    for number in range(200_000):
        total += number
    return total


def _convolution_ms() -> float | None:
    try:
        import torch
    except ImportError:
        return None
    convolution = torch.nn.Conv3d(16, 16, 3, padding=1)
    fields = torch.ones(32, 16, 16, 4, 4, requires_grad=True)

    def step() -> None:
        convolution(fields).sum().backward()

    with pinned_threads(1):
        return 1e3 * _seconds(step)
