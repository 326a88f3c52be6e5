"""List and clean the cache folder, which holds generated datasets and finished fits."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mor_bench.errors import InvalidInputError
from mor_bench.specs.one_line_errors import nearest_name

KINDS = {"datasets": "dataset", "fits": "fit"}
"""Subfolders of the cache, and the kind of their entries."""


@dataclass(frozen=True)
class CacheEntry:
    """All folders in the cache of one dataset or one method.

    Attributes
    ----------
    kind : {"dataset", "fit"}
    name : str
    folders : tuple of Path
        One per version of a dataset, or per configuration and dataset of a method.
    size_bytes : int
    changed : datetime
        Time of the last change.
    """

    kind: str
    name: str
    folders: tuple[Path, ...]
    size_bytes: int
    changed: datetime

    def as_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {
            "kind": self.kind,
            "name": self.name,
            "n_folders": len(self.folders),
            "size_bytes": self.size_bytes,
            "changed": self.changed.isoformat(timespec="seconds"),
        }

    def remove(self) -> None:
        """Delete the folders; a later run generates or fits again."""
        for folder in self.folders:
            shutil.rmtree(folder)


def cache_entries(cache: Path, names: Sequence[str] = ()) -> list[CacheEntry]:
    """Return the entries of a cache folder, or only those of some datasets and methods.

    Raises
    ------
    InvalidInputError
        If the cache has nothing of a name.
    """
    found = list(_entries(cache))
    known = {entry.name for entry in found}
    for name in names:
        if name not in known:
            raise InvalidInputError(
                f"{cache}: the cache has nothing of {name!r}{nearest_name(name, known)}"
            )
    return [entry for entry in found if not names or entry.name in names]


def _entries(cache: Path) -> Iterator[CacheEntry]:
    for part, kind in KINDS.items():
        groups: dict[str, list[Path]] = {}
        for folder in sorted((cache / part).glob("*-*")):
            if folder.is_dir() and not folder.is_symlink():
                groups.setdefault(_name(kind, folder.name), []).append(folder)
        for name, folders in groups.items():
            status = [path.lstat() for folder in folders for path in folder.rglob("*")]
            yield CacheEntry(
                kind,
                name,
                tuple(folders),
                sum(item.st_size for item in status),
                datetime.fromtimestamp(max((item.st_mtime for item in status), default=0.0), UTC),
            )


def _name(kind: str, folder: str) -> str:
    """Return the name in NAME-DIGEST-VERSION of a dataset, or in NAME-DIGEST of a fit."""
    return folder.rsplit("-", 2 if kind == "dataset" else 1)[0]
