"""Named sets of nodes, from what mesh formats call sets, physical groups and point data."""

from __future__ import annotations

import re
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError

PointSets = dict[str, NDArray[np.int64]]


def named_point_sets(mesh: meshio.Mesh, path: Path) -> PointSets:
    """The sets of nodes that a file names; those of the same name are joined.

    They are point sets (Abaqus NSET, also in a line `*NODE, NSET=…`), the nodes of cell sets (ELSET) and of Gmsh's physical
    groups of any dimension, a group without a name under its number, with its dimension before it where others have it too,
    and point data of zeros and ones (VTK). An Abaqus file is taken to have passed `check_abaqus`.
    """
    found: dict[str, list[NDArray[np.int64]]] = {}
    abaqus = path.suffix.lower() == ".inp"
    if abaqus:
        found |= {
            name: [np.arange(len(mesh.points))]
            for name in _keywords(path, "NODE", "NSET")
            if name is not None
        }
    for name, nodes in mesh.point_sets.items():
        found.setdefault(name, []).append(np.asarray(nodes, dtype=np.int64))
    for name, chosen in (
        (_abaqus_blocks(mesh, path) if abaqus else []) + _cell_sets(mesh) + _physical_groups(mesh)
    ):
        nodes = [
            np.asarray(block.data)[rows].ravel()
            for block, rows in zip(mesh.cells, chosen, strict=True)
            if len(rows)
        ]
        found.setdefault(name, []).extend(np.asarray(part, dtype=np.int64) for part in nodes)
    for name, values in mesh.point_data.items():
        if (
            values.ndim == 1
            and values.dtype.kind in "biuf"
            and np.isin(values, [0, 1]).all()
            and values.any()
        ):
            found.setdefault(name, []).append(np.flatnonzero(values))
    return {
        name: np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *parts]))
        for name, parts in found.items()
    }


_Rows = list[NDArray[np.int64]]
"""For each block of cells the rows that are chosen."""

_DIMENSIONS = ("point", "line", "surface", "volume")
"""Gmsh's words for groups, by dimension."""

_NO_ROWS = np.zeros(0, dtype=np.int64)


def _cell_sets(mesh: meshio.Mesh) -> list[tuple[str, _Rows]]:
    sets = []
    for name, members in mesh.cell_sets.items():
        if name.startswith("gmsh:"):
            continue
        rows = [_NO_ROWS if part is None else np.asarray(part, dtype=np.int64) for part in members]
        # A set that was defined before later cells has no part in them.
        sets.append((name, (rows + [_NO_ROWS] * len(mesh.cells))[: len(mesh.cells)]))
    return sets


def _physical_groups(mesh: meshio.Mesh) -> list[tuple[str, _Rows]]:
    data = mesh.cell_data.get("gmsh:physical")
    if data is None:
        return []
    tags = [np.abs(values) for values in data]  # negative where a group holds a surface turned over
    names = {(int(tag), int(dimension)): name for name, (tag, dimension) in mesh.field_data.items()}
    keys = sorted(
        {
            (int(tag), block.dim)
            for block, values in zip(mesh.cells, tags, strict=True)
            for tag in np.unique(values)
            if tag != 0
        }
    )
    unnamed = [tag for tag, dimension in keys if (tag, dimension) not in names]
    numbers = {
        (tag, dim): str(tag) if unnamed.count(tag) == 1 else f"{_DIMENSIONS[dim]} {tag}"
        for tag, dim in keys
    }
    return [
        (
            names.get(key, numbers[key]),
            [
                np.flatnonzero(values == key[0]) if block.dim == key[1] else _NO_ROWS
                for block, values in zip(mesh.cells, tags, strict=True)
            ],
        )
        for key in keys
    ]


def _keywords(path: Path, keyword: str, parameter: str) -> list[str | None]:
    """For each line of a keyword in an Abaqus file the value of one of its parameters."""
    lines = re.findall(
        rf"^\*{keyword}\s*((?:,.*)?)$",
        path.read_text(encoding="utf-8", errors="replace"),
        re.IGNORECASE | re.MULTILINE,
    )
    matches = [re.search(rf",\s*{parameter}\s*=\s*([^,]+)", line, re.IGNORECASE) for line in lines]
    return [match and match[1].strip() for match in matches]


def check_abaqus(path: Path) -> None:
    """Raise `SpecError` if an Abaqus file has two NSET of one name, or two NODE, of which only one would be read."""
    names = _keywords(path, "NSET", "NSET")
    repeated = sorted({name for name in names if name is not None and names.count(name) > 1})
    if repeated:
        raise SpecError(
            f"{path}: NSET {repeated[0]!r} is defined more than once; join the parts in one."
        )
    if (n_blocks := len(_keywords(path, "NODE", "NSET"))) > 1:
        raise SpecError(
            f"{path}: the nodes must stand under one line *NODE; there are {n_blocks}, of which only the last would be read."
        )


def _abaqus_blocks(mesh: meshio.Mesh, path: Path) -> list[tuple[str, _Rows]]:
    """Sets named in lines `*ELEMENT, ELSET=…`, which meshio gives to the wrong cells where a line has none.

    What meshio made of them is removed from the mesh.
    """
    names = _keywords(path, "ELEMENT", "ELSET")
    for name in {name for name in names if name is not None} - set(
        _keywords(path, "ELSET", "ELSET")
    ):
        mesh.cell_sets.pop(name, None)
    if len(names) != len(
        mesh.cells
    ):  # an included file brought cells: which ones are whose is not known
        return []
    return [
        (
            name,
            [np.arange(len(block)) if i == k else _NO_ROWS for i, block in enumerate(mesh.cells)],
        )
        for k, name in enumerate(names)
        if name is not None
    ]
