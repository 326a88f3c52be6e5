"""POD-NN: a network from principal coordinates of the input to those of the displacement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from mor_bench.counting import count
from mor_bench.learning.perceptron import (
    Perceptron,
    evaluate,
    named,
    named_shapes,
    slope_at_rest,
    taken,
)
from mor_bench.learning.training_plan import Loss
from mor_bench.model_file import fitting_arrays, weights_to_start_from
from mor_bench.reduction.coordinates import change_of_basis
from mor_bench.surrogates.coordinate_regression import Array, CoordinateSamples, Input
from mor_bench.surrogates.network_regression import NetworkRegression

DERIVATIVE_WEIGHT = 0.1
"""Weight of the squared error of a sample's derivatives relative to its displacement's."""


@dataclass(eq=False)
class PODNN(NetworkRegression):
    """g(z) = N(z) - N(0) - N′(0) z of the linear response, g(z) = N(z) - N(0) of the force.

    Hesthaven, Ubbiali: Non-intrusive reduced order modeling of nonlinear problems using neural
    networks, Journal of Computational Physics 363 (2018). With the linear response as input, the
    learned remainder is of second order in the load, so value and slope at rest are subtracted. See
    also `CoordinateRegression`.

    With derivatives the network also matches those of the displacement with respect to the load,
    see `mor_bench.reduction.sensitivity`; after O'Leary-Roseberry et al.: Derivative-informed
    neural operator, Journal of Computational Physics 496 (2024).

    `input`, `n_input_modes` and `n_output_modes` are those of `CoordinateRegression`.

    Parameters
    ----------
    n_hidden : int
        Units in each of the two hidden layers.
    derivatives : bool
        Whether to match derivatives; needs the scene's equations. Use it if samples are few.
    iterations : int
        Adam steps with batches of `BATCH_SIZE` samples.
    seed : int
        Seed of the initial weights and the order of the samples.
    """

    input: Input = "linear-response"
    n_input_modes: Annotated[int, Field(ge=1)] = 20
    n_output_modes: Annotated[int, Field(ge=1)] = 40
    n_hidden: Annotated[int, Field(ge=1, le=4096)] = 128
    derivatives: bool = False
    iterations: Annotated[int, Field(ge=1)] = 6000
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    architecture: ClassVar = ("input", "n_hidden")

    def networks(self, n_inputs: int, n_outputs: int) -> Mapping[str, tuple[int, int, int]]:
        return {"network": (n_inputs, self.n_hidden, n_outputs)}

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        scale = float(np.sqrt((samples.values**2).sum(axis=1).mean()))
        arrays = {
            "inputs": samples.z,
            "outputs": samples.values / scale,
            "weights": samples.weights,
        }
        if samples.directions is not None and samples.slopes is not None:
            arrays |= {"directions": samples.directions, "slopes": samples.slopes / scale}
        data = self.on_device(arrays)
        generator = torch.Generator().manual_seed(self.seed)
        network = Perceptron(samples.z.shape[1], self.n_hidden, samples.values.shape[1], generator)
        if self.training.start_from is not None:
            network.take(self._weights_of(self.training.start_from, scale))
        network.to(data["inputs"].device)
        known = self.train(network, self._loss(network, data), data, generator)
        weights = network.arrays()
        weights[-1] *= scale
        return {**known, **named("network", weights)}

    def _weights_of(self, path: Path, scale: float) -> list[Array]:
        """Return the weights of a model of the same mesh, converted to the samples' bases."""
        found, shape = weights_to_start_from(path, self), (len(self.axes_), None)
        bases = fitting_arrays(path, found, {"axes": shape, "modes": shape}, np.float64)
        axes, modes = bases["axes"], bases["modes"]
        shapes = named_shapes("network", axes.shape[1], self.n_hidden, modes.shape[1])
        first, *between, last = taken(fitting_arrays(path, found, shapes, np.float64), "network")
        return [
            change_of_basis(axes, self.axes_) @ first,
            *between,
            last @ change_of_basis(modes, self.modes_).T / scale,
        ]

    def _loss(self, network: Perceptron, data: dict[str, Tensor]) -> Loss:
        z, wanted, weights = data["inputs"], data["outputs"], data["weights"]
        known, rest = data.get("directions"), torch.zeros_like(z[:1])

        def loss(rows: Tensor) -> Tensor:
            directions = z[rows, None]
            if known is not None:
                directions = torch.cat([directions, known[rows]], dim=1)
            found, slopes = network.with_derivatives(z[rows], directions[:, 1:])
            if self.input == "linear-response":
                at_rest, first = network.with_derivatives(rest, directions.flatten(0, 1)[None])
                first = first.reshape(*directions.shape[:2], -1)
                found, slopes = found - first[:, 0], slopes - first[:, 1:]
            else:
                at_rest = network(rest)
            weight = weights[rows]
            total = (((found - at_rest - wanted[rows]) * weight) ** 2).sum(dim=1).mean()
            if known is not None:
                wrong = (slopes - data["slopes"][rows]) * weight[:, None]
                total = total + DERIVATIVE_WEIGHT * (wrong**2).sum(dim=(1, 2)).mean()
            return total

        return loss

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        super().take(model)
        self._slope: Array | None = None
        if self.input == "linear-response":
            self._slope = slope_at_rest(self.networks_["network"])

    def values(self, z: Array) -> Array:
        return evaluate(self.networks_["network"], z)

    def coefficients(self, z: Array) -> Array:
        out = super().coefficients(z)
        if self._slope is not None:
            count(multiply_adds=len(z) * self._slope.size)
            out -= z @ self._slope
        return out
