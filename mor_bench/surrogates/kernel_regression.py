"""Kernel ridge and Gaussian-process regression between principal coordinates, Gaussian kernel."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.linalg import solve, solve_triangular
from scipy.optimize import minimize

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.coordinate_regression import (
    Array,
    Arrays,
    CoordinateRegression,
    CoordinateSamples,
    Input,
)

LENGTH_SCALES = {"linear-response": 12.0, "force": 100.0}
"""Default length scale of kernel ridge regression, by input."""

FIRST_LENGTHS = {"linear-response": 8.0, "force": 100.0}
"""Where a Gaussian process begins to search its length scales. From a longer one it may end at no
correlation."""

LENGTHS = (1e-2, 1e3)
"""Bounds on length scales; inputs are of the order of one."""

N_LEADING, MAX_ITERATIONS = 5, 30
"""Leading outputs used to choose length scales, and steps of L-BFGS-B; a step with 40 outputs
takes 1 s."""

SHORTEST = 1e-6
"""Smallest length in a model; loads divided by it can be squared without overflow."""

LARGEST = 1e50
"""Largest ratio of points to length scales; its square and products with loads are finite."""

LEAST_NOISE = 1e-10
"""Smallest noise, a fraction of the targets' variance."""

LEAST_VARIANCE = 1e-14
"""Smallest variance of an answer, a fraction of that before the samples."""


def kernel_from_rest(a: Array, b: Array) -> Array:
    """Return k(a, b) - k(a, 0) k(0, b) of points (n, d) and (m, d), as (n, m).

    With k(a, b) = exp(-|a - b|² / 2), it is the covariance of a process with the covariance k and
    g(0) = 0. Near the origin it is small, and keeps its digits.
    """
    products = a @ b.T
    apart = -0.5 * ((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1))  # logarithm of the second
    near = np.exp(apart) * np.expm1(np.minimum(products, 1.0))
    far = np.exp(np.minimum(apart + products, 0.0)) - np.exp(apart)
    return np.asarray(np.where(products < 1.0, near, far))


class GaussianSums(CoordinateRegression):
    """g(z) = Σ_i w_i k(z, z_i) with the Gaussian kernel.

    The last z_i is the origin, whose weight makes g(0) = 0. This is the mean of a Gaussian process
    with g(0) = 0 that is conditioned on the samples, with the ridge as the variance of their noise
    (Rasmussen, Williams: Gaussian Processes for Machine Learning, 2006, section 2.2). The process
    also gives the uncertainty of each answer.
    """

    n_points: int

    def shapes(
        self, model: Arrays, n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int | None, ...]]:
        n_points = len(model["points"])
        return {
            "points": (n_points, n_inputs),
            "weights": (n_points, n_outputs),
            "lengths": (n_inputs,),
            "noise": (1,),
        }

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        self.points_, self.weights_ = model["points"], model["weights"]
        self.lengths_, self.noise_ = model["lengths"], float(model["noise"][0])
        if not 0 <= self.noise_ < np.inf:
            raise InvalidInputError("`noise` must be a number >= 0.")
        if not (self.lengths_ >= SHORTEST).all():
            raise InvalidInputError(f"`lengths` must be at least {SHORTEST:g}.")
        scaled = self.points_ / self.lengths_
        if not (np.abs(scaled) < LARGEST).all():
            raise InvalidInputError("`points` must be of moderate size relative to `lengths`.")
        # [z, 1, -|z|²/2] times this matrix gives the exponents, never much above zero.
        squares = -0.5 * (scaled**2).sum(axis=1)
        rows = [scaled.T / self.lengths_[:, None], squares, np.ones(len(scaled))]
        self._exponents = np.vstack(rows)

    def coefficients(self, z: Array) -> Array:
        per_load = self._exponents.size + self.weights_.size + 2 * z.shape[1]  # exp counts as one
        count(multiply_adds=len(z) * per_load)
        left = np.empty((len(z), len(self._exponents)))
        left[:, :-2], left[:, -2] = z, 1.0
        left[:, -1] = -0.5 * ((z / self.lengths_) ** 2).sum(axis=1)
        exponents = left @ self._exponents
        out = np.exp(exponents, out=exponents) @ self.weights_
        out[~z.any(axis=1)] = 0.0  # the sum there is round-off
        return np.asarray(out)

    def spread(self, forces: ArrayLike) -> Array:
        """Return the standard deviation of each answer relative to it, of shape () or (n,).

        It is that of the Gaussian process, with the prior variance of each output that makes the
        samples most probable. The first call factorises the covariance of the n points. Each load
        costs n² / 2 multiply-adds. Parameters and errors are those of `relative_spread`.
        """
        return self.relative_spread(forces, self._deviations)

    def _deviations(self, z: Array) -> Array:
        """Return the standard deviation of Φ g at inputs z (n, n_inputs), (n,), m."""
        lower, prior = self._posterior
        scaled = z / self.lengths_
        to_points = kernel_from_rest(scaled, self.points_[:-1] / self.lengths_)
        known = solve_triangular(lower, to_points.T, lower=True, check_finite=False)
        before = -np.expm1(-(scaled**2).sum(axis=1))
        # Round-off leaves no digits of a smaller variance.
        left = np.maximum(before - (known**2).sum(axis=0), LEAST_VARIANCE * before)
        return np.asarray(prior * np.sqrt(left))

    @cached_property
    def _posterior(self) -> tuple[Array, float]:
        """Cholesky factor of the covariance of the samples, and the prior deviation of Φ g, m."""
        scaled = self.points_[:-1] / self.lengths_
        noise = max(self.noise_, LEAST_NOISE) * np.eye(len(scaled))
        lower = np.asarray(np.linalg.cholesky(kernel_from_rest(scaled, scaled) + noise), np.float64)
        sizes = np.sqrt(((lower.T @ self.weights_[:-1]) ** 2).mean(axis=0))
        return lower, float(np.linalg.norm(self.norms_of(np.diag(sizes))))


