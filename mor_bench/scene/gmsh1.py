"""Reader for version 1 of Gmsh's format (ASCII, `$NOD` and `$ELM`), which meshio does not read.

Gmsh reference manual, "MSH file format version 1": a node is `number x y z`, an element is
`number type physical elementary n_nodes nodes…`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError, printable

_NAMES = (
    "line triangle quad tetra hexahedron wedge pyramid line3 triangle6 quad9 tetra10 hexahedron27 "
    "wedge18 pyramid14 vertex quad8 hexahedron20"
)
_TYPES = dict(enumerate(_NAMES.split(), start=1))
"""meshio's name for each element type. Linear elements have VTK's node order."""

_VTK_ORDER = {"tetra10": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]}
"""Places of VTK's nodes among Gmsh's, where they differ."""


def is_gmsh1(head: bytes) -> bool:
    """Return whether a file with these first bytes is in version 1 of Gmsh's format."""
    return head.lstrip().startswith(b"$NOD")


def read_gmsh1(path: Path) -> meshio.Mesh:
    """Read a file; the numbers of physical groups become cell data `gmsh:physical`.

    Raises
    ------
    SpecError
        If a section is missing or short, a line is malformed, or an element has an unknown node.
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
            [(kind, _in_vtk_order(kind, cells)) for kind, (cells, _) in blocks.items()],
            cell_data={"gmsh:physical": [np.array(groups) for _, groups in blocks.values()]},
        )
    except KeyError as error:
        reason = printable(str(error), 300, keep="")
        raise SpecError(
            f"{path}: invalid Gmsh 1 file: it has no node, or no element type, with the "
            f"number {reason}."
        ) from None
    except (ValueError, OverflowError) as error:
        reason = printable(str(error), 300, keep="")
        raise SpecError(f"{path}: invalid Gmsh 1 file: {reason}.") from None


def _in_vtk_order(kind: str, cells: list[list[int]]) -> NDArray[np.int64]:
    nodes = np.array(cells, dtype=np.int64)
    return nodes[:, _VTK_ORDER[kind]] if kind in _VTK_ORDER else nodes


def _section(lines: Sequence[str], name: str) -> list[list[str]]:
    """Return the words of each line between `$NAME` with its number of lines, and `$ENDNAME`."""
    stripped = [line.strip() for line in lines]
    if f"${name}" not in stripped or f"$END{name}" not in stripped:
        raise ValueError(f"${name} or $END{name} is missing")
    content = stripped[stripped.index(f"${name}") + 1 : stripped.index(f"$END{name}")]
    found = [line.split() for line in content if line]
    if not found or int(found[0][0]) != len(found) - 1:
        raise ValueError(f"the first line of ${name} must give the number of lines that follow")
    return found[1:]
