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


def multiply_adds(kernel: Callable[..., Any], *arguments: Any) -> int:
    Counted.total = 0
    kernel(*arguments)
    return Counted.total


def zeros(*shape: int) -> np.ndarray:
    return counted_array(np.zeros(shape))


def diagonalise(matrix: np.ndarray, vectors: np.ndarray) -> None:
    """Write the eigenvalues and eigenvectors of 6 components, and count the usual 4 sweeps."""
    full = matrix[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]].astype(float)
    found = np.linalg.eigh(full)
    matrix[:3], vectors[:] = counted_array(found[0]), counted_array(found[1].ravel())
    Counted.total += 4 * laws.SWEEP_MULTIPLY_ADDS


def law_kernel(name: str, *constants: int) -> Callable[..., Any]:
    """Return a kernel of `laws`, whose number of sweeps does not depend on the strain."""
    names = interpreted(laws)
    names["_diagonalise"] = diagonalise
    kernel: Callable[..., Any] = names[name](*constants)
    return kernel


def one_cell(n_points: int, n_nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return displacements (3 n_nodes + 1,), gradients (1, n_points, n_nodes, 3) and weights."""
    seeds = {(1, 10): 1, (4, 10): 20}
    rng = np.random.default_rng(seeds.get((n_points, n_nodes), 0))  # fibres are in tension
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
        3 * np.arange(8).reshape(1, 8, 1),
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


FIBRE = [0.5, 0.5, 0.5, 0.5, 0.5, -0.5]
"""Structure tensor of a family of fibres that is in tension here; others cost nothing."""

LAWS = {
    "saint-venant-kirchhoff": (laws.SAINT_VENANT_KIRCHHOFF, [1.0, 2.0]),
    "neo-hookean": (laws.NEO_HOOKEAN, [1.0, 2.0]),
    "mooney-rivlin": (laws.MOONEY_RIVLIN, [1.0, 2.0, 3.0]),
    "yeoh": (laws.YEOH, [1.0, 2.0, 3.0, 4.0]),
    "corotational": (laws.COROTATIONAL, [1.0, 2.0]),
    "one family of fibres": (laws.HOLZAPFEL_GASSER_OGDEN, [1.0, 2.0, 3.0, 4.0, *FIBRE]),
    "two families of fibres": (laws.HOLZAPFEL_GASSER_OGDEN, [1.0, 2.0, 3.0, 4.0, *FIBRE, *FIBRE]),
    "ogden, one term": (laws.OGDEN, [3.0, 1.0, 2.0]),
    "ogden, two terms": (laws.OGDEN, [3.0, 1.0, 2.0, -1.0, -2.0]),
}


@pytest.mark.parametrize(
    ("n_nodes", "n_points", "is_straight"),
    [(4, 1, True), (8, 1, False), (10, 1, False), (10, 4, True)],
)
@pytest.mark.parametrize("name", LAWS)
def test_the_general_kernel_does_the_declared_number_of_multiplications(
    name: str, n_nodes: int, n_points: int, is_straight: bool
) -> None:
    law, parameters = LAWS[name]
    kernel = law_kernel("general_force", law, n_nodes, is_straight)
    u, gradients, weights = one_cell(n_points, n_nodes)
    n_upper = 3 * n_nodes * (3 * n_nodes + 1) // 2
    slots, dofs = np.arange(n_upper)[None, :, None], 3 * np.arange(n_nodes)[None, :, None]
    flat = gradients.reshape(1, n_points, 3 * n_nodes)
    if is_straight:
        flat = flat[:, :1, :9]
    given = (u, dofs, flat, weights[:, :, None], counted_array([parameters] * n_points))
    force = zeros(3 * n_nodes + 1)
    alone = multiply_adds(kernel, *given, None, force, None)
    both = multiply_adds(kernel, *given, slots, force, zeros(n_upper + 1))
    assert (alone, both) == laws.general_multiply_adds(
        law, len(parameters), n_nodes, n_points, is_straight
    )


def test_a_sweep_takes_the_declared_number_of_multiplications() -> None:
    kernel = interpreted(laws)
    matrix = counted_array(0.1 * np.random.default_rng(0).normal(size=6))
    found = multiply_adds(kernel["_is_diagonal"], matrix)
    found += multiply_adds(kernel["_sweep"], matrix, zeros(9))
    assert found == laws.SWEEP_MULTIPLY_ADDS


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
    kernel = law_kernel("point_stresses", law)
    gradient = counted_array(0.1 * np.random.default_rng(0).normal(size=(1, 9)))
    given = (gradient, counted_array(np.ones((1, 1))), counted_array([parameters]), zeros(1, 9))
    without, whole = (multiply_adds(kernel, *given, A) for A in (None, zeros(1, 81)))
    assert (without, whole - without) == laws.point_multiply_adds(law, len(parameters))
