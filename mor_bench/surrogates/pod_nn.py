"""POD-NN: a network from principal coordinates of the input to those of the displacement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.linalg import solve
from torch import Tensor

from mor_bench.counting import count
from mor_bench.learning.losses import norms
from mor_bench.learning.perceptron import (
    Perceptron,
    evaluate,
    named,
    named_shapes,
    silu,
    slope_at_rest,
    stacked,
    taken,
)
from mor_bench.learning.training_plan import Loss
from mor_bench.model_file import fitting_arrays, weights_to_start_from
from mor_bench.reduction.coordinates import change_of_basis
from mor_bench.surrogates.coordinate_regression import Array, Arrays, CoordinateSamples, Input
from mor_bench.surrogates.network_regression import NetworkRegression

DERIVATIVE_WEIGHT = 0.1
"""Weight of the squared error of a sample's derivatives relative to its displacement's."""

RIDGE = 1e-6
"""Tikhonov weight of A, relative to the mean square of the coordinates."""


@dataclass(eq=False)
class PODNN(NetworkRegression):
    """g(z) = N(z) - N(0) - N′(0) z of the linear response, g(z) = A z + N(z) - N(0) of the force.

    Hesthaven, Ubbiali: Non-intrusive reduced order modeling of nonlinear problems using neural
    networks, Journal of Computational Physics 363 (2018). With the linear response as input, the
    learned remainder is of second order in the load, so value and slope at rest are subtracted.
    With the force as input, A is fitted first by ridge regression, and N learns what it leaves. The
    loss is the mean relative L2 error. See also `CoordinateRegression`.

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

    architecture: ClassVar[tuple[str, ...]] = ("input", "n_hidden")

    @property
    def names(self) -> list[str]:
        """Names of the networks."""
        return ["network"]

    def networks(self, n_inputs: int, n_outputs: int) -> Mapping[str, tuple[int, int, int]]:
        return dict.fromkeys(self.names, (n_inputs, self.n_hidden, n_outputs))

    def shapes(
        self, model: Arrays, n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int | None, ...]]:
        linear = {"linear": (n_inputs, n_outputs)} if self.input == "force" else {}
        return {**super().shapes(model, n_inputs, n_outputs), **linear}

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        if self.input == "linear-response":
            return self._trained(samples)
        linear = _linear_map(samples)
        return {"linear": linear, **self._trained(_without(samples, linear))}

    def _trained(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        """Train the networks; return their arrays."""
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
        sizes = self.networks(samples.z.shape[1], samples.values.shape[1])
        members = {name: Perceptron(*shape, generator) for name, shape in sizes.items()}
        if self.training.start_from is not None:
            for name, member in members.items():
                member.take(self._weights_of(self.training.start_from, name, scale))
        together = stacked(list(members.values())).to(data["inputs"].device)
        known = self.train(together, self._loss(together, data), data, generator)
        for name, weights in zip(members, together.members(), strict=True):
            weights[-1] *= scale
            known |= named(name, weights)
        return known

    def _weights_of(self, path: Path, name: str, scale: float) -> list[Array]:
        """Return a network of a model of the same mesh, converted to the samples' bases."""
        found, shape = weights_to_start_from(path, self), (len(self.axes_), None)
        bases = fitting_arrays(path, found, {"axes": shape, "modes": shape}, np.float64)
        axes, modes = bases["axes"], bases["modes"]
        shapes = named_shapes(name, axes.shape[1], self.n_hidden, modes.shape[1])
        first, *between, last = taken(fitting_arrays(path, found, shapes, np.float64), name)
        return [
            change_of_basis(axes, self.axes_) @ first,
            *between,
            last @ change_of_basis(modes, self.modes_).T / scale,
        ]

    def _loss(self, networks: Perceptron, data: dict[str, Tensor]) -> Loss:
        z, wanted, weights = data["inputs"], data["outputs"], data["weights"]
        known, rest = data.get("directions"), torch.zeros_like(z[:1])

        def remainder(x: Tensor) -> Tensor:
            found: Tensor = networks(x)
            if self.input == "force":
                found = found - networks(rest)
            else:
                value, slope = networks.at_rest()
                found = found - value - x @ slope
            return found

        def derivatives(x: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
            """Return the remainder, and its derivatives with respect to the load."""
            value, slope = networks.at_rest()
            found, slopes = networks.with_derivatives(x, directions)
            if self.input == "force":
                return found - value, slopes
            linear = directions.flatten(0, 1) @ slope
            return found - value - x @ slope, slopes - linear.view_as(slopes)

        def loss(rows: Tensor) -> Tensor:
            """Return the sum over the networks; Adam steps each weight alone."""
            x, weight = z[rows], weights[rows]
            if known is None:
                squares = ((remainder(x) - wanted[rows]) * weight).square().sum(dim=-1)
            else:
                found, slopes = derivatives(x, known[rows])
                squares = ((found - wanted[rows]) * weight).square().sum(dim=-1)
                wrong = (slopes - data["slopes"][rows]) * weight[:, None]
                squares = squares + DERIVATIVE_WEIGHT * wrong.square().sum(dim=(-2, -1))
            return norms(squares).sum() / len(rows)

        return loss

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        super().take(model)
        self._slope: Array | None = None
        if self.input == "linear-response":
            self._slopes = np.array([slope_at_rest(w) for w in self.networks_.values()])
            self._slope = self._slopes.mean(axis=0)
        self._linear = model.get("linear")

    def values(self, z: Array) -> Array:
        return evaluate(self.networks_["network"], z)

    def coefficients(self, z: Array) -> Array:
        out = super().coefficients(z)
        if self._slope is not None:
            count(multiply_adds=len(z) * self._slope.size)
            out -= z @ self._slope
        if self._linear is not None:
            count(multiply_adds=len(z) * self._linear.size)
            out += z @ self._linear
        return out


def _linear_map(samples: CoordinateSamples) -> Array:
    """Fit A (n_inputs, n_outputs) by ridge regression; errors are relative."""
    z = samples.z * samples.weights
    gram = z.T @ z
    gram[np.diag_indices(len(gram))] += RIDGE * gram.trace() / len(gram)
    return np.asarray(solve(gram, z.T @ (samples.values * samples.weights), assume_a="pos"))


def _without(samples: CoordinateSamples, linear: Array) -> CoordinateSamples:
    """Return samples whose values are without those of a linear map (n_inputs, n_outputs)."""
    slopes = samples.slopes
    if samples.directions is not None and slopes is not None:
        slopes = slopes - samples.directions @ linear
    return replace(samples, values=samples.values - samples.z @ linear, slopes=slopes)


@dataclass(eq=False)
class PODNNEnsemble(PODNN):
    """The mean of several `PODNN` that differ in their initial weights.

    Lakshminarayanan, Pritzel, Blundell: Simple and scalable predictive uncertainty estimation using
    deep ensembles, NeurIPS 2017. All members train on the same batches.

    Parameters
    ----------
    n_members : int
        Networks, 2 to 32.
    """

    n_members: Annotated[int, Field(ge=2, le=32)] = 5

    architecture: ClassVar = ("input", "n_hidden", "n_members")

    @property
    def names(self) -> list[str]:
        return [f"network_{i}" for i in range(self.n_members)]

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        members = [taken(model, name) for name in self.names]
        first, first_bias, second, second_bias, last = (
            np.stack(parts) for parts in zip(*members, strict=True)
        )
        n_inputs, n_outputs = first.shape[1], last.shape[2]
        self._first = first.transpose(1, 0, 2).reshape(n_inputs, -1), first_bias.ravel()
        self._second = second, second_bias[:, None]
        self._last, self._mean_last = last, last.reshape(-1, n_outputs) / self.n_members
        super().take(model)

    def values(self, z: Array) -> Array:
        hidden = self._hidden(z).transpose(1, 0, 2)
        out: Array = hidden.reshape(len(z), len(self._mean_last)) @ self._mean_last
        return out

    def spread(self, forces: ArrayLike) -> Array:
        """Return how much the members disagree relative to the prediction, of shape () or (n,).

        Parameters and errors are those of `disagreement`.
        """
        return self.disagreement(forces, self._members)

    def _members(self, z: Array) -> Array:
        """Return g of each member at z (n, n_inputs), as (n_members, n, n_outputs)."""
        members: Array = (self._hidden(z) - self._hidden(0.0 * z[:1])) @ self._last
        if self._linear is not None:
            members += z @ self._linear
        if self._slope is not None:
            members -= z @ self._slopes
        return members

    def _hidden(self, z: Array) -> Array:
        """Return the last hidden layers at z (n, n_inputs), (n_members, n, n_hidden)."""
        (first, first_bias), (second, second_bias) = self._first, self._second
        x = silu(z @ first + first_bias).reshape(len(z), self.n_members, self.n_hidden)
        return silu(x.transpose(1, 0, 2) @ second + second_bias)
