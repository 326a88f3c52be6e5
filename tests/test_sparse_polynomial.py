"""Polynomials in coordinates: their terms, the gain from choosing them, and small monomials."""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.greedy import solved
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.surrogates.coordinate_regression import CoordinateSamples
from mor_bench.surrogates.monomials import (
    MAX_DEGREE,
    Monomials,
    cheapest_terms,
    monomial_derivatives,
    sparse_levels,
    terms_from_array,
    terms_to_array,
)
from mor_bench.surrogates.sparse_polynomial import SparsePolynomial
from tests.relative_errors import median_error


def test_the_cheapest_terms_match_an_exhaustive_list() -> None:
    costs = np.array([0.3137, 0.7741, 1.0059, 1.9347])
    every = [
        term
        for degree in range(1, MAX_DEGREE + 1)
        for term in combinations_with_replacement(range(4), degree)
    ]
    every.sort(key=lambda term: float(costs[list(term)].sum()))
    assert cheapest_terms(costs, 60) == every[:60]
    assert len(cheapest_terms(costs, 10_000)) == len(every)


def test_sparse_monomials_and_their_derivatives_match_direct_products() -> None:
    terms = cheapest_terms(np.array([0.4, 0.9, 1.3]), 25)
    levels, places = sparse_levels(terms, 4)
    generator = np.random.default_rng(0)
    z, direction = generator.normal(size=(6, 4)), generator.normal(size=(6, 4))
    expected = np.stack([z[:, list(term)].prod(axis=1) for term in terms], axis=1)
    np.testing.assert_allclose(Monomials(4, levels)(z)[:, places], expected, rtol=1e-12)
    difference = Monomials(4, levels)(z + 1e-6 * direction) - Monomials(4, levels)(
        z - 1e-6 * direction
    )
    np.testing.assert_allclose(
        monomial_derivatives(z, direction, levels), difference / 2e-6, rtol=1e-5, atol=1e-6
    )


def test_a_high_degree_in_one_coordinate_is_found_from_few_samples() -> None:
    generator = np.random.default_rng(0)
    smallness = np.log10(1.0 / np.array([1.0, 0.3, 0.05, 0.04, 0.03, 0.02]))
    z = generator.normal(size=(60, 6))
    values = (z[:, 0] ** 5 + z[:, 0] * z[:, 1] - z[:, 2])[:, None]
    method = SparsePolynomial(ridge=1e-12)
    terms = method.choose_terms(CoordinateSamples(z, values, np.ones((60, 1))), smallness)
    assert {(0,) * 5, (0, 1), (2,)} <= set(terms)
    assert len(terms) < 60


def test_derivatives_help_with_few_samples(
    tiny_without_validation: Dataset,
) -> None:
    tiny = tiny_without_validation
    few = tiny.train[::6]
    errors = [
        median_error(mor_bench.load_method(name, **knobs).fit(tiny.scene, few), tiny.test)
        for name, knobs in (
            ("sparse-polynomial", {}),
            ("sparse-polynomial-derivative", {"max_terms": 100}),
        )
    ]
    assert errors[1] <= 0.6 * errors[0]


def test_training_loads_are_learned_from_either_input_and_zero_load_gives_zero(
    tiny: Dataset,
) -> None:
    for source in ("force", "linear-response"):
        method = mor_bench.load_method("sparse-polynomial", input=source, max_terms=300)
        method.fit(tiny.scene, tiny.train)
        assert not method.predict(np.zeros((tiny.scene.mesh.n_nodes, 3))).any()
        assert median_error(method, tiny.train) < 0.2


@pytest.mark.parametrize(
    "spoil",
    [
        [[0, 1]],
        [[1, 0], [1, -1]],
        [[0], [0]],
        [[7]],
        [[-1]],
        [[0, -2]],
        np.zeros((0, 1)),
        [0],
        [[0, 0, 0], [0, -1, -1]],
    ],
)
def test_damaged_terms_are_refused(spoil: Any) -> None:
    with pytest.raises(InvalidInputError, match="`terms` must hold monomials of 3 variables"):
        terms_from_array(np.array(spoil, dtype=np.int32), 3)


def test_terms_can_be_restored_from_their_array() -> None:
    terms = cheapest_terms(np.array([0.4, 0.9, 1.3]), 25)
    assert terms_from_array(terms_to_array(terms), 3) == terms


def test_monomials_that_nearly_vanish_in_training_get_no_large_weights(tiny: Dataset) -> None:
    def snapshots(data: Snapshots, factor: float) -> Snapshots:
        vectors = data.loads.vectors * [1.0, 1.0, factor]
        return solved(FullOrderModel(tiny.scene), PatchLoads(data.loads.patches, vectors))

    flat, other = snapshots(tiny.train, 0.01), snapshots(tiny.test, 0.3)
    method, linear = (
        mor_bench.load_method(name).fit(tiny.scene, flat)
        for name in ("pca-regression-linear", "linear-fem")
    )
    assert median_error(method, other) < 0.5 * median_error(linear, other)
