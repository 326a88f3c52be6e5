"""Checked reading of arrays from NPZ, NPY and HDF5 files.

Before an array is allocated, its declared size is compared with the size of the file. Objects,
which would need pickle, and data in other files are refused.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.checked_files import check_file, limited_memory
from mor_bench.errors import MorBenchError, StoreError, printable

Arrays = dict[str, NDArray[Any]]

FREE_BYTES, MOST_RATIO = 2**26, 50
"""Arrays may take this many bytes, and this many times the size of their file in addition."""

MOST_OBJECTS = 10_000
"""Limit of the number of arrays and groups in a file."""


class _RefusedError(Exception):
    """The end of a message that says what is wrong with a file."""


@contextmanager
def reading(where: str, kind: str, error: type[MorBenchError]) -> Iterator[None]:
    """Turn the errors of a reader into one line that names the file."""
    try:
        yield
    except _RefusedError as reason:
        raise error(f"{where}: {reason}") from None
    except (MorBenchError, MemoryError):
        raise
    except Exception as reason:  # damaged files raise errors of many kinds
        words = printable(" ".join(str(reason).split()), 300) or type(reason).__name__
        raise error(f"{where}: not a readable {kind}: {words}") from None


@contextmanager
def _reading(path: Path, kind: str, error: type[MorBenchError]) -> Iterator[None]:
    """Check a file; errors as in `reading`."""
    check_file(path, error=error)
    with reading(str(path), kind, error):
        yield


def read_npz(path: Path, error: type[MorBenchError] = StoreError) -> Arrays:
    """Read every array of an NPZ file.

    Raises
    ------
    StoreError, or the given class of errors
        If the file is unreadable, encrypted or too large, or holds objects.
    FileNotFoundError
        If it does not exist.
    """
    limits = limited_memory(path, error)
    with _reading(path, ".npz file of arrays", error), limits, zipfile.ZipFile(path) as archive:
        _check_members(archive.infolist(), path.stat().st_size)
        return {
            member.filename.removesuffix(".npy"): _array(archive.read(member))
            for member in archive.infolist()
        }


def _check_members(members: list[zipfile.ZipInfo], file_bytes: int) -> None:
    names = [member.filename.removesuffix(".npy") for member in members]
    if len(names) > MOST_OBJECTS:
        raise _RefusedError(
            f"it holds {len(names):,} arrays; at most {MOST_OBJECTS:,} are allowed."
        )
    if doubled := sorted(name for name, n in Counter(names).items() if n > 1):
        raise _RefusedError(f"the array `{doubled[0]}` occurs more than once.")
    if any(member.flag_bits & 1 for member in members):
        raise _RefusedError("it is encrypted.")
    if any(m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for m in members):
        raise _RefusedError("its compression is unknown; use `numpy.savez` or `savez_compressed`.")
    _check_size(sum(member.file_size for member in members), file_bytes)


def _check_size(declared: int, file_bytes: int) -> None:
    if declared > FREE_BYTES + MOST_RATIO * file_bytes:
        raise _RefusedError(
            f"it declares arrays of {declared / 1e6:,.0f} MB, which is too much for a file of "
            f"{file_bytes / 1e6:,.1f} MB."
        )


def _array(content: bytes) -> NDArray[Any]:
    """Return the array in the content of an NPY file."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    if dtype.hasobject:
        raise _RefusedError("it holds Python objects, which are not loaded.")
    if math.prod(shape) * dtype.itemsize > len(content):
        raise _RefusedError("it is truncated: an array is shorter than its header says.")
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def parse_npy(content: bytes, where: str, error: type[MorBenchError] = StoreError) -> NDArray[Any]:
    """Return the array in the content of an NPY file; errors begin with ``where``."""
    with reading(where, ".npy file", error):
        return _array(content)


def read_npy(path: Path, error: type[MorBenchError] = StoreError) -> NDArray[Any]:
    """Map the array of an NPY file into memory; errors as in `read_npz`."""
    with _reading(path, ".npy file", error):
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


@contextmanager
def open_hdf5(path: Path, error: type[MorBenchError] = StoreError) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading, after a check of all its arrays.

    Errors are as in `read_npz`, also for what the caller reads inside the context.
    """
    limits = limited_memory(path, error)
    with _reading(path, "HDF5 file of arrays", error), limits, h5py.File(path, "r") as file:
        check_hdf5(file, path.stat().st_size)
        yield file


def check_hdf5(file: h5py.File, file_bytes: int) -> None:
    """Refuse data in other files, and arrays that are too large for the file."""
    declared, groups, seen = 0, [file["/"]], set()
    while groups:
        group = groups.pop()
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise _RefusedError(f"`{name}` is a link to another place or file.")
            item = group[name]
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                continue
            seen.add(address)
            if len(seen) > MOST_OBJECTS:
                raise _RefusedError(f"it holds more than {MOST_OBJECTS:,} arrays and groups.")
            if isinstance(item, h5py.Group):
                groups.append(item)
            elif isinstance(item, h5py.Dataset):
                if item.is_virtual or item.external:
                    raise _RefusedError(f"the content of `{name}` lies in other files.")
                declared += math.prod(item.shape or ()) * item.dtype.itemsize
    _check_size(declared, file_bytes)


def read_hdf5(path: Path, error: type[MorBenchError] = StoreError) -> Arrays:
    """Read every array of an HDF5 file without groups; errors as in `read_npz`."""
    with open_hdf5(path, error) as file:
        arrays = {name: np.asarray(file[name][()]) for name in file}
    if unlike := [name for name, array in arrays.items() if array.dtype.hasobject]:
        raise error(f"{path}: `{unlike[0]}` must be an array of numbers.")
    return arrays


def is_hdf5(path: Path) -> bool:
    """Return whether a regular file is in HDF5 format."""
    return bool(h5py.is_hdf5(path))
