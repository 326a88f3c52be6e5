"""What the surrogates share whose network maps a field at the nodes to a field at the nodes: scales, rest state, files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.learning.training import Training, device_of, train
from mor_bench.learning.training_plan import LearningProblem, TrainingPlan
from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.observed import linear_response
from mor_bench.model_file import fitting_arrays, weights_to_start_from
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

Input = Literal["force", "linear-response"]

Arrays = Mapping[str, NDArray[Any]]

PREDICTION_CHUNK = 64
"""Samples per forward pass, which bounds the memory of a long batch."""

SECOND_MOMENT_DECAY = 0.99
"""Adam's β₂: these trainings are short, and gain from a short memory, see `UMesh`."""


class FieldNetwork(nn.Module, ABC):
    """A network G from a field at the nodes to another.

    Its weights are left without values until `initialise`, or until they are loaded: no random number is drawn. What it knows
    of the mesh and what is learned without training are buffers that `state_dict` leaves out.
    """

    @abstractmethod
    def encode(self, fields: Tensor) -> Tensor:
        """(n, n_nodes, 3) → features (n, ...), in which no weight takes part: computed once for each training sample."""

    @abstractmethod
    def forward(self, features: Tensor) -> Tensor:
        """Features of `encode` → (n, n_nodes, 3)."""

    @property
    @abstractmethod
    def multiply_adds(self) -> int:
        """Of `encode` and `forward` for one sample, after `prepare`."""

    def prepare(self) -> None:
        """Compute what depends on the weights but not on the input, once for all queries."""


