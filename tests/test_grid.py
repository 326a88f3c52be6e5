"""A regular grid for any mesh: sums, moments and linear fields are kept, and a mesh's own grid changes no bit."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, SpecError
from mor_bench.scene.grid import MAX_POINTS, GridMap, default_shape, grid_map
from mor_bench.scene.mesh import Mesh, box_mesh, l_mesh
from tests.irregular import irregular_box

SHAPES = st.tuples(*[st.integers(2, 7)] * 3)


def grid_points(mesh: Mesh, shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """(n_grid, 3) positions of the points of a grid over the mesh's bounding box."""
    axes = [np.linspace(low, high, n) for low, high, n in zip(*mesh.bounds, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def moved(mesh: Mesh, offset: NDArray[np.float64], scale: float = 1.0) -> Mesh:
    return Mesh(mesh.points * scale + offset, mesh.cells)


@st.composite
def irregular(draw: st.DrawFn) -> Mesh:
    """Boxes of any size, place and aspect, of either cell, moved and with nodes on, near and away from the bounding box."""
    size = draw(st.tuples(*[st.floats(0.3, 3.0)] * 3))
    cells = draw(st.tuples(*[st.integers(1, 4)] * 3))
    mesh = irregular_box(size, cells, draw(st.booleans()), seed=draw(st.integers(0, 99)))
    offset = np.array(draw(st.tuples(*[st.floats(-5.0, 5.0)] * 3)))
    return moved(mesh, offset, draw(st.sampled_from([1e-3, 1.0, 1e3])))


@settings(max_examples=60, deadline=None)
@given(irregular(), st.none() | SHAPES, st.integers(0, 99))
def test_forces_keep_their_sum_and_moment(
    mesh: Mesh, shape: tuple[int, int, int] | None, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    forces, about = (
        generator.standard_normal((3, mesh.n_nodes, 3)),
        mesh.points[generator.integers(mesh.n_nodes)],
    )
    grid = grid_map(mesh, shape)
    carried = grid.forces_to_grid(forces)
    assert carried.shape == (3, prod(grid.shape), 3)
    np.testing.assert_allclose(
        carried.sum(axis=1), forces.sum(axis=1), rtol=0, atol=1e-12 * np.abs(forces).sum()
    )
    moment, expected = (
        np.cross(grid_points(mesh, grid.shape) - about, carried),
        np.cross(mesh.points - about, forces),
    )
    scale = np.abs(forces).sum() * np.linalg.norm(mesh.points, axis=1).max()
    np.testing.assert_allclose(moment.sum(axis=1), expected.sum(axis=1), rtol=0, atol=1e-12 * scale)


@settings(max_examples=30, deadline=None)
@given(irregular(), st.none() | SHAPES)
def test_a_linear_displacement_of_the_grid_is_one_of_the_nodes(
    mesh: Mesh, shape: tuple[int, int, int] | None
) -> None:
    gradient, constant = (
        np.random.default_rng(0).standard_normal((3, 3)),
        np.array([0.1, -0.2, 0.3]),
    )
    grid = grid_map(mesh, shape)
    at_nodes = grid.displacements_to_nodes(
        (grid_points(mesh, grid.shape) @ gradient + constant)[None]
    )
    scale = 1 + np.abs(mesh.points).max()
    np.testing.assert_allclose(
        at_nodes[0], mesh.points @ gradient + constant, rtol=0, atol=1e-12 * scale
    )


@settings(max_examples=30, deadline=None)
@given(irregular(), st.none() | SHAPES)
def test_the_two_directions_are_adjoint_so_that_work_is_kept(
    mesh: Mesh, shape: tuple[int, int, int] | None
) -> None:
    generator = np.random.default_rng(0)
    grid = grid_map(mesh, shape)
    forces, displacements = (
        generator.standard_normal((2, mesh.n_nodes, 3)),
        generator.standard_normal((2, prod(grid.shape), 3)),
    )
    on_grid, at_nodes = (
        grid.forces_to_grid(forces) * displacements,
        forces * grid.displacements_to_nodes(displacements),
    )
    np.testing.assert_allclose(
        on_grid.sum(axis=(1, 2)),
        at_nodes.sum(axis=(1, 2)),
        rtol=0,
        atol=1e-12 * np.abs(at_nodes).sum(),
    )


def test_weights_are_the_product_of_three_linear_ones() -> None:
    """A node a quarter, a half and three quarters between two points: 8 weights by hand."""
    points = np.array([[0.0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 1], [1.25, 0.5, 0.75]])
    mesh = Mesh(points, np.array([[0, 1, 2, 4], [0, 1, 4, 3], [0, 4, 2, 3], [1, 4, 3, 2]]))
    weights = grid_map(mesh, (5, 3, 2)).weights.toarray()[4].reshape(5, 3, 2)
    expected = np.zeros((5, 3, 2))
    expected[1:3, 0:2, 0:2] = np.einsum("i,j,k->ijk", [0.75, 0.25], [0.5, 0.5], [0.25, 0.75])
    np.testing.assert_allclose(weights, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("tetrahedra", [False, True])
def test_a_meshs_own_grid_changes_no_bit(tetrahedra: bool) -> None:
    box, ell = (
        box_mesh((2.0, 1.0, 1.0), (6, 2, 3), tetrahedra),
        l_mesh((2.0, 0.7, 1.1), (4, 2, 3), (2, 1), tetrahedra),
    )
    for mesh in (box, ell):
        assert mesh.grid_shape is not None
        assert mesh.grid_index is not None
        grid = grid_map(mesh)
        assert grid.shape == mesh.grid_shape
        forces = np.random.default_rng(0).standard_normal((4, mesh.n_nodes, 3))
        carried = grid.forces_to_grid(forces)
        np.testing.assert_array_equal(carried[:, mesh.grid_index], forces)
        assert np.count_nonzero(carried) == forces.size
        np.testing.assert_array_equal(grid.displacements_to_nodes(carried), forces)
    assert grid_map(ell).weights.shape == (ell.n_nodes, 60)
    np.testing.assert_array_equal(
        grid_map(ell, ell.grid_shape).weights.toarray(), grid_map(ell).weights.toarray()
    )


def test_a_regular_mesh_on_a_grid_of_another_shape() -> None:
    """On a grid of every second point the nodes between have two weights of a half."""
    mesh = box_mesh((4.0, 1.0, 1.0), (4, 1, 1))
    weights = (
        grid_map(mesh, (3, 2, 2)).weights.toarray().reshape(5, 2, 2, 3, 2, 2)[:, 0, 1, :, 0, 1]
    )
    expected = np.array([[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]])
    np.testing.assert_allclose(weights, expected, rtol=0, atol=1e-14)


def test_nodes_on_the_bounding_box_are_inside_whatever_the_round_off() -> None:
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
    assert (
        default_shape(mesh)
        == grid_map(mesh).shape
        == tuple(max(2, round(length / spacing)) for length in size_m)
    )


def test_the_default_grid_of_half_a_bounding_box_counts_the_body_only() -> None:
    ell = l_mesh((4.0, 4.0, 4.0), (12, 12, 12), (6, 6))
    assert prod(default_shape(ell)) == pytest.approx(ell.n_nodes * 4 / 3, rel=0.1)


@pytest.mark.parametrize(
    "shape", [(1, 4, 4), (4, 0, 4), (4, 4, -3), (101, 100, 100), (2, 2, MAX_POINTS // 4 + 1)]
)
def test_shapes_out_of_range_are_refused(shape: tuple[int, int, int]) -> None:
    with pytest.raises(
        SpecError,
        match=f"at least 2 points per axis and at most 1,000,000 .* got {' x '.join(map(str, shape))}",
    ):
        grid_map(irregular_box((1.0, 1.0, 1.0), (2, 2, 2), tetrahedra=True), shape)


def test_a_body_without_volume_is_refused() -> None:
    mesh = irregular_box((1.0, 1.0, 1.0), (2, 2, 2), tetrahedra=True)
    with pytest.raises(InvalidInputError, match="volume"):
        grid_map(Mesh(mesh.points, mesh.cells[:, [0, 2, 1, 3]]))


@pytest.mark.parametrize("shape", [(27, 3), (2, 26, 3), (2, 27, 2)])
def test_values_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    grid: GridMap = grid_map(irregular_box((1.0, 1.0, 1.0), (2, 2, 2), tetrahedra=False), (3, 3, 3))
    for carry in (grid.forces_to_grid, grid.displacements_to_nodes):
        with pytest.raises(InvalidInputError, match=r"shape \(n, 27, 3\)"):
            carry(np.zeros(shape))
        assert carry(np.zeros((0, 27, 3))).shape == (0, 27, 3)
