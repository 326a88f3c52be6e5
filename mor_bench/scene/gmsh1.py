"""Gmsh's first file format, ASCII with `$NOD` and `$ELM`, which meshio does not read.

Gmsh reference manual, "MSH file format version 1": a node is `number x y z`, an element
`number type physical elementary n_nodes nodes…`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import meshio
import numpy as np

from mor_bench.errors import SpecError

_TYPES = {
    1: "line",
    2: "triangle",
    3: "quad",
    4: "tetra",
    5: "hexahedron",
    6: "wedge",
    7: "pyramid",
    8: "line3",
    9: "triangle6",
    10: "quad9",
    11: "tetra10",
    12: "hexahedron27",
    13: "wedge18",
    14: "pyramid14",
    15: "vertex",
    16: "quad8",
    17: "hexahedron20",
}
"""Numbers of element types; linear ones have the node order of VTK."""


def is_gmsh1(head: bytes) -> bool:
    """Whether a file that begins like this is in Gmsh's first format."""
    return head.lstrip().startswith(b"$NOD")


def read_gmsh1(path: Path) -> meshio.Mesh:
    """Read a file in Gmsh's first format; numbers of physical groups become cell data `gmsh:physical`.

    Raises
    ------
    SpecError
        If a section is missing or short, a line is not as it must be, or an element names a node that is not there.
    """
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    try:
        nodes = _section(lines, "NOD")
        points = np.array([[float(word) for word in line[1:4]] for line in nodes]).reshape(-1, 3)
        place = {int(line[0]): i for i, line in enumerate(nodes)}
        blocks: dict[str, tuple[list[list[int]], list[int]]] = {}
        for line in _section(lines, "ELM"):
            _, kind, physical, _, n_nodes = (int(word) for word in line[:5])
            corners = [place[int(word)] for word in line[5:]]
            if len(corners) != n_nodes:
                raise ValueError(f"element {line[0]} has {len(corners)} nodes, not {n_nodes}")
            cells, groups = blocks.setdefault(_TYPES[kind], ([], []))
            cells.append(corners)
            groups.append(physical)
        return meshio.Mesh(
            points,
            [(kind, np.array(cells, dtype=np.int64)) for kind, (cells, _) in blocks.items()],
            cell_data={"gmsh:physical": [np.array(groups) for _, groups in blocks.values()]},
        )
    except KeyError as error:
        raise SpecError(
            f"{path}: not a sound Gmsh 1 file: there is no node, or no element type, {error}."
        ) from None
    except ValueError as error:
        raise SpecError(f"{path}: not a sound Gmsh 1 file: {error}.") from None


def _section(lines: Sequence[str], name: str) -> list[list[str]]:
    """The words of each line between `$NAME`, which is followed by their number, and `$ENDNAME`."""
    stripped = [line.strip() for line in lines]
    if f"${name}" not in stripped or f"$END{name}" not in stripped:
        raise ValueError(f"${name} or $END{name} is missing")
    found = [
        line.split()
        for line in stripped[stripped.index(f"${name}") + 1 : stripped.index(f"$END{name}")]
        if line
    ]
    if not found or int(found[0][0]) != len(found) - 1:
        raise ValueError(f"${name} must hold as many lines as its first says")
    return found[1:]
