"""Shards of snapshots on disk: HDF5 files, each written atomically and carrying a checksum of all that it holds.

A shard begins with a 512-byte user block (which HDF5 skips) that holds one line of JSON: format, schema version, and the
length and the SHA-256 of the rest of the file. One rename commits data and checksum together.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import re
import secrets
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import NewerSchemaError, StoreError

SCHEMA_VERSION = 3
FORMAT = "mor-bench snapshots"
HEADER_BYTES = 512
STATUSES = ("ok", "inverted", "no-equilibrium")

STALE_AFTER_S = 3600.0
"""Age from which a temporary file is a leftover whoever wrote it; no write takes as long."""


@dataclass(frozen=True)
class Shard:
    """Consecutive samples.

    Attributes
    ----------
    dataset : str
        What the samples belong to, see `mor_bench.snapshots.generate.dataset_key`.
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

    dataset: str
    start: int
    patches: NDArray[np.int64]
    vectors: NDArray[np.float64]
    displacements: NDArray[np.float64]
    min_det_f: NDArray[np.float64]
    status: NDArray[np.uint8]

    def first(self, n: int) -> Shard:
        """The first n samples, or all if there are no more."""
        return replace(self, **{name: getattr(self, name)[:n] for name in _FIELDS})


_FIELDS = {
    "patches": "<i8",
    "vectors": "<f8",
    "displacements": "<f8",
    "min_det_f": "<f8",
    "status": "|u1",
}


def _host() -> str:
    return re.sub(r"[^0-9A-Za-z-]", "-", platform.node())


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all, whatever happens in between."""
    # The name tells who writes, and is another's on no machine that shares the folder.
    temporary = path.with_name(f".{path.name}.{_host()}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path, of: str = "*") -> None:
    """Remove temporary files, of all or of one name, whose writers were killed; those of processes that live are left to them."""
    for path in folder.glob(f".{of}.*.tmp"):
        with suppress(FileNotFoundError):  # another process is tidying up too
            if _writer_is_dead(path) or time.time() - path.stat().st_mtime > STALE_AFTER_S:
                path.unlink()


def _writer_is_dead(temporary: Path) -> bool:
    """Whether a file was written by a process of this machine that is no more; False if that cannot be known."""
    named = re.fullmatch(r"\..*\.(?P<host>[^.]*)\.(?P<pid>\d+)\.[0-9a-f]+\.tmp", temporary.name)
    if (
        named is None or named["host"] != _host() or sys.platform == "win32"
    ):  # there, signal 0 is not one that does nothing
        return False
    try:
        os.kill(int(named["pid"]), 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def shard_bytes(shard: Shard) -> bytes:
    """A shard as the content of a file; the same shard always gives the same bytes."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=HEADER_BYTES) as file:
        file.attrs["dataset"], file.attrs["start"] = shard.dataset, shard.start
        for name, dtype in _FIELDS.items():
            file.create_dataset(name, data=getattr(shard, name).astype(dtype), track_times=False)
    body = buffer.getvalue()[HEADER_BYTES:]
    return _header(SCHEMA_VERSION, len(body), hashlib.sha256(body).hexdigest()) + body


def _header(version: int, length: int, digest: str) -> bytes:
    header = {"format": FORMAT, "schema_version": version, "bytes": length, "sha256": digest}
    return json.dumps(header).encode().ljust(HEADER_BYTES, b" ")


def write_shard(path: Path, shard: Shard) -> None:
    """Write a shard atomically."""
    write_atomically(path, shard_bytes(shard))


def read_shard(path: Path) -> Shard:
    """Read a shard and check it.

    Raises
    ------
    StoreError
        If the file cannot be read, is foreign, of another schema, truncated, or a bit of it has changed.
    FileNotFoundError
        If there is none.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror}.") from None
    return parse_shard(content, str(path))


def parse_shard(content: bytes, where: str) -> Shard:
    """The shard that a file's content is; raises `StoreError`, whose message begins with ``where``."""
    head, body = content[:HEADER_BYTES], memoryview(content)[HEADER_BYTES:]
    try:
        header = json.loads(head)
        format_, version = header["format"], header["schema_version"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise StoreError(f"{where}: not a shard of mor-bench, or its header is damaged.") from None
    if format_ != FORMAT:
        raise StoreError(f"{where}: not a shard of mor-bench (format {format_!r}).")
    check_version(version, where)
    length, digest = header.get("bytes"), header.get("sha256")
    if _header(version, length, digest) != head:
        raise StoreError(f"{where}: damaged: the header is not as it was written.")
    if not isinstance(length, int) or len(body) > length:
        raise StoreError(f"{where}: damaged: it is not as long as its header says.")
    if len(body) < length:
        raise StoreError(
            f"{where}: truncated: {HEADER_BYTES + len(body):,} of {HEADER_BYTES + length:,} bytes are there."
        )
    if hashlib.sha256(body).hexdigest() != digest:
        raise StoreError(f"{where}: damaged: the checksum does not match.")
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            return Shard(
                str(file.attrs["dataset"]),
                int(file.attrs["start"]),
                **{name: file[name][()] for name in _FIELDS},
            )
    except (OSError, KeyError) as error:
        raise StoreError(f"{where}: its content is not that of a shard: {error}") from None


def check_version(version: object, where: str) -> None:
    """Raise `StoreError`, saying what to do, if a file is of another schema than this version of mor-bench reads."""
    if version == SCHEMA_VERSION:
        return
    newer = isinstance(version, int) and version > SCHEMA_VERSION
    kind, remedy = (
        (NewerSchemaError, "update mor-bench to read it, or remove it")
        if newer
        else (StoreError, "generate the dataset again")
    )
    raise kind(
        f"{where}: schema version {version}; this version of mor-bench reads version {SCHEMA_VERSION}: {remedy}."
    )
