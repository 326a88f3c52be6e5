"""Meshes of other programs: read correctly in every format, or refused in one line."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import SpecError
from mor_bench.hard_cases.setups import of_order
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.files import read_mesh, read_triangles
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.scene import Scene
from mor_bench.scene.soundness import in_grid
from mor_bench.scene.triangle_distance import distances
from tests.mesh_writers import write_abaqus, write_gmsh, write_gmsh1, write_gmsh_reversed, write_vtk

SIZE, CELLS = (1.2, 0.4, 0.4), (6, 2, 2)
ELEMENTS: dict[str, dict[str, Any]] = {
    "hexahedron": {"element": "hexahedron"},
    "tetra": {"element": "tetrahedron"},
    "tetra10": {"element": "tetrahedron", "order": 2},
}


def content(**changes: Any) -> dict[str, Any]:
    """Return a small beam as a dict."""
    loads = {"region": "z-max", "kind": "force", "patch_area_m2": 0.05, "samples_per_patch": 1}
    return {
        "name": "beam",
        "geometry": {"shape": "box", "size_m": SIZE, "cells": CELLS},
        "material": {"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.4},
        "supports": [{"region": "x-min"}],
        "loads": {**loads, "magnitude_n": [0.5, 1.0]},
        "needs": {"error": 0.01, "latency_ms": 3.0},
        **changes,
    }


def of_file(
    path: Path, *, support: Any = "x-min", load: Any = "z-max", kind: str = "hexahedron"
) -> dict[str, Any]:
    """Return the beam with its mesh from a file in metres."""
    return content(
        geometry={"shape": "file", "file": str(path)},
        supports=[{"region": support}],
        loads={**content()["loads"], "region": load},
        discretisation=ELEMENTS[kind],
    )


def sides(mesh: Mesh) -> list[NDArray[np.int64]]:
    """Return the facets of the beam's sides x-min and z-max."""
    corners = mesh.points[mesh.boundary_facets]
    return [
        mesh.boundary_facets[np.isclose(corners[:, :, axis], at).all(axis=1)]
        for axis, at in ((0, 0.0), (2, 0.4))
    ]


@pytest.fixture(scope="module", params=[*ELEMENTS])
def beam(request: pytest.FixtureRequest) -> tuple[str, Mesh, meshio.Mesh]:
    """The beam's mesh, and its meshio mesh with shuffled nodes, two unused nodes and two sides."""
    kind = request.param
    mesh = of_order(box_mesh(SIZE, CELLS, kind != "hexahedron"), 2 if kind == "tetra10" else 1)
    order = np.random.default_rng(0).permutation(mesh.n_nodes)
    number = np.argsort(order)
    points = np.vstack([mesh.points[order], [[9.0, 9.0, 9.0], [8.0, 8.0, 8.0]]])
    flat = {"hexahedron": "quad", "tetra": "triangle", "tetra10": "triangle6"}[kind]
    cells = [(kind, number[mesh.cells]), *((flat, number[side]) for side in sides(mesh))]
    return kind, mesh, meshio.Mesh(points, cells)


FORMATS: dict[str, tuple[str, Callable[[meshio.Mesh, Path], None]]] = {
    "gmsh 1": ("msh", write_gmsh1),
    "gmsh 2.2 ascii": ("msh", write_gmsh("2.2", False)),
    "gmsh 2.2 binary": ("msh", write_gmsh("2.2", True)),
    "gmsh 4.1 ascii": ("msh", write_gmsh("4.1", False)),
    "gmsh 4.1 binary": ("msh", write_gmsh("4.1", True)),
    "gmsh 4.1 reversed": ("msh", write_gmsh_reversed),
    "abaqus": ("inp", write_abaqus),
    "vtu": ("vtu", write_vtk("vtu", True)),
    "vtk 5.1": ("vtk", write_vtk("vtk", True)),
    "vtk 4.2 ascii": ("vtk", write_vtk("vtk42", False)),
}


def solve(scene: Scene) -> NDArray[np.float64]:
    """Return displacements under a force on the patch at the tip, ordered by position."""
    patch = int(np.linalg.norm(scene.patch_centres - [1.2, 0.2, 0.4], axis=1).argmin())
    force = scene.patch_weights.toarray()[patch][:, None] * np.array([0.2, 0.3, -0.5])
    free = scene.free_dofs
    displacement = np.zeros(scene.mesh.n_dofs)
    displacement[free] = FullOrderModel(scene).solve(force.ravel()[free]).displacement
    assert np.abs(displacement).max() > 0.01
    return np.asarray(displacement.reshape(-1, 3)[np.lexsort(np.round(scene.mesh.points, 6).T)])


