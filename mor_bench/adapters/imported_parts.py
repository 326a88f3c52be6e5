"""Samples that another format holds in parts, written as snapshots that `load_dataset` reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, SpecError, StoreError
from mor_bench.export.npz_file import new_dataset_file, write_snapshots
from mor_bench.export.toml_text import quoted
from mor_bench.snapshots.dataset import load_dataset

PARTS = ("train", "validation", "test")


@dataclass(frozen=True)
class Samples:
    """Samples of one part.

    Attributes
    ----------
    forces, displacements : (n, n_nodes, 3) float
        N and m.
    regions : (n, k) int or None
        Load-region ids.
    """

    forces: NDArray[Any]
    displacements: NDArray[Any]
    regions: NDArray[Any] | None = None


@dataclass(frozen=True)
class Body:
    """The mesh of all samples, and its title and source."""

    points: NDArray[Any]
    cells: NDArray[Any]
    fixed_nodes: NDArray[Any]
    title: str
    source: str


def write_parts(out: str | Path, body: Body, parts: Mapping[str, Samples]) -> list[Path]:
    """Write parts to an NPZ file and a TOML that reads them again; return both.

    With a part ``test``, the split is that of the parts. Otherwise test samples are drawn by load
    region if regions are known, and validation samples too; else both are drawn at random. So are
    validation samples if there is a part ``test`` but none ``validation``.

    Raises
    ------
    InvalidInputError
        If a file exists, or its name cannot be that of a dataset.
    StoreError
        If the content is no valid dataset. No file remains.
    """
    out = new_dataset_file(out)
    held = [parts[name] for name in PARTS if name in parts]
    arrays: dict[str, NDArray[Any]] = {
        "points": body.points,
        "cells": body.cells,
        "fixed_nodes": body.fixed_nodes,
        "forces": np.concatenate([part.forces for part in held]),
        "displacements": np.concatenate([part.displacements for part in held]),
    }
    regions = [part.regions for part in held if part.regions is not None]
    if len(regions) == len(held) and len({ids.shape[1] for ids in regions}) == 1:
        arrays["regions"] = np.concatenate(regions)
    by = "file" if "test" in parts else "region" if "regions" in arrays else "sample"
    if by == "file":
        lengths = [len(part.forces) for part in held]
        part_of = np.repeat([name for name in PARTS if name in parts], lengths)
        arrays["test"] = part_of == "test"
        if "validation" in parts:
            arrays["validation"] = part_of == "validation"
    toml = (
        f"title = {quoted(body.title)}\nsource = {quoted(body.source)}\n\n"
        f'[snapshots]\nfile = {quoted(out.name)}\n\n[split]\nby = "{by}"\n'
    )
    written = write_snapshots(out, arrays, toml)
    try:
        load_dataset(out.with_suffix(".toml"))
    except (SpecError, InvalidInputError) as error:
        for path in written:
            path.unlink()
        raise StoreError(f"{body.source}: its samples are refused: {error}") from None
    return written
