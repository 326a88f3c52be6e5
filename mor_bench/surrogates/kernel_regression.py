"""Kernel ridge regression and Gaussian-process regression between principal coordinates, with the Gaussian kernel."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import minimize

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.coordinate_regression import CoordinateRegression, CoordinateSamples

Array = NDArray[np.float64]

LENGTH_SCALES = {"linear-response": 8.0, "force": 100.0}
"""Of kernel ridge regression, by input."""
LENGTHS = (1e-2, 1e3)
"""Bounds on length scales; inputs are of the order of one."""
N_LEADING, MAX_ITERATIONS = 5, 30
"""Outputs that they are chosen by, the first and largest ones, and steps of L-BFGS-B; each takes a second with all 40 outputs."""
SHORTEST = 1e-6
"""Length that a file may hold; loads over it can be squared."""
LARGEST = 1e50
"""Of the points over the length scales: their squares, and their products with any load's, stay finite."""
LEAST_NOISE = 1e-10
"""Of the variance of the targets; what is added at the origin, where the value is known."""


def gaussian_kernel(a: Array, b: Array) -> Array:
    """k(a, b) = exp(-|a - b|² / 2) of points (n, d) and (m, d), as (n, m)."""
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.asarray(np.exp(-0.5 * np.maximum(squares, 0.0)))


class _GaussianSums(CoordinateRegression):
    """g(z) = Σ_i w_i k(z, z_i) with the Gaussian kernel; one of the z_i is the origin, by whose weight g(0) = 0."""

    def _shapes(
        self, state: dict[str, NDArray[Any]], n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int, ...]]:
        n_points = len(state["points"])
        return {
            "points": (n_points, n_inputs),
            "weights": (n_points, n_outputs),
            "lengths": (n_inputs,),
        }

    def _take(self, state: dict[str, NDArray[Any]]) -> None:
        self.points_, self.weights_, self.lengths_ = (
            state["points"],
            state["weights"],
            state["lengths"],
        )
        if not (self.lengths_ >= SHORTEST).all():
            raise InvalidInputError(f"`lengths` must be at least {SHORTEST:g}.")
        scaled = self.points_ / self.lengths_
        if not (np.abs(scaled) < LARGEST).all():
            raise InvalidInputError("`points` must be of moderate size against `lengths`.")
        # [z, 1, -|z|²/2] times these are the exponents, never much above zero.
        self._exponents = np.vstack(
            [
                scaled.T / self.lengths_[:, None],
                -0.5 * (scaled**2).sum(axis=1),
                np.ones(len(scaled)),
            ]
        )

    def _learned(self) -> dict[str, NDArray[Any]]:
        return {"points": self.points_, "weights": self.weights_, "lengths": self.lengths_}

    def _coefficients(self, z: Array) -> Array:
        # An exponential as one.
        per_load = self._exponents.size + self.weights_.size + 2 * z.shape[1]
        count(multiply_adds=len(z) * per_load)
        left = np.empty((len(z), len(self._exponents)))
        left[:, :-2], left[:, -2] = z, 1.0
        left[:, -1] = -0.5 * ((z / self.lengths_) ** 2).sum(axis=1)
        exponents = left @ self._exponents
        out = np.exp(exponents, out=exponents) @ self.weights_
        out[~z.any(axis=1)] = 0.0  # there the sum is round-off
        return np.asarray(out)


