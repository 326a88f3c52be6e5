"""Monomials of some variables: all up to a degree, or the cheapest ones, and their derivatives."""

from __future__ import annotations

from heapq import heappop, heappush
from itertools import pairwise
from math import comb
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError

Array = NDArray[np.float64]
Levels = list[tuple[NDArray[np.int64], NDArray[np.int64]]]
"""For each degree from 2: the parent monomial one degree lower, and the variable to multiply."""

Term = tuple[int, ...]
"""A monomial as its variables in ascending order; a variable is repeated for each power."""

MAX_DEGREE = 8


def n_monomials(n_variables: int, degree: int) -> int:
    """Return the number of monomials of degrees 1 to `degree`."""
    return comb(n_variables + degree, degree) - 1


def monomial_indices(n_variables: int, degree: int) -> Levels:
    """Return the levels of all monomials up to a degree."""
    levels = []
    last = np.arange(n_variables)
    for _ in range(degree - 1):
        parents = np.concatenate([np.flatnonzero(last <= v) for v in range(n_variables)])
        counts = [int((last <= v).sum()) for v in range(n_variables)]
        last = np.repeat(np.arange(n_variables), counts)
        levels.append((parents, last))
    return levels


def by_degree(x: Array, levels: Levels) -> list[Array]:
    """Return the monomials of the variables x (n, n_variables), by degree from 0."""
    found = [np.ones((len(x), 1)), x]
    for parents, variables in levels:
        found.append(found[-1].take(parents, axis=1) * x.take(variables, axis=1))
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _monomials(z, parents, variables, out):  # type: ignore[no-untyped-def]
    n_variables = z.shape[1]
    for i in range(len(z)):
        row, values = z[i], out[i]
        values[:n_variables] = row
        for k in range(len(parents)):
            values[n_variables + k] = values[parents[k]] * row[variables[k]]


class Monomials:
    """Monomials by ascending degree, beginning with the variables."""

    def __init__(self, n_variables: int, levels: Levels) -> None:
        starts = np.cumsum([0, n_variables, *(len(parents) for parents, _ in levels)])
        shifted = [start + parents for start, (parents, _) in zip(starts, levels, strict=False)]
        none = np.zeros(0, np.int64)
        self._parents = np.concatenate([none, *shifted])
        self._variables = np.concatenate([none, *(variables for _, variables in levels)])
        self.n_products = len(self._parents)

    def __call__(self, z: Array) -> Array:
        """Return the monomials (n, n_monomials) of variables (n, n_variables)."""
        out = np.empty((len(z), z.shape[1] + self.n_products))
        _monomials(z, self._parents, self._variables, out)
        return out


def monomial_derivatives(z: Array, direction: Array, levels: Levels) -> Array:
    """Return the derivatives (n, n_monomials) at z along directions, (n, n_variables) both."""
    powers, slopes = z, direction
    found = [slopes]
    for parents, variables in levels:
        slopes = slopes[:, parents] * z[:, variables] + powers[:, parents] * direction[:, variables]
        powers = powers[:, parents] * z[:, variables]
        found.append(slopes)
    return np.concatenate(found, axis=1)


def cheapest_terms(costs: Array, n_terms: int) -> list[Term]:
    """Return the monomials with the smallest sums of their factors' costs, the cheapest first.

    Every term but the first follows from another term that costs no more: its last variable is
    repeated, or raised by one. Therefore the divisors of a term come before it.

    Parameters
    ----------
    costs : (n_variables,) float64
        Costs in ascending order.
    n_terms : int
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
            dearer = cost + float(costs[last + 1] - costs[last])
            heappush(heap, (dearer, degree, (*term[:-1], last + 1)))
    return found


def sparse_levels(terms: list[Term], n_variables: int) -> tuple[Levels, NDArray[np.int32]]:
    """Return levels with the given terms and all variables, and the index of each term in them."""
    by_degree: list[list[Term]] = [[] for _ in range(max(map(len, terms)))]
    for term in terms:
        by_degree[len(term) - 1].append(term)
    by_degree[0] = [(v,) for v in range(n_variables)]
    levels = []
    for below, own in pairwise(by_degree):
        numbers = {term: i for i, term in enumerate(below)}
        parents = np.array([numbers[term[:-1]] for term in own])
        levels.append((parents, np.array([term[-1] for term in own])))
    places = {term: i for i, term in enumerate(term for own in by_degree for term in own)}
    return levels, np.array([places[term] for term in terms])


def terms_to_array(terms: list[Term]) -> NDArray[np.int32]:
    """Return the variables of each term, (n_terms, degree); -1 where its degree is lower."""
    degree = max(map(len, terms))
    return np.array([[*term, *[-1] * (degree - len(term))] for term in terms], dtype=np.int32)


def terms_from_array(array: NDArray[Any], n_variables: int) -> list[Term]:
    """Return the terms of `terms_to_array`.

    Raises
    ------
    InvalidInputError
        Unless each term is ascending, occurs once, and has its divisors among the terms.
    """
    right = array.ndim == 2 and 1 <= array.shape[1] <= MAX_DEGREE and array.size > 0
    terms = [tuple(int(v) for v in row if v >= 0) for row in array] if right else []
    known = set(terms)
    right = right and () not in known and len(known) == len(terms)
    right = right and np.array_equal(terms_to_array(terms), array)
    right = right and all(
        term == tuple(sorted(term))
        and term[-1] < n_variables
        and (len(term) == 1 or term[:-1] in known)
        for term in terms
    )
    if not right:
        raise InvalidInputError(
            f"`terms` must hold monomials of {n_variables} variables, together with their divisors."
        )
    return terms
