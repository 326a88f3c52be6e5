"""Data sets as folders in the manner of the Hugging Face Hub, on this machine alone.

A folder holds a data set card, `README.md`, whose YAML block names the files of each split, HDF5
files with one row per sample, and the mesh:

    README.md
    mesh.h5                         points, cells, fixed_nodes
    data/train-00000-of-00001.h5    forces, displacements, regions
    data/validation-00000-of-00001.h5
    data/test-00000-of-00001.h5

The arrays are those of `mor_bench.scene.snapshot_file`. The library `datasets` reads the splits
with its loader of HDF5 files. Nothing here opens a connection.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.adapters.dataset_card import CARD, Card
from mor_bench.adapters.exported_scene import why_not_written
from mor_bench.adapters.imported_parts import Body, Samples, write_parts
from mor_bench.array_files import read_hdf5
from mor_bench.errors import InvalidInputError, StoreError, UnsupportedSceneError, printable
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.store import write_atomically

MESH = "mesh.h5"
COLUMNS = {"forces": True, "displacements": True, "regions": False}
"""Columns of the files of a split, and whether each is required."""

Arrays = Mapping[str, NDArray[Any]]


def export_dataset_folder(data: Dataset, out: str | Path) -> list[Path]:
    """Write a dataset as a folder with a card; return its files.

    Parameters
    ----------
    data : Dataset
    out : path
        Folder; created if it does not exist.

    Raises
    ------
    UnsupportedSceneError
        If the body varies between samples, or methods are given displacements instead of forces.
    InvalidInputError
        If one of the files exists.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> with TemporaryDirectory() as folder:
    ...     files = export_dataset_folder(mor_bench.load_dataset("beam-tiny"), folder)
    >>> sorted(file.name.partition("-")[0] for file in files)
    ['README.md', 'mesh.h5', 'test', 'train', 'validation']
    """
    scene, out = data.scene, Path(out)
    if reason := why_not_written(scene):
        raise UnsupportedSceneError(f"{scene.name} cannot be written as a folder: {reason}.")
    mesh = {
        "points": scene.mesh.points,
        "cells": scene.mesh.cells,
        "fixed_nodes": scene.fixed_nodes,
    }
    parts = {"train": data.train, "validation": data.validation, "test": data.test}
    parts = {name: part for name, part in parts.items() if len(part)}
    contents = {out / CARD: _card(scene, parts).encode(), out / MESH: _hdf5(mesh)}
    for name, part in parts.items():
        columns = {column: getattr(part, column) for column in COLUMNS}
        contents[out / "data" / f"{name}-00000-of-00001.h5"] = _hdf5(columns)
    for path in contents:
        if path.exists():
            raise InvalidInputError(
                f"`out`: {path} exists and is not overwritten; remove it or choose another folder."
            )
    (out / "data").mkdir(parents=True, exist_ok=True)
    for path, content in contents.items():
        write_atomically(path, content)
    return list(contents)


def _hdf5(arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, track_times=False)
    return buffer.getvalue()


def _card(scene: Scene, parts: Mapping[str, Snapshots]) -> str:
    title = " ".join(scene.spec.title.split())
    files = "\n".join(f'      - split: {name}\n        path: "data/{name}-*.h5"' for name in parts)
    rows = "\n".join(f"| {name} | {len(part)} |" for name, part in parts.items())
    return f"""---
pretty_name: {json.dumps(title)}
tags:
  - mor-bench
  - model-order-reduction
configs:
  - config_name: default
    data_files:
{files}
---

# {title}

Static equilibria of a hyperelastic solid with {scene.mesh.n_nodes} nodes, written by mor-bench.

| split | samples |
|---|---|
{rows}

| column | shape of a row | |
|---|---|---|
| `forces` | (n_nodes, 3) | nodal forces, N |
| `displacements` | (n_nodes, 3) | nodal displacements, m |
| `regions` | () or (k,) | load region of each force |

`mesh.h5` holds the nodes' positions `points`, m, the `cells` in VTK order, and `fixed_nodes`.
"""


def import_dataset_folder(folder: str | Path, out: str | Path) -> list[Path]:
    """Turn a folder with a data set card into snapshots; return an NPZ and a TOML file.

    Of the card's YAML, `pretty_name` and the `data_files` of one configuration are read, in each
    form that the Hub allows. Without them, the files of a split are ``data/SPLIT-*.h5``.

    Parameters
    ----------
    folder : path
        A folder as `export_dataset_folder` writes it; a split may have several files.
    out : path
        New file with the ending ``.npz``. The TOML lies beside it: `load_dataset` reads it.

    Raises
    ------
    StoreError
        If a file is missing or damaged, is in two splits, or is no HDF5 file; the message names it.
        Also if the card is no valid YAML, or names its files in another way.
    InvalidInputError
        If `out` exists or has a wrong name.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import mor_bench
    >>> with TemporaryDirectory() as folder:
    ...     files = export_dataset_folder(mor_bench.load_dataset("beam-tiny"), f"{folder}/hub")
    ...     arrays, toml = import_dataset_folder(f"{folder}/hub", f"{folder}/again.npz")
    ...     len(mor_bench.load_dataset(toml).test)
    40
    """
    folder = Path(folder)
    try:
        card = Card(folder)
        mesh = read_hdf5(folder / MESH)
        for name in ("points", "cells"):
            if name not in mesh:
                raise StoreError(f"{folder / MESH}: the array `{name}` is missing.")
        n_nodes = len(np.atleast_1d(mesh["points"]))
        parts = {name: _read_split(files, n_nodes) for name, files in card.files().items()}
    except FileNotFoundError as error:
        raise StoreError(f"{error.filename}: no such file; the folder needs it.") from None
    fixed = mesh.get("fixed_nodes", np.zeros(0, dtype=np.int64))
    body = Body(mesh["points"], mesh["cells"], fixed, card.title, str(folder))
    return write_parts(out, body, parts)


def _read_split(files: Sequence[Path], n_nodes: int) -> Samples:
    """Read the rows of a split from all of its files."""
    tables = [_read_rows(path, n_nodes) for path in files]
    regions = [table["regions"] for table in tables if "regions" in table]
    return Samples(
        np.concatenate([table["forces"] for table in tables]),
        np.concatenate([table["displacements"] for table in tables]),
        np.concatenate(regions) if len(regions) == len(tables) else None,
    )


def _read_rows(path: Path, n_nodes: int) -> dict[str, NDArray[Any]]:
    table = read_hdf5(path)
    for name in sorted(table.keys() - COLUMNS.keys()):
        raise StoreError(
            f"{path}: unknown column `{printable(name, 100, '')}`; allowed: {', '.join(COLUMNS)}."
        )
    for name, required in COLUMNS.items():
        if required and name not in table:
            raise StoreError(f"{path}: the column `{name}` is missing.")
    shape = len(np.atleast_1d(table["forces"])), n_nodes, 3
    for name in ("forces", "displacements"):
        if table[name].shape != shape or table[name].dtype.kind != "f":
            raise StoreError(
                f"{path}: `{name}` must be real numbers of shape {shape}; "
                f"got {table[name].dtype} of shape {table[name].shape}."
            )
    if "regions" in table:
        regions = table["regions"]
        if regions.ndim not in (1, 2) or len(regions) != shape[0] or regions.dtype.kind not in "iu":
            raise StoreError(
                f"{path}: `regions` must be integers, one row per sample; "
                f"got {regions.dtype} of shape {regions.shape}."
            )
        table["regions"] = regions.reshape(shape[0], -1)
    return table
