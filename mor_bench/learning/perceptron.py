"""A multilayer perceptron: a torch module for training, and NumPy functions for answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

Array = NDArray[np.float64]

NAMES = ("first", "first_bias", "second", "second_bias", "last")


class Perceptron(nn.Module):
    """x ↦ W₃ᵀ s(W₂ᵀ s(W₁ᵀ x + b₁) + b₂) with s(x) = x / (1 + exp(-x)).

    Both hidden layers have the same width, and the last layer has no bias. The initial weights have
    the variance 1 / inputs and are drawn in the order of the parameters. The biases are zero.
    `stacked` joins networks of one size, which are then evaluated together.
    """

    def __init__(
        self, n_inputs: int, n_hidden: int, n_outputs: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.weights = nn.ParameterList()
        for shape in _shapes(n_inputs, n_hidden, n_outputs):
            drawn = torch.zeros(shape)
            if len(shape) == 2:
                drawn = torch.randn(shape, generator=generator) / shape[0] ** 0.5
            self.weights.append(nn.Parameter(drawn))

    def forward(self, x: Tensor) -> Tensor:
        first, first_bias, second, second_bias, last = self.weights
        silu = nn.functional.silu
        result: Tensor = silu(silu(x @ first + first_bias) @ second + second_bias) @ last
        return result

    def with_derivatives(self, x: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return values and directional derivatives.

        Parameters
        ----------
        x : (n, n_inputs)
        directions : (n, d, n_inputs)

        Returns
        -------
        values : (..., n, n_outputs)
        derivatives : (..., n, d, n_outputs)
        """
        first, first_bias, second, second_bias, last = self.weights
        n, d = directions.shape[:2]
        directions = directions.flatten(0, 1)
        for weight, bias in ((first, first_bias), (second, second_bias)):
            x, slope = _silu_with_slope(x @ weight + bias)
            changed = directions @ weight
            directions = changed * slope.repeat_interleave(d, dim=-2)
        values, changed = x @ last, directions @ last
        return values, changed.view(*changed.shape[:-2], n, d, -1)

    def at_rest(self) -> tuple[Tensor, Tensor]:
        """Return the value and the slope at x = 0.

        Returns
        -------
        value : (n_outputs,), or (..., 1, n_outputs) if stacked
        slope : (..., n_inputs, n_outputs)
        """
        first, first_bias, second, second_bias, last = self.weights
        x, share = _silu_with_slope(first_bias)
        slope = first * share
        x, share = _silu_with_slope(x @ second + second_bias)
        return x @ last, (slope @ second * share) @ last

    def take(self, arrays: Sequence[Array]) -> None:
        """Replace the weights."""
        with torch.no_grad():
            for weight, array in zip(self.weights, arrays, strict=True):
                weight.copy_(torch.from_numpy(array))

    def arrays(self) -> list[Array]:
        """Return weights and biases from input to output, float64."""
        return [weight.detach().cpu().numpy().astype(np.float64) for weight in self.weights]

    def members(self) -> list[list[Array]]:
        """Return the arrays of each network of a stack, or of this one."""
        weights = self.arrays()
        if weights[0].ndim == 2:
            return [weights]
        parts = zip(NAMES, weights, strict=True)
        weights = [part[:, 0] if name.endswith("bias") else part for name, part in parts]
        return [list(of_member) for of_member in zip(*weights, strict=True)]


def stacked(members: Sequence[Perceptron]) -> Perceptron:
    """Return one module of several networks of one size; its answers have a leading axis.

    One network alone is returned as it is.
    """
    if len(members) == 1:
        return members[0]
    together = deepcopy(members[0])
    together.weights = nn.ParameterList(
        torch.stack(parts).unsqueeze(1) if parts[0].ndim == 1 else torch.stack(parts)
        for parts in zip(*(member.weights for member in members), strict=True)
    )
    return together


def _silu_with_slope(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return s(x) and s′(x)."""
    share = torch.sigmoid(x)
    return x * share, share * (1.0 + x * (1.0 - share))


def evaluate(weights: Sequence[Array], x: Array) -> Array:
    """Return the values at x (n, n_inputs) of a network given by `Perceptron.arrays`."""
    first, first_bias, second, second_bias, last = weights
    return silu(silu(x @ first + first_bias) @ second + second_bias) @ last


def slope_at_rest(weights: Sequence[Array]) -> Array:
    """Return the derivative at x = 0, (n_inputs, n_outputs)."""
    first, first_bias, second, second_bias, last = weights
    before = first_bias
    slope = first * _silu_slope(before)
    before = silu(before) @ second + second_bias
    return (slope @ second * _silu_slope(before)) @ last


def named(prefix: str, weights: Sequence[Array]) -> dict[str, Array]:
    """Return weights as arrays of a model; the prefix begins their names."""
    return {f"{prefix}.{name}": weight for name, weight in zip(NAMES, weights, strict=True)}


def named_shapes(
    prefix: str, n_inputs: int, n_hidden: int, n_outputs: int
) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of `named`."""
    shapes = _shapes(n_inputs, n_hidden, n_outputs)
    return {f"{prefix}.{name}": shape for name, shape in zip(NAMES, shapes, strict=True)}


def taken(model: Mapping[str, Array], prefix: str) -> list[Array]:
    """Return the weights that `named` stored in a model."""
    return [model[f"{prefix}.{name}"] for name in NAMES]


def _shapes(n_inputs: int, n_hidden: int, n_outputs: int) -> list[tuple[int, ...]]:
    """Shapes of weights (inputs, outputs) and biases (outputs,)."""
    layers = pairwise((n_inputs, n_hidden, n_hidden, n_outputs))
    shapes: list[tuple[int, ...]] = [shape for n, m in layers for shape in ((n, m), (m,))]
    return shapes[:-1]


def silu(x: Array) -> Array:
    """x / (1 + exp(-x)) without overflow."""
    return 0.5 * x * (1.0 + np.tanh(0.5 * x))


def _silu_slope(x: Array) -> Array:
    share = 0.5 * (1.0 + np.tanh(0.5 * x))
    return share * (1.0 + x * (1.0 - share))
