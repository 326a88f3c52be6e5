"""Base class of surrogates with a network between fields at the nodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mor_bench.counting import count, is_counting
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.learning.training import Training, device_of, train
from mor_bench.learning.training_plan import LearningProblem, Loss, TrainingPlan
from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.observed import LinearResponse, linear_response
from mor_bench.model_arrays import take_array
from mor_bench.model_file import fitting_arrays, weights_to_start_from
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.surrogate import Surrogate

Input = Literal["force", "linear-response"]
Array = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]


class FieldSurrogate(Surrogate, ABC):
    """u = s (G(x) - G(0)) from the scaled force x, or u = K₀⁻¹f + s (G(x) - G(0)) from x ~ K₀⁻¹f.

    The network G is trained in float32. In a scene with observed nodes, their displacements replace
    the force, and their linear extension replaces the linear response. The supports do not move.
    A subclass defines the network, its loss and its evaluation. It declares the parameters below as
    its hyperparameters.

    Parameters
    ----------
    input : {"force", "linear-response"}
        Input of the network. The linear response gives far smaller errors, and needs the scene's
        equations.
    iterations : int
        Adam steps. A number instead of a time makes results independent of the machine's load.
    batch_size : int
        Samples per step; at most all samples.
    learning_rate : float
        Peak of the one-cycle schedule.
    seed : int
        Seed of the initial weights and the order of the samples.

    Attributes
    ----------
    network_ : nn.Module
        G.
    input_scale_, output_scale_ : float
        Divisors of the input, N or m, and of the learned displacement, m.
    loss_curve_ : (n_intervals,) float64
        Training loss; a mean squared error is in units of ``output_scale_`` squared.
    iterations_ : int
        Number of iterations that repeats the training.
    """

    input: Input
    iterations: int
    batch_size: int
    learning_rate: float
    seed: int

    zero_at_rest: bool = True
    """Subtract G(0); then no load gives exactly no displacement."""

    chunk: ClassVar[int] = 64
    """Samples per forward pass of a prediction; limits the memory of a long batch."""

    curves: ClassVar[tuple[str, ...]] = ("loss_curve",)
    """Curves of `Training` that the model keeps."""

    @property
    def repeats(self) -> bool:
        """True if the loss does the same operations with every batch, see `LearningProblem`."""
        return False

    network_: nn.Module
    loss_curve_: Array
    response_: LinearResponse

    @abstractmethod
    def build_network(self, constants: Arrays) -> nn.Module:
        """Return the network with unset weights.

        Raises
        ------
        InvalidInputError
            If the constants do not fit the scene and the hyperparameters.
        """

    @abstractmethod
    def initialise(self, network: Any, generator: torch.Generator) -> nn.Module:
        """Return the network with random weights drawn from the given generator only."""

    @abstractmethod
    def training_data(self, network: Any, inputs: Tensor, targets: Tensor) -> dict[str, Tensor]:
        """Return the loss's arrays from scaled samples (n, n_nodes, 3)."""

    @abstractmethod
    def loss_function(
        self, network: Any, data: dict[str, Tensor], generator: torch.Generator
    ) -> Loss:
        """Return the loss; it draws random numbers from the generator."""

    @abstractmethod
    def plan(self) -> TrainingPlan:
        """Return the settings of the training."""

    @abstractmethod
    def evaluate(self, fields: Tensor) -> Tensor:
        """Return G of scaled fields, (n, n_nodes, 3) both."""

    @abstractmethod
    def n_products(self) -> int:
        """Return the multiply-adds of G for one sample."""

    def constants(self, inputs: Array, targets: Array) -> dict[str, Array]:
        """Return arrays that the network needs besides the scene, from scaled samples."""
        return {}

    def scale(self, values: Array) -> float:
        """Return the root mean square over samples, nodes and components; 1 if all are zero."""
        return float(np.sqrt(np.mean(np.square(values)))) or 1.0

    def input_scale(self, values: Array) -> float:
        """Return the divisor of the input, by default its `scale`."""
        return self.scale(values)

    def turned(self, weights: dict[str, Tensor], source: Arrays, target: Arrays) -> Any:
        """Convert the weights of a model with other constants and scales; return them."""
        return weights

    def finish(self, inputs: Tensor, targets: Tensor) -> None:
        """Finish the fit after training ``network_``, with scaled samples on the processor."""

    def precompute(self) -> None:
        """Compute the parts of ``network_`` that depend on its weights but not on the input."""

    def set_up(self, scene: Scene) -> None:
        """Compute the scene's part of the network, unless it exists already."""
        if self.input == "linear-response" and not hasattr(self, "response_"):
            self.response_ = linear_response(scene)

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True) if self.input == "linear-response" else None

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        self.set_up(scene)
        given, wanted = self._pairs(samples)
        scales = np.array([self.input_scale(given), self.scale(wanted)])
        inputs, targets = given / scales[0], wanted / scales[1]
        constants = self.constants(inputs, targets)
        model: dict[str, NDArray[Any]] = {f"constant.{k}": v for k, v in constants.items()}
        model["scales"] = scales
        generator = torch.Generator().manual_seed(self.seed)
        network = self.initialise(self.build_network(constants), generator)
        if self.training.start_from is not None:
            self._start_from(network, self.training.start_from, model)
        known = [(_single(inputs), _single(targets))]
        if self.plan().validation_fraction > 0 and self.training.validation is not None:
            held = self._pairs(self.training.validation)
            known.append((_single(held[0] / scales[0]), _single(held[1] / scales[1])))
        done = self.train_network(network, known, generator)
        self.network_ = network.cpu()
        self.finish(_single(inputs), _single(targets))
        weights = self.network_.state_dict()
        model |= {f"network.{name}": value.contiguous().numpy() for name, value in weights.items()}
        model |= {name: getattr(done, name) for name in self.curves}
        model["iterations"] = np.array([done.iterations])
        return model

    def _pairs(self, samples: Snapshots) -> tuple[Array, Array]:
        """Return what the network is given and what it learns, (n, n_nodes, 3) both."""
        given, wanted = self._network_input(samples.given.values), samples.displacements
        return given, wanted - given if self.input == "linear-response" else wanted

    def train_network(
        self,
        network: nn.Module,
        known: Sequence[tuple[Tensor, Tensor]],
        generator: torch.Generator,
    ) -> Training:
        """Train on scaled samples: those to learn from, and perhaps those to validate on."""
        device = device_of(self.training)
        inputs, targets = (torch.cat(parts) for parts in zip(*known, strict=True))
        data = self.training_data(network, inputs, targets)
        data = {name: value.to(device) for name, value in data.items()}
        loss = self.loss_function(network.to(device), data, generator)
        n_train = len(known[0][0])
        n_validation = len(inputs) - n_train
        problem = LearningProblem(
            network,
            loss,
            n_train,
            generator,
            data,
            self.parameters,
            n_validation,
            self.repeats,
        )
        return train(problem, self.plan(), self.training, self.time_limit_s)

    def _start_from(self, network: nn.Module, path: Path, model: Arrays) -> None:
        """Load the weights of a saved model with this architecture, for this scene or another."""
        found = weights_to_start_from(path, self)
        own = _constants(model)
        shapes: dict[str, tuple[int | None, ...]] = {
            f"constant.{name}": (len(array), None) for name, array in own.items()
        }
        source = fitting_arrays(path, found, {**shapes, "scales": (2,)}, np.float64)
        try:
            like = self.build_network(_constants(source))
        except InvalidInputError as error:
            raise InvalidInputError(f"{path}: {error}") from None
        shapes = {f"network.{name}": tuple(v.shape) for name, v in like.state_dict().items()}
        weights = fitting_arrays(path, found, shapes, np.float32)
        if not (source["scales"] > 0).all():
            raise StoreError(f"{path}: `scales` must be greater than 0; got {source['scales']}.")
        tensors = {
            name.removeprefix("network."): torch.from_numpy(array)
            for name, array in weights.items()
        }
        network.load_state_dict(self.turned(tensors, source, model))

    def prepare(self, scene: Scene, model: Arrays) -> None:
        self.set_up(scene)
        network = self.build_network(_constants(model))
        shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
        names = {f"network.{name}" for name in shapes} | {"scales", "iterations", *self.curves}
        unlike = names ^ {name for name in model if not name.startswith("constant.")}
        if unlike:
            raise InvalidInputError(
                "the arrays do not fit the network; missing or not expected: "
                f"{', '.join(sorted(unlike))}."
            )
        weights = {
            name: torch.from_numpy(take_array(model, f"network.{name}", shape, np.float32))
            for name, shape in shapes.items()
        }
        network.load_state_dict(weights, assign=True)
        scales = take_array(model, "scales", (2,))
        (self.iterations_,) = take_array(model, "iterations", (1,), np.int64).tolist()
        if not (scales > 0).all() or self.iterations_ < 1:
            raise InvalidInputError("`scales` and `iterations` must be positive.")
        self.input_scale_, self.output_scale_ = scales.tolist()
        for name in self.curves:
            setattr(self, f"{name}_", take_array(model, name, (model[name].size,)))
        self.network_ = network.eval().requires_grad_(False)
        self._at_rest = torch.zeros(1, scene.mesh.n_nodes, 3)
        self.precompute()
        if self.zero_at_rest:
            with torch.inference_mode():
                self._at_rest = self.evaluate(self._at_rest)

    @torch.inference_mode()
    def answer(self, forces: Array) -> Array:
        if len(forces) == 0:
            return np.zeros(forces.shape)
        if is_counting():  # includes one scaling of each input and each output
            count(multiply_adds=len(forces) * (self.n_products() + 2 * self.scene_.mesh.n_dofs))
        inputs = self._network_input(forces)
        chunks = torch.split(_single(inputs / self.input_scale_), self.chunk)
        learned = torch.cat([self.evaluate(chunk) for chunk in chunks]) - self._at_rest
        out: Array = learned.to(torch.float64).numpy() * self.output_scale_
        if self.input == "linear-response":
            out += inputs
        self.scene_.hold(out.reshape(len(out), self.scene_.mesh.n_dofs))
        if self.zero_at_rest:  # the network rounds differently in a batch
            out[~forces.any(axis=(1, 2))] = 0.0
        return out

    def answer_observed(self, observed: ObservedDisplacements) -> Array:
        return self.answer(observed.values)

    def _network_input(self, given: Array) -> Array:
        """Return the given values, or the linear response to them, m, both (n, n_nodes, 3)."""
        if self.input == "force":
            return given
        flat = given.reshape(len(given), self.scene_.mesh.n_dofs)
        return self.response_.respond(flat).reshape(given.shape)


def _constants(model: Arrays) -> dict[str, NDArray[Any]]:
    return {
        name.removeprefix("constant."): array
        for name, array in model.items()
        if name.startswith("constant.")
    }


def _single(fields: Array) -> Tensor:
    return torch.from_numpy(fields.astype(np.float32))
