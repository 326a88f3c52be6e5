"""Mesh files that cannot be used are refused in one line that names the file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from mor_bench.errors import SpecError
from mor_bench.hard_cases.setups import of_order
from mor_bench.scene.files import read_mesh
from mor_bench.scene.mesh import TET_EDGES, Mesh, box_mesh

HEX = box_mesh((2.0, 1.0, 1.0), (2, 1, 1))
TET = box_mesh((2.0, 1.0, 1.0), (2, 1, 1), tetrahedra=True)


def hexes(cells: Any, points: Any = HEX.points) -> meshio.Mesh:
    return meshio.Mesh(points, [("hexahedron", np.asarray(cells))])


def second_as(order: list[int]) -> meshio.Mesh:
    """Return two hexahedra, the second with its corners in another order."""
    return hexes(np.vstack([HEX.cells[:1], HEX.cells[1:, order]]))


def flat_tetrahedron() -> meshio.Mesh:
    cells = TET.cells.copy()
    cells[5, 3] = cells[5, 2]
    return meshio.Mesh(TET.points, [("tetra", cells)])


def two_parts(shift: float) -> meshio.Mesh:
    points = np.vstack([HEX.points, HEX.points + np.array([shift, 0.0, 0.0])])
    return hexes(np.vstack([HEX.cells, HEX.cells + HEX.n_nodes]), points)


def hinge(kind: str, at: str) -> meshio.Mesh:
    """Return two of the eight blocks of a cube, which share only an edge or a node."""
    cube = box_mesh((2.0, 2.0, 2.0), (2, 2, 2), kind == "tetra")
    centres = cube.points[cube.cells].mean(axis=1) > 1.0
    other = centres[:, :2].all(axis=1) & (centres[:, 2] == (at == "node"))
    return meshio.Mesh(cube.points, [(kind, cube.cells[(centres.sum(axis=1) == 0) | other])])


def three_on_one_face() -> meshio.Mesh:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.1, 0.1, 2], [0.1, 0.1, -1]])
    return meshio.Mesh(points, [("tetra", np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 2, 1, 5]]))])


def on_one_side(kind: str) -> meshio.Mesh:
    """Return a cell, and one twice as high on the same face; both are oriented outwards."""
    mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1), kind == "tetra")
    cell = mesh.cells[0]
    higher = cell.copy()
    apex = np.flatnonzero(mesh.points[cell, 2] == 1.0) if kind == "hexahedron" else np.array([3])
    higher[apex] = mesh.n_nodes + np.arange(len(apex))
    points = np.vstack([mesh.points, mesh.points[cell[apex]] + [0.0, 0.0, 1.0]])
    return meshio.Mesh(points, [(kind, np.vstack([cell, higher]))])


def quadratic(change: Callable[[Mesh], Mesh]) -> meshio.Mesh:
    mesh = change(of_order(TET, 2))
    return meshio.Mesh(mesh.points, [("tetra10", mesh.cells)])


def curved(cell: int, shift: list[float]) -> meshio.Mesh:
    """Move the middle of a cell's first edge so far that the cell folds."""

    def change(mesh: Mesh) -> Mesh:
        points = mesh.points.copy()
        points[mesh.cells[cell, 4]] += shift
        return Mesh(points, mesh.cells)

    return quadratic(change)


def split_edge() -> meshio.Mesh:
    """Give one of the cells at an edge a middle of its own."""

    def change(mesh: Mesh) -> Mesh:
        cells = mesh.cells.copy()
        shared = np.flatnonzero((cells == cells[0, 9]).any(axis=1))
        assert len(shared) > 1
        cells[0, 9] = mesh.n_nodes
        moved = mesh.points[mesh.cells[0, 9]] + [0.0, 0.0, 1e-3]
        return Mesh(np.vstack([mesh.points, moved]), cells)

    return quadratic(change)


def corner_as_middle() -> meshio.Mesh:
    """Use a node in the middle of an edge as the corner of another cell."""

    def change(mesh: Mesh) -> Mesh:
        cells = mesh.cells.copy()
        apex = np.array([[0.5, 0.5, 2.0]])
        base = cells[0, [0, 4, 6]]
        corners = np.append(base, mesh.n_nodes)
        a, b = corners[TET_EDGES].T
        points = np.vstack([mesh.points, apex])
        middles = points[[a, b]].mean(axis=0) + 1e-3
        added = np.append(corners, mesh.n_nodes + 1 + np.arange(6))
        return Mesh(np.vstack([points, middles]), np.vstack([cells, added]))

    return quadratic(change)


def alone(kind: str, n: int) -> meshio.Mesh:
    return meshio.Mesh(np.random.default_rng(0).random((n, 3)), [(kind, [range(n)])])


