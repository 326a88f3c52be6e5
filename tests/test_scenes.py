"""Geometries: the L of the paper, its grid, and its meshes of other sizes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.scene.scene import load_scene, with_cells


def content(**changes: Any) -> dict[str, Any]:
    spec = load_scene("l-shape").spec.model_dump(mode="json")
    return {**spec, **changes, "geometry": {**spec["geometry"], **changes.get("geometry", {})}}


@pytest.mark.parametrize("element", ["hexahedron", "tetrahedron"])
def test_the_l_has_the_volume_the_surface_and_the_grid_of_a_box_without_a_corner(element: str) -> None:
    mesh = load_scene(content(discretisation={"element": element})).mesh
    width, depth, height = 28.424, 10.0, 40.0
    arm, column = width * 3 / 13 * height, width * 4 / 9 * height * 10 / 13
    reference = element_of(mesh.cells)
    volumes = shape_gradients(mesh.points, mesh.cells, reference.derivatives)[1] @ reference.weights
    assert volumes.sum() == pytest.approx(depth * (arm + column), rel=1e-12)
    corners = mesh.points[mesh.boundary_facets]
    triangles = [corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]] if element == "hexahedron" else [corners]
    area = sum(0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() for t in triangles)
    assert area == pytest.approx(2 * (arm + column) + 2 * depth * (width + height), rel=1e-12)
    assert mesh.grid_shape == (10, 6, 14)
    assert mesh.grid_index is not None
    assert len(np.unique(mesh.grid_index)) == mesh.n_nodes == 540
    place = np.stack(np.unravel_index(mesh.grid_index, mesh.grid_shape), axis=1)
    np.testing.assert_allclose(mesh.points, place * [width / 9, depth / 5, height / 13], rtol=1e-12, atol=1e-12)


def test_sixty_nodes_of_the_bottom_are_loaded_and_the_top_of_the_column_is_held() -> None:
    scene = load_scene("l-shape")
    assert (scene.mesh.points[scene.patch_nodes, 2] == 0).all()
    assert len(scene.patch_nodes) == 60
    assert (scene.mesh.points[scene.fixed_nodes, 2] == 40.0).all()
    assert scene.mesh.points[scene.fixed_nodes, 0].max() == pytest.approx(28.424 * 4 / 9)


def test_meshes_of_other_sizes_keep_the_body() -> None:
    scene = load_scene("l-shape")
    assert with_cells(scene, (18, 10, 26)).mesh.n_cells == 8 * 335
    with pytest.raises(UnsupportedSceneError, match="must consist of whole cells"):
        with_cells(scene, (5, 3, 7))
    assert "whole cells" in (mor_bench.load_method("fem-coarse").supports(scene) or "")


@pytest.mark.parametrize(
    ("cut", "message"),
    [
        ([9, 10], r"`geometry`: `cut_cells` must be less than the 9 cells along x and the 13 along z; got \(9, 10\)"),
        ([5, 13], r"got \(5, 13\)"),
        ([0, 10], r"`geometry.cut_cells\[0\]` must be greater than or equal to 1; got 0"),
        ([5], r"`geometry.cut_cells\[1\]` is missing"),
    ],
)
def test_a_cut_that_leaves_no_l_is_refused(cut: list[int], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        load_scene(content(geometry={"cut_cells": cut}))
