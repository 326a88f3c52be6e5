"""Digests of arrays and files, which identify equal content."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.checked_files import check_file
from mor_bench.errors import MorBenchError, StoreError


def digest_of_file(path: Path, error: type[MorBenchError] = StoreError) -> str:
    """Return the SHA-256 of a file, read in blocks; errors as in `check_file`."""
    check_file(path, error=error)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise
    except OSError as reason:
        raise error(f"{path}: cannot be read: {reason.strerror}.") from None


def digest_of_arrays(
    arrays: Mapping[str, NDArray[Any]], parts: Mapping[str, object] | None = None
) -> str:
    """Return the SHA-256 of names, dtypes, shapes and values of arrays, in the order of names.

    If `parts` are given, their JSON comes first; other values are converted to text.
    """
    text = "" if parts is None else json.dumps(parts, sort_keys=True, default=str)
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        digest.update(np.ascontiguousarray(arrays[name]).data)
    return digest.hexdigest()
