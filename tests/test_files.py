"""Meshes of other programs: read as they are, whatever the format, or refused in one line."""

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
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.files import read_mesh, read_triangles
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.scene import Scene
from mor_bench.scene.soundness import in_grid
from mor_bench.scene.triangle_distance import distances

SIZE, CELLS = (1.2, 0.4, 0.4), (6, 2, 2)


def content(**changes: Any) -> dict[str, Any]:
    """A small beam as a dict, to be changed."""
    return {
        "name": "beam",
        "geometry": {"shape": "box", "size_m": SIZE, "cells": CELLS},
        "material": {"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.4},
        "supports": [{"region": "x-min"}],
        "loads": {
            "region": "z-max",
            "kind": "force",
            "patch_area_m2": 0.05,
            "samples_per_patch": 1,
            "magnitude_n": [0.5, 1.0],
        },
        "needs": {"error": 0.01, "latency_ms": 3.0},
        **changes,
    }


def of_file(
    path: Path,
    *,
    support: Any = "x-min",
    load: Any = "z-max",
    element: str = "hexahedron",
    unit_m: float = 1.0,
) -> dict[str, Any]:
    """The beam with its mesh from a file, as a dict."""
    file = {"shape": "file", "file": str(path), "unit_m": unit_m}
    loads = {**content()["loads"], "region": load}
    return content(
        geometry=file,
        supports=[{"region": support}],
        loads=loads,
        discretisation={"element": element},
    )


@pytest.fixture(scope="module", params=["hexahedron", "tetra"])
def beam(request: pytest.FixtureRequest) -> tuple[str, Mesh, meshio.Mesh]:
    """The beam's mesh, and as meshio's with shuffled nodes, two nodes that no cell uses, and the faces of two sides."""
    kind = request.param
    mesh = box_mesh(SIZE, CELLS, kind == "tetra")
    order = np.random.default_rng(0).permutation(mesh.n_nodes)
    number = np.argsort(order)
    points = np.vstack([mesh.points[order], [[9.0, 9.0, 9.0], [8.0, 8.0, 8.0]]])
    flat = "quad" if kind == "hexahedron" else "triangle"
    sides = [
        mesh.boundary_facets[np.isclose(mesh.points[mesh.boundary_facets, axis], at).all(axis=1)]
        for axis, at in ((0, 0.0), (2, 0.4))
    ]
    cells = [(kind, number[mesh.cells]), *((flat, number[side]) for side in sides)]
    return kind, mesh, meshio.Mesh(points, cells)


def masks(raw: meshio.Mesh) -> dict[str, NDArray[np.int64]]:
    """1 at the nodes of each side, 0 elsewhere."""
    return {
        name: np.isin(np.arange(len(raw.points)), block.data).astype(int)
        for name, block in zip(("left", "top"), raw.cells[1:], strict=True)
    }


def write_gmsh(raw: meshio.Mesh, path: Path, version: str, binary: bool) -> None:
    # A body and one of its faces may have the same number.
    numbers = [np.full(len(block), tag) for block, tag in zip(raw.cells, (1, 1, 2), strict=True)]
    fields = {"body": np.array([1, 3]), "left": np.array([1, 2]), "top": np.array([2, 2])}
    data = {"gmsh:physical": numbers, "gmsh:geometrical": [n.copy() for n in numbers]}
    tags = np.tile([3, 1], (len(raw.points), 1))
    for entity, block in zip((1, 2), raw.cells[1:], strict=True):
        tags[block.data] = 2, entity
    point_data = {"gmsh:dim_tags": tags} if version == "4.1" else {}
    mesh = meshio.Mesh(
        raw.points, raw.cells, cell_data=data, field_data=fields, point_data=point_data
    )
    meshio.gmsh.write(path, mesh, fmt_version=version, binary=binary)


def write_gmsh_reversed(raw: meshio.Mesh, path: Path) -> None:
    """Gmsh gives the number of a group with a minus to a surface that the group holds turned over."""
    write_gmsh(raw, path, "4.1", False)
    lines = path.read_text().splitlines()
    first = (
        lines.index("$Entities") + 2
    )  # surface 1: its number, its box, how many groups, the groups
    words = lines[first].split()
    assert words[:1] + words[7:9] == ["1", "1", "1"]
    lines[first] = " ".join([*words[:8], "-1", *words[9:]])
    path.write_text("\n".join([*lines, ""]))


def write_gmsh1(raw: meshio.Mesh, path: Path) -> None:
    """By hand, from the manual: nodes and elements are numbered with gaps."""
    types = {"hexahedron": 5, "tetra": 4, "quad": 3, "triangle": 2}
    lines = [
        "$NOD",
        str(len(raw.points)),
        *(f"{3 * i + 5} {x:.17g} {y:.17g} {z:.17g}" for i, (x, y, z) in enumerate(raw.points)),
        "$ENDNOD",
    ]
    elements = [
        (types[block.type], tag, row)
        for block, tag in zip(raw.cells, (7, 1, 2), strict=True)
        for row in block.data
    ]
    lines += ["$ELM", str(len(elements))]
    lines += [
        f"{2 * i + 1} {kind} {tag} {tag} {len(row)} {' '.join(str(3 * n + 5) for n in row)}"
        for i, (kind, tag, row) in enumerate(elements)
    ]
    path.write_text("\n".join([*lines, "$ENDELM", ""]))


def write_abaqus(raw: meshio.Mesh, path: Path) -> None:
    """By hand: a point set, and a set in the second of three ELEMENT lines of which the first has none."""
    names = {"hexahedron": "C3D8", "tetra": "C3D4", "quad": "S4", "triangle": "S3"}
    lines = [
        "*HEADING",
        "*NODE",
        *(f"{10 + i}, {x:.17g}, {y:.17g}, {z:.17g}" for i, (x, y, z) in enumerate(raw.points)),
    ]
    first = 1
    for block, extra in zip(raw.cells, ("", ", ELSET=left", ""), strict=True):
        lines += [f"*ELEMENT, TYPE={names[block.type]}{extra}"]
        lines += [
            f"{first + i}, " + ", ".join(str(10 + n) for n in row)
            for i, row in enumerate(block.data)
        ]
        first += len(block.data)
    lines += ["*NSET, NSET=top", *(f"{10 + n}," for n in np.unique(raw.cells[2].data))]
    path.write_text("\n".join([*lines, ""]))


def write_vtk(file_format: str, binary: bool) -> Callable[[meshio.Mesh, Path], None]:
    def write(raw: meshio.Mesh, path: Path) -> None:
        meshio.Mesh(raw.points, raw.cells[:1], point_data=masks(raw)).write(
            path, file_format=file_format, binary=binary
        )

    return write


FORMATS: dict[str, tuple[str, Callable[[meshio.Mesh, Path], None], str, str]] = {
    "gmsh 1": ("msh", write_gmsh1, "1", "2"),
    "gmsh 2.2 ascii": ("msh", lambda raw, path: write_gmsh(raw, path, "2.2", False), "left", "top"),
    "gmsh 2.2 binary": ("msh", lambda raw, path: write_gmsh(raw, path, "2.2", True), "left", "top"),
    "gmsh 4.1 ascii": ("msh", lambda raw, path: write_gmsh(raw, path, "4.1", False), "left", "top"),
    "gmsh 4.1 with a reversed surface": ("msh", write_gmsh_reversed, "left", "top"),
    "gmsh 4.1 binary": ("msh", lambda raw, path: write_gmsh(raw, path, "4.1", True), "left", "top"),
    "abaqus": ("inp", write_abaqus, "left", "top"),
    "vtu": ("vtu", write_vtk("vtu", True), "left", "top"),
    "vtk 5.1": ("vtk", write_vtk("vtk", True), "left", "top"),
    "vtk 4.2 ascii": ("vtk", write_vtk("vtk42", False), "left", "top"),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_answer_of_the_box_it_came_from(
    name: str, beam: tuple[str, Mesh, meshio.Mesh], tmp_path: Path
) -> None:
    kind, mesh, raw = beam
    suffix, write, left, top = FORMATS[name]
    path = tmp_path / f"beam.{suffix}"
    millimetres = meshio.Mesh(1000 * raw.points, raw.cells)
    write(millimetres, path)
    element = "hexahedron" if kind == "hexahedron" else "tetrahedron"
    scene = mor_bench.load_scene(
        of_file(
            path, support={"point_set": left}, load={"point_set": top}, element=element, unit_m=1e-3
        )
    )
    reference = mor_bench.load_scene(content(discretisation={"element": element}))
    assert scene.mesh.cells.shape == mesh.cells.shape
    _, det_j = shape_gradients(
        scene.mesh.points, scene.mesh.cells, element_of(scene.mesh.cells).derivatives
    )
    assert (det_j > 0).all()
    np.testing.assert_allclose(solve(scene), solve(reference), rtol=0, atol=1e-7)


def solve(scene: Scene) -> NDArray[np.float64]:
    """Displacements under a force on the patch at the tip, by position."""
    patch = int(np.linalg.norm(scene.patch_centres - [1.2, 0.2, 0.4], axis=1).argmin())
    force = scene.patch_weights.toarray()[patch][:, None] * np.array([0.2, 0.3, -0.5])
    displacement = np.zeros(scene.mesh.n_dofs)
    displacement[scene.free_dofs] = (
        FullOrderModel(scene).solve(force.ravel()[scene.free_dofs]).displacement
    )
    assert np.abs(displacement).max() > 0.01
    return np.asarray(displacement.reshape(-1, 3)[np.lexsort(np.round(scene.mesh.points, 6).T)])


def test_nodes_are_numbered_for_a_small_band_and_the_grid_is_seen(
    beam: tuple[str, Mesh, meshio.Mesh], tmp_path: Path
) -> None:
    _, mesh, raw = beam
    raw.write(tmp_path / "beam.vtu")
    read, _ = read_mesh(tmp_path / "beam.vtu", 1.0)
    assert (
        np.ptp(read.cells, axis=1).max()
        == np.ptp(mesh.cells, axis=1).max()
        < np.ptp(raw.cells[0].data, axis=1).max()
    )
    assert read.grid_shape == mesh.grid_shape
    np.testing.assert_array_equal(read.grid_index, mesh.grid_index)


def test_what_is_no_regular_grid_is_not_taken_for_one() -> None:
    mesh = replace(box_mesh(SIZE, CELLS), grid_shape=None, grid_index=None)
    assert in_grid(mesh).grid_shape == (7, 3, 3)
    uneven = mesh.points + 0.02 * np.sin(2 * np.pi / 1.2 * mesh.points * [1, 0, 0])
    assert in_grid(replace(mesh, points=uneven)).grid_shape is None
    coarse = box_mesh(SIZE, (6, 1, 1))
    both = Mesh(
        np.vstack([mesh.points, coarse.points + np.array([1.4, 0.0, 0.0])]),
        np.vstack([mesh.cells, coarse.cells + mesh.n_nodes]),
    )
    assert in_grid(both).grid_shape is None
    doubled = Mesh(
        np.vstack([mesh.points, mesh.points]), np.vstack([mesh.cells, mesh.cells + mesh.n_nodes])
    )
    assert in_grid(doubled).grid_shape is None


@pytest.mark.parametrize(
    "line", ["*NODE, NSET=held", "*Node,nset=held", "*NODE, INPUT=, NSET = held"]
)
def test_a_set_in_the_line_of_abaqus_nodes_holds_them_all(line: str, tmp_path: Path) -> None:
    rows = [f"{i + 1}, {x:g}, {y:g}, {z:g}" for i, (x, y, z) in enumerate(HEX.points)]
    cells = [", ".join(str(n) for n in (i + 1, *(cell + 1))) for i, cell in enumerate(HEX.cells)]
    text = "\n".join(
        [line, *rows, "*ELEMENT, TYPE=C3D8", *cells, "*NSET, NSET=left", "1, 2,", "3, 4", ""]
    )
    (tmp_path / "m.inp").write_text(text)
    _, sets = read_mesh(tmp_path / "m.inp", 1.0)
    assert {name: nodes.tolist() for name, nodes in sets.items()} == {
        "held": list(range(12)),
        "left": [0, 1, 2, 3],
    }


def test_groups_of_one_number_are_told_apart_by_dimension(tmp_path: Path) -> None:
    mesh = box_mesh(SIZE, CELLS)
    sides = [
        mesh.boundary_facets[np.isclose(mesh.points[mesh.boundary_facets, axis], at).all(axis=1)]
        for axis, at in ((0, 0.0), (2, 0.4))
    ]
    blocks = [("hexahedron", mesh.cells), *(("quad", side) for side in sides)]
    data = {
        name: [np.full(len(block), tag) for (_, block), tag in zip(blocks, (1, 1, 2), strict=True)]
        for name in ("gmsh:physical", "gmsh:geometrical")
    }
    meshio.gmsh.write(
        tmp_path / "m.msh",
        meshio.Mesh(mesh.points, blocks, cell_data=data),
        fmt_version="2.2",
        binary=False,
    )
    read, sets = read_mesh(tmp_path / "m.msh", 1.0)
    assert {name: len(nodes) for name, nodes in sets.items()} == {
        "surface 1": 9,
        "volume 1": 63,
        "2": 21,
    }
    np.testing.assert_array_equal(sets["surface 1"], np.flatnonzero(read.points[:, 0] == 0.0))
    with pytest.raises(SpecError, match=r"unknown point set '1'\. Known: surface 1, volume 1, 2"):
        mor_bench.load_scene(of_file(tmp_path / "m.msh", support={"point_set": "1"}))


def test_inverted_cells_are_turned_over(
    beam: tuple[str, Mesh, meshio.Mesh], tmp_path: Path
) -> None:
    kind, mesh, _ = beam
    mirrored = mesh.points * [1, 1, -1] + [0, 0, 0.4]
    some = mesh.cells.copy()
    some[::3] = some[::3][:, [1, 0, 2, 3]] if kind == "tetra" else some[::3]
    for points, cells in ((mirrored, mesh.cells), (mesh.points, some)):
        meshio.Mesh(points, [(kind, cells)]).write(tmp_path / "mesh.vtk")
        read, _ = read_mesh(tmp_path / "mesh.vtk", 1.0)
        volumes = shape_gradients(read.points, read.cells, element_of(read.cells).derivatives)[1]
        weights = element_of(read.cells).weights
        assert float((volumes * weights).sum()) == pytest.approx(1.2 * 0.4 * 0.4)


PLANE = np.array([[-1.0, -1.0, 0.41], [3.0, -1.0, 0.41], [3.0, 3.0, 0.41], [-1.0, 3.0, 0.41]])


def write_plane(path: Path) -> Path:
    """A plane just above the beam, in decimetres, as two triangles or a polygon of four."""
    cells = (
        [("quad", [[0, 1, 2, 3]])]
        if path.suffix == ".obj"
        else [("triangle", [[0, 1, 2], [0, 2, 3]])]
    )
    meshio.Mesh(10 * PLANE, cells).write(path)
    return path


REGIONS: list[tuple[dict[str, Any], Callable[[NDArray[np.float64]], NDArray[np.bool_]]]] = [
    ({"box_m": [[-1.0, -1.0, 0.39], [9.0, 9.0, 9.0]]}, lambda x: x[:, 2] > 0.39),
    (
        {"sphere_m": [[1.2, 0.2, 0.4], 0.45]},
        lambda x: np.linalg.norm(x - [1.2, 0.2, 0.4], axis=1) < 0.4501,
    ),
    (
        {"nearest_m": [[1.2, 0.2, 0.6], 6]},
        lambda x: np.linalg.norm(x - [1.2, 0.2, 0.6], axis=1) < 0.35,
    ),
    ({"point_set": "top"}, lambda x: x[:, 2] > 0.39),
    ({"near_surface": "plane.stl", "within_m": 0.05, "unit_m": 0.1}, lambda x: x[:, 2] > 0.39),
    ({"near_surface": "plane.obj", "within_m": 0.05, "unit_m": 0.1}, lambda x: x[:, 2] > 0.39),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the beam and the plane above it."""
    mesh = box_mesh(SIZE, CELLS)
    top = (mesh.points[:, 2] > 0.39).astype(int)
    meshio.Mesh(
        mesh.points,
        [("hexahedron", mesh.cells)],
        point_data={"top": top, "temperature": mesh.points[:, 0]},
    ).write(tmp_path / "beam.vtu")
    for name in ("plane.stl", "plane.obj"):
        write_plane(tmp_path / name)
    return tmp_path


def placed(region: dict[str, Any], folder: Path) -> dict[str, Any]:
    return {
        **region,
        **(
            {"near_surface": str(folder / region["near_surface"])}
            if "near_surface" in region
            else {}
        ),
    }


@pytest.mark.parametrize(("region", "inside"), REGIONS)
def test_every_region_holds_supports_and_loads(
    region: dict[str, Any], inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]], folder: Path
) -> None:
    held = mor_bench.load_scene(
        of_file(folder / "beam.vtu", support=placed(region, folder), load="z-min")
    )
    np.testing.assert_array_equal(held.fixed_nodes, np.flatnonzero(inside(held.mesh.points)))
    pushed = mor_bench.load_scene(of_file(folder / "beam.vtu", load=placed(region, folder)))
    expected = np.intersect1d(
        np.flatnonzero(inside(pushed.mesh.points)), pushed.mesh.boundary_facets
    )
    np.testing.assert_array_equal(pushed.patch_nodes, expected)
    assert set(pushed.patch_weights.indices) <= set(expected)


EMPTY: list[tuple[dict[str, Any], str]] = [
    ({"box_m": [[5.0, 5.0, 5.0], [6.0, 6.0, 6.0]]}, "holds no node of the mesh"),
    ({"sphere_m": [[5.0, 5.0, 5.0], 0.1]}, "holds no node of the mesh"),
    ({"nearest_m": [[1.2, 0.2, 0.5], 1000]}, r"`nearest_m` must ask for at most 58 nodes"),
    ({"point_set": "tpo"}, r"unknown point set 'tpo'. Known: top\."),
    ({"near_surface": "plane.stl", "within_m": 0.005, "unit_m": 0.1}, "holds no node of the mesh"),
    ({"near_surface": "plain.stl", "within_m": 0.1}, r"plain.stl: no such file"),
    ({"near_surface": "beam.vtu", "within_m": 0.1}, r"must be an .stl or .obj file; got '.vtu'"),
]


@pytest.mark.parametrize(("region", "message"), EMPTY)
@pytest.mark.parametrize("where", ["support", "load"])
def test_empty_and_unknown_regions_are_named(
    region: dict[str, Any], message: str, where: str, folder: Path
) -> None:
    here = placed(region, folder)
    source = (
        of_file(folder / "beam.vtu", support=here)
        if where == "support"
        else of_file(folder / "beam.vtu", load=here)
    )
    with pytest.raises(SpecError, match=message) as caught:
        mor_bench.load_scene(source)
    assert "\n" not in str(caught.value)


def test_the_element_must_be_that_of_the_file(folder: Path) -> None:
    with pytest.raises(
        SpecError,
        match=r"`discretisation.element` must be 'hexahedron', as in the mesh; got 'tetrahedron'",
    ):
        mor_bench.load_scene(of_file(folder / "beam.vtu", element="tetrahedron"))


def test_distance_from_a_triangle() -> None:
    """Against distances from a million points of random triangles, and one that is a needle without area."""
    generator = np.random.default_rng(1)
    corners = generator.normal(size=(4, 3, 3))
    corners[3, 2] = 0.25 * corners[3, 0] + 0.75 * corners[3, 1]
    points = 2 * generator.normal(size=(40, 3))
    n = 600
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
    weights = np.stack([i, j, n - i - j], axis=1)[i + j <= n] / n
    for triangle in corners:
        sampled = weights @ triangle
        expected = np.array([np.linalg.norm(sampled - point, axis=1).min() for point in points])
        np.testing.assert_allclose(distances(triangle[None], points), expected, atol=2e-2)
        assert (distances(triangle[None], points) <= expected + 1e-12).all()
    np.testing.assert_allclose(
        distances(corners, points),
        np.min([distances(c[None], points) for c in corners], axis=0),
        rtol=1e-14,
    )
    assert distances(
        np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]),
        np.array([[0.2, 0.2, 0.7], [2.0, 0, 0], [1.0, 1, 0]]),
    ) == pytest.approx([0.7, 1.0, np.sqrt(0.5)])


HEX = box_mesh((2.0, 1.0, 1.0), (2, 1, 1))
TET = box_mesh((2.0, 1.0, 1.0), (2, 1, 1), tetrahedra=True)
GMSH1 = (
    "$NOD\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n$ENDNOD\n$ELM\n1\n1 4 1 1 4 1 2 3 4\n$ENDELM\n"
)


def nan_point() -> meshio.Mesh:
    points = HEX.points.copy()
    points[3, 1] = np.nan
    return meshio.Mesh(points, [("hexahedron", HEX.cells)])


def one_inside_out() -> meshio.Mesh:
    return meshio.Mesh(
        HEX.points,
        [("hexahedron", np.vstack([HEX.cells[:1], HEX.cells[1:, [4, 5, 6, 7, 0, 1, 2, 3]]]))],
    )


def folded() -> meshio.Mesh:
    return meshio.Mesh(
        HEX.points,
        [("hexahedron", np.vstack([HEX.cells[:1], HEX.cells[1:, [1, 0, 2, 3, 4, 5, 6, 7]]]))],
    )


def flat_tetrahedron() -> meshio.Mesh:
    cells = TET.cells.copy()
    cells[5, 3] = cells[5, 2]
    return meshio.Mesh(TET.points, [("tetra", cells)])


def two_parts(shift: float) -> meshio.Mesh:
    points, n = np.vstack([HEX.points, HEX.points + np.array([shift, 0.0, 0.0])]), HEX.n_nodes
    return meshio.Mesh(points, [("hexahedron", np.vstack([HEX.cells, HEX.cells + n]))])


def hinge(kind: str, at: str) -> meshio.Mesh:
    """Two of the eight blocks of a cube, which have an edge or a node in common."""
    cube = box_mesh((2.0, 2.0, 2.0), (2, 2, 2), kind == "tetra")
    centres = cube.points[cube.cells].mean(axis=1) > 1.0
    blocks = (
        centres.sum(axis=1) == 0,
        centres[:, :2].all(axis=1) & (centres[:, 2] == (at == "node")),
    )
    return meshio.Mesh(cube.points, [(kind, cube.cells[blocks[0] | blocks[1]])])


def overlapping() -> meshio.Mesh:
    """Three tetrahedra on one face."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.1, 0.1, 2], [0.1, 0.1, -1]])
    return meshio.Mesh(points, [("tetra", np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 2, 1, 5]]))])


