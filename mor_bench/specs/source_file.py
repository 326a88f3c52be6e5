"""Files that a dataset is made from, identified by their content."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationInfo

from mor_bench.digests import digest_of_file
from mor_bench.errors import SpecError
from mor_bench.specs.base import StrictModel

RECORDED = "recorded"
"""Validation context of a specification in a stored file, where each file needs a checksum."""


class SourceFile(StrictModel):
    """A file with the checksum of its content. A TOML holds its path alone.

    Attributes
    ----------
    path : str
        Absolute path. It is not part of a dataset's digest.
    sha256 : str
        SHA-256 of the content.
    """

    path: str
    sha256: str

    def checked(self) -> Path:
        """Return the path after checking that the content has not changed.

        Raises
        ------
        SpecError
            If the file is missing, is a device or pipe, or has changed. The message is the same
            for all, so that a forged specification does not find out which files exist.
        """
        try:
            same = _sha256(Path(self.path)) == self.sha256
        except SpecError:
            same = False
        if not same:
            raise SpecError(
                f"{self.path}: the file has changed since the dataset was read, or is missing."
            )
        return Path(self.path)


def _sha256(path: Path) -> str:
    try:
        return digest_of_file(path, SpecError)
    except FileNotFoundError:
        raise SpecError(f"{path}: no such file.") from None


def read_source_file(value: Any, info: ValidationInfo) -> Any:
    """Turn a path, relative to the folder of the TOML, into the content of a `SourceFile`."""
    if isinstance(value, SourceFile | dict):
        return value
    if not isinstance(value, str):
        raise ValueError("it must be the path of a file")
    if info.context is RECORDED:
        raise ValueError("it must be a table of `path` and `sha256`")
    try:
        path = (Path(info.context or ".") / value).resolve()
    except (ValueError, OSError, RuntimeError) as error:  # a NUL, or a circle of links
        raise ValueError(f"it cannot be a path: {error}") from None
    return {"path": str(path), "sha256": _sha256(path)}


File = Annotated[SourceFile, BeforeValidator(read_source_file)]


def without_paths(value: Any) -> Any:
    """Copy a dumped specification without the paths of its files: only their content counts."""
    if isinstance(value, dict):
        return {
            key: without_paths(item)
            for key, item in value.items()
            if not (key == "path" and "sha256" in value)
        }
    return [without_paths(item) for item in value] if isinstance(value, list) else value