def weights_from_rest(kernel_weights: Array, scaled: Array) -> Array:
    """Return the weights (n + 1, m) of k for those (n, m) of `kernel_from_rest` at points (n, d).

    The last one is that of the origin.
    """
    to_rest = np.exp(-0.5 * (scaled**2).sum(axis=1))
    return np.vstack([kernel_weights, -to_rest @ kernel_weights])


@dataclass(eq=False)
class PCAKernelRidge(GaussianSums):
    """Kernel ridge regression between principal coordinates; see `CoordinateRegression`.

    g is sought among the functions with g(0) = 0. Their kernel is k(z, z') - k(z, 0) k(0, z'), with
    k the Gaussian kernel.

    `input`, `n_input_modes` and `n_output_modes` are those of `CoordinateRegression`.

    Parameters
    ----------
    n_points : int
        Largest number of training samples. The first ones are used, which cover the load regions
        evenly; imported ones are shuffled. Every query is compared with each of them, and the fit
        solves with a dense matrix of this size.
    length_scale : float, optional
        Length scale of the kernel, for coordinates with root mean squares of the order of one.
        Default: 12 for the linear response and 100 for the force.
    ridge : float
        Tikhonov weight, relative to the kernel's largest value.
    """

    input: Input = "linear-response"
    n_input_modes: Annotated[int, Field(ge=1)] | None = None
    n_output_modes: Annotated[int, Field(ge=1)] = 80
    n_points: Annotated[int, Field(ge=1, le=20_000)] = 2000
    length_scale: Annotated[float, Field(ge=LENGTHS[0], le=LENGTHS[1])] | None = None
    ridge: Annotated[float, Field(ge=1e-14, allow_inf_nan=False)] = 1e-9

    usual_inputs: ClassVar = {"linear-response": 40, "force": 200}

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        from sklearn.kernel_ridge import KernelRidge

        z, targets = samples.z[: self.n_points], samples.values[: self.n_points]
        length = float(self.length_scale or LENGTH_SCALES[self.input])
        kernel = kernel_from_rest(z / length, z / length)
        regression = KernelRidge(alpha=self.ridge, kernel="precomputed").fit(kernel, targets)
        return {
            "points": np.vstack([z, np.zeros((1, z.shape[1]))]),
            "weights": weights_from_rest(regression.dual_coef_, z / length),
            "lengths": np.full(z.shape[1], length),
            "noise": np.array([self.ridge]),
        }


@dataclass(eq=False)
class PCAGaussianProcess(GaussianSums):
    """Gaussian-process regression between principal coordinates; see `CoordinateRegression`.

    The prior covariance is a Gaussian kernel with a length scale for each input, the same for all
    outputs, and g(0) = 0. Length scales, variance and noise maximise the likelihood of the first
    `n_optimised` samples and the first `N_LEADING` outputs. L-BFGS-B takes at most `MAX_ITERATIONS`
    steps from one start. Then the process is conditioned on the first `n_points` samples.

    `input`, `n_input_modes` and `n_output_modes` are those of `CoordinateRegression`.

    Parameters
    ----------
    n_points : int
        Largest number of training samples that condition the mean. The first ones are used, which
        cover the load regions evenly; imported ones are shuffled.
    n_optimised : int
        Largest number of these samples used to choose length scales, variance and noise.
    """

    input: Input = "linear-response"
    n_input_modes: Annotated[int, Field(ge=1)] | None = None
    n_output_modes: Annotated[int, Field(ge=1)] = 80
    n_points: Annotated[int, Field(ge=1, le=20_000)] = 2000
    n_optimised: Annotated[int, Field(ge=1, le=5000)] = 300

    usual_inputs: ClassVar = {"linear-response": 20, "force": 200}

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

        z, targets = samples.z[: self.n_points], samples.values[: self.n_points]
        scale = float(np.sqrt((targets**2).mean(axis=0).max()))
        start = np.full(z.shape[1], FIRST_LENGTHS[self.input])
        kernel = ConstantKernel(100.0, (1e-4, 1e8)) * RBF(start, LENGTHS) + WhiteKernel(
            1e-5, (LEAST_NOISE, 1e1)
        )
        chosen = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=_optimised)
        with warnings.catch_warnings():
            # The length scale of an input without effect reaches its upper bound.
            warnings.simplefilter("ignore", ConvergenceWarning)
            chosen.fit(z[: self.n_optimised], targets[: self.n_optimised, :N_LEADING] / scale)
        variance = chosen.kernel_.k1.k1.constant_value
        lengths = np.atleast_1d(chosen.kernel_.k1.k2.length_scale)
        noise = max(chosen.kernel_.k2.noise_level / variance, LEAST_NOISE)
        scaled = z / lengths
        covariance = kernel_from_rest(scaled, scaled) + noise * np.eye(len(z))
        return {
            "points": np.vstack([z, np.zeros((1, z.shape[1]))]),
            "weights": weights_from_rest(solve(covariance, targets, assume_a="pos"), scaled),
            "lengths": lengths,
            "noise": np.array([noise]),
        }


def _optimised(objective: Any, start: Any, bounds: Any) -> tuple[Array, float]:
    found = minimize(
        objective,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": MAX_ITERATIONS},
    )
    return np.asarray(found.x), float(found.fun)
