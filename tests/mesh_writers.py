"""Writers of mesh files with named sets, for tests of the readers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import meshio
import numpy as np


def write_gmsh(version: str, binary: bool) -> Callable[[meshio.Mesh, Path], None]:
    def write(raw: meshio.Mesh, path: Path) -> None:
        # A body and one of its faces may have the same number.
        tags = zip(raw.cells, (1, 1, 2), strict=True)
        numbers = [np.full(len(block), tag) for block, tag in tags]
        fields = {"body": np.array([1, 3]), "left": np.array([1, 2]), "top": np.array([2, 2])}
        data = {"gmsh:physical": numbers, "gmsh:geometrical": [n.copy() for n in numbers]}
        dim_tags = np.tile([3, 1], (len(raw.points), 1))
        for entity, block in zip((1, 2), raw.cells[1:], strict=True):
            dim_tags[block.data] = 2, entity
        point_data = {"gmsh:dim_tags": dim_tags} if version == "4.1" else {}
        options = {"cell_data": data, "field_data": fields, "point_data": point_data}
        mesh = meshio.Mesh(raw.points, raw.cells, **options)
        meshio.gmsh.write(path, mesh, fmt_version=version, binary=binary)

    return write


def write_gmsh_reversed(raw: meshio.Mesh, path: Path) -> None:
    """Write a Gmsh file with a reversed surface in a group, marked by a negative number."""
    write_gmsh("4.1", False)(raw, path)
    lines = path.read_text().splitlines()
    first = lines.index("$Entities") + 2  # surface 1: number, box, number of groups, groups
    words = lines[first].split()
    assert words[:1] + words[7:9] == ["1", "1", "1"]
    lines[first] = " ".join([*words[:8], "-1", *words[9:]])
    path.write_text("\n".join([*lines, ""]))


def write_gmsh1(raw: meshio.Mesh, path: Path) -> None:
    """Write the format of the manual, with gaps between the numbers of nodes and elements."""
    types = {"hexahedron": 5, "tetra": 4, "quad": 3, "triangle": 2, "tetra10": 11, "triangle6": 9}
    swapped = {"tetra10": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}
    lines = ["$NOD", str(len(raw.points))]
    lines += [f"{3 * i + 5} {x:.17g} {y:.17g} {z:.17g}" for i, (x, y, z) in enumerate(raw.points)]
    blocks = zip(raw.cells, (7, 1, 2), strict=True)
    rows = [
        (types[block.type], tag, row[swapped.get(block.type, slice(None))])
        for block, tag in blocks
        for row in block.data
    ]
    lines += ["$ENDNOD", "$ELM", str(len(rows))]
    for i, (kind, tag, row) in enumerate(rows):
        nodes = " ".join(str(3 * n + 5) for n in row)
        lines.append(f"{2 * i + 1} {kind} {tag} {tag} {len(row)} {nodes}")
    path.write_text("\n".join([*lines, "$ENDELM", ""]))


def write_abaqus(raw: meshio.Mesh, path: Path) -> None:
    """Write a point set, and a set that only the second of three ELEMENT lines names."""
    names = {"hexahedron": "C3D8", "tetra": "C3D4", "quad": "S4", "triangle": "S3"}
    names |= {"tetra10": "C3D10", "triangle6": "STRI65"}
    lines = ["*HEADING", "*NODE"]
    lines += [f"{10 + i}, {x:.17g}, {y:.17g}, {z:.17g}" for i, (x, y, z) in enumerate(raw.points)]
    first = 1
    for block, extra in zip(raw.cells, ("", ", ELSET=left", ""), strict=True):
        lines += [f"*ELEMENT, TYPE={names[block.type]}{extra}"]
        for i, row in enumerate(block.data):
            lines.append(", ".join(map(str, [first + i, *(10 + n for n in row)])))
        first += len(block.data)
    lines += ["*NSET, NSET=top", *(f"{10 + n}," for n in np.unique(raw.cells[2].data))]
    path.write_text("\n".join([*lines, ""]))


def write_vtk(file_format: str, binary: bool) -> Callable[[meshio.Mesh, Path], None]:
    def write(raw: meshio.Mesh, path: Path) -> None:
        numbers = np.arange(len(raw.points))
        left, top = (np.isin(numbers, block.data).astype(int) for block in raw.cells[1:])
        masks = {"left": left, "top": top}
        mesh = meshio.Mesh(raw.points, raw.cells[:1], point_data=masks)
        mesh.write(path, file_format=file_format, binary=binary)

    return write
