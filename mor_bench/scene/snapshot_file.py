"""Snapshots of another program: arrays in an NPZ or HDF5 file.

`points` (n_nodes, 3), m; `cells` (n_cells, 8 or 4), in VTK order, counted from 0; `forces` and `displacements`
(n, n_nodes, 3), N and m; and, where there are any, `fixed_nodes` (n_fixed,); `regions` (n,), or (n, k) with k forces at
once, load-region ids from 0; `test` (n,), true, or 1, for the samples that are kept for the test.
"""

from __future__ import annotations

import difflib
import hashlib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.soundness import check_numbers, in_grid, sound_cells
from mor_bench.specs import SourceFile

STILL = 1e-9
"""Displacement of a fixed node, as a fraction of the largest of all, that is taken for zero."""

MAX_SIZE = {"forces": 1e30, "displacements": 1e30}
"""N and m; squares and products of what is no larger are far from overflow."""

REQUIRED = ("points", "cells", "forces", "displacements")
OPTIONAL = ("fixed_nodes", "regions", "test")
_KINDS = {"cells": "iu", "fixed_nodes": "iu", "regions": "iu", "test": "biu"}
_WORDS = {"iu": "integers", "biu": "booleans, or 0 and 1 as integers", "fiu": "real numbers"}


@dataclass(frozen=True)
class ImportedArrays:
    """What a file of snapshots holds, checked.

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
    test : (n,) bool or None
    """

    mesh: Mesh
    forces: NDArray[np.float64]
    displacements: NDArray[np.float64]
    fixed_nodes: NDArray[np.int64]
    regions: NDArray[np.int64] | None
    test: NDArray[np.bool_] | None


def read_arrays(file: SourceFile) -> ImportedArrays:
    """Read and check a file of snapshots.

    Raises
    ------
    SpecError
        If the file is missing, has changed or cannot be read, or an array is missing, unknown, or not as it must be.
    """
    path = file.checked()
    try:
        return _checked(_read(path))
    except SpecError as error:
        raise SpecError(f"{path}: {error}") from None


