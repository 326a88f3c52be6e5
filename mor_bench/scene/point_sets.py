"""Named sets of nodes, from the sets, physical groups and point data of mesh formats."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError

PointSets = dict[str, NDArray[np.int64]]

_Rows = list[NDArray[np.int64]]
"""The chosen rows of each block of cells."""

_DIMENSIONS = ("point", "line", "surface", "volume")
"""Gmsh's names of groups, by dimension."""

_NO_ROWS = np.zeros(0, dtype=np.int64)

MOST_GROUPS = 10_000
"""Largest number of physical groups in a file; each takes a pass over all cells."""

MOST_NUMBERS = 10_000_000
"""Largest number of nodes and cells that the ranges of all sets of an Abaqus file may list."""


def named_point_sets(mesh: meshio.Mesh, path: Path) -> PointSets:
    """Return the sets of nodes that a file names; sets with the same name are joined.

    Sources: point sets (Abaqus NSET, also in `*NODE, NSET=…`); the nodes of cell sets (ELSET) and
    of Gmsh's physical groups of any dimension; point data of zeros and ones (VTK). A group without
    a name is called by its number. If groups of other dimensions have the same number, the
    dimension comes first. An Abaqus file must have passed `check_abaqus`.
    """
    found: dict[str, list[NDArray[np.int64]]] = {}
    abaqus = path.suffix.lower() == ".inp"
    if abaqus:
        for name in _keywords(path, "NODE", "NSET"):
            if name is not None:
                found[name] = [np.arange(len(mesh.points))]
    for name, nodes in mesh.point_sets.items():
        found.setdefault(name, []).append(np.asarray(nodes, dtype=np.int64))
    cell_sets = (_abaqus_blocks(mesh, path) if abaqus else []) + _cell_sets(mesh)
    for name, chosen in cell_sets + _physical_groups(mesh):
        parts = found.setdefault(name, [])
        for block, rows in zip(mesh.cells, chosen, strict=True):
            if len(rows):
                parts.append(np.asarray(np.asarray(block.data)[rows].ravel(), dtype=np.int64))
    for name, values in mesh.point_data.items():
        numbers = values.ndim == 1 and values.dtype.kind in "biuf"
        if numbers and np.isin(values, [0, 1]).all() and values.any():
            found.setdefault(name, []).append(np.flatnonzero(values))
    return {name: np.unique(np.concatenate([_NO_ROWS, *parts])) for name, parts in found.items()}


def _cell_sets(mesh: meshio.Mesh) -> list[tuple[str, _Rows]]:
    sets = []
    for name, members in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):
            rows = [_NO_ROWS if part is None else np.asarray(part, np.int64) for part in members]
            # A set defined before later cells has no rows for them.
            sets.append((name, (rows + [_NO_ROWS] * len(mesh.cells))[: len(mesh.cells)]))
    return sets


def _physical_groups(mesh: meshio.Mesh) -> list[tuple[str, _Rows]]:
    data = mesh.cell_data.get("gmsh:physical")
    if data is None:
        return []
    # A tag is negative if the group holds a surface with reversed orientation.
    blocks = [(block.dim, np.abs(tags)) for block, tags in zip(mesh.cells, data, strict=True)]
    names = {(int(tag), int(dimension)): name for name, (tag, dimension) in mesh.field_data.items()}
    keys = sorted({(int(tag), dim) for dim, tags in blocks for tag in np.unique(tags) if tag != 0})
    if len(keys) > MOST_GROUPS:
        raise SpecError(
            f"the mesh has {len(keys):,} physical groups; at most {MOST_GROUPS:,} are allowed."
        )
    unnamed = Counter(key[0] for key in keys if key not in names)

    def name_of(tag: int, dim: int) -> str:
        number = str(tag) if unnamed[tag] == 1 else f"{_DIMENSIONS[dim]} {tag}"
        return str(names.get((tag, dim), number))

    return [
        (
            name_of(tag, dim),
            [np.flatnonzero(tags == tag) if d == dim else _NO_ROWS for d, tags in blocks],
        )
        for tag, dim in keys
    ]


def abaqus_lines(path: Path) -> list[str]:
    """Return the lines of an Abaqus file that may hold a keyword."""
    text = path.read_text(encoding="utf-8", errors="replace")
    # Some letters beyond A to Z become such letters in capitals.
    return re.findall(r"^[^\S\n]*(?:\*|[^\W\d]).*$", text, re.MULTILINE)


def abaqus_keyword(line: str) -> str:
    """Return the keyword of a line by meshio's rule: blanks and stars do not count."""
    if line.startswith("**"):
        return ""
    return line.partition(",")[0].strip().replace("*", "").upper()


def _keywords(path: Path, keyword: str, parameter: str) -> list[str | None]:
    """Return a parameter's value from each line of an Abaqus file with a keyword."""
    lines = [line for line in abaqus_lines(path) if abaqus_keyword(line) == keyword]
    matches = [re.search(rf",\s*{parameter}\s*=\s*([^,]+)", line, re.IGNORECASE) for line in lines]
    return [match and match[1].strip() for match in matches]


def check_abaqus(path: Path) -> None:
    """Raise `SpecError` if an Abaqus file has two NSET with the same name, or two NODE blocks.

    meshio would read only one of them. It would also list every number of a range.
    """
    _check_ranges(path)
    names = Counter(_keywords(path, "NSET", "NSET"))
    repeated = sorted(name for name, n in names.items() if name is not None and n > 1)
    if repeated:
        raise SpecError(
            f"{path}: NSET {repeated[0][:100]!r} is defined more than once; "
            "join its parts into one set."
        )
    if (n_blocks := len(_keywords(path, "NODE", "NSET"))) > 1:
        raise SpecError(
            f"{path}: all nodes must stand under one line *NODE; there are {n_blocks}, "
            "and only the last would be read."
        )


def _check_ranges(path: Path) -> None:
    """Refuse sets whose ranges (GENERATE) have more numbers than a mesh may have."""
    total, inside = 0, False
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.lstrip().startswith("*"):
                inside = "GENERATE" in line.upper()
            elif inside:
                numbers = [int(word) for word in re.findall(r"-?\d{1,18}", line)]
                first, last, *step = numbers[:3] if len(numbers) > 1 else (0, 0)
                total += abs(last - first) // max(1, abs(step[0]) if step else 1) + 1
            if total > MOST_NUMBERS:
                raise SpecError(
                    f"{path}: the ranges of its sets (GENERATE) have more than {MOST_NUMBERS:,} "
                    "numbers."
                )


def _abaqus_blocks(mesh: meshio.Mesh, path: Path) -> list[tuple[str, _Rows]]:
    """Return the sets named in lines `*ELEMENT, ELSET=…`, and remove meshio's version of them.

    If a line has no set, meshio assigns these sets to wrong cells.
    """
    names = _keywords(path, "ELEMENT", "ELSET")
    for name in {*names} - {None, *_keywords(path, "ELSET", "ELSET")}:
        mesh.cell_sets.pop(name, None)
    n_blocks = len(mesh.cells)
    if len(names) != n_blocks:  # an included file has cells, whose sets are not known
        return []
    every = [np.arange(len(block)) for block in mesh.cells]
    return [
        (name, [every[i] if i == k else _NO_ROWS for i in range(n_blocks)])
        for k, name in enumerate(names)
        if name is not None
    ]
