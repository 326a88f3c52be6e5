"""Named arrays in HDF5 files."""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.array_files import read_hdf5
from mor_bench.digests import digest_of_arrays
from mor_bench.errors import StoreError
from mor_bench.snapshots.store import make_own_folder, write_atomically


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays to an HDF5 file, atomically.

    Raises
    ------
    StoreError
        If the file's folder is a link.
    """
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, track_times=False)
    make_own_folder(path.parent)
    write_atomically(path, buffer.getvalue())


def write_verified(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays with their digest."""
    digest = np.array(digest_of_arrays(arrays).encode())
    write_arrays(path, {**arrays, "digest": digest})


def verified_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """Read arrays that have their digest; None if there are none or they are damaged."""
    with suppress(OSError, KeyError, ValueError, StoreError):
        arrays = read_hdf5(path)
        if str(arrays.pop("digest").astype(str)) == digest_of_arrays(arrays):
            return arrays
    return None