@pytest.fixture(scope="module")
def expected(beam: tuple[str, Mesh, meshio.Mesh]) -> NDArray[np.float64]:
    """The displacements of the original box."""
    return solve(mor_bench.load_scene(content(discretisation=ELEMENTS[beam[0]])))


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_solution_of_its_original_box(
    name: str,
    beam: tuple[str, Mesh, meshio.Mesh],
    expected: NDArray[np.float64],
    tmp_path: Path,
) -> None:
    kind, mesh, raw = beam
    suffix, write = FORMATS[name]
    path = tmp_path / f"beam.{suffix}"
    write(meshio.Mesh(1000 * raw.points, raw.cells), path)  # in millimetres
    left, top = ("1", "2") if name == "gmsh 1" else ("left", "top")
    sets = {"support": {"point_set": left}, "load": {"point_set": top}}
    spec = of_file(path, **sets, kind=kind)
    scene = mor_bench.load_scene({**spec, "geometry": {**spec["geometry"], "unit_m": 1e-3}})
    assert scene.mesh.cells.shape == mesh.cells.shape
    derivatives = element_of(scene.mesh.cells).derivatives
    assert (shape_gradients(scene.mesh.points, scene.mesh.cells, derivatives)[1] > 0).all()
    np.testing.assert_allclose(solve(scene), expected, rtol=0, atol=1e-7)


def test_nodes_are_numbered_for_a_small_bandwidth_and_the_grid_is_found(
    beam: tuple[str, Mesh, meshio.Mesh], tmp_path: Path
) -> None:
    _, mesh, raw = beam
    raw.write(tmp_path / "beam.vtu")
    read, _ = read_mesh(tmp_path / "beam.vtu", 1.0)
    band, before = (np.ptp(cells, axis=1).max() for cells in (read.cells, raw.cells[0].data))
    assert band == np.ptp(mesh.cells, axis=1).max() < before
    assert read.grid_shape == mesh.grid_shape
    np.testing.assert_array_equal(read.grid_index, mesh.grid_index)


def test_only_a_regular_grid_is_recognised_as_one() -> None:
    mesh = replace(box_mesh(SIZE, CELLS), grid_shape=None, grid_index=None)
    assert in_grid(mesh).grid_shape == (7, 3, 3)
    uneven = mesh.points + 0.02 * np.sin(2 * np.pi / 1.2 * mesh.points * [1, 0, 0])
    coarse = box_mesh(SIZE, (6, 1, 1))
    for points, other in ((np.add(coarse.points, [1.4, 0, 0]), coarse), (mesh.points, mesh)):
        cells = np.vstack([mesh.cells, other.cells + mesh.n_nodes])
        assert in_grid(Mesh(np.vstack([mesh.points, points]), cells)).grid_shape is None
    assert in_grid(replace(mesh, points=uneven)).grid_shape is None


HEX = box_mesh((2.0, 1.0, 1.0), (2, 1, 1))


@pytest.mark.parametrize(
    "line", ["*NODE, NSET=held", "*Node,nset=held", "*NODE, INPUT=, NSET = held"]
)
def test_a_set_in_the_node_line_of_abaqus_holds_all_its_nodes(line: str, tmp_path: Path) -> None:
    rows = [f"{i + 1}, {x:g}, {y:g}, {z:g}" for i, (x, y, z) in enumerate(HEX.points)]
    cells = [", ".join(str(n) for n in (i + 1, *(cell + 1))) for i, cell in enumerate(HEX.cells)]
    lines = [line, *rows, "*ELEMENT, TYPE=C3D8", *cells, "*NSET, NSET=left", "1, 2,", "3, 4", ""]
    (tmp_path / "m.inp").write_text("\n".join(lines))
    found = {name: [*nodes] for name, nodes in read_mesh(tmp_path / "m.inp", 1.0)[1].items()}
    assert found == {"held": list(range(12)), "left": [0, 1, 2, 3]}


def test_groups_with_the_same_number_are_named_by_dimension(tmp_path: Path) -> None:
    mesh = box_mesh(SIZE, CELLS)
    blocks = [("hexahedron", mesh.cells), *(("quad", side) for side in sides(mesh))]
    tags = [np.full(len(block), tag) for (_, block), tag in zip(blocks, (1, 1, 2), strict=True)]
    data = {"gmsh:physical": tags, "gmsh:geometrical": [*tags]}
    raw = meshio.Mesh(mesh.points, blocks, cell_data=data)
    meshio.gmsh.write(tmp_path / "m.msh", raw, fmt_version="2.2", binary=False)
    read, sets = read_mesh(tmp_path / "m.msh", 1.0)
    assert {n: len(nodes) for n, nodes in sets.items()} == {"surface 1": 9, "volume 1": 63, "2": 21}
    np.testing.assert_array_equal(sets["surface 1"], np.flatnonzero(read.points[:, 0] == 0.0))
    with pytest.raises(SpecError, match=r"unknown point set '1'\. Known: surface 1, volume 1, 2"):
        mor_bench.load_scene(of_file(tmp_path / "m.msh", support={"point_set": "1"}))


