"""Shards of snapshots on disk: HDF5 files, written atomically, with a checksum of their content.

A shard begins with a user block of 512 bytes, which HDF5 skips. It holds one line of JSON: format,
schema version, and the length and SHA-256 of the rest of the file. One rename commits data and
checksum together.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import secrets
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.array_files import check_hdf5, reading
from mor_bench.checked_files import parse_json, read_bytes
from mor_bench.errors import NewerSchemaError, StoreError, printable
from mor_bench.scratch import host_name, identity, is_running

SCHEMA_VERSION = 3
FORMAT = "mor-bench snapshots"
HEADER_BYTES = 512
STATUSES = ("ok", "inverted", "no-equilibrium")

STALE_AFTER_S = 3600.0
"""Age after which a temporary file of another machine is a leftover, s. No write takes as long."""


@dataclass(frozen=True)
class Shard:
    """Consecutive samples.

    Attributes
    ----------
    dataset : str
        Key of the dataset, see `mor_bench.snapshots.generate.dataset_key`.
    start : int
        Number of the first sample.
    patches : (n, k) int64
    vectors : (n, k, 3) float64
        Forces on the patches, N.
    displacements : (n, n_free) float64
        Displacements of the free dofs, m; NaN where the status is not `ok`.
    min_det_f : (n,) float64
    status : (n,) uint8
        Index into `STATUSES`.
    parameters : (n, n_parameters) float64
        Sampled parameters. Without any, there are no columns, and the file has no such array.
    """

    dataset: str
    start: int
    patches: NDArray[np.int64]
    vectors: NDArray[np.float64]
    displacements: NDArray[np.float64]
    min_det_f: NDArray[np.float64]
    status: NDArray[np.uint8]
    parameters: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        if self.parameters.size == 0:
            vars(self)["parameters"] = np.zeros((len(self.patches), 0))

    @property
    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """The arrays that a file holds, by name."""
        names = list(_FIELDS) if self.parameters.shape[1] else list(_FIELDS)[:-1]
        return {name: getattr(self, name) for name in names}

    def first(self, n: int) -> Shard:
        """Return the first n samples, or all if there are fewer."""
        return replace(self, **{name: getattr(self, name)[:n] for name in _FIELDS})


_FIELDS = {
    "patches": "<i8",
    "vectors": "<f8",
    "displacements": "<f8",
    "min_det_f": "<f8",
    "status": "|u1",
    "parameters": "<f8",
}
_RANKS = {
    "patches": 2,
    "vectors": 3,
    "displacements": 2,
    "min_det_f": 1,
    "status": 1,
    "parameters": 2,
}


def make_own_folder(folder: Path) -> None:
    """Create a folder in a run's folder; refuse a link, which may lead to files of others.

    Raises
    ------
    StoreError
        If the folder is a link.
    """
    if folder.is_symlink():
        raise StoreError(f"{folder}: is a link to another folder; remove it.")
    folder.mkdir(parents=True, exist_ok=True)


def temporary_beside(path: Path) -> Path:
    """Return the name of a temporary file that `remove_leftovers` removes if its writer is killed.

    The name identifies the writer, even if several machines share the folder.
    """
    owner = f"{host_name()}.{identity(os.getpid())}"
    return path.with_name(f".{path.name}.{owner}.{secrets.token_hex(4)}.tmp")


def check_replaceable(path: Path) -> None:
    """Refuse a folder, and a device or a pipe, which a file would replace.

    Raises
    ------
    StoreError
        If something other than a file is there.
    """
    if path.is_dir():
        raise StoreError(f"{path}: is a folder, so no file can be written there.")
    if path.exists() and not path.is_file():
        raise StoreError(f"{path}: is a device or pipe, so no file can be written there.")


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that it is complete or absent, even if the process is killed."""
    temporary = temporary_beside(path)
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        error.filename, error.filename2 = str(path), None  # the user knows no temporary file
        raise
    finally:
        with suppress(NotADirectoryError):
            temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path, of: str = "*") -> None:
    """Remove temporary files of killed writers, for one target name or all.

    Files of live processes are kept.
    """
    for path in folder.glob(f".{of}.*.tmp"):
        with suppress(FileNotFoundError):  # another process may remove it first
            if _is_abandoned(path):
                path.unlink()


