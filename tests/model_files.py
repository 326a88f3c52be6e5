"""Forge model files with a checksum that fits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from safetensors.numpy import save as serialise

from mor_bench.model_file import model_digest, read_header_and_arrays

Arrays = dict[str, NDArray[Any]]


def sealed(header: Mapping[str, str], arrays: Arrays) -> bytes:
    """Return a model file with this header and these arrays."""
    return serialise(arrays, metadata={**header, "sha256": model_digest(header, arrays)})


def rewrite(path: Path, forge: Callable[[Arrays], object], **header: str) -> None:
    """Change the arrays and the header of a model file."""
    known, arrays = read_header_and_arrays(path)
    forge(arrays)
    path.write_bytes(sealed({**known, **header}, arrays))