def on_one_side(kind: str) -> meshio.Mesh:
    """A cell, and one that is twice as high on the same face; both are turned outwards."""
    mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1), kind == "tetra")
    cell = mesh.cells[0]
    higher = cell.copy()
    apex = np.flatnonzero(mesh.points[cell, 2] == 1.0) if kind == "hexahedron" else np.array([3])
    higher[apex] = mesh.n_nodes + np.arange(len(apex))
    points = np.vstack([mesh.points, mesh.points[cell[apex]] + [0.0, 0.0, 1.0]])
    return meshio.Mesh(points, [(kind, np.vstack([cell, higher]))])


MIXED = meshio.Mesh(
    np.vstack([HEX.points, [[3.0, 0.5, 0.5]]]),
    [
        ("hexahedron", HEX.cells),
        ("pyramid", np.array([[8, 9, 11, 10, 12]])),
        ("tetra", np.array([[8, 9, 10, 12]])),
    ],
)
BAD: list[tuple[str, str | bytes | meshio.Mesh, str]] = [
    ("mesh.vtu", nan_point(), r"positions must be finite; point 3 \(counted from 0\) is not"),
    ("mesh.vtu", one_inside_out(), r"1 of 2 hexahedra are inside out, the first is cell 1"),
    ("mesh.vtu", folded(), r"cell 1 \(counted from 0\) is flat or folded"),
    ("mesh.vtu", flat_tetrahedron(), r"cell 5 \(counted from 0\) is flat or folded"),
    (
        "mesh.vtu",
        two_parts(2.0),
        r"4 nodes coincide with others, as at \[2.0, 0.0, 0.0\] m; merge them",
    ),
    ("mesh.vtu", two_parts(5.0), r"it is 2 parts that no face joins"),
    *(
        ("mesh.vtu", hinge(kind, at), "it is 2 parts that no face joins")
        for kind in ("hexahedron", "tetra")
        for at in ("edge", "node")
    ),
    (
        "mesh.vtu",
        meshio.Mesh(
            HEX.points,
            [("hexahedron", np.vstack([HEX.cells, HEX.cells[:1, [1, 2, 3, 0, 5, 6, 7, 4]]]))],
        ),
        "are there twice",
    ),
    ("mesh.vtu", overlapping(), r"1 faces belong to more than two cells"),
    *(
        ("mesh.vtu", on_one_side(kind), "1 faces have both of their cells on one side")
        for kind in ("hexahedron", "tetra")
    ),
    (
        "mesh.vtu",
        MIXED,
        r"all be linear hexahedra or all linear tetrahedra, hexahedron or tetra; got hexahedron and pyramid and tetra",
    ),
    ("mesh.vtu", meshio.Mesh(HEX.points, [("quad", HEX.boundary_facets)]), "got no volume cells"),
    (
        "mesh.vtu",
        meshio.Mesh(np.random.default_rng(0).random((10, 3)), [("tetra10", [range(10)])]),
        "got tetra10",
    ),
    (
        "mesh.vtu",
        meshio.Mesh(np.random.default_rng(0).random((6, 3)), [("wedge", [range(6)])]),
        "got wedge",
    ),
    (
        "mesh.vtu",
        meshio.Mesh(HEX.points, [("hexahedron", HEX.cells + 1)]),
        r"cells must have nodes in \[0, 11\]; got 1 to 12",
    ),
    ("mesh.vtu", "<VTKFile", "meshio cannot read it"),
    ("mesh.vtu", b"", "meshio cannot read it"),
    ("mesh.msh", b"", "the file is empty or holds no mesh"),
    ("mesh.vtk", "# vtk DataFile Version 4.2\nx\nASCII\n", "meshio cannot read it"),
    ("mesh.msh", "$MeshFormat\n9.9 0 8\n$EndMeshFormat\n", "meshio cannot read it"),
    ("mesh.msh", "nothing of the kind", "meshio cannot read it"),
    ("mesh.msh", b"\n\n", "the file is empty or holds no mesh"),
    ("mesh.med", b"\x00\x01", "meshio cannot read it"),
    ("mesh.unknown", "x", "Could not deduce file format"),
    (
        "mesh.inp",
        "*NODE\n1, 0, 0, 0\n*ELEMENT, TYPE=C3D8R5\n1, 1\n",
        "Element type not available: C3D8R5",
    ),
    (
        "mesh.inp",
        "*NODE\n1, 0, 0\n2, 1, 0\n3, 0, 1\n*ELEMENT, TYPE=S3\n1, 1, 2, 3\n",
        r"must have three coordinates; got an array of shape \(3, 2\)",
    ),
    (
        "mesh.inp",
        "*NODE\n1, 0, 0, 0\n*NSET, NSET=a\n1\n*NSET, NSET=a\n1\n",
        "NSET 'a' is defined more than once",
    ),
    (
        "mesh.inp",
        "*NODE, NSET=a\n1, 0, 0, 0\n*NODE\n2, 1, 0, 0\n*ELEMENT, TYPE=T3D2\n1, 1, 2\n",
        r"under one line \*NODE; there are 2",
    ),
    (
        "mesh.msh",
        GMSH1.replace("4 1 2 3 4\n", "4 1 2 3 9\n"),
        "invalid Gmsh 1 file: there is no node, or no element type, 9",
    ),
    ("mesh.msh", GMSH1.replace("1 4 1 1", "1 44 1 1"), "no element type, 44"),
    (
        "mesh.msh",
        GMSH1.replace("$ELM\n1\n", "$ELM\n2\n"),
        r"the first line of \$ELM must give the number of lines",
    ),
    ("mesh.msh", GMSH1.replace("$ENDELM", ""), r"\$ELM or \$ENDELM is missing"),
    ("mesh.msh", GMSH1.replace("4 0 0 1", "4 0 0 x"), "could not convert string to float"),
    ("mesh.msh", GMSH1.replace("4 1 2 3 4\n", "4 1 2 3\n"), "element 1 has 3 nodes, not 4"),
    ("mesh.msh", GMSH1.replace("4 0 0 1", "4 0 0"), "Gmsh 1 file"),
]


