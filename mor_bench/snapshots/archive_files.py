"""The files of an archive of a dataset: their names and checksums, in a folder or a ZIP file.

``SHA256SUMS`` lists every other file in the form of ``sha256sum``::

    NAME.toml, source-…                the dataset, and the meshes and surfaces that it names
    samples/manifest.json              the manifest of the main set
    samples/shard-…, seconds-…         its shards, and the time that each took
    tests/SET/…                        the same for each named test set
    README.md, LICENSE.txt             for people
    metadata.json                      for catalogues

Files of an archive are data of strangers. Only these names are allowed, so no name leads out of the
archive and no file of another kind is opened.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from mor_bench.array_files import reading
from mor_bench.checked_files import MIB, MOST_BYTES, MOST_JSON_BYTES, MOST_TOML_BYTES, check_file
from mor_bench.errors import StoreError, printable

SUMS = "SHA256SUMS"
MAIN, TESTS = "samples", "tests"
MANIFEST = "manifest.json"
CARD, LICENCE, METADATA = "README.md", "LICENSE.txt", "metadata.json"

MOST_SUMS_BYTES, MOST_TEXT_BYTES, MOST_MESH_BYTES = 64 * MIB, MIB, 1024 * MIB
"""Size limits of the list of checksums, of a text, and of a mesh or surface file."""

_SET = rf"(?:{MAIN}|{TESTS}/[a-z0-9-]{{1,40}})"
_KINDS = {
    re.escape(SUMS): MOST_SUMS_BYTES,
    "README\\.md|LICENSE\\.txt": MOST_TEXT_BYTES,
    "metadata\\.json": MOST_JSON_BYTES,
    "[a-z0-9-]{1,100}\\.toml": MOST_TOML_BYTES,
    r"source-[0-9a-f]{12}(?:\.\w{1,10})?": MOST_MESH_BYTES,
    rf"{_SET}/manifest\.json": MOST_JSON_BYTES,
    rf"{_SET}/seconds-\d{{5,6}}\.txt": 100,
    rf"{_SET}/shard-\d{{5,6}}\.h5": MOST_BYTES,
}
"""Patterns of the names that an archive may hold, with the size limits of such files, bytes."""

_IGNORED = ".DS_Store"
"""A file that the Finder of macOS adds to each folder that it shows; it is never opened."""

_FOLDERS = re.compile(rf"{MAIN}|{TESTS}|{TESTS}/[a-z0-9-]{{1,40}}")
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")


def most_bytes(name: str) -> int | None:
    """Return the size limit of a file of an archive; None if an archive has no such file."""
    found = (most for pattern, most in _KINDS.items() if re.fullmatch(pattern, name, re.ASCII))
    return next(found, None)


@dataclass(frozen=True)
class Archive:
    """The files of an opened archive, whose names and sizes are allowed.

    Attributes
    ----------
    path : Path
        The folder or ZIP file, for messages.
    sizes : dict of str to int
        Bytes of each file, by its name in the archive.
    sums : dict of str to str
        SHA-256 of each file but the list itself, as listed.
    """

    path: Path
    sizes: dict[str, int]
    _open: Callable[[str], IO[bytes]]
    sums: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        for name, size in self.sizes.items():
            most = most_bytes(name)
            if most is None:
                raise StoreError(
                    f"{self.where(name)}: no file of an archive of a dataset; remove it."
                )
            if size > most:
                raise StoreError(
                    f"{self.where(name)}: {size:,} bytes; files of this kind have at most {most:,}."
                )
        if SUMS not in self.sizes:
            raise StoreError(f"{self.path}: no archive of a dataset: {SUMS} is missing.")
        vars(self)["sums"] = self._listed()

    def where(self, name: str) -> str:
        """Return the place of a file, for messages."""
        return f"{self.path}/{printable(name, 200, '')}"

    def _listed(self) -> dict[str, str]:
        sums: dict[str, str] = {}
        for i, line in enumerate(self._content(SUMS).decode(errors="replace").splitlines(), 1):
            found = _LINE.fullmatch(line)
            if not found or most_bytes(found[2]) is None or found[2] == SUMS or found[2] in sums:
                raise StoreError(
                    f"{self.where(SUMS)}: line {i} is not the checksum of a file of an archive: "
                    f"{printable(line, 100, '')!r}."
                )
            sums[found[2]] = found[1]
        if lost := sorted(sums.keys() - self.sizes.keys()):
            more = f", and {len(lost) - 1:,} more" if len(lost) > 1 else ""
            raise StoreError(f"{self.path}: incomplete: {lost[0]} is missing{more}.")
        if extra := sorted(self.sizes.keys() - sums.keys() - {SUMS}):
            raise StoreError(f"{self.where(extra[0])}: has no checksum in {SUMS}; remove it.")
        return sums

    def check_sums(self) -> None:
        """Compare every file with its checksum.

        Raises
        ------
        StoreError
            If a file differs or cannot be read.
        """
        for name in self.sums:
            with reading(self.where(name), "file", StoreError), self._open(name) as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
            self._compare(name, found)

    def _compare(self, name: str, found: str) -> None:
        if found != self.sums[name]:
            raise StoreError(
                f"{self.where(name)}: damaged: its SHA-256 differs from the one in {SUMS}."
            )

    def read(self, name: str) -> bytes:
        """Read a listed file whole, and compare it with its checksum; errors as `check_sums`."""
        content = self._content(name)
        self._compare(name, hashlib.sha256(content).hexdigest())
        return content

    def _content(self, name: str) -> bytes:
        with reading(self.where(name), "file", StoreError), self._open(name) as file:
            return file.read(self.sizes[name] + 1)


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """Open an archive, in a folder or a ZIP file, and check the names and sizes of its files.

    Raises
    ------
    StoreError
        If it is no archive, is incomplete, or holds links or anything else that is not allowed.
    FileNotFoundError
        If nothing is there.
    """
    if path.is_dir():
        yield Archive(path, _sizes_in_folder(path), lambda name: (path / name).open("rb"))
        return
    check_file(path)
    with reading(str(path), "folder or ZIP file", StoreError):
        packed = zipfile.ZipFile(path)
    with packed:
        members = _members(path, packed)
        sizes = {name: member.file_size for name, member in members.items()}
        yield Archive(path, sizes, lambda name: packed.open(members[name]))


def _sizes_in_folder(root: Path) -> dict[str, int]:
    """Return the size of each file; stop at the first thing that no archive holds."""
    if not (root / SUMS).is_file():  # before a walk through a large foreign folder
        raise StoreError(f"{root}: no archive of a dataset: {SUMS} is missing.")
    sizes: dict[str, int] = {}
    for folder, inner, files in os.walk(root):
        for name in (*inner, *files):
            path = Path(folder, name)
            inside = path.relative_to(root).as_posix()
            status = path.lstat()
            if stat.S_ISLNK(status.st_mode):
                raise StoreError(f"{path}: a link; an archive of a dataset holds none.")
            allowed = _FOLDERS.fullmatch(inside) if name in inner else most_bytes(inside)
            if name == _IGNORED and stat.S_ISREG(status.st_mode):
                continue
            if not allowed or not (stat.S_ISDIR if name in inner else stat.S_ISREG)(status.st_mode):
                shown = printable(str(path), 300, "")
                raise StoreError(f"{shown}: no file of an archive of a dataset; remove it.")
            if name not in inner:
                sizes[inside] = status.st_size
    return sizes


def _members(path: Path, packed: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the files of a ZIP file by their names below its one folder, if it has one.

    Files are stored as they are, so none is larger than the ZIP file.
    """
    infos = [
        info
        for info in packed.infolist()
        if not info.is_dir() and info.filename.rpartition("/")[2] != _IGNORED
    ]
    tops = {info.filename.partition("/")[0] for info in infos}
    top = f"{tops.pop()}/" if len(tops) == 1 and all("/" in i.filename for i in infos) else ""
    members: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.filename.removeprefix(top)
        problem = None
        if name in members:
            problem = "occurs more than once"
        elif stat.S_ISLNK(info.external_attr >> 16):
            problem = "a link; an archive of a dataset holds none"
        elif info.flag_bits & 1:
            problem = "encrypted"
        elif info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
            problem = "compressed; unpack the ZIP file, and give the folder"
        if problem:
            raise StoreError(f"{path}/{printable(info.filename, 200, '')}: {problem}.")
        members[name] = info
    if sum(info.file_size for info in infos) > path.stat().st_size:
        raise StoreError(f"{path}: its files are larger than the ZIP file, so they overlap.")
    return members
