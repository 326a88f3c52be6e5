"""Tetrahedra with ten nodes: no locking, consistent loads, and facets."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.hard_cases.setups import cantilever, cantilever_spec, of_order, tip
from mor_bench.mechanics import model as model_module
from mor_bench.mechanics.elements import T10, shape_gradients
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.scene.interpolation import interpolation_matrix, quadratic
from mor_bench.scene.loads import Facets, cut_patches
from mor_bench.scene.mesh import Mesh, box_mesh, corners_of
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.scene.second_order import with_middles
from mor_bench.scene.triangle_rules import (
    DEGREE_2,
    DEGREE_4,
    DEGREE_4_WEIGHTS,
    quadratic_triangle,
)
from mor_bench.specs import SolverName

from .laws_and_elements import LAWS

QUADRATIC = {"element": "tetrahedron", "order": 2}


def box() -> Mesh:
    return of_order(box_mesh((2.0, 1.0, 1.0), (4, 2, 2), tetrahedra=True), 2)


def bent(points: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = points.T
    return np.stack([x + 0.2 * y * z, y + 0.1 * x * z, z + 0.15 * x * y], axis=1)


def scene() -> Scene:
    spec = cantilever_spec([4.0, 1.0, 1.0], [8, 2, 2], 0.3)
    return load_scene({**spec, "discretisation": QUADRATIC})


@pytest.mark.filterwarnings("ignore::mor_bench.errors.LockingWarning")
@pytest.mark.parametrize(
    ("poisson", "law"),
    [
        pytest.param(p, law, marks=() if (p, law) == (0.499, "neo-hookean") else pytest.mark.slow)
        for p, law in itertools.product([0.48, 0.499, 0.4999], LAWS)
    ],
)
def test_quadratic_tetrahedra_do_not_lock(poisson: float, law: str) -> None:
    """A short cantilever bends as one of selectively integrated H8; T4 lock without bound."""
    spec = cantilever_spec([4.0, 1.0, 1.0], [8, 2, 2], poisson, law=law)
    found = [
        tip(FullOrderModel(load_scene({**spec, "discretisation": table})), -50.0)[2]
        for table in (QUADRATIC, {"element": "tetrahedron"})
    ]
    expected = tip(cantilever([4.0, 1.0, 1.0], [12, 3, 3], poisson, "selective", law), -50.0)[2]
    assert found[0] / expected == pytest.approx(1.0, abs=0.06)
    assert found[1] / expected < 0.3


@pytest.mark.parametrize("solver", ["auto", "rotated-pcg"])
def test_multigrid_solves_for_quadratic_tetrahedra(
    solver: SolverName, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = scene()
    expected = tip(FullOrderModel(body), -50.0)
    monkeypatch.setattr(model_module, "MAX_BAND_ENTRIES", 0)
    model = FullOrderModel(body, solver)
    factor, rhs = model.rest_factor, np.random.default_rng(0).normal(size=model.n_unknowns)
    assert isinstance(factor, MultigridFactor)
    product = model.assembler.pattern.symmetric(model.rest_tangent) @ factor.solve(rhs)
    np.testing.assert_allclose(product, rhs, rtol=0, atol=1e-7 * np.abs(rhs).max())
    np.testing.assert_allclose(tip(model, -50.0), expected, rtol=1e-5)


def test_shape_functions_are_one_at_their_node_and_zero_at_the_others() -> None:
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    edges = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
    nodes = np.concatenate([corners, corners[edges].mean(axis=1)])
    values, derivatives = quadratic(nodes)
    np.testing.assert_allclose(values, np.eye(10), atol=1e-15)
    step = 1e-6
    for axis in range(3):
        ahead, behind = (quadratic(nodes + s * step * np.eye(3)[axis])[0] for s in (1, -1))
        np.testing.assert_allclose(
            (ahead - behind) / (2 * step), derivatives[:, :, axis], atol=1e-8
        )
    flat = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0], [0.5, 0.5], [0, 0.5]])
    values, derivatives = quadratic_triangle(flat)
    np.testing.assert_allclose(values, np.eye(6), atol=1e-15)
    for axis in range(2):
        ahead, behind = (quadratic_triangle(flat + s * step * np.eye(2)[axis])[0] for s in (1, -1))
        np.testing.assert_allclose(
            (ahead - behind) / (2 * step), derivatives[:, :, axis], atol=1e-8
        )


@pytest.mark.parametrize(
    ("points", "weights", "degree"),
    [(DEGREE_2, np.full(3, 1 / 6), 2), (DEGREE_4, DEGREE_4_WEIGHTS, 4)],
)
def test_rules_for_triangles_are_exact(
    points: NDArray[np.float64], weights: NDArray[np.float64], degree: int
) -> None:
    """∫ xᵃ yᵇ over the triangle is a! b! / (a + b + 2)!."""
    exact = {(0, 0): 1 / 2, (1, 0): 1 / 6, (2, 0): 1 / 12, (1, 1): 1 / 24, (2, 2): 1 / 180}
    exact |= {(3, 1): 1 / 120, (4, 0): 1 / 30}
    for (a, b), integral in exact.items():
        if a + b <= degree:
            for x, y in (points.T, points.T[::-1]):
                assert weights @ (x**a * y**b) == pytest.approx(integral, rel=1e-13)


def test_a_uniform_traction_acts_on_the_middles_of_facets_alone() -> None:
    mesh = box()
    facets = mesh.boundary_facets
    top = facets[(mesh.points[facets][:, :, 2] == 1.0).all(axis=1)]
    patch = cut_patches(Facets(mesh.points, facets), top, top[0, :1], 2.0)
    weights = (patch.areas @ patch.values).toarray()[0]
    expected = np.zeros(mesh.n_nodes)
    np.add.at(expected, top[:, 3:], 2.0 / top[:, 3:].size)
    np.testing.assert_allclose(weights, expected, atol=1e-12)


def test_parts_of_facets_have_their_area_and_moment() -> None:
    """Weights at corners may be negative. Sum and moment are those of the traction."""
    loaded = scene()
    patches = np.arange(len(loaded.patch_nodes))
    points, shares = loaded.patch_points(patches)
    weights = loaded.patch_weights
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(weights @ loaded.mesh.points, shares @ points, atol=1e-12)
    other = shares @ interpolation_matrix(loaded.mesh, points)
    np.testing.assert_allclose(weights.toarray(), other.toarray(), atol=1e-12)


def test_patches_that_need_too_many_points_are_refused() -> None:
    mesh = box()
    facets = mesh.boundary_facets
    with pytest.raises(SpecError, match="`patch_area_m2` must be at least about"):
        cut_patches(Facets(mesh.points, facets), facets, facets[0, :1], 1e-5)


def test_facets_are_drawn_as_four_triangles_that_face_outwards() -> None:
    mesh = Mesh(bent(box().points), box().cells)
    a, b, c = np.moveaxis(mesh.points[mesh.drawn_facets], 1, 0)
    assert len(mesh.drawn_facets) == 4 * len(mesh.boundary_facets)
    volume = float((a * np.cross(b, c)).sum() / 6)
    det_j = shape_gradients(mesh.points, mesh.cells, T10.derivatives)[1]
    assert volume == pytest.approx(float((det_j @ T10.weights).sum()), rel=1e-3)
    linear = box_mesh((2.0, 1.0, 1.0), (4, 2, 2), tetrahedra=True)
    assert linear.drawn_facets is linear.boundary_facets
    flat = box()
    corners = flat.points[corners_of(flat.boundary_facets)]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    np.testing.assert_allclose(flat.points[flat.boundary_facets[:, 3:]], middles, atol=1e-15)


def test_points_in_curved_cells_are_found() -> None:
    straight = box()
    x, y, z = straight.points.T
    # The middles of the first cells' edges along y lie beyond the boxes around the corners.
    mesh = Mesh(np.stack([x + 0.2 * y * (0.5 - y), y, z], axis=1), straight.cells)
    cells = np.repeat(mesh.cells, 10, axis=0)
    at = np.random.default_rng(0).dirichlet(np.full(4, 0.3), len(cells))[:, 1:]
    shape = quadratic(at)[0]
    points = np.einsum("ca,cai->ci", shape, mesh.points[cells])
    # At rest the same places hold the values of the map, which is quadratic.
    at_rest = np.einsum("ca,cai->ci", shape, straight.points[cells])
    weights = interpolation_matrix(mesh, points)
    np.testing.assert_allclose(weights @ straight.points, at_rest, atol=1e-11)


def test_sets_gain_the_middles_between_their_nodes_alone() -> None:
    linear = box_mesh((2.0, 1.0, 1.0), (4, 2, 2), tetrahedra=True)
    end = np.flatnonzero(linear.points[:, 0] == 0.0)
    mesh, sets = with_middles(linear, {"end": end})
    np.testing.assert_array_equal(sets["end"], np.flatnonzero(mesh.points[:, 0] == 0.0))
