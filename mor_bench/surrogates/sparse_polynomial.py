"""Sparse polynomial: high degrees in the leading coordinates of the input, low in the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cholesky, solve_triangular

from mor_bench.counting import count, is_counting
from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.coordinate_regression import (
    Array,
    Arrays,
    CoordinateRegression,
    CoordinateSamples,
    Input,
)
from mor_bench.surrogates.monomials import (
    Monomials,
    Term,
    cheapest_terms,
    monomial_derivatives,
    sparse_levels,
    terms_from_array,
    terms_to_array,
)

DECADES = (0.5, 1.0, 1.5, 2.0, 3.0)
"""Tried costs of a factor, added to the size of its coordinate: small ones favour high degrees."""

HELD_OUT = 5
"""One in this many training samples, chosen at random, is held out to choose the terms."""

DERIVATIVE_WEIGHT = 0.1
"""Weight of the squared error of the derivatives relative to that of the values."""


@dataclass(eq=False)
class SparsePolynomial(CoordinateRegression):
    """g(z) = W p(z), with p a sparse set of monomials of z; see `CoordinateRegression`.

    Each factor zᵢ of a term costs log₁₀(σ₁ / σᵢ) plus a number of decades. σᵢ is the coordinate's
    root mean square, and all factors have the same number of decades. The cheapest terms are used,
    as in anisotropic total-degree spaces (Nobile, Tempone, Webster: An anisotropic sparse grid
    stochastic collocation method, SIAM Journal on Numerical Analysis 46 (2008)). The numbers of
    decades and of terms minimise the error on a held-out fifth of the training samples. Then all
    samples are fitted. With derivatives, the polynomial also matches those of the displacement with
    respect to the load, see `mor_bench.reduction.sensitivity`.

    `input`, `n_input_modes` and `n_output_modes` are those of `CoordinateRegression`.

    Parameters
    ----------
    max_terms : int
        Monomials to choose from; also at most two per training sample and derivative.
    ridge : float
        Tikhonov weight relative to the mean squared feature, with features scaled to unit root mean
        square.
    derivatives : bool
        Whether to match derivatives; needs the scene's equations. Use it if samples are few.

    Attributes
    ----------
    terms_ : list of tuple of int
        The monomials as tuples of variables; the cheapest first.
    """

    input: Input = "linear-response"
    n_input_modes: Annotated[int, Field(ge=1)] = 20
    n_output_modes: Annotated[int, Field(ge=1)] = 40
    max_terms: Annotated[int, Field(ge=1, le=20_000)] = 1500
    ridge: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-6
    derivatives: bool = False

    evenness: ClassVar = 1.0
    integers: ClassVar = frozenset({"terms"})

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        # The axes divide by the coordinates' root mean squares.
        sizes = np.log10(np.linalg.norm(self.axes_, axis=0))
        terms = self.choose_terms(samples, sizes - sizes[0])
        factor, right, scale = self._system(samples, terms)
        weights = solve_triangular(factor, right).T / scale
        return {"weights": weights, "terms": terms_to_array(terms)}

    def choose_terms(self, samples: CoordinateSamples, smallness: Array) -> list[Term]:
        """Return the terms with the smallest error on held-out samples.

        The triangular factor of all terms contains that of the first n terms, for every n. As in
        the Gram-Schmidt process, each further term adds one product to the prediction. `smallness`
        (n_inputs,) float64 is log₁₀(σ₁ / σᵢ) of the coordinates, ascending.
        """
        n = len(samples.z)
        if n < HELD_OUT:
            return cheapest_terms(smallness + DECADES[-1], min(n, self.max_terms))
        held = np.random.default_rng(0).permutation(n) % HELD_OUT == 0
        fitted, tried = samples[~held], samples[held]
        n_directions = 0 if fitted.directions is None else fitted.directions.shape[1]
        n_terms = min(self.max_terms, 2 * len(fitted.z) * (1 + n_directions))
        least, best = np.inf, []
        for decades in DECADES:
            terms = cheapest_terms(decades + smallness, n_terms)
            factor, coefficients, scale = self._system(fitted, terms)
            levels, places = sparse_levels(terms, samples.z.shape[1])
            features = Monomials(tried.z.shape[1], levels)(tried.z)[:, places]
            orthogonal = solve_triangular(factor, (features * tried.weights / scale).T, trans="T")
            rest = tried.values * tried.weights
            columns = zip(orthogonal, coefficients, strict=True)
            for number, (column, coefficient) in enumerate(columns, start=1):
                rest -= np.outer(column, coefficient)
                error = float((rest**2).sum())
                if error < least:
                    least, best = error, terms[:number]
        return best

    def _system(self, samples: CoordinateSamples, terms: list[Term]) -> tuple[Array, Array, Array]:
        """Return R with RᵀR the normal matrix, R⁻ᵀ times the right-hand sides, and the scales."""
        levels, places = sparse_levels(terms, samples.z.shape[1])
        features = Monomials(samples.z.shape[1], levels)(samples.z)[:, places] * samples.weights
        scale = np.sqrt((features**2).mean(axis=0))
        features /= scale
        matrix, right = features.T @ features, features.T @ (samples.values * samples.weights)
        if samples.directions is not None and samples.slopes is not None:
            for k in range(samples.directions.shape[1]):
                slopes = monomial_derivatives(samples.z, samples.directions[:, k], levels)
                slopes = slopes[:, places] * samples.weights / scale
                matrix += DERIVATIVE_WEIGHT * slopes.T @ slopes
                right += DERIVATIVE_WEIGHT * slopes.T @ (samples.slopes[:, k] * samples.weights)
        matrix[np.diag_indices(len(matrix))] += self.ridge * len(samples.z)
        try:
            factor = cholesky(matrix, overwrite_a=True)
        except np.linalg.LinAlgError:
            raise InvalidInputError(
                f"`ridge` of {type(self).__name__} is too small for these samples; "
                f"got {self.ridge:g}."
            ) from None
        return factor, solve_triangular(factor, right, trans="T"), scale

    def shapes(
        self, model: Arrays, n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int | None, ...]]:
        return {"weights": (n_outputs, len(model["terms"])), "terms": model["terms"].shape}

    def take(self, model: dict[str, NDArray[Any]]) -> None:
        n_variables = self.axes_.shape[1]
        self.terms_ = terms_from_array(model["terms"], n_variables)
        levels, places = sparse_levels(self.terms_, n_variables)
        self._monomials = Monomials(n_variables, levels)
        n_monomials = n_variables + self._monomials.n_products
        self._weights = np.zeros((len(model["weights"]), n_monomials))
        self._weights[:, places] = model["weights"]

    def coefficients(self, z: Array) -> Array:
        if is_counting():
            count(multiply_adds=len(z) * (self._monomials.n_products + self._weights.size))
        return np.asarray(self._monomials(z) @ self._weights.T)
