"""A dataset's samples as NumPy arrays, with the TOML file that reads them in again."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.export.output_path import new_file
from mor_bench.export.toml_text import quoted
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.imported_dataset import NodalLoads
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs.base import NAME_PATTERN


def export_numpy(data: Dataset, out: str | Path) -> list[Path]:
    """Write a dataset's samples to an NPZ file, with a TOML file beside it; return both files.

    The TOML file reads the samples in again with the same split.

    Raises
    ------
    InvalidInputError
        If the file's name does not end in .npz, or cannot be the name of a dataset, or one of the
        two files exists.
    UnsupportedSceneError
        If the scene samples parameters, which the file has no room for.
    """
    out = new_dataset_file(out)
    if names := data.scene.parameter_names:
        raise UnsupportedSceneError(
            f"{data.scene.name}: an NPZ file cannot hold the sampled parameters {', '.join(names)}."
        )
    return write_snapshots(out, snapshot_arrays(data), _toml(data.scene, out.name))


def new_dataset_file(out: str | Path) -> Path:
    """Check the NPZ file of a new dataset; errors as in `export_numpy`."""
    out = new_file(out, ".npz", ".toml")
    if not re.fullmatch(NAME_PATTERN, out.stem):
        raise InvalidInputError(
            "`out` must have a name of lower-case letters, digits and hyphens, because the dataset "
            f"gets it; got {out.name!r}."
        )
    return out


def write_snapshots(out: Path, arrays: Mapping[str, NDArray[Any]], toml: str) -> list[Path]:
    """Write arrays in the schema of `mor_bench.scene.snapshot_file`, and their TOML beside them."""
    out.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    write_atomically(out, buffer.getvalue())
    write_atomically(out.with_suffix(".toml"), toml.encode())
    return [out, out.with_suffix(".toml")]


def snapshot_arrays(data: Dataset) -> dict[str, NDArray[Any]]:
    """Return all samples in the schema of `mor_bench.scene.snapshot_file`.

    The parts alternate, so the first n samples hold each in about its proportion.
    """
    parts = (data.train, data.validation, data.test)
    places = np.concatenate([(np.arange(len(part)) + 0.5) / len(part) for part in parts])
    order = np.argsort(places, kind="stable")
    arrays: dict[str, NDArray[Any]] = {
        "points": data.scene.mesh.points,
        "cells": data.scene.mesh.cells,
        "fixed_nodes": data.scene.fixed_nodes,
    }
    for name in ("forces", "displacements", "regions"):
        arrays[name] = np.concatenate([getattr(part, name) for part in parts])[order]
    if isinstance(data.train.loads, NodalLoads) and not arrays["regions"].any():
        del arrays["regions"]  # the imported file had none
    part = np.repeat(["train", "validation", "test"], [len(samples) for samples in parts])[order]
    for name in ("validation", "test"):
        arrays[name] = part == name
    return arrays


def _toml(scene: Scene, file: str) -> str:
    spec = scene.spec
    grid = spec.grid_nodes or scene.mesh.grid_shape
    return f"""title = {quoted(spec.title)}
source = {quoted(spec.source)}
{f"grid_nodes = {list(grid)}" if grid else ""}

[snapshots]
file = {quoted(file)}

[split]
by = "file"

[needs]
error = {spec.needs.error!r}
latency_ms = {spec.needs.latency_ms!r}
"""