class PCAKernelRidge(_GaussianSums):
    """Kernel ridge regression between principal coordinates; see `CoordinateRegression` for what it shares with others.

    g is sought among the functions with g(0) = 0, whose kernel is k(z, z') - k(z, 0) k(0, z'), with k the Gaussian kernel.

    Parameters
    ----------
    input : {"linear-response", "force"}
        What the coordinates z are taken of.
    n_input_modes : int, optional
        Length of z, by default 20 of the linear response and at most 200 of the force; capped at the rank of the input with a warning.
    n_output_modes : int
        Size of the basis Φ of the displacement, or of its nonlinear rest; capped at the rank with a warning.
    n_points : int
        Training samples at most that are learned from, the first ones, which cover the load regions evenly (imported ones are
        shuffled): each is kept and compared with in every query, and the fit solves with a dense matrix of that size.
    length_scale : float, optional
        Of the kernel, where the coordinates have root mean squares from a few to less than one; by default 8 for the linear
        response and 100 for the force, whose effect is all but linear over such lengths.
    ridge : float
        Tikhonov weight, relative to the kernel's largest value.
    """

    usual_inputs = {"linear-response": 20, "force": 200}  # noqa: RUF012

    def __init__(
        self,
        input: Literal["linear-response", "force"] = "linear-response",
        n_input_modes: Annotated[int, Field(ge=1)] | None = None,
        n_output_modes: Annotated[int, Field(ge=1)] = 40,
        n_points: Annotated[int, Field(ge=1, le=20_000)] = 2000,
        length_scale: Annotated[float, Field(ge=LENGTHS[0], le=LENGTHS[1])] | None = None,
        ridge: Annotated[float, Field(ge=1e-14, allow_inf_nan=False)] = 1e-8,
    ) -> None:
        self.input = input
        self.n_input_modes = n_input_modes
        self.n_output_modes = n_output_modes
        self.n_points = n_points
        self.length_scale = length_scale
        self.ridge = ridge

    def _learn(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        from sklearn.kernel_ridge import KernelRidge

        z, targets = samples.z[: self.n_points], samples.values[: self.n_points]
        origin = np.zeros((1, z.shape[1]))
        length = float(self.length_scale or LENGTH_SCALES[self.input])
        scaled = z / length
        to_origin = gaussian_kernel(scaled, origin)
        kernel = gaussian_kernel(scaled, scaled) - to_origin @ to_origin.T
        weights = (
            KernelRidge(alpha=self.ridge, kernel="precomputed").fit(kernel, targets).dual_coef_
        )
        return {
            "points": np.vstack([z, origin]),
            "weights": np.vstack([weights, -to_origin.T @ weights]),
            "lengths": np.full(z.shape[1], length),
        }


def _optimised(objective: Any, start: Any, bounds: Any) -> tuple[Array, float]:
    """Where the negative likelihood is least, and its value there."""
    found = minimize(
        objective,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": MAX_ITERATIONS},
    )
    return np.asarray(found.x), float(found.fun)


class PCAGaussianProcess(_GaussianSums):
    """Gaussian-process regression between principal coordinates; see `CoordinateRegression` for what it shares with others.

    The prior covariance is a Gaussian kernel with a length scale for each input, the same for all outputs, and g(0) = 0 is an
    observation without noise. Length scales, variance and noise maximise the likelihood of the first `n_optimised` samples
    and the first `N_LEADING` outputs (at most `MAX_ITERATIONS` steps of L-BFGS-B from one start); with them the mean is conditioned
    on the first `n_points`, and alone is kept.

    Parameters
    ----------
    input : {"linear-response", "force"}
        What the coordinates z are taken of.
    n_input_modes : int, optional
        Length of z, by default 20 of the linear response and 60 of the force; capped at the rank of the input with a warning.
    n_output_modes : int
        Size of the basis Φ of the displacement, or of its nonlinear rest; capped at the rank with a warning.
    n_points : int
        Training samples at most that the mean is conditioned on, the first ones, which cover the load regions evenly (imported
        ones are shuffled).
    n_optimised : int
        Of these, samples at most that the length scales, the variance and the noise are chosen by.
    """

    def __init__(
        self,
        input: Literal["linear-response", "force"] = "linear-response",
        n_input_modes: Annotated[int, Field(ge=1)] | None = None,
        n_output_modes: Annotated[int, Field(ge=1)] = 40,
        n_points: Annotated[int, Field(ge=1, le=20_000)] = 2000,
        n_optimised: Annotated[int, Field(ge=1, le=5000)] = 300,
    ) -> None:
        self.input = input
        self.n_input_modes = n_input_modes
        self.n_output_modes = n_output_modes
        self.n_points = n_points
        self.n_optimised = n_optimised

    def _learn(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

        z, targets = samples.z[: self.n_points], samples.values[: self.n_points]
        scale = float(np.sqrt((targets**2).mean(axis=0).max()))
        start = np.full(z.shape[1], LENGTH_SCALES[self.input])
        kernel = ConstantKernel(100.0, (1e-4, 1e8)) * RBF(start, LENGTHS) + WhiteKernel(
            1e-5, (LEAST_NOISE, 1e1)
        )
        chosen = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=_optimised)
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", ConvergenceWarning
            )  # of an input that says nothing the length is at its upper bound
            chosen.fit(z[: self.n_optimised], targets[: self.n_optimised, :N_LEADING] / scale)
        variance, lengths = (
            chosen.kernel_.k1.k1.constant_value,
            np.atleast_1d(chosen.kernel_.k1.k2.length_scale),
        )
        noise = np.append(np.full(len(z), chosen.kernel_.k2.noise_level), LEAST_NOISE) / variance
        points = np.vstack([z, np.zeros((1, z.shape[1]))])
        process = GaussianProcessRegressor(
            RBF(lengths), alpha=np.maximum(noise, LEAST_NOISE), optimizer=None
        )
        process.fit(points, np.vstack([targets, np.zeros((1, targets.shape[1]))]))
        return {
            "points": points,
            "weights": process.alpha_.reshape(len(points), -1),
            "lengths": lengths,
        }
