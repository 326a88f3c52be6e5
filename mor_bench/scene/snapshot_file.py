"""Snapshots from another program: arrays in an NPZ or HDF5 file.

Required: `points` (n_nodes, 3), m; `cells` (n_cells, 8, 4 or 10) in VTK order, counted from 0;
`forces` and `displacements` (n, n_nodes, 3), N and m. Optional: `fixed_nodes` (n_fixed,);
`regions` (n,), or (n, k) with k forces at once, load-region ids from 0; `test` and `validation`
(n,), true or 1 for test and validation samples.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.array_files import open_hdf5, read_npz
from mor_bench.errors import SpecError
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.soundness import check_numbers, in_grid, sound_cells
from mor_bench.specs import SourceFile
from mor_bench.specs.one_line_errors import nearest_name

STILL = 1e-9
"""Displacement of a fixed node that counts as zero, as a fraction of the largest displacement."""

MAX_SIZE = {"forces": 1e30, "displacements": 1e30}
"""Largest allowed values, N and m. Their squares and products do not overflow."""

REQUIRED = ("points", "cells", "forces", "displacements")
OPTIONAL = ("fixed_nodes", "regions", "test", "validation")
_KINDS = {"cells": "iu", "fixed_nodes": "iu", "regions": "iu", "test": "biu", "validation": "biu"}
_WORDS = {"iu": "integers", "biu": "booleans, or 0 and 1 as integers", "fiu": "real numbers"}


@dataclass(frozen=True)
class ImportedArrays:
    """The checked content of a file of snapshots.

    Attributes
    ----------
    mesh : Mesh
        Nodes are numbered as in the file.
    forces, displacements : (n, n_nodes, 3) float64
        N and m.
    fixed_nodes : (n_fixed,) int64
        Sorted.
    regions : (n, k) int64 or None
        Load-region ids.
    test, validation : (n,) bool or None
    """

    mesh: Mesh
    forces: NDArray[np.float64]
    displacements: NDArray[np.float64]
    fixed_nodes: NDArray[np.int64]
    regions: NDArray[np.int64] | None
    test: NDArray[np.bool_] | None
    validation: NDArray[np.bool_] | None


def read_arrays(file: SourceFile) -> ImportedArrays:
    """Read and check a file of snapshots.

    Raises
    ------
    SpecError
        If the file is missing, changed or unreadable, or an array is missing, unknown or not valid.
    """
    path = file.checked()
    try:
        return _checked(_read(path))
    except SpecError as error:
        named = str(error).startswith(f"{path}: ")
        raise SpecError(str(error) if named else f"{path}: {error}") from None


def _read(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file, see `mor_bench.array_files`."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        arrays = read_npz(path, SpecError)
        _check_names(list(arrays))
        return arrays
    if suffix in (".h5", ".hdf5"):
        with open_hdf5(path, SpecError) as content:
            _check_names(list(content))
            return {name: _entry(content, name) for name in content}
    raise SpecError(f"snapshots must be in an .npz, .h5 or .hdf5 file; got {suffix!r}.")


def _entry(content: h5py.File, name: str) -> NDArray[Any]:
    try:
        entry = content[name]
        if isinstance(entry, h5py.Dataset) and h5py.check_string_dtype(entry.dtype) is None:
            return np.asarray(entry[()] if entry.shape is not None else np.zeros(0))
    except (OSError, KeyError, RuntimeError) as error:
        raise SpecError(f"`{name}` cannot be read: {' '.join(str(error).split())}") from None
    kind = "text" if isinstance(entry, h5py.Dataset) else "a group"
    raise SpecError(f"`{name}` must be an array of numbers; got {kind}.")


def _check_names(names: list[str]) -> None:
    known = (*REQUIRED, *OPTIONAL)
    for name in names:
        if name not in known:
            hint = nearest_name(name, known)
            raise SpecError(f"unknown array `{name}`{hint} Allowed: {', '.join(known)}.")
    for name in REQUIRED:
        if name not in names:
            raise SpecError(f"array `{name}` is missing.")


def _checked(arrays: Mapping[str, NDArray[Any]]) -> ImportedArrays:
    _check_shapes(arrays)
    points, cells = arrays["points"].astype(np.float64), arrays["cells"].astype(np.int64)
    fixed = np.unique(arrays.get("fixed_nodes", np.zeros(0)).astype(np.int64))
    forces, displacements = (_in_range(name, arrays[name]) for name in ("forces", "displacements"))
    n, n_nodes = forces.shape[:2]
    if n == 0:
        raise SpecError("there must be samples; got none.")
    regions = arrays.get("regions")
    check_numbers(points, cells)
    if (unused := n_nodes - len(np.unique(cells))) > 0:
        raise SpecError(f"every node must belong to a cell; {unused} of {n_nodes} do not.")
    mesh = Mesh(points, sound_cells(points, cells))
    _check_fixed(displacements, fixed)
    if regions is not None:
        regions = regions.astype(np.int64).reshape(n, -1)
        if not regions.size or regions.min() < 0:
            raise SpecError("`regions` must be ids from 0 on.")
    # Adding zero gives -0.0 and 0.0 the same bytes.
    seen = {hashlib.sha256((force + 0.0).tobytes()).digest() for force in forces}
    if len(seen) < n:
        raise SpecError(f"`forces`: {n - len(seen)} samples have the same forces as others.")
    test, validation = (_truth_values(name, arrays.get(name)) for name in ("test", "validation"))
    if test is not None and validation is not None and (both := int((test & validation).sum())):
        raise SpecError(
            f"`test` and `validation` must exclude each other; {both} samples are both."
        )
    return ImportedArrays(in_grid(mesh), forces, displacements, fixed, regions, test, validation)


def _truth_values(name: str, array: NDArray[Any] | None) -> NDArray[np.bool_] | None:
    if array is None:
        return None
    if not np.isin(array, [0, 1]).all():
        raise SpecError(f"`{name}` must hold {_WORDS['biu']}; got {array.min()} to {array.max()}.")
    return array.astype(np.bool_)


def _check_shapes(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise `SpecError` for an array with a wrong type or shape, or a non-finite entry."""
    n, n_nodes = len(np.atleast_1d(arrays["forces"])), len(np.atleast_1d(arrays["points"]))
    shapes: dict[str, tuple[tuple[int | None, ...], ...]] = {
        "points": ((None, 3),),
        "cells": ((None, 8), (None, 4), (None, 10)),
        "forces": ((n, n_nodes, 3),),
        "displacements": ((n, n_nodes, 3),),
        "fixed_nodes": ((None,),),
        "regions": ((n,), (n, None)),
        "test": ((n,),),
        "validation": ((n,),),
    }
    for name in (*REQUIRED, *OPTIONAL):
        array = arrays.get(name)
        if array is None or (name == "fixed_nodes" and array.size == 0):  # empty: any type is valid
            continue
        kinds = _KINDS.get(name, "fiu")
        if array.dtype.kind not in kinds:
            raise SpecError(f"`{name}` must hold {_WORDS[kinds]}; got dtype {array.dtype}.")
        if not any(_has_shape(array, shape) for shape in shapes[name]):
            allowed = " or ".join(str(shape).replace("None", "any") for shape in shapes[name])
            raise SpecError(f"`{name}` must have shape {allowed}; got {array.shape}.")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            first = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
            raise SpecError(f"`{name}` must be finite; entry {first} is not.")


