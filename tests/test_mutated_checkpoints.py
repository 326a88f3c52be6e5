"""Damaged and forged checkpoints of trainings give one clear line, or resume."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from mor_bench.training_options import TrainingOptions
from tests.mutations import QUICK, SLOW, Reader, attacked, documented, mutated_bytes, mutated_json

if TYPE_CHECKING:
    from torch import Tensor

torch = pytest.importorskip("torch", reason="needs pip install 'mor-bench[learn]'")

from safetensors.torch import load as load_tensors  # noqa: E402 - torch is there
from safetensors.torch import save as serialise  # noqa: E402

from mor_bench.learning import training  # noqa: E402
from mor_bench.learning.checkpoint import fingerprint_of  # noqa: E402
from mor_bench.learning.training_plan import LearningProblem, TrainingPlan  # noqa: E402

PLAN = TrainingPlan(60, 8, 1e-2, validation_fraction=0.2)
WRITTEN = 57
"""Iterations of the training, and of the checkpoint: after a success, few are left."""


class StoppedError(Exception):
    """Stands for the end of the process."""


def train(checkpoint: Path, steps: int = PLAN.iterations) -> None:
    """Train a small regression, and stop after some steps."""
    draw = torch.Generator().manual_seed(3)
    x = torch.randn(40, 3, generator=draw)
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=draw))
    calls = 0

    def loss(rows: Tensor) -> Tensor:
        nonlocal calls
        calls += network.training
        if calls > steps:
            raise StoppedError
        error: Tensor = network(x[rows]) - x[rows].sum(1, keepdim=True)
        return error.square().mean()

    problem = LearningProblem(network, loss, len(x), draw)
    training.train(problem, PLAN, TrainingOptions(checkpoint=checkpoint))


def a_checkpoint(path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)
        with pytest.raises(StoppedError):
            train(path, WRITTEN)


def forged(content: bytes, generator: np.random.Generator) -> bytes:
    """Mutate the numbers or a tensor of a checkpoint, with a checksum that fits."""
    length = int.from_bytes(content[:8], "little")
    header: dict[str, str] = json.loads(content[8 : 8 + length])["__metadata__"]
    tensors: dict[str, Any] = load_tensors(content)
    name = sorted(tensors)[generator.integers(len(tensors))]
    value = tensors[name]
    match generator.integers(6):
        case 0 | 1:
            header["numbers"] = mutated_json(header["numbers"].encode(), generator).decode()
        case 2:
            del tensors[name]
        case 3:
            kinds = (torch.float32, torch.float64, torch.int64, torch.uint8, torch.bool)
            tensors[name] = value.to(kinds[generator.integers(len(kinds))])
        case 4:
            tensors[name] = value.flatten()[: generator.integers(9)].repeat(generator.integers(4))
        case _:
            odd = (float("nan"), float("inf"), -1.0, 1e30, 1e-40, 0.0, 255.0)
            changed = value.double().flatten().clone()
            changed[generator.integers(len(changed)) if len(changed) else slice(0)] = odd[
                generator.integers(len(odd))
            ]
            tensors[name] = changed.reshape(value.shape).to(value.dtype)
    header.pop("sha256")
    return serialise(tensors, {**header, "sha256": fingerprint_of(header, tensors)})


READER = Reader("checkpoint", a_checkpoint, train, [mutated_bytes, forged, forged])


def test_the_mutated_checkpoint_is_one_of_a_stopped_training(tmp_path: Path) -> None:
    a_checkpoint(tmp_path / "checkpoint")
    header = (tmp_path / "checkpoint").read_bytes()[:2000]
    assert f'\\"iteration\\": {WRITTEN}'.encode() in header


@pytest.mark.parametrize("n", [QUICK, pytest.param(SLOW, marks=pytest.mark.slow)])
def test_mutated_checkpoints_are_resumed_or_refused(n: int, tmp_path: Path) -> None:
    attacked(READER, tmp_path, n)


def test_the_documented_count_is_that_of_these_tests() -> None:
    assert documented()["checkpoints of trainings"] == SLOW
