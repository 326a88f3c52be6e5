"""Base class of regressions between principal coordinates by perceptrons."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mor_bench.counting import count
from mor_bench.learning.perceptron import named_shapes, taken
from mor_bench.learning.training import device_of, train
from mor_bench.learning.training_plan import LearningProblem, Loss, TrainingPlan
from mor_bench.surrogates.coordinate_regression import Array, Arrays, CoordinateRegression

BATCH_SIZE = 64
LEARNING_RATE = 3e-3


class NetworkRegression(CoordinateRegression):
    """A `CoordinateRegression` by perceptrons, which a subclass names and trains.

    `loss_curve_` is (n_intervals,) float64. `iterations_` is the number of iterations that repeats
    the training.
    """

    iterations: int
    seed: int

    integers: ClassVar = frozenset({"iterations"})

    @abstractmethod
    def networks(self, n_inputs: int, n_outputs: int) -> Mapping[str, tuple[int, int, int]]:
        """Return inputs, hidden units and outputs of the perceptrons for predictions, by name."""

    @abstractmethod
    def values(self, z: Array) -> Array:
        """Return the answer of the networks at z (n, n_inputs), (n, n_outputs)."""

    def on_device(self, arrays: Mapping[str, Array]) -> dict[str, Tensor]:
        """Return arrays in float32 on the training device."""
        device = device_of(self.training)
        return {
            name: torch.from_numpy(array.astype(np.float32)).to(device)
            for name, array in arrays.items()
        }

    def train(
        self,
        networks: nn.Module,
        loss: Loss,
        data: dict[str, Tensor],
        generator: torch.Generator,
    ) -> dict[str, NDArray[Any]]:
        """Train, and return the arrays that describe the training."""
        plan = TrainingPlan(self.iterations, BATCH_SIZE, LEARNING_RATE)
        n_samples = len(data["inputs"])
        problem = LearningProblem(networks, loss, n_samples, generator, data, self.parameters)
        done = train(problem, plan, self.training, self.time_limit_s)
        iterations = np.array([done.iterations], dtype=np.int32)
        return {"loss_curve": done.loss_curve, "iterations": iterations}

    def shapes(
        self, model: Arrays, n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int | None, ...]]:
        shapes: dict[str, tuple[int | None, ...]] = {"loss_curve": (None,), "iterations": (1,)}
        for name, sizes in self.networks(n_inputs, n_outputs).items():
            shapes |= named_shapes(name, *sizes)
        return shapes

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        n_inputs, n_outputs = self.axes_.shape[1], self.modes_.shape[1]
        self.networks_ = {name: taken(model, name) for name in self.networks(n_inputs, n_outputs)}
        self.loss_curve_, self.iterations_ = model["loss_curve"], int(model["iterations"][0])
        self._at_rest = self.values(np.zeros((1, n_inputs)))

    def coefficients(self, z: Array) -> Array:
        weights = [weight for network in self.networks_.values() for weight in network]
        count(multiply_adds=len(z) * sum(weight.size for weight in weights))  # nonlinearity: one
        out = self.values(z) - self._at_rest
        out[~z.any(axis=1)] = 0.0  # the network rounds differently in a batch
        return out
