"""Networks between fields at the nodes, and the surrogate that trains such a network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from mor_bench.learning.losses import norms
from mor_bench.learning.training_plan import Loss, TrainingPlan
from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.field_surrogate import Arrays, FieldSurrogate

SampleLoss = Literal["absolute", "relative"]

SECOND_MOMENT_DECAY = 0.99
"""Adam's β₂. A value smaller than Adam's default suits short trainings."""

SMALLEST_SIZE = 0.1
"""Smallest denominator of relative errors, as a fraction of all samples' root mean square."""


class FieldNetwork(nn.Module, ABC):
    """A network G between fields at the nodes.

    `initialise` or loading sets its weights; the constructor draws no random number. Constants are
    buffers that `state_dict` leaves out.
    """

    @abstractmethod
    def encode(self, fields: Tensor) -> Tensor:
        """(n, n_nodes, 3) → features (n, ...), once per sample: they depend on no weight."""

    @abstractmethod
    def forward(self, features: Tensor) -> Tensor:
        """Features of `encode` → (n, n_nodes, 3)."""

    @property
    @abstractmethod
    def multiply_adds(self) -> int:
        """Work of `encode` and `forward` for one sample, after `precompute`."""

    def precompute(self) -> None:
        """Compute the parts that depend on the weights but not on the input."""


class OperatorSurrogate(FieldSurrogate):
    """A `FieldSurrogate` with a `FieldNetwork`.

    The training loss is the mean over the samples of the error's L2 norm, divided by that of the
    displacement, or of its nonlinear remainder. With the loss "absolute", it is the mean squared
    error over the components of all nodes. G(0) is subtracted in training too.
    """

    network_: FieldNetwork
    loss: SampleLoss = "relative"

    @abstractmethod
    def build_network(self, constants: Arrays) -> FieldNetwork: ...

    def initialise(self, network: FieldNetwork, generator: torch.Generator) -> nn.Module:
        initialise(network, generator)
        return network

    def training_data(
        self, network: FieldNetwork, inputs: Tensor, targets: Tensor
    ) -> dict[str, Tensor]:
        with torch.no_grad():
            features = network.encode(torch.cat([inputs, torch.zeros_like(inputs[:1])]))
        return {"features": features, "targets": targets}

    def loss_function(
        self, network: FieldNetwork, data: dict[str, Tensor], generator: torch.Generator
    ) -> Loss:
        features, targets = data["features"], data["targets"]
        free = torch.ones(targets.shape[1:])
        free.view(-1)[torch.from_numpy(self.scene_.fixed_dofs)] = 0.0
        free = free.to(targets.device)
        weights = relative_weights(targets) if self.loss == "relative" else None

        def loss(rows: Tensor) -> Tensor:
            at_rest = rows.new_full((1,), len(targets))
            answers = network(features[torch.cat([rows, at_rest])])
            errors: Tensor = (answers[:-1] - answers[-1:]) * free - targets[rows]
            if weights is None:
                return errors.square().mean()
            return norms(errors.square().mean(dim=(1, 2)) * weights[rows]).mean()

        return loss

    @property
    def repeats(self) -> bool:
        return True

    def plan(self) -> TrainingPlan:
        return TrainingPlan(
            self.iterations,
            self.batch_size,
            self.learning_rate,
            second_moment_decay=SECOND_MOMENT_DECAY,
        )

    def precompute(self) -> None:
        self.network_.precompute()

    def evaluate(self, fields: Tensor) -> Tensor:
        answer: Tensor = self.network_(self.network_.encode(fields))
        return answer

    def n_products(self) -> int:
        return self.network_.multiply_adds


def relative_weights(targets: Tensor) -> Tensor:
    """Return 1 / mean square of each target (n, n_nodes, 3), (n,).

    The mean square is at least that of `SMALLEST_SIZE` times the root mean square of all.
    """
    size = targets.square().mean(dim=(1, 2))
    least = max(SMALLEST_SIZE**2 * float(size.mean()), torch.finfo(size.dtype).tiny)
    return 1.0 / size.clamp(min=least)


class SelfInitialised(ABC, nn.Module):
    """A layer that initialises itself instead of by `initialise`."""

    @abstractmethod
    def initialise(self, generator: torch.Generator) -> None:
        """Draw all weights from the given generator only."""


def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Draw all weights with variance 1 / inputs from the given generator; set biases to zero."""
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            nn.init.normal_(layer.weight, std=layer.in_features**-0.5, generator=generator)
            nn.init.zeros_(layer.bias)
        elif isinstance(layer, SelfInitialised):
            layer.initialise(generator)


def perceptron(*widths: int) -> nn.Sequential:
    """Return linear layers with SiLU between them, with unset weights."""
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(widths):
        layers += [linear(n_in, n_out), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


def linear(n_in: int, n_out: int) -> nn.Linear:
    """Return a linear layer with unset weights."""
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out)  # type: ignore[no-untyped-call]
    return layer


def n_products(module: nn.Module) -> int:
    """Return the multiply-adds of the linear layers in a module for one row of input."""
    return sum(layer.weight.numel() for layer in module.modules() if isinstance(layer, nn.Linear))


def add_constants(module: nn.Module, **arrays: Any) -> None:
    """Add buffers that `state_dict` leaves out."""
    for name, array in arrays.items():
        module.register_buffer(name, array, persistent=False)


def scaled_positions(mesh: Mesh) -> Tensor:
    """Return node positions from the middle of the bounding box, in halves of its longest edge."""
    low, high = mesh.bounds
    scaled = 2.0 * (mesh.points - (low + high) / 2) / (high - low).max()
    return torch.from_numpy(scaled.astype(np.float32))
