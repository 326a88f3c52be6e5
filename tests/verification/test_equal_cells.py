"""Cells of equal shape, whose gradients the kernels read once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.hard_cases.setups import of_order
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import Discretisation, distinct
from mor_bench.mechanics.elements import is_straight
from mor_bench.scene.mesh import box_mesh

from .laws_and_elements import LAWS

Array = NDArray[np.float64]

N = 70
"""Cells in a row: more than two batches."""


def assembled(points: Array, cells: NDArray[np.int64], u: Array, law: str) -> Array:
    """Return internal forces, and the product of the tangent and u: (2, n_nodes, 3)."""
    dofs = np.arange(points.size).reshape(-1, 3)
    body = Assembler(Discretisation(points, cells, LAWS[law]), dofs, points.size)
    state, values = body.force_and_tangent(u.ravel())
    product = body.pattern.symmetric(values) @ u.ravel()
    return np.stack([state.force, product]).reshape(2, -1, 3)


@pytest.mark.parametrize("law", ["saint-venant-kirchhoff", "neo-hookean"])
@pytest.mark.parametrize("moved_m", [0.0, 0.2])
def test_forces_and_tangents_are_the_sums_of_those_of_single_cells(
    law: str, moved_m: float
) -> None:
    """If the end of the row is moved, only the last cell differs."""
    mesh = box_mesh((float(N), 1.0, 1.0), (N, 1, 1))
    points = mesh.points.copy()
    points[points[:, 0] == N, 0] += moved_m
    u = 0.05 * np.random.default_rng(0).normal(size=(mesh.n_nodes, 3))
    whole = np.concatenate(assembled(points, mesh.cells, u, law))
    single = np.zeros((2, mesh.n_nodes, 3))
    for nodes in mesh.cells:
        single[:, nodes] += assembled(points[nodes], np.arange(8)[None], u[nodes], law)
    np.testing.assert_allclose(whole, single.reshape(-1, 3), atol=1e-12 * np.abs(whole).max())


def test_gradients_are_kept_unless_all_are_equal() -> None:
    equal = np.broadcast_to(np.arange(6.0), (N, 6)) + 1e-14
    assert len(distinct(equal, 32)) == 32
    for cell in (0, 1, N - 1):
        other = equal.copy()
        other[cell, 5] += 1e-9
        assert distinct(other, 32) is other


def test_a_few_batches_of_gradients_serve_all_if_cells_repeat() -> None:
    """Six tetrahedra of each cell of a box repeat; 96 is the least common multiple of 6 and 32."""
    kinds = np.random.default_rng(0).normal(size=(6, 9))
    repeated = kinds[np.arange(400) % 6]
    assert len(distinct(repeated, 32)) == 96
    assert distinct(repeated[:96], 32).shape == (96, 9)
    for cell in (3, 97, 399):
        other = repeated.copy()
        other[cell, 5] += 1e-9
        assert distinct(other, 32) is other


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("moved_m", [0.0, 0.1])
def test_forces_and_tangents_of_repeated_tetrahedra_are_those_of_single_cells(
    order: int, moved_m: float
) -> None:
    """If a corner is moved, the cells at that corner differ, and their edges stay straight."""
    box = box_mesh((4.0, 3.0, 3.0), (4, 3, 3), tetrahedra=True)
    points = box.points.copy()
    points[-1] += moved_m
    mesh = of_order(replace(box, points=points), order)
    u = 0.03 * np.random.default_rng(0).normal(size=(mesh.n_nodes, 3))
    whole = np.concatenate(assembled(mesh.points, mesh.cells, u, "neo-hookean"))
    single = np.zeros((2, mesh.n_nodes, 3))
    for nodes in mesh.cells:
        own = np.arange(len(nodes))[None]
        single[:, nodes] += assembled(mesh.points[nodes], own, u[nodes], "neo-hookean")
    np.testing.assert_allclose(whole, single.reshape(-1, 3), atol=1e-12 * np.abs(whole).max())


def test_a_straight_and_a_curved_tetrahedron_have_the_same_forces_in_the_limit() -> None:
    """A node off the middle of its edge by little more than round-off selects the other kernel."""
    mesh = of_order(box_mesh((1.0, 1.0, 1.0), (1, 1, 1), tetrahedra=True), 2)
    moved = mesh.points.copy()
    moved[-1, 0] += 1e-12
    assert is_straight(mesh.points, mesh.cells)
    assert not is_straight(moved, mesh.cells)
    u = 0.03 * np.random.default_rng(0).normal(size=(mesh.n_nodes, 3))
    straight = assembled(mesh.points, mesh.cells, u, "neo-hookean")
    curved = assembled(moved, mesh.cells, u, "neo-hookean")
    np.testing.assert_allclose(straight, curved, atol=1e-10 * np.abs(curved).max())


@pytest.mark.parametrize("law", ["saint-venant-kirchhoff", "neo-hookean"])
def test_partly_fixed_nodes_and_dofs_in_any_order_have_the_same_forces(law: str) -> None:
    mesh = box_mesh((2.0, 1.0, 1.0), (4, 2, 2))
    u = 0.03 * np.random.default_rng(0).normal(size=mesh.points.size)
    u[[0, 4, 9, 10, 11]] = 0.0
    free = np.flatnonzero(u)
    body = Discretisation(mesh.points, mesh.cells, LAWS[law])
    whole = Assembler(body, np.arange(u.size).reshape(-1, 3), u.size).force(u)
    for order in (free, np.random.default_rng(0).permutation(free)):
        dofs = np.full(u.size, len(free))
        dofs[order] = np.arange(len(free))
        found = Assembler(body, dofs.reshape(-1, 3), len(free)).force(u[order])
        np.testing.assert_allclose(found.force, whole.force[order], atol=1e-12 * 500.0)
        assert found.energy_j == pytest.approx(whole.energy_j, rel=1e-12)