def _read(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a file; objects, which would have to be unpickled, are refused."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".npz":
            with zipfile.ZipFile(path):  # anything else that numpy reads holds no named arrays
                pass
            with np.load(path, allow_pickle=False) as content:
                _check_names(content.files)
                return {name: content[name] for name in content.files}
        if suffix in (".h5", ".hdf5"):
            with h5py.File(path, "r") as content:
                _check_names(list(content))
                return {name: _entry(content, name) for name in content}
    except SpecError:
        raise
    except (
        OSError,
        ValueError,
        EOFError,
        TypeError,
        KeyError,
        AttributeError,
        zipfile.BadZipFile,
        UnpicklingError,
    ) as error:
        raise SpecError(
            f"not a readable {suffix} file of arrays: {' '.join(str(error).split())}"
        ) from None
    raise SpecError(f"snapshots must be in an .npz, .h5 or .hdf5 file; got {suffix!r}.")


def _entry(content: h5py.File, name: str) -> NDArray[Any]:
    try:
        entry = content[name]
        if isinstance(entry, h5py.Dataset) and h5py.check_string_dtype(entry.dtype) is None:
            return np.asarray(entry[()] if entry.shape is not None else np.zeros(0))
    except (OSError, KeyError, RuntimeError) as error:
        raise SpecError(f"`{name}` cannot be read: {' '.join(str(error).split())}") from None
    raise SpecError(
        f"`{name}` must be an array of numbers; got {'text' if isinstance(entry, h5py.Dataset) else 'a group'}."
    )


def _check_names(names: list[str]) -> None:
    known = (*REQUIRED, *OPTIONAL)
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            raise SpecError(
                f"unknown array `{name}`{f'; did you mean {close[0]!r}?' if close else '.'} Allowed: {', '.join(known)}."
            )
    for name in REQUIRED:
        if name not in names:
            raise SpecError(f"array `{name}` is missing.")


def _checked(arrays: Mapping[str, NDArray[Any]]) -> ImportedArrays:
    _check_shapes(arrays)
    points, cells = arrays["points"].astype(np.float64), _integers(arrays["cells"])
    fixed = np.unique(_integers(arrays.get("fixed_nodes", np.zeros(0))))
    forces, displacements = (_in_range(name, arrays[name]) for name in ("forces", "displacements"))
    n, n_nodes = forces.shape[:2]
    if n == 0:
        raise SpecError("there must be samples; got none.")
    regions = _integers(arrays["regions"]).reshape(n, -1) if "regions" in arrays else None
    check_numbers(points, cells)
    if (unused := n_nodes - len(np.unique(cells))) > 0:
        raise SpecError(f"every node must belong to a cell; {unused} of {n_nodes} do not.")
    cells = sound_cells(points, cells)
    _check_samples(forces, displacements, fixed, regions)
    return ImportedArrays(
        in_grid(Mesh(points, cells)),
        forces,
        displacements,
        fixed,
        regions,
        _truths(arrays.get("test")),
    )


def _check_shapes(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise `SpecError` for the first array of a wrong type or shape, or with an entry that is not finite."""
    n, n_nodes = len(np.atleast_1d(arrays["forces"])), len(np.atleast_1d(arrays["points"]))
    shapes: dict[str, tuple[tuple[int | None, ...], ...]] = {
        "points": ((None, 3),),
        "cells": ((None, 8), (None, 4)),
        "forces": ((n, n_nodes, 3),),
        "displacements": ((n, n_nodes, 3),),
        "fixed_nodes": ((None,),),
        "regions": ((n,), (n, None)),
        "test": ((n,),),
    }
    for name in (*REQUIRED, *OPTIONAL):
        array = arrays.get(name)
        if array is None or (
            name == "fixed_nodes" and array.size == 0
        ):  # what is empty may have any type
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


def _integers(array: NDArray[Any]) -> NDArray[np.int64]:
    return np.asarray(array).astype(np.int64)


def _in_range(name: str, array: NDArray[Any]) -> NDArray[np.float64]:
    with np.errstate(over="ignore"):  # a longer type may hold what is infinite here
        numbers = np.ascontiguousarray(array, dtype=np.float64)
    size, unit = np.abs(numbers), {"forces": "N", "displacements": "m"}[name]
    if not (size <= MAX_SIZE[name]).all():
        worst = [int(i) for i in np.unravel_index(size.argmax(), size.shape)]
        raise SpecError(
            f"`{name}` must be in [-{MAX_SIZE[name]:g}, {MAX_SIZE[name]:g}] {unit}; entry {worst} is {numbers[tuple(worst)]:g}."
        )
    if size.size and not size.any():
        raise SpecError(
            f"`{name}` must differ from zero somewhere, and be at most {MAX_SIZE[name]:g} {unit}; got zeros only."
        )
    return numbers


def _truths(array: NDArray[Any] | None) -> NDArray[np.bool_] | None:
    if array is not None and not np.isin(array, [0, 1]).all():
        raise SpecError(f"`test` must hold {_WORDS['biu']}; got {array.min()} to {array.max()}.")
    return None if array is None else array.astype(np.bool_)


def _check_samples(
    forces: NDArray[np.float64],
    displacements: NDArray[np.float64],
    fixed: NDArray[np.int64],
    regions: NDArray[np.int64] | None,
) -> None:
    n, n_nodes = forces.shape[:2]
    if len(fixed) and (fixed[0] < 0 or fixed[-1] >= n_nodes):
        raise SpecError(
            f"`fixed_nodes` must be in [0, {n_nodes - 1}]; got {fixed[0]} to {fixed[-1]}."
        )
    if len(fixed) == n_nodes:
        raise SpecError("`fixed_nodes` holds every node: nothing can move.")
    moved = np.abs(displacements[:, fixed]).max(axis=(1, 2), initial=0.0)
    if (moved > STILL * np.abs(displacements).max()).any():
        raise SpecError(
            f"`displacements` must be zero at `fixed_nodes`; sample {int(moved.argmax())} has {moved.max():.3g} m."
        )
    if regions is not None and (not regions.size or regions.min() < 0):
        raise SpecError("`regions` must be ids from 0 on.")
    # 0.0 and -0.0 are one number and two patterns of bits.
    seen = {hashlib.sha256((force + 0.0).tobytes()).digest() for force in forces}
    if len(seen) < n:
        raise SpecError(f"`forces`: {n - len(seen)} samples repeat others.")