def test_inverted_cells_are_reoriented(beam: tuple[str, Mesh, meshio.Mesh], tmp_path: Path) -> None:
    kind, mesh, _ = beam
    mirrored, some = mesh.points * [1, 1, -1] + [0, 0, 0.4], mesh.cells.copy()
    if kind != "hexahedron":
        some[::3] = some[::3][:, [1, 0, 2, 3, 4, 6, 5, 8, 7, 9][: some.shape[1]]]
    for points, cells in ((mirrored, mesh.cells), (mesh.points, some)):
        meshio.Mesh(points, [(kind, cells)]).write(tmp_path / "mesh.vtk")
        read, _ = read_mesh(tmp_path / "mesh.vtk", 1.0)
        element = element_of(read.cells)
        volumes = shape_gradients(read.points, read.cells, element.derivatives)[1] * element.weights
        assert float(volumes.sum()) == pytest.approx(1.2 * 0.4 * 0.4)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two files in decimetres: the beam, and a plane just above it."""
    mesh = box_mesh(SIZE, CELLS)
    top = (mesh.points[:, 2] > 0.39).astype(int)
    data = {"top": top, "temperature": mesh.points[:, 0]}
    meshio.Mesh(mesh.points, [("hexahedron", mesh.cells)], data).write(tmp_path / "beam.vtu")
    plane = np.array([[-10.0, -10.0, 4.1], [30, -10, 4.1], [30, 30, 4.1], [-10, 30, 4.1]])
    meshio.Mesh(plane, [("triangle", [[0, 1, 2], [0, 2, 3]])]).write(tmp_path / "plane.stl")
    meshio.Mesh(plane, [("quad", [[0, 1, 2, 3]])]).write(tmp_path / "plane.obj")
    return tmp_path


def near(surface: str, within_m: float) -> dict[str, Any]:
    return {"near_surface": surface, "within_m": within_m, "unit_m": 0.1}


def placed(region: dict[str, Any], folder: Path) -> dict[str, Any]:
    return {k: str(folder / v) if k == "near_surface" else v for k, v in region.items()}


def at_top(x: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(x[:, 2] > 0.39)


def around(
    centre: list[float], radius: float
) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
    return lambda x: np.asarray(np.linalg.norm(x - centre, axis=1) < radius)


REGIONS: list[tuple[dict[str, Any], Callable[[NDArray[np.float64]], NDArray[np.bool_]]]] = [
    ({"box_m": [[-1.0, -1.0, 0.39], [9.0, 9.0, 9.0]]}, at_top),
    ({"sphere_m": [[1.2, 0.2, 0.4], 0.45]}, around([1.2, 0.2, 0.4], 0.4501)),
    ({"nearest_m": [[1.2, 0.2, 0.6], 6]}, around([1.2, 0.2, 0.6], 0.35)),
    ({"point_set": "top"}, at_top),
    (near("plane.stl", 0.05), at_top),
    (near("plane.obj", 0.05), at_top),
]


@pytest.mark.parametrize(("region", "inside"), REGIONS)
def test_every_region_can_hold_supports_and_loads(
    region: dict[str, Any], inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]], folder: Path
) -> None:
    region = placed(region, folder)
    held = mor_bench.load_scene(of_file(folder / "beam.vtu", support=region, load="z-min"))
    chosen = np.flatnonzero(inside(held.mesh.points))
    np.testing.assert_array_equal(held.fixed_nodes, chosen)
    pushed = mor_bench.load_scene(of_file(folder / "beam.vtu", load=region))
    on_surface = np.intersect1d(chosen, pushed.mesh.boundary_facets)
    np.testing.assert_array_equal(pushed.patch_nodes, on_surface)
    assert set(pushed.patch_weights.indices) <= set(on_surface)


EMPTY: list[tuple[dict[str, Any], str]] = [
    ({"box_m": [[5.0, 5.0, 5.0], [6.0, 6.0, 6.0]]}, "holds no node of the mesh"),
    ({"sphere_m": [[5.0, 5.0, 5.0], 0.1]}, "holds no node of the mesh"),
    ({"nearest_m": [[1.2, 0.2, 0.5], 1000]}, r"`nearest_m` must ask for at most 58 nodes"),
    ({"point_set": "tpo"}, r"unknown point set 'tpo'. Known: top\."),
    (near("plane.stl", 0.005), "holds no node of the mesh"),
    (near("plain.stl", 0.1), r"plain.stl: no such file"),
    (near("beam.vtu", 0.1), r"must be an .stl or .obj file; got '.vtu'"),
]


@pytest.mark.parametrize(("region", "message"), EMPTY)
@pytest.mark.parametrize("where", ["support", "load"])
def test_empty_and_unknown_regions_give_an_error_that_names_them(
    region: dict[str, Any], message: str, where: str, folder: Path
) -> None:
    region = placed(region, folder)
    here, there = (region, "z-max") if where == "support" else ("x-min", region)
    with pytest.raises(SpecError, match=message) as caught:
        mor_bench.load_scene(of_file(folder / "beam.vtu", support=here, load=there))
    assert "\n" not in str(caught.value)


def test_an_element_other_than_that_of_the_file_is_refused(folder: Path) -> None:
    message = "must be 'hexahedron', as in the mesh; got 'tetrahedron'"
    with pytest.raises(SpecError, match=message):
        mor_bench.load_scene(of_file(folder / "beam.vtu", kind="tetra"))


def test_middles_are_added_to_a_file_without_them_and_needed_where_a_file_has_them(
    tmp_path: Path,
) -> None:
    linear = box_mesh(SIZE, CELLS, tetrahedra=True)
    whole = of_order(linear, 2)
    meshio.Mesh(linear.points, [("tetra", linear.cells)]).write(tmp_path / "linear.vtu")
    meshio.Mesh(whole.points, [("tetra10", whole.cells)]).write(tmp_path / "whole.vtu")
    made, read = (
        mor_bench.load_scene(of_file(tmp_path / f"{name}.vtu", kind="tetra10"))
        for name in ("linear", "whole")
    )
    np.testing.assert_array_equal(made.mesh.points, read.mesh.points)
    np.testing.assert_allclose(solve(made), solve(read), rtol=0, atol=1e-9)
    with pytest.raises(
        SpecError, match=r"`discretisation\.order` must be 2, as in the mesh; got 1"
    ):
        mor_bench.load_scene(of_file(tmp_path / "whole.vtu", kind="tetra"))


def test_the_distance_to_a_triangle_is_that_to_its_nearest_sample_point() -> None:
    """Sample random triangles densely. One of them is a needle without area."""
    generator = np.random.default_rng(1)
    corners = generator.normal(size=(4, 3, 3))
    corners[3, 2] = 0.25 * corners[3, 0] + 0.75 * corners[3, 1]
    points, n = 2 * generator.normal(size=(40, 3)), 300
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
    weights = np.stack([i, j, n - i - j], axis=1)[i + j <= n] / n
    for triangle in corners:
        sampled = weights @ triangle
        expected = np.array([np.linalg.norm(sampled - point, axis=1).min() for point in points])
        found = distances(triangle[None], points)
        np.testing.assert_allclose(found, expected, atol=4e-2)
        assert (found <= expected + 1e-12).all()
    least = np.min([distances(c[None], points) for c in corners], axis=0)
    np.testing.assert_allclose(distances(corners, points), least, rtol=1e-14)
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    points = np.array([[0.2, 0.2, 0.7], [2.0, 0, 0], [1.0, 1, 0]])
    assert distances(triangle, points) == pytest.approx([0.7, 1.0, np.sqrt(0.5)])


def test_a_missing_or_changed_file_gives_an_error_that_names_it(folder: Path) -> None:
    with pytest.raises(SpecError, match=r"`geometry.file`: .*nowhere.vtu: no such file; got"):
        mor_bench.load_scene(of_file(folder / "nowhere.vtu"))
    with pytest.raises(SpecError, match="no such file"):
        read_mesh(folder / "nowhere.vtu", 1.0)
    with pytest.raises(SpecError, match="Is a directory"):
        read_mesh(folder, 1.0)
    spec = mor_bench.load_scene(of_file(folder / "beam.vtu")).spec
    (folder / "beam.vtu").write_bytes(b"other")
    with pytest.raises(SpecError, match="has changed since"):
        mor_bench.load_scene(spec)


def test_a_truncated_binary_surface_is_refused_in_one_line(folder: Path) -> None:
    path, corners = folder / "half.stl", np.random.default_rng(0).random((60, 3))
    triangles = np.arange(60).reshape(20, 3)
    meshio.Mesh(corners, [("triangle", triangles)]).write(path, binary=True)
    whole = path.read_bytes()
    assert read_triangles(path, 1.0).shape == (20, 3, 3)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SpecError, match=r"half.stl: cannot be read as STL: it is neither text nor"):
        read_triangles(path, 1.0)


def test_files_are_closed_after_reading(folder: Path) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_triangles(folder / "plane.stl", 1.0)
        gc.collect()
    assert not [warning for warning in caught if warning.category is ResourceWarning]
