"""Let the Linux kernel keep a process, and all that it starts, out of some folders.

Landlock (Linux 5.13 and later) can only allow. So every file and folder is allowed that does not
contain a closed folder: the neighbours of each closed folder and of the folders above it. The
contents of closed folders then cannot be read or changed; their names and sizes can be seen. In the
folders above a closed one no entry can be created, removed or renamed.
"""

from __future__ import annotations

import ctypes
import os
import stat
import struct
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from mor_bench.errors import MorBenchError

CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
"""Numbers of the system calls, the same on all processors."""

VERSION_FLAG, PATH_BENEATH, PR_SET_NO_NEW_PRIVS = 1, 1, 38

WRITE_FILE, READ_FILE = 1 << 1, 1 << 2
CHANGE_FOLDERS = sum(1 << bit for bit in range(4, 13))
REFER, TRUNCATE = 1 << 13, 1 << 14
"""Access rights, see linux/landlock.h. Executing and listing stay free."""

OF_FILES = WRITE_FILE | READ_FILE | TRUNCATE

SCOPES = 1 << 0 | 1 << 1
"""Blocks signals to processes outside, and their abstract sockets."""

_REFUSED = "the kernel has Landlock, but refuses to close folders to the method's process."


@cache
def version() -> int:
    """Return the version of Landlock in this kernel; 0 if there is none."""
    if sys.platform != "linux":
        return 0
    return max(0, _call(CREATE_RULESET, None, 0, VERSION_FLAG))


def close_folders(
    folders: Sequence[Path],
    exempt: Path | None = None,
    writable: Sequence[Path] | None = None,
) -> None:
    """Close folders to this thread and to all that it starts, if the kernel has Landlock.

    Parameters
    ----------
    folders : sequence of Path
        Folders or files, which need not exist yet.
    exempt : Path, optional
        A folder within them that stays open, or a file that may still be read.
    writable : sequence of Path, optional
        The only other folders in which files may be written; by default all that are not closed.

    Raises
    ------
    MorBenchError
        If the kernel has Landlock, but refuses to close the folders.
    """
    if not folders or version() < 1:
        return
    handled = WRITE_FILE | READ_FILE | CHANGE_FOLDERS
    handled |= (REFER if version() >= 2 else 0) | (TRUNCATE if version() >= 3 else 0)
    scoped = SCOPES if version() >= 6 else 0
    attributes = struct.pack("=QQQ", handled, 0, scoped)
    size = 24 if version() >= 6 else 8
    ruleset = _call(CREATE_RULESET, attributes, size, 0)
    if ruleset < 0:
        raise MorBenchError(_REFUSED)
    try:
        for path in _neighbours([Path(os.path.realpath(folder)) for folder in folders]):
            _allow(ruleset, path, handled if writable is None else READ_FILE)
        for path in writable or ():
            _allow(ruleset, path, handled)
        if exempt is not None:
            _allow(ruleset, exempt, READ_FILE if exempt.is_file() else handled)
        ctypes.CDLL(None).prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        if _call(RESTRICT_SELF, ruleset, 0) != 0:
            raise MorBenchError(_REFUSED)
    finally:
        os.close(ruleset)


def _neighbours(closed: Sequence[Path]) -> Iterator[Path]:
    """Yield all existing paths that hold none of the closed ones, as few as possible."""
    above = {parent for path in closed for parent in path.parents}
    for folder in above - set(closed):
        if any(folder.is_relative_to(path) for path in closed):
            continue
        with suppress(OSError), os.scandir(folder) as entries:
            # A symbolic link would open what it points to.
            yield from (
                path
                for path in (Path(entry.path) for entry in entries if not entry.is_symlink())
                if path not in above and path not in closed
            )


def _allow(ruleset: int, path: Path, rights: int) -> None:
    with suppress(OSError):
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            if not stat.S_ISDIR(os.fstat(descriptor).st_mode):
                rights &= OF_FILES
            _call(ADD_RULE, ruleset, PATH_BENEATH, struct.pack("=Qi", rights, descriptor), 0)
        finally:
            os.close(descriptor)


def _call(number: int, *arguments: int | bytes | None) -> int:
    syscall = ctypes.CDLL(None).syscall
    syscall.restype = ctypes.c_long
    converted = [
        ctypes.c_long(item) if isinstance(item, int) else ctypes.c_char_p(item)
        for item in arguments
    ]
    return int(syscall(ctypes.c_long(number), *converted))
