"""A regular grid keeps sums, moments and linear fields of any mesh; a mesh's own grid is exact."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, SpecError
from mor_bench.scene.grid import MAX_POINTS, default_shape, grid_map
from mor_bench.scene.mesh import Mesh, box_mesh, l_mesh
from tests.irregular import irregular_box

SHAPES = st.none() | st.tuples(*[st.integers(2, 7)] * 3)
UNIT = irregular_box((1.0, 1.0, 1.0), (2, 2, 2), tetrahedra=True)


def grid_points(mesh: Mesh, shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """Return positions (n_grid, 3) of the points of a grid over the mesh's bounding box."""
    axes = [np.linspace(low, high, n) for low, high, n in zip(*mesh.bounds, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def moved(mesh: Mesh, offset: NDArray[np.float64], scale: float) -> Mesh:
    return Mesh(mesh.points * scale + offset, mesh.cells)


@st.composite
def irregular(draw: st.DrawFn) -> Mesh:
    """Draw boxes of any size, place and aspect, of either cell."""
    size = draw(st.tuples(*[st.floats(0.3, 3.0)] * 3))
    cells = draw(st.tuples(*[st.integers(1, 4)] * 3))
    mesh = irregular_box(size, cells, draw(st.booleans()), seed=draw(st.integers(0, 99)))
    offset = np.array(draw(st.tuples(*[st.floats(-5.0, 5.0)] * 3)))
    return moved(mesh, offset, draw(st.sampled_from([1e-3, 1.0, 1e3])))


@settings(max_examples=60, deadline=None)
@given(irregular(), SHAPES, st.integers(0, 99))
def test_forces_keep_sum_moment_and_work_and_linear_displacements_stay_exact(
    mesh: Mesh, shape: tuple[int, int, int] | None, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    grid = grid_map(mesh, shape)
    points = grid_points(mesh, grid.shape)
    forces = generator.standard_normal((3, mesh.n_nodes, 3))
    carried, size = grid.forces_to_grid(forces), np.abs(forces).sum()
    assert carried.shape == (3, prod(grid.shape), 3)
    sums, expected = carried.sum(axis=1), forces.sum(axis=1)
    np.testing.assert_allclose(sums, expected, rtol=0, atol=1e-12 * size)
    about = mesh.points[generator.integers(mesh.n_nodes)]
    moments = np.cross(points - about, carried).sum(axis=1)
    expected = np.cross(mesh.points - about, forces).sum(axis=1)
    scale = size * np.linalg.norm(mesh.points, axis=1).max()
    np.testing.assert_allclose(moments, expected, rtol=0, atol=1e-12 * scale)

    displacements = generator.standard_normal((3, prod(grid.shape), 3))
    at_nodes = forces * grid.displacements_to_nodes(displacements)
    work, expected = ((carried * displacements).sum(axis=(1, 2)), at_nodes.sum(axis=(1, 2)))
    np.testing.assert_allclose(work, expected, rtol=0, atol=1e-12 * np.abs(at_nodes).sum())

    gradient, constant = generator.standard_normal((3, 3)), np.array([0.1, -0.2, 0.3])
    found = grid.displacements_to_nodes((points @ gradient + constant)[None])[0]
    near = 1e-12 * (1 + np.abs(mesh.points).max())
    np.testing.assert_allclose(found, mesh.points @ gradient + constant, rtol=0, atol=near)


def test_weights_are_products_of_three_linear_weights() -> None:
    """The 8 hand-computed weights of a node at 1/4, 1/2 and 3/4 between two points."""
    points = np.array([[0.0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 1], [1.25, 0.5, 0.75]])
    mesh = Mesh(points, np.array([[0, 1, 2, 4], [0, 1, 4, 3], [0, 4, 2, 3], [1, 4, 3, 2]]))
    weights = grid_map(mesh, (5, 3, 2)).weights.toarray()[4].reshape(5, 3, 2)
    expected = np.zeros((5, 3, 2))
    expected[1:3, 0:2, 0:2] = np.einsum("i,j,k->ijk", [0.75, 0.25], [0.5, 0.5], [0.25, 0.75])
    np.testing.assert_allclose(weights, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("tetrahedra", [False, True])
def test_the_own_grid_of_a_mesh_changes_no_bit(tetrahedra: bool) -> None:
    ell = l_mesh((2.0, 0.7, 1.1), (4, 2, 3), (2, 1), tetrahedra)
    for mesh in (box_mesh((2.0, 1.0, 1.0), (6, 2, 3), tetrahedra), ell):
        assert mesh.grid_index is not None
        grid = grid_map(mesh)
        assert grid.shape == mesh.grid_shape
        forces = np.random.default_rng(0).standard_normal((4, mesh.n_nodes, 3))
        carried = grid.forces_to_grid(forces)
        np.testing.assert_array_equal(carried[:, mesh.grid_index], forces)
        assert np.count_nonzero(carried) == forces.size
        np.testing.assert_array_equal(grid.displacements_to_nodes(carried), forces)
        by_shape = grid_map(mesh, mesh.grid_shape)
        np.testing.assert_array_equal(by_shape.weights.toarray(), grid.weights.toarray())
    assert grid_map(ell).weights.shape == (ell.n_nodes, 60)


def test_nodes_on_the_bounding_box_are_inside_despite_round_off() -> None:
    box = irregular_box((1.0, 1.0, 1.0), (3, 3, 3), tetrahedra=True)
    generator = np.random.default_rng(0)
    for _ in range(30):
        mesh = moved(box, generator.uniform(-1e4, 1e4, 3), float(10 ** generator.uniform(-3, 3)))
        np.testing.assert_allclose(grid_map(mesh).weights.sum(axis=1), 1, rtol=0, atol=1e-14)


@pytest.mark.parametrize("tetrahedra", [False, True])
@pytest.mark.parametrize(
    ("size_m", "cells"),
    [((4.0, 1.0, 1.0), (15, 3, 3)), ((2.0, 1.0, 0.1), (12, 6, 1)), ((3.0, 3.0, 3.0), (5, 5, 5))],
)
def test_the_default_grid_is_as_dense_as_the_nodes(
    size_m: tuple[float, float, float], cells: tuple[int, int, int], tetrahedra: bool
) -> None:
    mesh = irregular_box(size_m, cells, tetrahedra)
    spacing = (prod(size_m) / mesh.n_nodes) ** (1 / 3)
    expected = tuple(max(2, round(length / spacing)) for length in size_m)
    assert default_shape(mesh) == grid_map(mesh).shape == expected


def test_the_default_grid_is_sized_by_the_volume_of_the_body() -> None:
    ell = l_mesh((4.0, 4.0, 4.0), (12, 12, 12), (6, 6))
    assert prod(default_shape(ell)) == pytest.approx(ell.n_nodes * 4 / 3, rel=0.1)


@pytest.mark.parametrize(
    "shape", [(1, 4, 4), (4, 0, 4), (4, 4, -3), (101, 100, 100), (2, 2, MAX_POINTS // 4 + 1)]
)
def test_shapes_out_of_range_are_refused(shape: tuple[int, int, int]) -> None:
    got = " x ".join(map(str, shape))
    message = f"at least 2 points per axis and at most 1,000,000 .* got {got}"
    with pytest.raises(SpecError, match=message):
        grid_map(UNIT, shape)


def test_a_body_without_volume_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="volume"):
        grid_map(Mesh(UNIT.points, UNIT.cells[:, [0, 2, 1, 3]]))


@pytest.mark.parametrize("shape", [(27, 3), (2, 26, 3), (2, 27, 2)])
def test_values_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    grid = grid_map(UNIT, (3, 3, 3))
    for carry in (grid.forces_to_grid, grid.displacements_to_nodes):
        with pytest.raises(InvalidInputError, match=r"shape \(n, 27, 3\)"):
            carry(np.zeros(shape))
        assert carry(np.zeros((0, 27, 3))).shape == (0, 27, 3)
