"""Separated representations of separable functions, and of displacements under one patch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.reduction.separated import Separation, separate
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.pgd import SeparatedLoad, load_coordinates
from tests.relative_errors import median_error

Array = NDArray[np.float64]


def functions(x: Array, kind: str) -> list[list[Array]]:
    """Return two families of factors of x (n, 3), even and odd in the last coordinate."""
    first = np.stack([np.ones(len(x)), x[:, 0], x[:, 0] ** 2], axis=1)
    second = np.stack([np.ones(len(x)), x[:, 1], x[:, 1] ** 2, x[:, 1] ** 3], axis=1)
    even, odd = np.stack([x[:, 2] ** 2, x[:, 2] ** 4], axis=1), x[:, 2:] ** 3
    return (
        [[first, second, even], [first, second, odd]] if kind == "both" else [[first, second, even]]
    )


def values(separation: Separation, families: list[list[Array]]) -> Array:
    terms = [
        np.prod([f @ c for f, c in zip(families[t.family], t.coefficients, strict=True)], axis=0)
        for t in separation.terms
    ]
    return np.stack(terms, axis=1) @ separation.vectors


def residual(target: Array, families: list[list[Array]], n_terms: int, ridge: float) -> float:
    """Return the norm of the residual of a separation, relative to the target."""
    found = values(separate(target, families, n_terms, ridge), families)
    return float(np.linalg.norm(found - target) / np.linalg.norm(target))


def separable(x: Array) -> Array:
    """Return (n, 6) sums of three products, two even in the last coordinate and one odd."""
    vectors = np.random.default_rng(1).normal(size=(3, 6))
    products = [
        (1 + x[:, 0]) * (x[:, 1] ** 2 - 0.3) * (x[:, 2] ** 2 - 0.5 * x[:, 2] ** 4),
        3 * (x[:, 0] ** 2 - 0.2) * x[:, 1] * x[:, 2] ** 4,
        0.5 * (2 - x[:, 0]) * (1 + x[:, 1] ** 3) * x[:, 2] ** 3,
    ]
    return np.stack(products, axis=1) @ vectors


def test_a_sum_of_products_is_found_and_generalises() -> None:
    x, new = np.random.default_rng(0).uniform(-1, 1, (2, 400, 3))
    found = separate(separable(x), functions(x, "both"), 40, 0.0)
    assert {term.family for term in found.terms} == {0, 1}
    for points, most in ((x, 1e-6), (new, 1e-5)):
        difference = values(found, functions(points, "both")) - separable(points)
        assert np.linalg.norm(difference) <= most * np.linalg.norm(separable(points))
    assert residual(separable(x), functions(x, "even"), 40, 0.0) > 0.05


def test_one_product_takes_one_term() -> None:
    x = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    target = ((1 + x[:, 0]) * (0.4 + x[:, 1] ** 2) * (x[:, 2] ** 2 + x[:, 2] ** 4))[
        :, None
    ] * np.arange(1.0, 5.0)
    assert residual(target, functions(x, "both"), 1, 0.0) <= 1e-2
    # The residual of a term is that of its last alternating step.
    assert residual(target, functions(x, "both"), 4, 0.0) <= 1e-4


def test_the_residual_falls_with_every_term() -> None:
    x = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    target = np.exp(x @ np.random.default_rng(2).normal(size=(3, 5))) * x[:, 2:] ** 2
    left = [residual(target, functions(x, "both"), n, 1e-12) for n in (1, 2, 3, 4, 8, 12)]
    assert (np.diff(left) < 0).all()
    assert left[-1] < 0.3 * left[0]


def test_coordinates_are_those_of_the_patch(tiny: Dataset) -> None:
    """They are the centroid of the patch's area, and its force in the load plan."""
    scene, forces = tiny.scene, tiny.train.forces
    points, shares = scene.patch_points(np.arange(len(scene.patch_nodes)))
    centroids = shares @ points
    positions, vectors = load_coordinates(scene.mesh.points, forces)
    np.testing.assert_allclose(positions, centroids[tiny.train.regions], atol=1e-9)
    np.testing.assert_allclose(vectors, tiny.train.loads.vectors[:, 0], atol=1e-12)


