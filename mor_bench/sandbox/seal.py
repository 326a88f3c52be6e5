"""Block a process's access to folders with the displacements that a method must predict."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

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


def seal(folders: Sequence[Path], exempt: Path | None = None) -> None:
    """Make every access to some folders raise `PermissionError` for the rest of this process.

    The seal stops Python's usual ways to a file and the start of programs, so it catches mistakes.
    It does not stop a method that attacks the machine.

    Parameters
    ----------
    folders : sequence of Path
        Folders to seal, with all their contents.
    exempt : Path, optional
        A folder within them that stays accessible, such as the folder of a training's checkpoint.
    """
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
            for argument in arguments[:2]:
                check(argument)
        elif event in PROGRAM_EVENTS:
            raise PermissionError(f"{event}: a method must not start programs during a comparison.")

    sys.addaudithook(refuse)
    _guard_hdf5(check)


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
