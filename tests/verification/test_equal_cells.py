"""Cells of equal shape, whose gradients the kernels read once."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import Discretisation, distinct
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
