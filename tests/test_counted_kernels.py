"""Multiply-adds of the kernels, counted by executing them on counting numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mor_bench.mechanics import kernels, laws
from mor_bench.reduction import point_kernels
from mor_bench.reduction.points import SVK_MULTIPLY_ADDS, tangent_multiply_adds
from tests.counting_numbers import Counted, counted_array, interpreted

EIGENVECTORS = 122
"""Multiply-adds that are counted for `eigh`, which does not execute on counting numbers."""


def multiply_adds(kernel: Callable[..., Any], *arguments: Any) -> int:
    Counted.total = 0
    kernel(*arguments)
    return Counted.total


def zeros(*shape: int) -> np.ndarray:
    return counted_array(np.zeros(shape))


def one_cell(n_points: int, n_nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return displacements (3 n_nodes + 1,), gradients (1, n_points, n_nodes, 3) and weights."""
    rng = np.random.default_rng(0)
    gradients = 0.3 * rng.normal(size=(1, n_points, n_nodes, 3))
    return (
        counted_array(0.02 * rng.normal(size=3 * n_nodes + 1)),
        counted_array(gradients),
        counted_array(np.ones((1, n_points))),
    )


def test_the_vectorised_kernel_does_the_declared_number_of_multiplications() -> None:
    kernel = interpreted(kernels)
    u, gradients, w = one_cell(8, 8)
    arguments = (
        u,
        np.arange(24).reshape(1, 24, 1),
        gradients.reshape(1, 8, 24),
        w[:, :, None],
        w[:, :, None],
    )
    by_force = multiply_adds(kernel["internal_force"], *arguments, zeros(25))
    assert by_force == 8 * kernels.FORCE_MULTIPLY_ADDS
    slots = np.arange(300).reshape(1, 300, 1)
    by_both = multiply_adds(
        kernel["internal_force_and_tangent"], *arguments, slots, zeros(25), zeros(301)
    )
    assert by_both == 8 * (kernels.FORCE_MULTIPLY_ADDS + kernels.TANGENT_MULTIPLY_ADDS)


LAWS = {
    "saint-venant-kirchhoff": (laws.SAINT_VENANT_KIRCHHOFF, [1.0, 2.0]),
    "neo-hookean": (laws.NEO_HOOKEAN, [1.0, 2.0]),
    "mooney-rivlin": (laws.MOONEY_RIVLIN, [1.0, 2.0, 3.0]),
    "ogden, one term": (laws.OGDEN, [3.0, 1.0, 2.0]),
    "ogden, two terms": (laws.OGDEN, [3.0, 1.0, 2.0, -1.0, -2.0]),
}


@pytest.mark.parametrize("n_nodes", [4, 8])
@pytest.mark.parametrize("name", LAWS)
def test_the_general_kernel_does_the_declared_number_of_multiplications(
    name: str, n_nodes: int
) -> None:
    law, parameters = LAWS[name]
    kernel = interpreted(laws)["general_force"]
    u, gradients, weights = one_cell(1, n_nodes)
    n_upper = 3 * n_nodes * (3 * n_nodes + 1) // 2
    slots, dofs = np.arange(n_upper).reshape(1, n_upper), np.arange(3 * n_nodes).reshape(1, -1)
    given = (u, dofs, gradients, weights, law, counted_array([parameters]), slots)
    eigenvectors = EIGENVECTORS if law == laws.OGDEN else 0
    found = tuple(
        multiply_adds(kernel, *given, zeros(3 * n_nodes + 1), values) + eigenvectors
        for values in (np.zeros(0), zeros(n_upper + 1))
    )
    assert found == laws.general_multiply_adds(law, len(parameters), n_nodes)


@pytest.mark.parametrize("r", [1, 2, 3, 6, 9])
@pytest.mark.parametrize("symmetric", [True, False])
def test_the_kernel_of_points_does_the_declared_number_of_multiplications(
    r: int, symmetric: bool
) -> None:
    kernel, rng = interpreted(point_kernels)["integrate"], np.random.default_rng(0)
    q = counted_array(0.1 * rng.normal(size=r))
    modes = counted_array(0.3 * rng.normal(size=(1, r, 9)))
    one = counted_array(np.ones((1, 2, 1)))
    given = (q, modes, modes, symmetric, one[:, 0], one)
    by_force, by_both = (multiply_adds(kernel, *given, zeros(r), zeros(n, n)) for n in (0, r))
    assert by_force == SVK_MULTIPLY_ADDS[0] + 18 * r
    assert by_both - by_force == SVK_MULTIPLY_ADDS[1] + tangent_multiply_adds(r, symmetric)


@pytest.mark.parametrize("name", LAWS)
def test_stresses_at_points_take_the_declared_number_of_multiplications(name: str) -> None:
    law, parameters = LAWS[name]
    kernel = interpreted(laws)["point_stresses"]
    gradient = counted_array(0.1 * np.random.default_rng(0).normal(size=(1, 9)))
    given = (gradient, counted_array(np.ones((1, 1))), law, counted_array([parameters]))
    eigenvectors = EIGENVECTORS if law == laws.OGDEN else 0
    without, whole = (
        multiply_adds(kernel, *given, zeros(1, 9), zeros(n, 81)) + eigenvectors for n in (0, 1)
    )
    assert (without, whole - without) == laws.point_multiply_adds(law, len(parameters))
