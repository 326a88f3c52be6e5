"""Sparse polynomial: high degrees in the leading coordinates of the input, low ones in the rest."""

from __future__ import annotations

from collections.abc import Mapping
from heapq import heappop, heappush
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cholesky, solve_triangular

from mor_bench.counting import count, is_counting
from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.coordinate_regression import CoordinateRegression, CoordinateSamples
from mor_bench.surrogates.pca_regression import Levels, Monomials

Array = NDArray[np.float64]
Term = tuple[int, ...]

MAX_DEGREE = 8
DECADES = (0.5, 1.0, 1.5, 2.0, 3.0)
"""What each factor costs a term beside the size of its coordinate: small ones favour high degrees, large ones many coordinates."""
HELD_OUT = 5
"""Every which training sample, in random order, is kept to choose the terms."""
DERIVATIVE_WEIGHT = 0.1
"""Of the squared error of the derivatives beside that of the values."""


class SparsePolynomial(CoordinateRegression):
    """u = K₀⁻¹f + Φ W p(z), z principal coordinates of the linear response, p a sparse set of monomials; or u = Φ W p(z), z those of the force.

    A term costs, for each factor zᵢ, log₁₀(σ₁ / σᵢ) with σᵢ the coordinate's root mean square, and a number of decades, the same
    for every factor: the cheapest terms are used, as in anisotropic total-degree spaces (Nobile, Tempone, Webster: An anisotropic
    sparse grid stochastic collocation method, SIAM Journal on Numerical Analysis 46 (2008)), but of snapshots as they come. The
    number of decades and of terms are those with the least error of a fifth of the training samples that the others were
    fitted to; then all samples are fitted. No load gives exactly no displacement.

    With derivatives the polynomial also matches those of the displacement with respect to the load, see
    `mor_bench.reduction.sensitivity`. Median errors on beam-coarse (split by region) with 40, 160, 640 and 2,560 samples: 1.3,
    0.39, 0.070 and 0.044 % without, 0.33, 0.093, 0.048 and 0.036 % with derivatives; 1.3, 1.1, 0.23 and 0.084 % of
    `pca-regression` with as many coordinates, and 0.041 % against 0.061 % with all 5,100.

    Parameters
    ----------
    input : {"linear-response", "force"}
        What the coordinates z are taken of.
    n_input_modes : int
        Length of z; capped at the rank of the input with a warning.
    n_output_modes : int
        Size of the basis Φ of the nonlinear rest, or of the displacement; capped at the rank with a warning.
    max_terms : int
        Monomials to choose from; also at most two per training sample and derivative.
    ridge : float
        Tikhonov weight relative to the mean squared feature, with features scaled to unit root mean square.
    derivatives : bool
        Whether derivatives are matched; then the scene's equations must be known.

    Attributes
    ----------
    terms_ : list of tuple of int
        The monomials, each by its variables; the cheapest first.
    """

    evenness = 1.0
    integers = frozenset({"terms"})

    def __init__(
        self,
        input: Literal["linear-response", "force"] = "linear-response",
        n_input_modes: Annotated[int, Field(ge=1)] = 20,
        n_output_modes: Annotated[int, Field(ge=1)] = 40,
        max_terms: Annotated[int, Field(ge=1, le=20_000)] = 1500,
        ridge: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-6,
        derivatives: bool = False,
    ) -> None:
        self.input = input
        self.n_input_modes = n_input_modes
        self.n_output_modes = n_output_modes
        self.max_terms = max_terms
        self.ridge = ridge
        self.derivatives = derivatives

    def _learn(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        sizes = np.log10(
            np.linalg.norm(self.axes_, axis=0)
        )  # the axes divide by the coordinates' root mean squares
        terms = self._chosen(samples, sizes - sizes[0])
        factor, right, scale = self._system(samples, terms)
        return {"weights": solve_triangular(factor, right).T / scale, "terms": _as_array(terms)}

    def _chosen(self, samples: CoordinateSamples, smallness: Array) -> list[Term]:
        """The terms with the least error of samples that were held out.

        The triangular factor of all terms holds those of the first n for every n: as in Gram and Schmidt's process, each term
        in its turn adds one product to the prediction.
        """
        n = len(samples.z)
        if n < HELD_OUT:
            return cheapest_terms(smallness + DECADES[-1], min(n, self.max_terms))
        held = np.random.default_rng(0).permutation(n) % HELD_OUT == 0
        fitted, tried = samples[~held], samples[held]
        n_equations = len(fitted.z) * (
            1 if fitted.directions is None else 1 + fitted.directions.shape[1]
        )
        least, best = np.inf, []
        for decades in DECADES:
            terms = cheapest_terms(decades + smallness, min(self.max_terms, 2 * n_equations))
            factor, coefficients, scale = self._system(fitted, terms)
            levels, places = sparse_levels(terms, samples.z.shape[1])
            orthogonal = solve_triangular(
                factor,
                (Monomials(tried.z.shape[1], levels)(tried.z)[:, places] * tried.weights / scale).T,
                trans="T",
            )
            rest = tried.values * tried.weights
            for number, (column, coefficient) in enumerate(
                zip(orthogonal, coefficients, strict=True), start=1
            ):
                rest -= np.outer(column, coefficient)
                error = float((rest**2).sum())
                if error < least:
                    least, best = error, terms[:number]
        return best

    def _system(self, samples: CoordinateSamples, terms: list[Term]) -> tuple[Array, Array, Array]:
        """R with RᵀR the normal matrix, R⁻ᵀ times the right-hand sides, and what the features were divided by."""
        levels, places = sparse_levels(terms, samples.z.shape[1])
        features = Monomials(samples.z.shape[1], levels)(samples.z)[:, places] * samples.weights
        scale = np.sqrt((features**2).mean(axis=0))
        features /= scale
        matrix, right = features.T @ features, features.T @ (samples.values * samples.weights)
        if samples.directions is not None and samples.slopes is not None:
            for k in range(samples.directions.shape[1]):
                slopes = (
                    monomial_derivatives(samples.z, samples.directions[:, k], levels)[:, places]
                    * samples.weights
                    / scale
                )
                matrix += DERIVATIVE_WEIGHT * slopes.T @ slopes
                right += DERIVATIVE_WEIGHT * slopes.T @ (samples.slopes[:, k] * samples.weights)
        matrix[np.diag_indices(len(matrix))] += self.ridge * len(samples.z)
        try:
            factor = cholesky(matrix, overwrite_a=True)
        except np.linalg.LinAlgError:
            raise InvalidInputError(
                f"`ridge` of {type(self).__name__} is too small for these samples; got {self.ridge:g}."
            ) from None
        return factor, solve_triangular(factor, right, trans="T"), scale

    def _shapes(
        self, state: dict[str, NDArray[Any]], n_inputs: int, n_outputs: int
    ) -> Mapping[str, tuple[int, ...]]:
        return {"weights": (n_outputs, len(state["terms"])), "terms": state["terms"].shape}

    def _take(self, state: dict[str, NDArray[Any]]) -> None:
        n_variables = state["axes"].shape[1]
        self.terms_, self.weights_ = _checked_terms(state["terms"], n_variables), state["weights"]
        levels, places = sparse_levels(self.terms_, n_variables)
        self._monomials = Monomials(n_variables, levels)
        self._weights = np.zeros((len(self.weights_), n_variables + self._monomials.n_products))
        self._weights[:, places] = self.weights_

    def _learned(self) -> dict[str, NDArray[Any]]:
        return {"weights": self.weights_, "terms": _as_array(self.terms_)}

    def _coefficients(self, z: Array) -> Array:
        if is_counting():
            count(multiply_adds=len(z) * (self._monomials.n_products + self._weights.size))
        return np.asarray(self._monomials(z) @ self._weights.T)


def _as_array(terms: list[Term]) -> NDArray[np.int32]:
    """(n_terms, degree) variables of each term, -1 where its degree is lower."""
    degree = max(map(len, terms))
    return np.array([[*term, *[-1] * (degree - len(term))] for term in terms], dtype=np.int32)


def _checked_terms(array: NDArray[Any], n_variables: int) -> list[Term]:
    """The terms of `_as_array`; raises `InvalidInputError` unless each is rising, there once and has its divisors among them."""
    right = (
        array.ndim == 2
        and array.dtype == np.int32
        and 1 <= array.shape[1] <= MAX_DEGREE
        and array.size > 0
    )
    terms = [tuple(int(v) for v in row if v >= 0) for row in array] if right else []
    known = set(terms)
    right = right and len(known) == len(terms) and np.array_equal(_as_array(terms), array)
    right = right and all(
        term == tuple(sorted(term))
        and term[-1] < n_variables
        and (len(term) == 1 or term[:-1] in known)
        for term in terms
        if term
    )
    if not right or () in known:
        raise InvalidInputError(
            f"`terms` must hold monomials of {n_variables} variables with all that they are products of."
        )
    return terms


def cheapest_terms(costs: Array, n_terms: int) -> list[Term]:
    """The n_terms monomials with the least sums of their factors' costs (n_variables,), which must rise, the cheapest first.

    Each is the rising tuple of its variables. Every term but the first follows from one other, which costs no more, by
    repeating its last variable or by raising it by one; what a term is a product of comes before it.
    """
    found: list[Term] = []
    heap: list[tuple[float, int, Term]] = [(float(costs[0]), 1, (0,))]
    while heap and len(found) < n_terms:
        cost, degree, term = heappop(heap)
        found.append(term)
        last = term[-1]
        if degree < MAX_DEGREE:
            heappush(heap, (cost + float(costs[last]), degree + 1, (*term, last)))
        if last + 1 < len(costs):
            heappush(
                heap, (cost + float(costs[last + 1] - costs[last]), degree, (*term[:-1], last + 1))
            )
    return found


def sparse_levels(terms: list[Term], n_variables: int) -> tuple[Levels, NDArray[np.int32]]:
    """The recursion for `Monomials` that gives some terms and all variables, and the place of each term among what it gives."""
    by_degree: list[list[Term]] = [[] for _ in range(max(map(len, terms)))]
    for term in terms:
        by_degree[len(term) - 1].append(term)
    by_degree[0] = [(v,) for v in range(n_variables)]
    levels = []
    for below, own in pairwise(by_degree):
        numbers = {term: i for i, term in enumerate(below)}
        levels.append(
            (np.array([numbers[term[:-1]] for term in own]), np.array([term[-1] for term in own]))
        )
    places = {term: i for i, term in enumerate(term for own in by_degree for term in own)}
    return levels, np.array([places[term] for term in terms])


def monomial_derivatives(z: Array, direction: Array, levels: Levels) -> Array:
    """Derivatives of all `Monomials` at z (n, n_variables) along directions (n, n_variables), (n, n_monomials)."""
    powers, slopes = z, direction
    found = [slopes]
    for parents, variables in levels:
        slopes = slopes[:, parents] * z[:, variables] + powers[:, parents] * direction[:, variables]
        powers = powers[:, parents] * z[:, variables]
        found.append(slopes)
    return np.concatenate(found, axis=1)
