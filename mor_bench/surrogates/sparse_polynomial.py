"""Sparse polynomial: high degrees in the leading coordinates of the input, low ones in the rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.linalg import cholesky, solve_triangular

from mor_bench import counting
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import error_weights, input_axes
from mor_bench.reduction.sensitivity import sensitivities
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
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


class SparsePolynomial(Surrogate):
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

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene) if self.derivatives or self._from_linear else None

    @property
    def _from_linear(self) -> bool:
        return self.input == "linear-response"

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            snapshots = self._checked_snapshots(snapshots)
            inputs, targets = snapshots.free_forces, snapshots.free_displacements
            model = FullOrderModel(scene) if self.derivatives or self._from_linear else None
            if model is not None and self._from_linear:
                inputs = model.rest_factor.solve(inputs.T).T
                targets = targets - inputs
            axes, modes = input_axes(inputs, self.n_input_modes, 1.0), pod(targets, self.n_output_modes).modes
            samples = _Samples(inputs @ axes, targets @ modes, error_weights(snapshots.free_displacements)[:, None])
            if model is not None and self.derivatives:
                known = sensitivities(model, snapshots, axes, modes, of_force=not self._from_linear)
                samples = replace(samples, directions=known.inputs, slopes=known.outputs)
            sizes = np.log10(np.linalg.norm(axes, axis=0))  # the axes divide by the coordinates' root mean squares
            terms = self._chosen(samples, sizes - sizes[0])
            factor, right, scale = self._system(samples, terms)
            weights = solve_triangular(factor, right).T / scale
            self._restore({"axes": axes, "modes": modes, "weights": weights, "terms": _as_array(terms)})
        return self

    def _chosen(self, samples: _Samples, smallness: Array) -> list[Term]:
        """The terms with the least error of samples that were held out.

        The triangular factor of all terms holds those of the first n for every n: as in Gram and Schmidt's process, each term
        in its turn adds one product to the prediction.
        """
        n = len(samples.z)
        if n < HELD_OUT:
            return cheapest_terms(smallness + DECADES[-1], min(n, self.max_terms))
        held = np.random.default_rng(0).permutation(n) % HELD_OUT == 0
        fitted, tried = samples[~held], samples[held]
        n_equations = len(fitted.z) * (1 if fitted.directions is None else 1 + fitted.directions.shape[1])
        least, best = np.inf, []
        for decades in DECADES:
            terms = cheapest_terms(decades + smallness, min(self.max_terms, 2 * n_equations))
            factor, coefficients, scale = self._system(fitted, terms)
            levels, places = sparse_levels(terms, samples.z.shape[1])
            orthogonal = solve_triangular(factor, (Monomials(tried.z.shape[1], levels)(tried.z)[:, places] * tried.weights / scale).T, trans="T")
            rest = tried.values * tried.weights
            for number, (column, coefficient) in enumerate(zip(orthogonal, coefficients, strict=True), start=1):
                rest -= np.outer(column, coefficient)
                error = float((rest**2).sum())
                if error < least:
                    least, best = error, terms[:number]
        return best

    def _system(self, samples: _Samples, terms: list[Term]) -> tuple[Array, Array, Array]:
        """R with RᵀR the normal matrix, R⁻ᵀ times the right-hand sides, and what the features were divided by."""
        levels, places = sparse_levels(terms, samples.z.shape[1])
        features = Monomials(samples.z.shape[1], levels)(samples.z)[:, places] * samples.weights
        scale = np.sqrt((features**2).mean(axis=0))
        features /= scale
        matrix, right = features.T @ features, features.T @ (samples.values * samples.weights)
        if samples.directions is not None and samples.slopes is not None:
            for k in range(samples.directions.shape[1]):
                slopes = monomial_derivatives(samples.z, samples.directions[:, k], levels)[:, places] * samples.weights / scale
                matrix += DERIVATIVE_WEIGHT * slopes.T @ slopes
                right += DERIVATIVE_WEIGHT * slopes.T @ (samples.slopes[:, k] * samples.weights)
        matrix[np.diag_indices(len(matrix))] += self.ridge * len(samples.z)
        try:
            factor = cholesky(matrix, overwrite_a=True)
        except np.linalg.LinAlgError:
            raise InvalidInputError(f"`ridge` of {type(self).__name__} is too small for these samples; got {self.ridge:g}.") from None
        return factor, solve_triangular(factor, right, trans="T"), scale

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces).reshape(-1, self.scene_.mesh.n_dofs)
        free = batch[:, self.scene_.free_dofs]
        out = np.zeros_like(batch)
        if counting.running is not None:
            monomial_products = self._weights.shape[1] - self.axes_.shape[1]
            counting.running.add(multiply_adds=len(batch) * (self.axes_.size + monomial_products + self._weights.size + self.modes_.size))
        inputs = self.model_.rest_factor.solve(free.T).T if self._from_linear else free
        found = (self._monomials(inputs @ self.axes_) @ self._weights.T) @ self.modes_.T
        out[:, self.scene_.free_dofs] = inputs + found if self._from_linear else found
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"axes": self.axes_, "modes": self.modes_, "weights": self.weights_, "terms": _as_array(self.terms_)}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        state = {name: np.ascontiguousarray(array) for name, array in state.items()}
        n_free, n_axes, n_modes = len(self.scene_.free_dofs), state["axes"].shape[1], state["modes"].shape[1]
        shapes = {"axes": (n_free, n_axes), "modes": (n_free, n_modes), "weights": (n_modes, len(state["terms"]))}
        for name, shape in shapes.items():
            if state[name].shape != shape or not np.isfinite(state[name]).all():
                raise InvalidInputError(f"`{name}` must be a finite array of shape {shape}; got shape {state[name].shape}.")
        terms = _checked_terms(state["terms"], n_axes)
        self.axes_, self.modes_, self.weights_, self.terms_ = state["axes"], state["modes"], state["weights"], terms
        self._levels, places = sparse_levels(terms, n_axes)
        self._monomials = Monomials(n_axes, self._levels)
        n_monomials = n_axes + sum(len(variables) for _, variables in self._levels)
        self._weights = np.zeros((n_modes, n_monomials))
        self._weights[:, places] = self.weights_
        if self._from_linear:
            self.model_ = FullOrderModel(self.scene_)
            _ = self.model_.rest_factor


@dataclass(frozen=True)
class _Samples:
    """What is fitted: values at z, and slopes along directions if there are any.

    Attributes
    ----------
    z : (n, n_variables) float64
    values : (n, n_outputs) float64
    weights : (n, 1) float64
        What errors are multiplied by.
    directions : (n, d, n_variables) float64, optional
    slopes : (n, d, n_outputs) float64, optional
    """

    z: Array
    values: Array
    weights: Array
    directions: Array | None = None
    slopes: Array | None = None

    def __getitem__(self, rows: NDArray[np.bool_]) -> _Samples:
        derived = (None if array is None else array[rows] for array in (self.directions, self.slopes))
        return _Samples(self.z[rows], self.values[rows], self.weights[rows], *derived)


def _as_array(terms: list[Term]) -> NDArray[np.int64]:
    """(n_terms, degree) variables of each term, -1 where its degree is lower."""
    degree = max(map(len, terms))
    return np.array([[*term, *[-1] * (degree - len(term))] for term in terms], dtype=np.int64)


def _checked_terms(array: NDArray[Any], n_variables: int) -> list[Term]:
    """The terms of `_as_array`; raises `InvalidInputError` unless each is rising, there once and has its divisors among them."""
    right = array.ndim == 2 and array.dtype == np.int64 and 1 <= array.shape[1] <= MAX_DEGREE and array.size > 0
    terms = [tuple(int(v) for v in row if v >= 0) for row in array] if right else []
    known = set(terms)
    right = right and len(known) == len(terms) and np.array_equal(_as_array(terms), array)
    right = right and all(term == tuple(sorted(term)) and term[-1] < n_variables and (len(term) == 1 or term[:-1] in known) for term in terms if term)
    if not right or () in known:
        raise InvalidInputError(f"`terms` must hold monomials of {n_variables} variables with all that they are products of.")
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
            heappush(heap, (cost + float(costs[last + 1] - costs[last]), degree, (*term[:-1], last + 1)))
    return found


def sparse_levels(terms: list[Term], n_variables: int) -> tuple[Levels, NDArray[np.int64]]:
    """The recursion for `Monomials` that gives some terms and all variables, and the place of each term among what it gives."""
    by_degree: list[list[Term]] = [[] for _ in range(max(map(len, terms)))]
    for term in terms:
        by_degree[len(term) - 1].append(term)
    by_degree[0] = [(v,) for v in range(n_variables)]
    levels = []
    for below, own in pairwise(by_degree):
        numbers = {term: i for i, term in enumerate(below)}
        levels.append((np.array([numbers[term[:-1]] for term in own]), np.array([term[-1] for term in own])))
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
