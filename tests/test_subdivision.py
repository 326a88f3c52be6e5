"""Uniform refinement: the same body with eight cells for each, and a finer mesh without gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.other_meshes import refined, with_cells
from mor_bench.scene.scene import Scene, load_scene
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