@pytest.mark.parametrize("base", ["linear-response", "none"])
def test_zero_load_gives_zero_and_a_couple_gives_the_answer_of_the_base(
    base: str, tiny: Dataset
) -> None:
    method = SeparatedLoad(base, n_terms=10, position_degree=2).fit(tiny.scene, tiny.train)  # type: ignore[arg-type]
    force = np.zeros((tiny.scene.mesh.n_nodes, 3))
    assert not method.predict(force).any()
    force[[-1, -2], 2] = 1.0, -1.0
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None).predict(force)
    np.testing.assert_allclose(
        method.predict(force),
        linear if base == "linear-response" else 0 * linear,
        rtol=0,
        atol=1e-12,
    )


def test_a_separable_solution_of_patch_loads_is_found_in_unseen_regions(
    tiny_without_validation: Dataset,
) -> None:
    """It has degrees one to three in the force, and one factor for the patch position."""
    tiny = tiny_without_validation
    n_free = len(tiny.scene.free_dofs)
    vectors = np.random.default_rng(3).normal(size=(3, n_free))

    def displacements(forces: Array) -> Array:
        positions, f = load_coordinates(tiny.scene.mesh.points, forces)
        x, y = positions[:, 0], positions[:, 1]
        products = [
            (1 + x) * f[:, 2],
            (x - y**2) * f[:, 0] * f[:, 1],
            (0.5 + y) * f[:, 0] ** 2 * f[:, 2],
        ]
        return np.stack(products, axis=1) @ vectors

    samples = replace(tiny.train, free_displacements=displacements(tiny.train.forces))
    method = SeparatedLoad("none", n_terms=100, position_degree=2, n_output_modes=3, ridge=0.0).fit(
        tiny.scene, samples
    )
    exact = displacements(tiny.test.forces)
    found = method.predict(tiny.test.forces).reshape(len(exact), -1)[:, tiny.scene.free_dofs]
    assert np.linalg.norm(found - exact) <= 2e-3 * np.linalg.norm(exact)


def test_terms_added_to_the_linear_response_are_of_second_degree_and_more(tiny: Dataset) -> None:
    """Small loads get the linear response, even if the linear part of the samples differs."""
    samples = replace(tiny.train, free_displacements=1.5 * tiny.train.free_displacements)
    method = SeparatedLoad(n_terms=30).fit(tiny.scene, samples)
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    small, smaller = (
        np.linalg.norm(
            method.predict(scale * tiny.test.forces) - linear.predict(scale * tiny.test.forces)
        )
        for scale in (1e-3, 1e-5)
    )
    assert 0.9e-4 * small <= smaller <= 1.1e-4 * small


def test_on_unseen_load_regions_it_is_far_better_than_the_linear_response(
    tiny_without_validation: Dataset,
) -> None:
    tiny = tiny_without_validation
    method = SeparatedLoad(n_terms=20, position_degree=2).fit(tiny.scene, tiny.train)
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None)
    assert median_error(method, tiny.test) <= 0.4 * median_error(linear, tiny.test)


def test_outside_the_training_positions_the_prediction_is_that_of_their_edge(tiny: Dataset) -> None:
    method = SeparatedLoad("none", n_terms=20, position_degree=2).fit(tiny.scene, tiny.train)
    functions = method.functions_
    assert functions.ends.shape == (2, 2)
    far, vector = np.array([[50.0, -30.0, 1.0]]), np.ones((1, 3))
    back = np.linalg.pinv(functions.frame[:3]).T
    edge = np.clip(far @ functions.frame[:3] + functions.frame[3], *functions.ends)
    near = (edge - functions.frame[3]) @ back.T
    (position, _, _), (there, _, _) = (
        functions(far, vector),
        functions(near, vector),
    )
    np.testing.assert_allclose(position, there, atol=1e-9)


def test_several_forces_are_refused_with_this_reason() -> None:
    scene = mor_bench.load_scene("beam-coarse-3-forces")
    assert (
        SeparatedLoad().supports(scene) == "it handles one load patch, and here several act at once"
    )
    assert SeparatedLoad().supports(mor_bench.load_scene("beam-tiny")) is None