def _is_abandoned(temporary: Path) -> bool:
    """Return whether a writer has ended: by its process here, by age on other machines.

    Ages depend on the system clock, which may jump.
    """
    named = re.fullmatch(r"\..*\.([^.]*)\.(\d+-\d+)\.[0-9a-f]+\.tmp", temporary.name)
    if named and named[1] == host_name():
        return not is_running(named[2])
    return time.time() - temporary.stat().st_mtime > STALE_AFTER_S


def shard_bytes(shard: Shard) -> bytes:
    """Return the content of a shard's file. The same shard always gives the same bytes."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=HEADER_BYTES) as file:
        file.attrs["dataset"], file.attrs["start"] = shard.dataset, shard.start
        for name, array in shard.arrays.items():
            file.create_dataset(name, data=array.astype(_FIELDS[name]), track_times=False)
    body = buffer.getvalue()[HEADER_BYTES:]
    return header_line(SCHEMA_VERSION, len(body), hashlib.sha256(body).hexdigest()) + body


def header_line(version: int, length: int, digest: str) -> bytes:
    """Return the user block of a shard."""
    header = {"format": FORMAT, "schema_version": version, "bytes": length, "sha256": digest}
    return json.dumps(header).encode().ljust(HEADER_BYTES, b" ")


def write_shard(path: Path, shard: Shard) -> None:
    """Write a shard atomically."""
    write_atomically(path, shard_bytes(shard))


def read_shard(path: Path) -> Shard:
    """Read and check a shard.

    Raises
    ------
    StoreError
        If the file is unreadable, truncated, changed, not a shard, or of another schema.
    FileNotFoundError
        If it does not exist.
    """
    return parse_shard(read_bytes(path), str(path))


def parse_shard(content: bytes, where: str) -> Shard:
    """Return the shard in a file's content; messages of `StoreError` begin with ``where``."""
    head, body = content[:HEADER_BYTES], memoryview(content)[HEADER_BYTES:]
    try:
        header = parse_json(head, where)
        format_, version = header["format"], header["schema_version"]
    except (StoreError, KeyError, TypeError):
        raise StoreError(f"{where}: not a shard of mor-bench, or its header is damaged.") from None
    if format_ != FORMAT:
        raise StoreError(f"{where}: not a shard of mor-bench (format {format_!r}).")
    check_version(version, where)
    length, digest = header.get("bytes"), header.get("sha256")
    if header_line(version, length, digest) != head:
        raise StoreError(f"{where}: damaged: the header has changed.")
    if not isinstance(length, int) or len(body) > length:
        raise StoreError(f"{where}: damaged: its length differs from the length in its header.")
    if len(body) < length:
        raise StoreError(
            f"{where}: truncated: only {HEADER_BYTES + len(body):,} of "
            f"{HEADER_BYTES + length:,} bytes exist."
        )
    if hashlib.sha256(body).hexdigest() != digest:
        raise StoreError(f"{where}: damaged: the checksum does not match.")
    with reading(where, "shard", StoreError), h5py.File(io.BytesIO(content), "r") as file:
        check_hdf5(file, len(content))
        names = [name for name in _FIELDS if name != "parameters" or name in file]
        for name in names:
            dtype = _FIELDS[name]
            if file[name].dtype != dtype or file[name].ndim != _RANKS[name]:
                raise ValueError(f"`{name}` must be an array of {_RANKS[name]} axes of {dtype}")
        return Shard(
            str(file.attrs["dataset"]),
            int(file.attrs["start"]),
            **{name: file[name][()] for name in names},
        )


def check_version(version: object, where: str) -> None:
    """Raise `StoreError` with advice if a file has a schema that this version does not read."""
    if version == SCHEMA_VERSION:
        return
    newer = isinstance(version, int) and version > SCHEMA_VERSION
    kind: type[StoreError] = NewerSchemaError if newer else StoreError
    remedy = "update mor-bench to read it, or remove it" if newer else "generate the dataset again"
    raise kind(
        f"{where}: schema version {printable(str(version), 50, '')}; "
        f"this version of mor-bench reads version {SCHEMA_VERSION}: {remedy}."
    )
