"""POD-NN: a network from principal coordinates of the input to POD coordinates of the displacement, trained with or without derivatives."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from torch import Tensor

from mor_bench import counting
from mor_bench.errors import InvalidInputError
from mor_bench.learning.perceptron import Perceptron, checked, evaluate, named, slope_at_rest
from mor_bench.learning.training import TrainingPlan, device_of, fingerprint_of, train
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import error_weights, input_axes
from mor_bench.reduction.sensitivity import sensitivities
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate, weights_to_start_from

Array = NDArray[np.float64]

BATCH_SIZE = 64
LEARNING_RATE = 3e-3
DERIVATIVE_WEIGHT = 0.1
"""Of the squared error of a sample's derivatives beside that of its displacement."""


class PODNN(Surrogate):
    """u = K₀⁻¹f + Φ (N(z) - N(0) - N′(0) z), z principal coordinates of the linear response; or u = Φ (N(z) - N(0)), z those of the force.

    Hesthaven, Ubbiali: Non-intrusive reduced order modeling of nonlinear problems using neural networks, Journal of
    Computational Physics 363 (2018), with the linear response as input: what linear elasticity lacks is of second order in the
    load, so the network's value and slope at rest are subtracted. No load gives exactly no displacement.

    With derivatives the network also matches those of the displacement with respect to the load, which the equations give by
    back-solves with K(u) at the samples' own solutions, see `mor_bench.reduction.sensitivity`; after O'Leary-Roseberry et al.:
    Derivative-informed neural operator, Journal of Computational Physics 496 (2024).

    On beam-coarse (split by region, 160 training samples, 6,000 iterations) the median error was 0.22 % without derivatives and
    0.12 % with them; with 5,100 samples and no derivatives 0.084 %. Subtracting the slope at rest took the latter, with 64
    hidden units, from 0.16 to 0.10 %.

    Parameters
    ----------
    input : {"linear-response", "force"}
        What the coordinates z are taken of.
    n_input_modes : int
        Length of z; capped at the rank of the input with a warning.
    n_output_modes : int
        Size of the basis Φ of the nonlinear rest, or of the displacement; capped at the rank with a warning.
    n_hidden : int
        Units in each of two hidden layers.
    derivatives : bool
        Whether derivatives are matched; then the scene's equations must be known.
    iterations : int
        Adam steps of batches of `BATCH_SIZE` samples.
    seed : int
        Of the initial weights and of the order of the samples.

    Attributes
    ----------
    loss_curve_ : (n_intervals,) float64
    iterations_ : int
        Steps that the training took.
    """

    loss_curve_: Array
    iterations_: int

    def __init__(
        self,
        input: Literal["linear-response", "force"] = "linear-response",
        n_input_modes: Annotated[int, Field(ge=1)] = 20,
        n_output_modes: Annotated[int, Field(ge=1)] = 40,
        n_hidden: Annotated[int, Field(ge=1, le=4096)] = 128,
        derivatives: bool = False,
        iterations: Annotated[int, Field(ge=1)] = 6000,
        seed: Annotated[int, Field(ge=0, lt=2**63)] = 0,
    ) -> None:
        self.input = input
        self.n_input_modes = n_input_modes
        self.n_output_modes = n_output_modes
        self.n_hidden = n_hidden
        self.derivatives = derivatives
        self.iterations = iterations
        self.seed = seed

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene) if self.derivatives or self._from_linear else None

    @property
    def _from_linear(self) -> bool:
        return self.input == "linear-response"

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            snapshots = self._checked_snapshots(snapshots)
            inputs, targets = snapshots.free_forces, snapshots.free_displacements
            model = FullOrderModel(scene) if self.derivatives or self._from_linear else None
            if model is not None and self._from_linear:
                inputs = model.rest_factor.solve(inputs.T).T
                targets = targets - inputs
            axes, modes = input_axes(inputs, self.n_input_modes, 0.5), pod(targets, self.n_output_modes).modes
            coordinates = targets @ modes
            scale = float(np.sqrt((coordinates**2).sum(axis=1).mean()))
            arrays = {"inputs": inputs @ axes, "outputs": coordinates / scale, "weights": error_weights(snapshots.free_displacements)}
            if model is not None and self.derivatives:
                known = sensitivities(model, snapshots, axes, modes, of_force=not self._from_linear)
                arrays |= {"directions": known.inputs, "slopes": known.outputs / scale}
            device = device_of(self.training)
            data = {name: torch.from_numpy(array.astype(np.float32)).to(device) for name, array in arrays.items()}
            generator = torch.Generator().manual_seed(self.seed)
            network = Perceptron(axes.shape[1], self.n_hidden, modes.shape[1], generator)
            if self.training.start_from is not None:
                network.take(self._weights_of(self.training.start_from, axes, modes, scale))
            network.to(device)
            plan = TrainingPlan(self.iterations, BATCH_SIZE, LEARNING_RATE)
            fingerprint = fingerprint_of(self.parameters, {**data, **network.state_dict()}) if self.training.checkpoint else ""
            trained = train(network, self._loss(network, data), len(snapshots), plan, generator, self.training, self.time_limit_s, fingerprint)
            weights = network.arrays()
            weights[-1] *= scale
            state = {"axes": axes, "modes": modes, "loss_curve": trained.loss_curve, "iterations": np.array([trained.iterations])}
            self._restore({**state, **named("network", weights)})
        return self

    def _weights_of(self, path: Path, axes: Array, modes: Array, scale: float) -> list[Array]:
        """The weights of a model of the same mesh, turned from its bases into others."""
        state = weights_to_start_from(path, type(self))
        sizes = state["axes"].shape[1], self.n_hidden, state["modes"].shape[1]
        if (len(state["axes"]), state["network.second"].shape) != (len(axes), (self.n_hidden, self.n_hidden)):
            raise InvalidInputError(f"{path}: `start_from` must be a model of {len(axes)} free dofs and {self.n_hidden} hidden units.")
        first, *between, last = checked(state, "network", *sizes)
        return [np.linalg.pinv(axes) @ state["axes"] @ first, *between, last @ state["modes"].T @ modes / scale]

    def _loss(self, network: Perceptron, data: dict[str, Tensor]) -> Callable[[Tensor], Tensor]:
        """Mean squared errors of the coordinates, and of their derivatives if there are any."""
        z, wanted, weights, known = data["inputs"], data["outputs"], data["weights"], data.get("directions")
        rest = torch.zeros_like(z[:1])

        def loss(rows: Tensor) -> Tensor:
            directions = z[rows, None]
            if known is not None:
                directions = torch.cat([directions, known[rows]], dim=1)
            found, slopes = network.with_derivatives(z[rows], directions[:, 1:])
            if self._from_linear:
                at_rest, first = network.with_derivatives(rest, directions.flatten(0, 1)[None])
                first = first.reshape(*directions.shape[:2], -1)
                found, slopes = found - first[:, 0], slopes - first[:, 1:]
            else:
                at_rest = network(rest)
            weight = weights[rows, None]
            total = (((found - at_rest - wanted[rows]) * weight) ** 2).sum(dim=1).mean()
            if known is not None:
                wrong = (slopes - data["slopes"][rows]) * weight[:, None]
                total = total + DERIVATIVE_WEIGHT * (wrong**2).sum(dim=(1, 2)).mean()
            return total

        return loss

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces).reshape(-1, self.scene_.mesh.n_dofs)
        free = self.scene_.free_dofs
        out = np.zeros_like(batch)
        if counting.running is not None:  # each unit's nonlinearity as one
            network = sum(weight.size for weight in self._network) + (self._slope.size if self._from_linear else 0)
            counting.running.add(multiply_adds=len(batch) * (self.axes_.size + network + self.modes_.size))
        inputs = batch[:, free]
        if self._from_linear:
            inputs = self.model_.rest_factor.solve(inputs.T).T
        z = inputs @ self.axes_
        coordinates = evaluate(self._network, z) - self._at_rest
        if self._from_linear:
            out[:, free] = inputs + (coordinates - z @ self._slope) @ self.modes_.T
        else:
            out[:, free] = coordinates @ self.modes_.T
        out[~batch.any(axis=1)] = 0.0  # in a batch the network at rest is rounded otherwise
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        state = {"axes": self.axes_, "modes": self.modes_, "loss_curve": self.loss_curve_, "iterations": np.array([self.iterations_])}
        return {**state, **named("network", self._network)}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        state = {name: np.ascontiguousarray(array) for name, array in state.items()}
        n_free, n_inputs, n_outputs = len(self.scene_.free_dofs), state["axes"].shape[1], state["modes"].shape[1]
        shapes = {"axes": (n_free, n_inputs), "modes": (n_free, n_outputs), "loss_curve": (state["loss_curve"].size,), "iterations": (1,)}
        for name, shape in shapes.items():
            if state[name].shape != shape or not np.isfinite(state[name]).all():
                raise InvalidInputError(f"`{name}` must be a finite array of shape {shape}; got shape {state[name].shape}.")
        self.axes_, self.modes_ = state["axes"], state["modes"]
        self.loss_curve_, self.iterations_ = state["loss_curve"], int(state["iterations"][0])
        self._network = checked(state, "network", n_inputs, self.n_hidden, n_outputs)
        self._at_rest, self._slope = evaluate(self._network, np.zeros((1, n_inputs))), slope_at_rest(self._network)
        if self._from_linear:
            self.model_ = FullOrderModel(self.scene_)
            _ = self.model_.rest_factor
