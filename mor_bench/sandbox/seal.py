"""Block a process's access to folders with the displacements that a method must predict."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mor_bench.sandbox import landlock

PROGRAM_EVENTS = (
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.startfile",
)
"""Audit events of starting a program; the seal would not cover the program."""

FILE_EVENTS = (
    "open",
    "os.listdir",
    "os.scandir",
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "shutil.rmtree",
)


@dataclass(frozen=True)
class Restrictions:
    """Access rights and limits of a sandboxed process.

    Attributes
    ----------
    sealed : tuple of Path
        Folders that it must not access.
    exempt : Path, optional
        A folder within the sealed ones that stays accessible, or a file that it may read.
    import_from : Path, optional
        The first folder on the import path, which holds a third party's module.
    scratch : Path, optional
        Folder for its temporary files.
    memory_bytes : float
        Limit on the resident memory of the process and its children; above it they are ended.
    """

    sealed: tuple[Path, ...] = ()
    exempt: Path | None = None
    import_from: Path | None = None
    scratch: Path | None = None
    memory_bytes: float = float("inf")


def seal(restrictions: Restrictions) -> None:
    """Close the sealed folders to this process for the rest of its life.

    Where the kernel has Landlock, it refuses every access to their contents, also to libraries in
    other languages and to processes that this one starts. Everywhere, Python's usual ways to a file
    and the start of programs raise `PermissionError`; there alone, that catches mistakes only.

    With Landlock, a third party's method can write to its scratch folder and to devices only, and
    where Python and numba keep what they compiled from its modules. So it cannot change code that
    runs later without a seal.
    """
    folders, exempt = restrictions.sealed, restrictions.exempt
    exempt_prefix = None if exempt is None else _prefix(exempt)
    prefixes = tuple(_prefix(folder) for folder in folders)

    def check(path: object) -> None:
        if not isinstance(path, str | bytes | os.PathLike):
            return
        real = _prefix(path)
        exempted = exempt_prefix is not None and real.startswith(exempt_prefix)
        if real.startswith(prefixes) and not exempted:
            raise PermissionError(
                f"{os.fsdecode(path)}: a method must not read datasets or results during a "
                "comparison."
            )

    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if event in FILE_EVENTS:
            for argument in arguments[: 1 if event == "open" else 2]:  # then comes the mode
                check(argument)
        elif event in PROGRAM_EVENTS:
            raise PermissionError(f"{event}: a method must not start programs during a comparison.")

    landlock.close_folders(folders, exempt, _writable(restrictions))
    sys.addaudithook(refuse)
    _guard_hdf5(check)


def _writable(restrictions: Restrictions) -> list[Path] | None:
    """Return the folders in which a third party's method may write; None for own methods."""
    if restrictions.import_from is None or restrictions.scratch is None:
        return None
    compiled = restrictions.import_from / "__pycache__"
    with suppress(OSError):
        if any(restrictions.import_from.glob("*.py")):
            compiled.mkdir(exist_ok=True)
    _only_read_compiled_code()
    return [restrictions.scratch, compiled, Path("/dev")]


def _only_read_compiled_code() -> None:
    """Let numba read its caches in folders in which it cannot write."""
    from numba.core import caching

    save: Callable[..., None] = caching.Cache.save_overload

    def save_if_possible(*arguments: Any) -> None:
        with suppress(OSError):
            save(*arguments)

    def check(locator: Any) -> None:
        path = locator.get_cache_path()
        if os.path.exists(path) and not os.access(path, os.W_OK):
            raise PermissionError(path)

    # Before numba reads a cache, it tries to write beside it, which Landlock would refuse.
    names: Any = caching
    names.Cache.save_overload = save_if_possible
    for name in ("UserProvidedCacheLocator", "InTreeCacheLocator", "UserWideCacheLocator"):
        getattr(names, name).ensure_cache_path = check


def isolation() -> dict[str, str]:
    """Return the kind of isolation on this machine, for the description of the machine."""
    return {"isolation": "landlock" if landlock.version() else "audit hook"}


def _prefix(path: str | bytes | os.PathLike[Any]) -> str:
    return os.path.realpath(os.fsdecode(path)) + os.sep


def _guard_hdf5(check: Callable[[object], None]) -> None:
    """Check what HDF5 opens, which causes no audit events."""
    import h5py

    unguarded = h5py.h5f.open

    def guarded(name: bytes, *arguments: Any, **keywords: Any) -> Any:
        check(name)
        return unguarded(name, *arguments, **keywords)

    h5py.h5f.open = guarded
