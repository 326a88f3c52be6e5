"""A new folder or ZIP file that gets files and their checksums, and appears when it is complete."""

from __future__ import annotations

import hashlib
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mor_bench.errors import StoreError
from mor_bench.snapshots.archive_files import SUMS, most_bytes
from mor_bench.snapshots.store import temporary_beside


class ArchiveWriter:
    """Adds files to an archive; `new_archive` makes one.

    Attributes
    ----------
    sums : dict of str to str
        SHA-256 of each file, by name.
    sizes : dict of str to int
        Bytes of each file.
    """

    def __init__(self, folder: Path, packed: zipfile.ZipFile | None, top: str) -> None:
        self._folder, self._packed, self._top = folder, packed, top
        self.sums: dict[str, str] = {}
        self.sizes: dict[str, int] = {}

    def add(self, name: str, content: bytes) -> None:
        """Write a file.

        Raises
        ------
        StoreError
            If an archive may not hold a file of this name or size.
        """
        most = most_bytes(name)
        if most is None or len(content) > most:
            raise StoreError(f"{name}: {len(content):,} bytes; an archive cannot hold this file.")
        self.sums[name], self.sizes[name] = hashlib.sha256(content).hexdigest(), len(content)
        if self._packed is None:
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            return
        # Always the same date and rights, so that equal datasets give equal bytes.
        info = zipfile.ZipInfo(f"{self._top}/{name}")
        info.external_attr = 0o644 << 16
        self._packed.writestr(info, content)

    def list_sums(self) -> str:
        """Write the list of the checksums so far, and return the SHA-256 of the list."""
        lines = "".join(f"{digest}  {name}\n" for name, digest in sorted(self.sums.items()))
        self.add(SUMS, lines.encode())
        return self.sums[SUMS]


@contextmanager
def new_archive(target: Path) -> Iterator[ArchiveWriter]:
    """Make a ZIP file if the name ends in .zip, and a folder otherwise.

    After an error nothing is left of it.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_beside(target)
    try:
        if target.suffix.lower() == ".zip":
            with zipfile.ZipFile(temporary, "x", zipfile.ZIP_STORED) as packed:
                yield ArchiveWriter(temporary, packed, target.stem)
        else:
            temporary.mkdir()
            yield ArchiveWriter(temporary, None, "")
        temporary.rename(target)
    except OSError as error:
        raise StoreError(f"{target}: cannot be written: {error.strerror or error}.") from error
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)
