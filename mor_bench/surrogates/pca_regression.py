"""PCA regression: a ridge regression from a few coordinates of the input to a few coordinates of the displacement."""

from __future__ import annotations

from collections.abc import Mapping
from math import comb
from typing import Annotated, Any, Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count, is_counting
from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.coordinate_regression import CoordinateRegression, CoordinateSamples

Levels = list[tuple[NDArray[np.int64], NDArray[np.int64]]]

MAX_FEATURE_BYTES = 2 * 2**30
"""Of the monomials of all training samples, of which a fit holds some copies."""


def n_monomials(n_variables: int, degree: int) -> int:
    """Of degrees 1 to `degree`."""
    return comb(n_variables + degree, degree) - 1


def monomial_indices(n_variables: int, degree: int) -> Levels:
    """For each degree from 2 on: which monomial of the degree below, times which variable, gives each monomial."""
    levels = []
    last = np.arange(n_variables)
    for _ in range(degree - 1):
        parents = np.concatenate([np.flatnonzero(last <= v) for v in range(n_variables)])
        variables = np.repeat(
            np.arange(n_variables), [int((last <= v).sum()) for v in range(n_variables)]
        )
        levels.append((parents, variables))
        last = variables
    return levels


@njit(cache=True, nogil=True, error_model="numpy")
def _monomials(z, parents, variables, out):  # type: ignore[no-untyped-def]
    n_variables = z.shape[1]
    for i in range(len(z)):
        row, values = z[i], out[i]
        values[:n_variables] = row
        for k in range(len(parents)):
            values[n_variables + k] = values[parents[k]] * row[variables[k]]


class Monomials:
    """Monomials of some variables, those of low degree first: the variables, and for each further degree what ``levels`` says.

    Parameters
    ----------
    n_variables : int
    levels : list of two (n,) int64
        As from `monomial_indices`, which gives all monomials up to a degree.
    """

    def __init__(self, n_variables: int, levels: Levels) -> None:
        starts = np.cumsum([0, n_variables, *(len(parents) for parents, _ in levels)])
        self._parents = np.concatenate(
            [
                np.zeros(0, np.int64),
                *(start + parents for start, (parents, _) in zip(starts, levels, strict=False)),
            ]
        )
        self._variables = np.concatenate(
            [np.zeros(0, np.int64), *(variables for _, variables in levels)]
        )
        self.n_products = len(self._parents)

    def __call__(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of variables (n, n_variables), (n, n_monomials)."""
        out = np.empty((len(z), z.shape[1] + self.n_products))
        _monomials(z, self._parents, self._variables, out)
        return out


class PCARegression(CoordinateRegression):
    """Polynomial ridge regression between principal coordinates; see `CoordinateRegression` for what it shares with others.

    g(z) = W p(z), with p the monomials of z.

    Parameters
    ----------
    input : {"linear-response", "force"}
        What the coordinates z are taken of.
    n_input_modes : int
        Length of z; capped at the rank of the input with a warning.
    n_output_modes : int
        Size of the basis Φ of the displacement, or of its nonlinear rest; capped at the rank with a warning.
    degree : int
        Highest degree of the monomials; 1 is plain ridge regression. Refused where they need more than `MAX_FEATURE_BYTES`.
    ridge : float
        Tikhonov weight relative to the mean squared feature, with features scaled to unit root mean square.
    """

    def __init__(
        self,
        input: Literal["linear-response", "force"] = "linear-response",
        n_input_modes: Annotated[int, Field(ge=1)] = 20,
        n_output_modes: Annotated[int, Field(ge=1)] = 40,
        degree: Annotated[int, Field(ge=1, le=4)] = 3,
        ridge: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1e-6,
    ) -> None:
        self.input = input
        self.n_input_modes = n_input_modes
        self.n_output_modes = n_output_modes
        self.degree = degree
        self.ridge = ridge

    def _learn(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        from sklearn.linear_model import Ridge

        n_variables = samples.z.shape[1]
        n = n_monomials(n_variables, self.degree)
        if 8 * n * len(samples.z) > MAX_FEATURE_BYTES:
            raise InvalidInputError(
                f"`degree` {self.degree} of {n_variables} input modes gives {n:,} monomials, too many for {len(samples.z):,} samples: "
                f"{8e-9 * n * len(samples.z):.1f} GB; lower it or `n_input_modes`."
            )
        features = Monomials(n_variables, monomial_indices(n_variables, self.degree))(samples.z)
        feature_scale = np.sqrt((features**2).mean(axis=0))
        regression = Ridge(alpha=self.ridge * len(features), fit_intercept=False, solver="cholesky")
        regression.fit(features / feature_scale, samples.values)
        return {"weights": np.atleast_2d(regression.coef_) / feature_scale}

    def _shapes(
        self, state: dict[str, NDArray[Any]], n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int, ...]]:
        return {"weights": (n_outputs, n_monomials(n_inputs, self.degree))}

    def _take(self, state: dict[str, NDArray[Any]]) -> None:
        self.weights_ = state["weights"]
        n_variables = state["axes"].shape[1]
        self._monomials = Monomials(n_variables, monomial_indices(n_variables, self.degree))

    def _learned(self) -> dict[str, NDArray[Any]]:
        return {"weights": self.weights_}

    def _coefficients(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        if is_counting():
            count(multiply_adds=len(z) * (self._monomials.n_products + self.weights_.size))
        return np.asarray(self._monomials(z) @ self.weights_.T)