NAN = HEX.points.copy()
NAN[3, 1] = np.nan
MIXED = meshio.Mesh(
    np.vstack([HEX.points, [[3.0, 0.5, 0.5]]]),
    [
        ("hexahedron", HEX.cells),
        ("pyramid", np.array([[8, 9, 11, 10, 12]])),
        ("tetra", np.array([[8, 9, 10, 12]])),
    ],
)
UNSOUND: list[tuple[meshio.Mesh, str]] = [
    (hexes(HEX.cells, NAN), r"positions must be finite; point 3 \(counted from 0\) is not"),
    (second_as([4, 5, 6, 7, 0, 1, 2, 3]), r"1 of 2 hexahedra are inside out, .* cell 1"),
    (second_as([1, 0, 2, 3, 4, 5, 6, 7]), r"cell 1 \(counted from 0\) is flat or folded"),
    (flat_tetrahedron(), r"cell 5 \(counted from 0\) is flat or folded"),
    (two_parts(2.0), r"4 nodes coincide with others, as at \[2.0, 0.0, 0.0\] m; merge them"),
    (two_parts(5.0), r"it has 2 parts that share no face"),
    (hinge("hexahedron", "edge"), "it has 2 parts that share no face"),
    (hinge("hexahedron", "node"), "it has 2 parts that share no face"),
    (hinge("tetra", "edge"), "it has 2 parts that share no face"),
    (hinge("tetra", "node"), "it has 2 parts that share no face"),
    (hexes(np.vstack([HEX.cells, HEX.cells[:1, [1, 2, 3, 0, 5, 6, 7, 4]]])), "cells occur twice"),
    (three_on_one_face(), r"1 faces belong to more than two cells"),
    (on_one_side("hexahedron"), "1 faces have both of their cells on one side"),
    (on_one_side("tetra"), "1 faces have both of their cells on one side"),
    (MIXED, r"\(hexahedron, tetra, tetra10\); got hexahedron and pyramid and tetra"),
    (curved(0, [0.9, 0.1, 0.0]), r"cell \d \(counted from 0\) is flat or folded"),
    (split_edge(), "every edge .* one middle of its own, .*; 1 have not"),
    (corner_as_middle(), r"one middle of its own, .*; \d have not"),
    (meshio.Mesh(HEX.points, [("quad", HEX.boundary_facets)]), "got no volume cells"),
    (alone("hexahedron20", 20), "got hexahedron20"),
    (alone("wedge", 6), "got wedge"),
    (hexes(HEX.cells + 1), r"cells must have nodes in \[0, 11\]; got 1 to 12"),
]
GMSH1 = (
    "$NOD\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n$ENDNOD\n$ELM\n1\n1 4 1 1 4 1 2 3 4\n$ENDELM\n"
)
FLAT = "*NODE\n1, 0, 0\n2, 1, 0\n3, 0, 1\n*ELEMENT, TYPE=S3\n1, 1, 2, 3\n"
TWO_BLOCKS = "*NODE, NSET=a\n1, 0, 0, 0\n*NODE\n2, 1, 0, 0\n*ELEMENT, TYPE=T3D2\n1, 1, 2\n"
BROKEN: list[tuple[str, str, str]] = [
    ("vtu", "<VTKFile", "meshio cannot read it"),
    ("vtu", "", "meshio cannot read it"),
    ("msh", "", "the file is empty or holds no mesh"),
    ("msh", "\n\n", "the file is empty or holds no mesh"),
    ("msh", "$MeshFormat\n9.9 0 8\n$EndMeshFormat\n", "meshio cannot read it"),
    ("msh", "nothing of the kind", "meshio cannot read it"),
    ("vtk", "# vtk DataFile Version 4.2\nx\nASCII\n", "meshio cannot read it"),
    ("med", "\0\1", "meshio cannot read it"),
    ("unknown", "x", "a mesh must be one of"),
    ("inp", "*NODE\n1, 0, 0, 0\n*ELEMENT, TYPE=C3D8R5\n1, 1\n", "type not available: C3D8R5"),
    ("inp", FLAT, r"must have three coordinates; got an array of shape \(3, 2\)"),
    ("inp", "*NODE\n1, 0, 0, 0\n*NSET, NSET=a\n1\n*NSET, NSET=a\n1\n", "'a' is defined more than"),
    ("inp", TWO_BLOCKS, r"under one line \*NODE; there are 2"),
    ("msh", GMSH1.replace("2 3 4\n", "2 3 9\n"), "invalid Gmsh 1 file: it has no node, .* 9"),
    ("msh", GMSH1.replace("1 4 1 1", "1 44 1 1"), "no element type, with the number 44"),
    ("msh", GMSH1.replace("$ELM\n1\n", "$ELM\n2\n"), r"first line of \$ELM must give the number"),
    ("msh", GMSH1.replace("$ENDELM", ""), r"\$ELM or \$ENDELM is missing"),
    ("msh", GMSH1.replace("4 0 0 1", "4 0 0 x"), "could not convert string to float"),
    ("msh", GMSH1.replace("1 2 3 4\n", "1 2 3\n"), "element 1 has 3 nodes, not 4"),
    ("msh", GMSH1.replace("4 0 0 1", "4 0 0"), "Gmsh 1 file"),
]


@pytest.mark.parametrize(
    ("suffix", "bad", "message"), [*(("vtu", *unsound) for unsound in UNSOUND), *BROKEN]
)
def test_bad_meshes_are_refused_in_one_line(
    suffix: str,
    bad: str | meshio.Mesh,
    message: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / f"mesh.{suffix}"
    if isinstance(bad, meshio.Mesh):
        bad.write(path)
    else:
        path.write_text(bad)
    with pytest.raises(SpecError, match=message) as caught:
        read_mesh(path, 1.0)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_bulk_data_without_an_end_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "cut.bdf"
    hexes(HEX.cells).write(path, file_format="nastran")
    whole = path.read_text(encoding="utf-8")
    assert len(read_mesh(path, 1.0)[0].cells) == 2
    no_end, no_card = whole.replace("ENDDATA", ""), whole[: whole.index("GRID")]
    for text in (no_end, no_card, "ENDDATA\nBEGIN BULK\n"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(SpecError, match=r"cut.bdf: ENDDATA is missing after BEGIN BULK"):
            read_mesh(path, 1.0)
