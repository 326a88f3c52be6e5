"""Shards of snapshots on disk: HDF5 files, each written atomically and carrying a checksum of all that it holds.

A shard begins with a 512-byte user block (which HDF5 skips) that holds one line of JSON: format, schema version and
the SHA-256 of the rest of the file. One rename commits data and checksum together.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import StoreError

SCHEMA_VERSION = 2
FORMAT = "mor-bench snapshots"
HEADER_BYTES = 512
STATUSES = ("ok", "inverted", "no-equilibrium")


@dataclass(frozen=True)
class Shard:
    """Consecutive samples.

    Attributes
    ----------
    start : int
        Number of the first sample.
    patches : (n, k) int64
    vectors : (n, k, 3) float64
        Forces on the patches, N.
    displacements : (n, n_free) float64
        At the free dofs, m; NaN where the status is not `ok`.
    min_det_f : (n,) float64
    status : (n,) uint8
        Index into `STATUSES`.
    """

    start: int
    patches: NDArray[np.int64]
    vectors: NDArray[np.float64]
    displacements: NDArray[np.float64]
    min_det_f: NDArray[np.float64]
    status: NDArray[np.uint8]

    def first(self, n: int) -> Shard:
        """The first n samples, or all if there are no more."""
        return Shard(self.start, **{name: getattr(self, name)[:n] for name in _FIELDS})


_FIELDS = {"patches": "<i8", "vectors": "<f8", "displacements": "<f8", "min_det_f": "<f8", "status": "|u1"}


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all, whatever happens in between."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_shard(path: Path, shard: Shard) -> None:
    """Write a shard atomically; the same shard always gives the same bytes."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=HEADER_BYTES) as file:
        file.attrs["start"] = shard.start
        for name, dtype in _FIELDS.items():
            file.create_dataset(name, data=getattr(shard, name).astype(dtype), track_times=False)
    body = buffer.getvalue()[HEADER_BYTES:]
    header = {"format": FORMAT, "schema_version": SCHEMA_VERSION, "sha256": hashlib.sha256(body).hexdigest()}
    write_atomically(path, json.dumps(header).encode().ljust(HEADER_BYTES, b" ") + body)


def read_shard(path: Path) -> Shard:
    """Read a shard and check it.

    Raises
    ------
    StoreError
        If the file is foreign, of a newer schema, truncated, or a byte of it has changed.
    """
    content = path.read_bytes()
    try:
        header = json.loads(content[:HEADER_BYTES])
        format_, version, digest = header["format"], header["schema_version"], header["sha256"]
    except (ValueError, KeyError, TypeError):
        raise StoreError(f"{path}: not a shard of mor-bench, or its header is damaged.") from None
    if format_ != FORMAT:
        raise StoreError(f"{path}: not a shard of mor-bench (format {format_!r}).")
    if version != SCHEMA_VERSION:
        raise StoreError(f"{path}: schema version {version}; this version of mor-bench reads version {SCHEMA_VERSION}.")
    canonical = json.dumps({"format": format_, "schema_version": version, "sha256": digest}).encode().ljust(HEADER_BYTES, b" ")
    if canonical != content[:HEADER_BYTES] or hashlib.sha256(content[HEADER_BYTES:]).hexdigest() != digest:
        raise StoreError(f"{path}: damaged: the checksum does not match.")
    with h5py.File(io.BytesIO(content), "r") as file:
        return Shard(int(file.attrs["start"]), **{name: file[name][()] for name in _FIELDS})
