"""What regressions between principal coordinates share that are perceptrons."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mor_bench.counting import count
from mor_bench.learning.perceptron import named, named_shapes, taken
from mor_bench.learning.training import device_of, train
from mor_bench.learning.training_plan import LearningProblem, TrainingPlan
from mor_bench.surrogates.coordinate_regression import CoordinateRegression

Array = NDArray[np.float64]

BATCH_SIZE = 64
LEARNING_RATE = 3e-3


class NetworkRegression(CoordinateRegression):
    """A `CoordinateRegression` by perceptrons, which `_sizes` names; a subclass trains them in `_learn` by `_trained`.

    Attributes
    ----------
    loss_curve_ : (n_intervals,) float64
    iterations_ : int
        Steps that the training took.
    """

    iterations: int
    seed: int
    loss_curve_: Array
    iterations_: int

    integers = frozenset({"iterations"})

    @abstractmethod
    def _sizes(self, n_inputs: int, n_outputs: int) -> Mapping[str, tuple[int, int, int]]:
        """Inputs, hidden units and outputs of the perceptrons that answer, by name."""

    def _on_device(self, arrays: Mapping[str, Array]) -> dict[str, Tensor]:
        device = device_of(self.training)
        return {
            name: torch.from_numpy(array.astype(np.float32)).to(device)
            for name, array in arrays.items()
        }

    def _trained(
        self,
        networks: nn.Module,
        loss: Callable[[Tensor], Tensor],
        data: dict[str, Tensor],
        generator: torch.Generator,
    ) -> dict[str, NDArray[Any]]:
        """Train, and give what is to be known of that."""
        plan = TrainingPlan(self.iterations, BATCH_SIZE, LEARNING_RATE)
        problem = LearningProblem(
            networks, loss, len(data["inputs"]), generator, data, self.parameters
        )
        done = train(problem, plan, self.training, self.time_limit_s)
        return {
            "loss_curve": done.loss_curve,
            "iterations": np.array([done.iterations], dtype=np.int32),
        }

    def _shapes(
        self, state: dict[str, NDArray[Any]], n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int, ...]]:
        shapes: dict[str, tuple[int, ...]] = {
            "loss_curve": (state["loss_curve"].size,),
            "iterations": (1,),
        }
        for name, sizes in self._sizes(n_inputs, n_outputs).items():
            shapes |= named_shapes(name, *sizes)
        return shapes

    def _take(self, state: dict[str, NDArray[Any]]) -> None:
        n_inputs, n_outputs = state["axes"].shape[1], state["modes"].shape[1]
        self._networks = {name: taken(state, name) for name in self._sizes(n_inputs, n_outputs)}
        self.loss_curve_, self.iterations_ = state["loss_curve"], int(state["iterations"][0])
        self._at_rest = self._values(np.zeros((1, n_inputs)))

    def _learned(self) -> dict[str, NDArray[Any]]:
        weights = {
            key: array
            for name, network in self._networks.items()
            for key, array in named(name, network).items()
        }
        return {
            "loss_curve": self.loss_curve_,
            "iterations": np.array([self.iterations_], dtype=np.int32),
            **weights,
        }

    @abstractmethod
    def _values(self, z: Array) -> Array:
        """What the networks answer at z (n, n_inputs), (n, n_outputs)."""

    def _coefficients(self, z: Array) -> Array:
        # Each unit's nonlinearity as one.
        count(
            multiply_adds=len(z)
            * sum(weight.size for network in self._networks.values() for weight in network)
        )
        out = self._values(z) - self._at_rest
        out[~z.any(axis=1)] = 0.0  # in a batch the network at rest is rounded otherwise
        return out