def _has_shape(array: NDArray[Any], shape: tuple[int | None, ...]) -> bool:
    return array.ndim == len(shape) and all(
        size in (None, found) for size, found in zip(shape, array.shape, strict=True)
    )


def _in_range(name: str, array: NDArray[Any]) -> NDArray[np.float64]:
    with np.errstate(over="ignore"):  # a value of a longer type may become infinite
        numbers = np.ascontiguousarray(array, dtype=np.float64)
    size, largest = np.abs(numbers), MAX_SIZE[name]
    unit = {"forces": "N", "displacements": "m"}[name]
    if not (size <= largest).all():
        worst = [int(i) for i in np.unravel_index(size.argmax(), size.shape)]
        raise SpecError(
            f"`{name}` must be in [-{largest:g}, {largest:g}] {unit}; "
            f"entry {worst} is {numbers[tuple(worst)]:g}."
        )
    if size.size and not size.any():
        raise SpecError(
            f"`{name}` must differ from zero somewhere, and be at most {largest:g} {unit}; "
            "got zeros only."
        )
    return numbers


def _check_fixed(displacements: NDArray[np.float64], fixed: NDArray[np.int64]) -> None:
    n_nodes = displacements.shape[1]
    if len(fixed) and (fixed[0] < 0 or fixed[-1] >= n_nodes):
        raise SpecError(
            f"`fixed_nodes` must be in [0, {n_nodes - 1}]; got {fixed[0]} to {fixed[-1]}."
        )
    if len(fixed) == n_nodes:
        raise SpecError("`fixed_nodes` holds every node: nothing can move.")
    moved = np.abs(displacements[:, fixed]).max(axis=(1, 2), initial=0.0)
    if (moved > STILL * np.abs(displacements).max()).any():
        raise SpecError(
            f"`displacements` must be zero at `fixed_nodes`; "
            f"sample {int(moved.argmax())} has {moved.max():.3g} m."
        )