@pytest.mark.parametrize(("name", "bad", "message"), BAD)
def test_bad_meshes_are_one_clear_line(
    name: str,
    bad: str | bytes | meshio.Mesh,
    message: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / name
    if isinstance(bad, meshio.Mesh):
        bad.write(path)
    else:
        path.write_bytes(bad if isinstance(bad, bytes) else bad.encode())
    with pytest.raises(SpecError, match=message) as caught:
        read_mesh(path, 1.0)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_a_missing_file_or_one_that_has_changed_is_named(folder: Path) -> None:
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


def test_half_a_binary_surface_is_one_clear_line(folder: Path) -> None:
    corners = np.random.default_rng(0).random((60, 3))
    meshio.Mesh(corners, [("triangle", np.arange(60).reshape(20, 3))]).write(
        folder / "half.stl", binary=True
    )
    whole = (folder / "half.stl").read_bytes()
    assert read_triangles(folder / "half.stl", 1.0).shape == (20, 3, 3)
    (folder / "half.stl").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(
        SpecError,
        match=r"half.stl: cannot be read as STL: it is neither text nor a binary file of the length given in its header\.$",
    ):
        read_triangles(folder / "half.stl", 1.0)


def test_files_are_closed_again(folder: Path) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_triangles(folder / "plane.stl", 1.0)
        gc.collect()
    assert not [warning for warning in caught if warning.category is ResourceWarning]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("s.stl", "solid x\nendsolid x\n", "must hold triangles; got none|meshio cannot read it"),
        ("s.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", r"points in \[1, 3\]; got 1 to 4"),
        ("s.obj", "v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", "positions must be finite"),
        ("s.obj", "v 0 0 0\n", "must hold triangles; got none"),
    ],
)
def test_bad_surfaces_are_one_clear_line(
    name: str, text: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SpecError, match=message):
        read_triangles(tmp_path / name, 1.0)
