"""POD-NN: a network from principal coordinates of the input to POD coordinates of the displacement, trained with or without derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

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
from mor_bench.model_file import fitting_arrays, weights_to_start_from
from mor_bench.reduction.coordinates import change_of_basis
from mor_bench.surrogates.coordinate_regression import CoordinateSamples
from mor_bench.surrogates.network_regression import NetworkRegression

Array = NDArray[np.float64]

DERIVATIVE_WEIGHT = 0.1
"""Of the squared error of a sample's derivatives beside that of its displacement."""


class PODNN(NetworkRegression):
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
    """

    architecture: ClassVar[tuple[str, ...]] = ("input", "n_hidden")

    def __init__(
        self,
        input: Literal["linear-response", "force"] = "linear-response",
        n_input_modes: Annotated[int, Field(ge=1)] = 20,
        n_output_modes: Annotated[int, Field(ge=1)] = 40,
        n_hidden: Annotated[int, Field(ge=1, le=4096)] = 128,
        derivatives: bool = False,
        iterations: Annotated[int, Field(ge=1)] = 6000,
        seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
    ) -> None:
        self.input = input
        self.n_input_modes = n_input_modes
        self.n_output_modes = n_output_modes
        self.n_hidden = n_hidden
        self.derivatives = derivatives
        self.iterations = iterations
        self.seed = seed

    def _sizes(self, n_inputs: int, n_outputs: int) -> Mapping[str, tuple[int, int, int]]:
        return {"network": (n_inputs, self.n_hidden, n_outputs)}

    def _learn(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        scale = float(np.sqrt((samples.values**2).sum(axis=1).mean()))
        arrays = {
            "inputs": samples.z,
            "outputs": samples.values / scale,
            "weights": samples.weights,
        }
        if samples.directions is not None and samples.slopes is not None:
            arrays |= {"directions": samples.directions, "slopes": samples.slopes / scale}
        data = self._on_device(arrays)
        generator = torch.Generator().manual_seed(self.seed)
        network = Perceptron(samples.z.shape[1], self.n_hidden, samples.values.shape[1], generator)
        if self.training.start_from is not None:
            network.take(self._weights_of(self.training.start_from, scale))
        network.to(data["inputs"].device)
        known = self._trained(network, self._loss(network, data), data, generator)
        weights = network.arrays()
        weights[-1] *= scale
        return {**known, **named("network", weights)}

    def _weights_of(self, path: Path, scale: float) -> list[Array]:
        """The weights of a model of the same mesh, turned from its bases into those of the samples."""
        state, n_free = weights_to_start_from(path, self), len(self.axes_)
        axes, modes = fitting_arrays(
            path, state, {"axes": (n_free, None), "modes": (n_free, None)}, np.float64
        ).values()
        shapes = named_shapes("network", axes.shape[1], self.n_hidden, modes.shape[1])
        first, *between, last = taken(fitting_arrays(path, state, shapes, np.float64), "network")
        return [
            change_of_basis(axes, self.axes_) @ first,
            *between,
            last @ change_of_basis(modes, self.modes_).T / scale,
        ]

    def _loss(self, network: Perceptron, data: dict[str, Tensor]) -> Callable[[Tensor], Tensor]:
        """Mean squared errors of the coordinates, and of their derivatives if there are any."""
        z, wanted, weights, known = (
            data["inputs"],
            data["outputs"],
            data["weights"],
            data.get("directions"),
        )
        rest = torch.zeros_like(z[:1])

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

    def _take(self, state: dict[str, NDArray[Any]]) -> None:
        super()._take(state)
        self._slope = (
            slope_at_rest(self._networks["network"]) if self.input == "linear-response" else None
        )

    def _values(self, z: Array) -> Array:
        return evaluate(self._networks["network"], z)

    def _coefficients(self, z: Array) -> Array:
        out = super()._coefficients(z)
        if self._slope is not None:
            count(multiply_adds=len(z) * self._slope.size)
            out -= z @ self._slope
        return out
