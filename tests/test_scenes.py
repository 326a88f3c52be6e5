"""Geometries: the L of the paper, its grid, and its meshes of other sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.scene.loads import cut_patches
from mor_bench.scene.scene import Scene, load_scene, with_cells
from mor_bench.snapshots.test_sets import spec_of_set
from mor_bench.specs import list_suite, load_generated_spec


def content(**changes: Any) -> dict[str, Any]:
    spec = load_scene("l-shape").spec.model_dump(mode="json")
    return {**spec, **changes, "geometry": {**spec["geometry"], **changes.get("geometry", {})}}


@pytest.mark.parametrize("element", ["hexahedron", "tetrahedron"])
def test_the_l_has_the_volume_the_surface_and_the_grid_of_a_box_without_a_corner(
    element: str,
) -> None:
    mesh = load_scene(content(discretisation={"element": element})).mesh
    width, depth, height = 28.424, 10.0, 40.0
    arm, column = width * 3 / 13 * height, width * 4 / 9 * height * 10 / 13
    reference = element_of(mesh.cells)
    volumes = shape_gradients(mesh.points, mesh.cells, reference.derivatives)[1] @ reference.weights
    assert volumes.sum() == pytest.approx(depth * (arm + column), rel=1e-12)
    corners = mesh.points[mesh.boundary_facets]
    triangles = (
        [corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]] if element == "hexahedron" else [corners]
    )
    area = sum(
        0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum()
        for t in triangles
    )
    assert area == pytest.approx(2 * (arm + column) + 2 * depth * (width + height), rel=1e-12)
    assert mesh.grid_shape == (10, 6, 14)
    assert mesh.grid_index is not None
    assert len(np.unique(mesh.grid_index)) == mesh.n_nodes == 540
    place = np.stack(np.unravel_index(mesh.grid_index, mesh.grid_shape), axis=1)
    np.testing.assert_allclose(
        mesh.points, place * [width / 9, depth / 5, height / 13], rtol=1e-12, atol=1e-12
    )


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
        (
            [9, 10],
            r"`geometry`: `cut_cells` must be less than the 9 cells along x and the 13 along z; got \(9, 10\)",
        ),
        ([5, 13], r"got \(5, 13\)"),
        ([0, 10], r"`geometry.cut_cells\[0\]` must be greater than or equal to 1; got 0"),
        ([5], r"`geometry.cut_cells\[1\]` is missing"),
    ],
)
def test_a_cut_that_leaves_no_l_is_refused(cut: list[int], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        load_scene(content(geometry={"cut_cells": cut}))


def mean_lengths(scene: Scene) -> NDArray[np.float64]:
    """Length of the mean normal of each patch: 1 where it is flat."""
    areas = scene.patches.areas
    return np.asarray(np.linalg.norm(areas @ scene.patches.normals, axis=1) / areas.sum(axis=1))


@pytest.fixture(scope="module")
def liver() -> Scene:
    return load_scene("liver-hex")


def test_forces_on_the_livers_surface_reach_the_grid_with_sum_and_moment(liver: Scene) -> None:
    points, shares = liver.patch_points(np.arange(200))
    weights = liver.patch_weights
    assert (weights.toarray() >= -1e-15).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=0, atol=1e-13)
    np.testing.assert_allclose(weights @ liver.mesh.points, shares @ points, rtol=0, atol=1e-13)
    forces = np.random.default_rng(0).normal(size=(len(liver.surface.points), 3))
    nodal = liver.to_surface.T @ forces
    moments = [
        np.cross(x, f).sum(axis=0)
        for x, f in ((liver.surface.points, forces), (liver.mesh.points, nodal))
    ]
    np.testing.assert_allclose(moments[0], moments[1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(nodal.sum(axis=0), forces.sum(axis=0), rtol=0, atol=1e-11)


def test_displacements_of_the_grid_come_back_to_the_livers_surface(liver: Scene) -> None:
    gradient, shift = np.random.default_rng(1).normal(size=(3, 3)), np.array([0.1, -0.2, 0.3])
    np.testing.assert_allclose(
        liver.to_surface @ (liver.mesh.points @ gradient + shift),
        liver.surface.points @ gradient + shift,
        rtol=0,
        atol=1e-12,
    )


def test_the_liver_is_held_between_its_lobes_and_pressed_on_its_upper_half(liver: Scene) -> None:
    held = liver.mesh.points[liver.fixed_nodes]
    assert len(held) == 54
    assert np.ptp(held, axis=0).max() < 0.1
    assert liver.patch_centres[:, 2].min() >= 0
    distance = np.linalg.norm(liver.patch_centres[:, None] - held, axis=2).min(axis=1)
    assert distance.min() > np.sqrt(9e-4 / np.pi)
    outwards = liver.patch_centres - liver.surface.points.mean(axis=0)
    assert ((liver.patch_normals * outwards).sum(axis=1) > 0).mean() > 0.9


def test_the_two_livers_are_one_body(liver: Scene) -> None:
    other = load_scene("liver-tet")
    assert other.mesh.cells.shape[1] == 4
    np.testing.assert_allclose(
        other.mesh.bounds,
        [liver.surface.points.min(axis=0), liver.surface.points.max(axis=0)],
        atol=5e-4,
    )
    assert other.spec.grid_nodes == liver.mesh.grid_shape == (16, 15, 16)


def cube_stl(path: Path) -> Path:
    """A cube of 2 cm, in centimetres, its lowest corner at (1, 0, 0)."""
    corners = np.array([[x, y, z] for x in (1, 3) for y in (0, 2) for z in (0, 2)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    lines = ["solid cube"]
    for a, b, c, d in quads:
        for triangle in ((a, b, c), (a, c, d)):
            vertices = "".join(f"vertex {' '.join(map(str, corners[v]))}\n" for v in triangle)
            lines.append(f"facet normal 0 0 0\nouter loop\n{vertices}endloop\nendfacet")
    path.write_text("\n".join([*lines, "endsolid cube"]))
    return path


def test_a_users_surface_becomes_a_scene_wherever_its_file_lies(tmp_path: Path) -> None:
    base = {key: value for key, value in content().items() if key != "name"}
    base["loads"] = {**base["loads"], "patch_area_m2": 1e-4, "magnitude_n": [0.0, 1e-3]}
    cubes = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        cube_stl(tmp_path / folder / "cube.stl")
        spec = {
            **base,
            "geometry": {
                "shape": "voxels",
                "surface": str(tmp_path / folder / "cube.stl"),
                "cells": [3, 2, 2],
                "unit_m": 0.01,
            },
        }
        cubes.append(load_scene(spec))
    np.testing.assert_allclose(cubes[0].mesh.bounds, [[0.01, 0, 0], [0.03, 0.02, 0.02]], atol=1e-15)
    assert cubes[0].mesh.n_cells == 12
    assert cubes[0].spec.digest() == cubes[1].spec.digest()
    load = np.zeros((cubes[0].mesh.n_nodes, 3))
    load[:, 0] = 1e-6
    answer = mor_bench.load_method("fem").fit(cubes[0], None).predict(load)
    assert 0 < np.abs(answer).max() < 0.01
    with pytest.raises(SpecError, match=r"nowhere.stl: no such file"):
        load_scene(
            {**base, "geometry": {"shape": "voxels", "surface": "nowhere.stl", "cells": [3, 2, 2]}}
        )
    kept = cubes[0].spec
    (tmp_path / "one" / "cube.stl").write_text("solid other")
    with pytest.raises(
        SpecError, match=r"cube.stl: the file has changed since the dataset was read"
    ):
        load_scene(kept)


@pytest.mark.parametrize("name", sorted(list_suite("datasets")))
def test_every_load_patch_lies_on_the_surface_and_pushes_something_that_can_move(name: str) -> None:
    spec = load_generated_spec(name)
    items = [spec, spec_of_set(spec, "unseen-regions")]
    for scene in map(load_scene, items):
        assert np.isin(scene.patch_nodes, scene.surface.facets).all()
        assert mean_lengths(scene).min() > 0.6
        free = np.setdiff1d(np.arange(scene.mesh.n_nodes), scene.fixed_nodes)
        assert scene.patch_weights[:, free].sum(axis=1).min() > 0.2


def test_a_load_region_inside_the_body_is_refused() -> None:
    with pytest.raises(SpecError, match="nodes inside the body only"):
        load_scene(
            content(loads={**content()["loads"], "region": {"sphere_m": [[6.3, 4.0, 6.2], 1.5]}})
        )


def rod_stl(path: Path, n: int = 24) -> Path:
    """A rod of 0.2 m with two long triangles for each of its n sides, as drawing programs write it."""
    angle = 2 * np.pi * np.arange(n) / n
    ring = 0.02 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ends = [np.column_stack([np.full(n, x), ring]) for x in (0.0, 0.2)]
    centres = [np.array([x, 0.0, 0.0]) for x in (0.0, 0.2)]
    triangles = []
    for i in range(n):
        j = (i + 1) % n
        triangles += [(ends[0][i], ends[1][j], ends[1][i]), (ends[0][i], ends[0][j], ends[1][j])]
        triangles += [(centres[0], ends[0][j], ends[0][i]), (centres[1], ends[1][i], ends[1][j])]
    meshio.Mesh(
        np.array(triangles).reshape(-1, 3), [("triangle", np.arange(12 * n).reshape(-1, 3))]
    ).write(path)
    return path


def test_patches_on_a_surface_of_long_triangles(tmp_path: Path) -> None:
    base = {key: value for key, value in content().items() if key != "name"}
    base["supports"] = [{"region": "x-min"}]
    base["loads"] = {**base["loads"], "region": "x-max", "patch_area_m2": 2e-4, "kind": "normal"}
    geometry = {
        "shape": "voxels",
        "surface": str(rod_stl(tmp_path / "rod.stl")),
        "cells": [20, 5, 5],
    }
    with pytest.raises(SpecError, match="the area of the load region"):
        load_scene(
            {**base, "geometry": geometry, "loads": {**base["loads"], "patch_area_m2": 2e-3}}
        )
    scene = load_scene(
        {**base, "geometry": geometry, "loads": {**base["loads"], "region": "surface"}}
    )
    np.testing.assert_allclose(scene.patches.areas.sum(axis=1), 2e-4, rtol=1e-12)
    points, shares = scene.patch_points(np.arange(len(scene.patch_nodes)))
    np.testing.assert_allclose(
        scene.patch_weights @ scene.mesh.points, shares @ points, rtol=0, atol=1e-13
    )
    values = scene.patches.values
    np.testing.assert_allclose(
        values @ scene.surface.points, scene.patches.points, rtol=0, atol=1e-15
    )
    corners = scene.surface.points[scene.surface.facets]
    area = (
        0.5
        * np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        ).sum()
    )
    whole = cut_patches(scene.surface, scene.surface.facets, np.array([0]), area * (1 - 1e-9))
    assert whole.areas.sum() == pytest.approx(area, rel=1e-8)