class FieldSurrogate(Surrogate):
    """u = s (G(x) - G(0)) with x the scaled force, or u = K₀⁻¹f + s (G(x) - G(0)) with x the scaled linear response K₀⁻¹f.

    Trained with the mean squared error over the components of all nodes of the body, in float32. G(0) is subtracted in the
    training too, so that no load gives exactly no displacement. In a scene with observed nodes their displacements take the
    place of the force, and the linear extension of these that of the linear response.

    Attributes
    ----------
    network_ : FieldNetwork
        G.
    input_scale_, output_scale_ : float
        Root mean square over training samples, nodes and components of the input, N or m, and of what is learned, m.
    loss_curve_ : (n_intervals,) float64
        Training loss, in units of ``output_scale_`` squared.
    iterations_ : int
        Adam steps done.
    """

    takes_observations = True

    input: Input
    iterations: int
    batch_size: int
    learning_rate: float
    seed: int

    @abstractmethod
    def _constants(
        self, inputs: NDArray[np.float64], targets: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float64]]:
        """What the network needs beside the scene: arrays learned from scaled inputs and targets, (n_samples, n_nodes, 3)."""

    @abstractmethod
    def _network(self, constants: Arrays) -> FieldNetwork:
        """The network without values; raises InvalidInputError if the constants do not fit the scene and the knobs."""

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True) if self.input == "linear-response" else None

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            samples = self._checked_snapshots(snapshots)
            if self.input == "linear-response":
                self.compliance_ = linear_response(scene)
                inputs = self._linear_response(samples.inputs)
                targets = samples.displacements - inputs
            else:
                inputs, targets = samples.inputs, samples.displacements
            self.input_scale_, self.output_scale_ = _rms(inputs), _rms(targets)
            inputs, targets = inputs / self.input_scale_, targets / self.output_scale_
            self.constants_ = self._constants(inputs, targets)
            network = self._network(self.constants_)
            generator = torch.Generator().manual_seed(self.seed)
            initialise(network, generator)
            if self.training.start_from is not None:
                self._start_from(network, self.training.start_from)
            done = self._train(network, _single(inputs), _single(targets), generator)
            self.loss_curve_, self.iterations_ = done.loss_curve, done.iterations
            self._finish(network.cpu())
        return self

    def _train(
        self, network: FieldNetwork, fields: Tensor, targets: Tensor, generator: torch.Generator
    ) -> Training:
        device = device_of(self.training)
        with torch.no_grad():
            features = network.encode(torch.cat([fields, torch.zeros_like(fields[:1])])).to(device)
        network.to(device)
        targets = targets.to(device)
        free = torch.ones(targets.shape[1], 1)
        free[torch.from_numpy(self.scene_.fixed_nodes)] = 0.0
        free = free.to(device)

        def loss(rows: Tensor) -> Tensor:
            at_rest = rows.new_full((1,), len(targets))
            answers = network(features[torch.cat([rows, at_rest])])
            errors: Tensor = (answers[:-1] - answers[-1:]) * free - targets[rows]
            return errors.square().mean()

        plan = TrainingPlan(
            self.iterations,
            self.batch_size,
            self.learning_rate,
            second_moment_decay=SECOND_MOMENT_DECAY,
        )
        arrays = {"features": features, "targets": targets}
        problem = LearningProblem(
            network, loss, len(targets), generator, arrays, self.parameters
        )
        return train(problem, plan, self.training, self.time_limit_s)

    def _start_from(self, network: FieldNetwork, path: Path) -> None:
        """Take the weights of a model of this architecture, trained on this scene or another."""
        state = weights_to_start_from(path, self)
        known = fitting_arrays(
            path,
            state,
            {f"constant.{name}": (len(array), None) for name, array in self.constants_.items()},
            np.float64,
        )
        constants = {name.removeprefix("constant."): array for name, array in known.items()}
        try:
            source = self._network(constants)
        except InvalidInputError as error:
            raise InvalidInputError(f"{path}: {error}") from None
        shapes = {
            f"network.{name}": tuple(value.shape) for name, value in source.state_dict().items()
        }
        weights = network_weights(fitting_arrays(path, state, shapes, np.float32))
        scales = fitting_arrays(path, state, {"scales": (2,)}, np.float64)["scales"]
        if not (scales > 0).all():
            raise StoreError(f"{path}: `scales` must be greater than 0; got {scales}.")
        network.load_state_dict(self._turned(weights, constants, scales))

    def _turned(
        self, weights: dict[str, Tensor], constants: Arrays, scales: NDArray[np.float64]
    ) -> dict[str, Tensor]:
        """Weights of a model of other constants and scales, for this one's own."""
        return weights

    @torch.inference_mode()
    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        if len(batch) == 0:
            return np.zeros(np.shape(forces))
        # With one scaling of each input and each output.
        count(
            multiply_adds=len(batch) * (self.network_.multiply_adds + 2 * self.scene_.mesh.n_dofs)
        )
        inputs = self._linear_response(batch) if self.input == "linear-response" else batch
        answers = [
            self.network_(self.network_.encode(chunk))
            for chunk in torch.split(_single(inputs / self.input_scale_), PREDICTION_CHUNK)
        ]
        learned = (torch.cat(answers) - self._at_rest).to(
            torch.float64
        ).numpy() * self.output_scale_
        out = inputs + learned if self.input == "linear-response" else learned
        out[:, self.scene_.fixed_nodes] = 0.0
        out[~batch.any(axis=(1, 2))] = 0.0  # in a batch the network at rest is rounded otherwise
        return out.reshape(np.shape(forces))

    def _linear_response(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """K₀⁻¹f, (n, n_nodes, 3) m of forces (n, n_nodes, 3) N, or the linear extension of observed displacements, m."""
        return self.compliance_.respond(
            forces.reshape(len(forces), self.scene_.mesh.n_dofs)
        ).reshape(forces.shape)

    def _finish(self, network: FieldNetwork) -> None:
        self.network_ = network.eval().requires_grad_(False)
        with torch.inference_mode():
            network.prepare()
            self._at_rest: Tensor = network(
                network.encode(torch.zeros(1, self.scene_.mesh.n_nodes, 3))
            )

    def _state(self) -> dict[str, NDArray[Any]]:
        return {
            **{
                f"network.{name}": value.numpy()
                for name, value in self.network_.state_dict().items()
            },
            **{f"constant.{name}": array for name, array in self.constants_.items()},
            "scales": np.array([self.input_scale_, self.output_scale_]),
            "loss_curve": self.loss_curve_,
            "iterations": np.array([self.iterations_]),
        }

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        for name, array in state.items():
            if array.dtype.kind not in "fi" or not np.isfinite(array).all():
                raise InvalidInputError(
                    f"`{name}` must be finite numbers; got {array.dtype}, or NaN or infinity."
                )
        self.input_scale_, self.output_scale_ = (float(scale) for scale in state["scales"])
        if not min(self.input_scale_, self.output_scale_) > 0:
            raise InvalidInputError(f"`scales` must be greater than 0; got {state['scales']}.")
        self.loss_curve_, self.iterations_ = state["loss_curve"], int(state["iterations"][0])
        self.constants_ = {
            name.removeprefix("constant."): array
            for name, array in state.items()
            if name.startswith("constant.")
        }
        network = self._network(self.constants_)
        weights = network_weights(state)
        expected = {
            name: (value.shape, value.dtype) for name, value in network.state_dict().items()
        }
        if expected != {name: (value.shape, value.dtype) for name, value in weights.items()}:
            raise InvalidInputError("the weights do not fit the network.")
        network.load_state_dict(weights, assign=True)
        if self.input == "linear-response":
            self.compliance_ = linear_response(self.scene_)
        self._finish(network)


class SelfInitialised(ABC, nn.Module):
    """A layer that `initialise` knows nothing of."""

    @abstractmethod
    def initialise(self, generator: torch.Generator) -> None:
        """Give all weights values, from the given generator only."""


def perceptron(*widths: int) -> nn.Sequential:
    """Linear layers with SiLU between them, without values."""
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(widths):
        layers += [linear(n_in, n_out), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


def linear(n_in: int, n_out: int) -> nn.Linear:
    """A linear layer without values."""
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out)  # type: ignore[no-untyped-call]
    return layer


def n_products(module: nn.Module) -> int:
    """Multiply-adds of the linear layers in a module for one row of input."""
    return sum(layer.weight.numel() for layer in module.modules() if isinstance(layer, nn.Linear))


def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Give all weights values, from the given generator only: variance 1 / inputs, and zero biases."""
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            nn.init.normal_(layer.weight, std=layer.in_features**-0.5, generator=generator)
            nn.init.zeros_(layer.bias)
        elif isinstance(layer, SelfInitialised):
            layer.initialise(generator)


def network_weights(state: Arrays) -> dict[str, Tensor]:
    """Return the weights among the arrays of a model, by their names in the network."""
    return {
        name.removeprefix("network."): torch.from_numpy(array)
        for name, array in state.items()
        if name.startswith("network.")
    }


def _single(fields: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(fields.astype(np.float32))


def _rms(values: NDArray[np.float64]) -> float:
    """Root of the mean square over all samples, nodes and components; 1 where all are zero."""
    return float(np.sqrt(np.mean(np.square(values)))) or 1.0
