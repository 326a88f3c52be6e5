"""Uniform refinement: the same body with eight cells for each, and a finer mesh without gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mor_bench.hard_cases.setups import of_order
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.other_meshes import refined, with_cells
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.scene.soundness import sound_cells
from mor_bench.scene.subdivision import subdivide


def volumes(mesh: Mesh) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    element = element_of(mesh.cells)
    det_j = shape_gradients(mesh.points, mesh.cells, element.derivatives)[1]
    return np.asarray(det_j @ element.weights)


def off_grid(scene: Scene) -> Scene:
    return refined(replace(scene, mesh=Mesh(scene.mesh.points, scene.mesh.cells)))


def places(points: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> set[tuple[float, ...]]:
    return {tuple(p) for p in np.round(points, 9)}


@pytest.mark.parametrize("tetrahedra", [False, True])
def test_a_subdivided_mesh_fills_the_same_body_without_gaps(tetrahedra: bool) -> None:
    box = box_mesh((2.0, 1.0, 1.0), (4, 2, 3), tetrahedra)
    x, y, z = box.points.T
    bent = np.stack([x + 0.2 * y * z, y + 0.1 * x * z, z + 0.15 * x * y], axis=1)
    coarse = Mesh(bent, box.cells)
    fine, parents = subdivide(coarse)
    assert fine.n_cells == 8 * coarse.n_cells
    assert volumes(fine).min() > 0
    accuracy = 1e-12 if tetrahedra else 1e-3
    assert volumes(fine).sum() == pytest.approx(volumes(coarse).sum(), rel=accuracy)
    assert len(fine.boundary_facets) == 4 * len(coarse.boundary_facets)
    assert len(places(fine.points)) == fine.n_nodes == len(np.unique(fine.cells))
    np.testing.assert_allclose(fine.points, coarse.points[parents].mean(axis=1), rtol=0, atol=1e-12)
    weights, field = interpolation_matrix(coarse, fine.points), coarse.points**2
    np.testing.assert_allclose(weights @ field, field[parents].mean(axis=1), rtol=0, atol=1e-9)


def curved() -> Mesh:
    """Return a box of T10 whose edges are bent by a quadratic map."""
    box = of_order(box_mesh((2.0, 1.0, 1.0), (2, 1, 2), tetrahedra=True), 2)
    return Mesh(bent(box.points), box.cells)


def bent(points: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> np.ndarray:
    x, y, z = points.T
    return np.stack([x + 0.2 * y * z, y + 0.1 * x * z, z + 0.15 * x * y], axis=1)


def test_curved_cells_are_divided_along_their_curves() -> None:
    """A quadratic map is exact on T10, so all nodes of the parts lie where it takes them."""
    coarse = curved()
    fine, parents = subdivide(coarse)
    assert fine.n_cells == 8 * coarse.n_cells
    assert volumes(fine).min() > 0
    # The cubic det J is beyond the rule of four points.
    assert volumes(fine).sum() == pytest.approx(volumes(coarse).sum(), rel=1e-4)
    assert len(fine.boundary_facets) == 4 * len(coarse.boundary_facets)
    sound_cells(fine.points, fine.cells)
    straight = of_order(box_mesh((2.0, 1.0, 1.0), (2, 1, 2), tetrahedra=True), 2)
    at_rest, _ = subdivide(straight)
    assert places(fine.points) == places(bent(at_rest.points))
    middles = coarse.points[parents].mean(axis=1)
    assert np.abs(fine.points - middles).max() > 1e-3
    weights = interpolation_matrix(coarse, fine.points)
    np.testing.assert_allclose(weights @ coarse.points, fine.points, rtol=0, atol=1e-12)


def test_subdivision_of_quadratic_tetrahedra_gives_those_of_the_divided_ones() -> None:
    linear = replace(box_mesh((2.0, 1.0, 1.0), (2, 2, 2), tetrahedra=True), grid_shape=None)
    fine, parents = subdivide(of_order(linear, 2))
    expected = of_order(subdivide(linear)[0], 2)
    assert places(fine.points) == places(expected.points)
    assert fine.n_nodes == expected.n_nodes
    coarse = of_order(linear, 2)
    np.testing.assert_allclose(fine.points, coarse.points[parents].mean(axis=1), rtol=0, atol=1e-12)
    # Quadratic functions are exact on the coarse mesh, and so at all new nodes.
    weights = interpolation_matrix(coarse, fine.points)
    np.testing.assert_allclose(weights @ coarse.points**2, fine.points**2, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["beam-tiny", "l-shape"])
def test_subdivision_of_a_grid_gives_the_finer_grid(name: str) -> None:
    scene = load_scene(name)
    nx, ny, nz = (2 * n for n in scene.spec.geometry.cells)  # type: ignore[union-attr]
    expected, found = with_cells(scene, (nx, ny, nz)), off_grid(scene)
    assert places(found.mesh.points) == places(expected.mesh.points)
    held = [places(s.mesh.points[s.fixed_nodes]) for s in (found, expected)]
    assert held[0] == held[1]
    assert refined(scene).mesh.grid_shape == expected.mesh.grid_shape


def test_the_subdivided_mesh_and_the_finer_grid_have_the_same_solutions() -> None:
    scene = load_scene("beam-tiny")
    answers = []
    for finer in (refined(scene), off_grid(scene)):
        tip = finer.mesh.points[:, 0] == 2.0
        load = np.zeros((finer.mesh.n_nodes, 3))
        load[tip, 2] = -2.0 / tip.sum()
        u = np.zeros(finer.mesh.n_dofs)
        u[finer.free_dofs] = FullOrderModel(finer).solve(load.ravel()[finer.free_dofs]).displacement
        answers.append(interpolation_matrix(finer.mesh, scene.mesh.points) @ u.reshape(-1, 3))
    np.testing.assert_allclose(answers[0], answers[1], rtol=0, atol=1e-8 * np.abs(answers[0]).max())
