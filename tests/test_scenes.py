"""Scenes: the L of the paper, the liver, surfaces of users, and load patches on all of them."""

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
from mor_bench.report.published_figures import scene_of
from mor_bench.scene.loads import cut_patches
from mor_bench.scene.mesh import box_mesh
from mor_bench.scene.other_meshes import with_cells
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.test_sets import spec_of_set
from mor_bench.specs import list_suite, load_generated_spec
from tests.verification.laws_and_elements import discretisation

WIDTH, DEPTH, HEIGHT = 28.424, 10.0, 40.0


def content(**changes: Any) -> dict[str, Any]:
    spec = load_scene("l-shape").spec.model_dump(mode="json")
    return {**spec, **changes, "geometry": {**spec["geometry"], **changes.get("geometry", {})}}


def triangles_of(facets: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners (n, 3, 3) of facets (n, 3 or 4, 3), quadrilaterals cut in two."""
    if facets.shape[1] == 3:
        return facets
    return np.concatenate([facets[:, [0, 1, 2]], facets[:, [0, 2, 3]]])


def area_of(facets: NDArray[np.float64]) -> float:
    a, b, c = np.moveaxis(triangles_of(facets), 1, 0)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


@pytest.mark.parametrize("element", ["hexahedron", "tetrahedron", "quadratic tetrahedron"])
def test_the_l_has_volume_surface_and_grid_of_a_box_without_a_corner(element: str) -> None:
    mesh = load_scene(content(discretisation=discretisation((element, False)))).mesh
    arm, column = WIDTH * 3 / 13 * HEIGHT, WIDTH * 4 / 9 * HEIGHT * 10 / 13
    reference = element_of(mesh.cells)
    det_j = shape_gradients(mesh.points, mesh.cells, reference.derivatives)[1]
    assert (det_j @ reference.weights).sum() == pytest.approx(DEPTH * (arm + column), rel=1e-12)
    expected = 2 * (arm + column) + 2 * DEPTH * (WIDTH + HEIGHT)
    assert area_of(mesh.points[mesh.drawn_facets]) == pytest.approx(expected, rel=1e-12)
    n = 2 if "quadratic" in element else 1
    assert mesh.grid_shape == (9 * n + 1, 5 * n + 1, 13 * n + 1)
    assert mesh.grid_index is not None
    n_nodes = (5 * n + 1) * ((9 * n + 1) * (3 * n + 1) + (4 * n + 1) * 10 * n)
    assert len(np.unique(mesh.grid_index)) == mesh.n_nodes == n_nodes
    place = np.stack(np.unravel_index(mesh.grid_index, mesh.grid_shape), axis=1)
    spacing = np.array([WIDTH / 9, DEPTH / 5, HEIGHT / 13]) / n
    np.testing.assert_allclose(mesh.points, place * spacing, rtol=1e-12, atol=1e-12)


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
        ([9, 10], r"must be less than the 9 cells along x and the 13 along z; got \(9, 10\)"),
        ([5, 13], r"got \(5, 13\)"),
        ([0, 10], r"`geometry.cut_cells\[0\]` must be greater than or equal to 1; got 0"),
        ([5], r"`geometry.cut_cells\[1\]` is missing"),
    ],
)
def test_a_cut_that_leaves_no_l_shape_is_refused(cut: list[int], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        load_scene(content(geometry={"cut_cells": cut}))


def test_a_load_region_inside_the_body_is_refused() -> None:
    inner = {"sphere_m": [[6.3, 4.0, 6.2], 1.5]}
    with pytest.raises(SpecError, match="nodes inside the body only"):
        load_scene(content(loads={**content()["loads"], "region": inner}))


@pytest.fixture(scope="module")
def liver() -> Scene:
    return load_scene("liver-hex")


def test_forces_and_displacements_are_transferred_between_the_liver_and_its_grid(
    liver: Scene,
) -> None:
    points, shares = liver.patch_points(np.arange(200))
    weights, mesh, surface = liver.patch_weights, liver.mesh, liver.surface
    assert (weights.toarray() >= -1e-15).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=0, atol=1e-13)
    np.testing.assert_allclose(weights @ mesh.points, shares @ points, rtol=0, atol=1e-13)
    rng = np.random.default_rng(0)
    forces = rng.normal(size=(len(surface.points), 3))
    nodal = liver.to_surface.T @ forces
    moments = [
        np.cross(x, f).sum(axis=0) for x, f in ((surface.points, forces), (mesh.points, nodal))
    ]
    np.testing.assert_allclose(moments[0], moments[1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(nodal.sum(axis=0), forces.sum(axis=0), rtol=0, atol=1e-11)
    gradient, shift = rng.normal(size=(3, 3)), np.array([0.1, -0.2, 0.3])
    found = liver.to_surface @ (mesh.points @ gradient + shift)
    np.testing.assert_allclose(found, surface.points @ gradient + shift, rtol=0, atol=1e-12)


def test_the_liver_is_held_between_its_lobes_and_pressed_on_its_upper_half(liver: Scene) -> None:
    held = liver.mesh.points[liver.fixed_nodes]
    assert len(held) == 54
    assert np.ptp(held, axis=0).max() < 0.1
    assert liver.patch_centres[:, 2].min() >= 0
    distance = np.linalg.norm(liver.patch_centres[:, None] - held, axis=2).min(axis=1)
    assert distance.min() > np.sqrt(9e-4 / np.pi)
    outwards = liver.patch_centres - liver.surface.points.mean(axis=0)
    assert ((liver.patch_normals * outwards).sum(axis=1) > 0).mean() > 0.9


def test_the_two_liver_meshes_describe_the_same_body(liver: Scene) -> None:
    other = load_scene("liver-tet")
    assert other.mesh.cells.shape[1] == 4
    points = liver.surface.points
    expected = np.array([points.min(axis=0), points.max(axis=0)])
    np.testing.assert_allclose(other.mesh.bounds, expected, atol=5e-4)
    assert other.spec.grid_nodes == liver.mesh.grid_shape == (16, 15, 16)


def write_stl(path: Path, triangles: NDArray[np.float64]) -> str:
    numbers = np.arange(3 * len(triangles)).reshape(-1, 3)
    meshio.Mesh(triangles.reshape(-1, 3), [("triangle", numbers)]).write(path)
    return str(path)


def on_surface(surface: str, cells: list[int], unit_m: float = 1.0, **loads: Any) -> dict[str, Any]:
    """Return the L's scene with the voxels of another surface as a body."""
    geometry = {"shape": "voxels", "surface": surface, "cells": cells, "unit_m": unit_m}
    changed = content(supports=[{"region": "x-min"}], loads={**content()["loads"], **loads})
    return {**changed, "name": "body", "geometry": geometry}


def test_a_users_surface_becomes_a_scene_from_any_folder(tmp_path: Path) -> None:
    """The surface is a cube of 2 cm, in centimetres, with its lowest corner at (1, 0, 0)."""
    cube = box_mesh((2.0, 2.0, 2.0), (1, 1, 1))
    corners = triangles_of(np.add(cube.points, [1.0, 0, 0])[cube.boundary_facets])
    cubes, loads = [], {"patch_area_m2": 1e-4, "magnitude_n": [0.0, 1e-3], "region": "z-max"}
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        path = write_stl(tmp_path / folder / "cube.stl", corners)
        cubes.append(load_scene(on_surface(path, [3, 2, 2], 0.01, **loads)))
    first = cubes[0]
    np.testing.assert_allclose(first.mesh.bounds, [[0.01, 0, 0], [0.03, 0.02, 0.02]], atol=1e-15)
    assert first.mesh.n_cells == 12
    assert first.spec.digest() == cubes[1].spec.digest()
    load = np.zeros((first.mesh.n_nodes, 3))
    load[:, 0] = 1e-6
    answer = mor_bench.load_method("fem").fit(first, None).predict(load)
    assert 0 < np.abs(answer).max() < 0.01
    with pytest.raises(SpecError, match=r"nowhere.stl: no such file"):
        load_scene(on_surface("nowhere.stl", [3, 2, 2]))
    (tmp_path / "one" / "cube.stl").write_text("solid other")
    with pytest.raises(SpecError, match=r"cube.stl: the file has changed since the dataset was"):
        load_scene(first.spec)


SLOW = {"beam-fine", "liver-hex", "liver-tet"}
OTHERS = {
    "liver-hex-observed",
    "liver-grasped",
    "liver-pressed",
    "artery-pressure",
    "soft-arm",
}  # of liver-hex; no patches
QUICK = {*map(scene_of, list_suite("datasets"))} - SLOW - OTHERS


@pytest.mark.parametrize(
    "name", [*sorted(QUICK), *(pytest.param(n, marks=pytest.mark.slow) for n in sorted(SLOW))]
)
def test_every_load_patch_lies_on_the_surface_and_pushes_free_nodes(name: str) -> None:
    spec = load_generated_spec(name)
    for scene in map(load_scene, [spec, spec_of_set(spec, "unseen-regions")]):
        assert np.isin(scene.patch_nodes, scene.surface.facets).all()
        # The mean normal of a flat patch has length 1.
        sums = np.linalg.norm(scene.acting[0].patches.normal_sums(), axis=1)
        assert (sums / scene.acting[0].patches.areas.sum(axis=1)).min() > 0.6
        free = np.setdiff1d(np.arange(scene.mesh.n_nodes), scene.fixed_nodes)
        assert scene.patch_weights[:, free].sum(axis=1).min() > 0.2


def rod(n: int = 24) -> NDArray[np.float64]:
    """Return a rod of 0.2 m with two long triangles for each of n sides, as in CAD files."""
    angle = 2 * np.pi * np.arange(n) / n
    ring = 0.02 * np.stack([np.zeros(n), np.cos(angle), np.sin(angle)], axis=1)
    along, centre = np.array([0.2, 0.0, 0.0]), np.zeros(3)
    triangles = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        triangles += [(a, b + along, a + along), (a, b, b + along)]
        triangles += [(centre, b, a), (centre + along, a + along, b + along)]
    return np.array(triangles)


def test_patches_on_long_triangles_have_their_area_and_moment(tmp_path: Path) -> None:
    path, cells = write_stl(tmp_path / "rod.stl", rod()), [20, 5, 5]
    with pytest.raises(SpecError, match="the area of the load region"):
        load_scene(on_surface(path, cells, region="x-max", patch_area_m2=2e-3, kind="normal"))
    spec = on_surface(path, cells, region="surface", patch_area_m2=2e-4, kind="normal")
    scene = load_scene(spec)
    patches, surface = scene.acting[0].patches, scene.surface
    np.testing.assert_allclose(patches.areas.sum(axis=1), 2e-4, rtol=1e-12)
    points, shares = scene.patch_points(np.arange(len(scene.patch_nodes)))
    at_nodes = scene.patch_weights @ scene.mesh.points
    np.testing.assert_allclose(at_nodes, shares @ points, rtol=0, atol=1e-13)
    found = patches.values @ surface.points
    np.testing.assert_allclose(found, patches.points, rtol=0, atol=1e-15)
    area = area_of(surface.points[surface.facets])
    whole = cut_patches(surface, surface.facets, np.array([0]), area * (1 - 1e-9))
    assert whole.areas.sum() == pytest.approx(area, rel=1e-8)
