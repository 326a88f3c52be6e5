"""A map of latent coordinates by a perceptron, with first and second derivatives by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.learning.perceptron import evaluate, slope_at_rest

Array = NDArray[np.float64]


class NetworkMap:
    """The map c(q) = A q + N(q) - N(0), with A the identity on the first r coordinates.

    Parameters
    ----------
    weights : sequence of array
        Of the network N, see `Perceptron.arrays`.
    n_coordinates : int
        Number of coordinates; N gives the last ones of them.
    flat : bool
        Whether to subtract the slope of N at rest, so that D(0) = A.
    """

    def __init__(self, weights: Sequence[Array], n_coordinates: int, flat: bool) -> None:
        self._weights, self.n_latent = weights, len(weights[0])
        self._from = n_coordinates - weights[-1].shape[1]
        self._linear = np.eye(n_coordinates, self.n_latent)
        self._at_rest = evaluate(weights, np.zeros((1, self.n_latent)))[0]
        if flat:
            self._linear[self._from :] -= slope_at_rest(weights).T

    def _layers(self, q: Array) -> tuple[Array, Array, Array, Array]:
        """Return inputs of both activations, (h,), output of the second, and (r, h) slopes."""
        first, first_bias, second, second_bias, _ = self._weights
        before = q @ first + first_bias
        after, slope, _ = _silu(before)
        slopes = (first * slope) @ second
        return before, after @ second + second_bias, after, slopes

    def at(self, q: Array) -> tuple[Array, Array]:
        first, _, second, _, last = self._weights
        count(multiply_adds=(1 + self.n_latent) * (second.size + last.size) + 2 * first.size)
        count(multiply_adds=self._linear.size)
        _, before, _, slopes = self._layers(q)
        after, slope, _ = _silu(before)
        c, derivative = self._linear @ q, self._linear.copy()
        c[self._from :] += after @ last - self._at_rest
        derivative[self._from :] += ((slopes * slope) @ last).T
        return c, derivative

    def curvature(self, q: Array, weights: Array) -> Array:
        first, _, second, _, last = self._weights
        r = self.n_latent
        count(multiply_adds=last.size + (2 + r) * second.size + (r + 2) * 3 * first.size)
        before, later, _, slopes = self._layers(q)
        _, slope, bend = _silu(later)
        back = last @ weights[self._from :]
        _, _, first_bend = _silu(before)
        of_first = (second @ (back * slope)) * first_bend
        return np.asarray((slopes * (back * bend)) @ slopes.T + (first * of_first) @ first.T)


def _silu(x: Array) -> tuple[Array, Array, Array]:
    """Return x / (1 + exp(-x)) with its first and second derivative."""
    share = 0.5 * (1.0 + np.tanh(0.5 * x))
    change = share * (1.0 - share)
    return x * share, share + x * change, change * (2.0 + x * (1.0 - 2.0 * share))
