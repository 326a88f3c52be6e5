"""Temporary folders that a later process removes if their owner was killed."""

from __future__ import annotations

import os
import platform
import re
import secrets
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = "mor-bench"


def host_name() -> str:
    """Return the name of this machine, and of this container, for names of temporary files.

    A container on Linux has its own numbers of processes, but may share the machine's name and
    folders.
    """
    name = re.sub(r"[^0-9A-Za-z-]", "-", platform.node())
    try:
        return f"{name}-{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:
        return name


def identity(pid: int) -> str | None:
    """Return a text that no later process with the same number has; None if there is no process.

    On Linux it does not depend on the system clock, which may jump.
    """
    try:
        if sys.platform == "linux":
            stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
            state, *fields = stat.rpartition(")")[2].split()
            return None if state in "ZX" else f"{pid}-{fields[18]}"
    except (OSError, IndexError):
        return None
    import psutil  # here, because Linux does without, and its import takes 10 ms

    try:
        return f"{pid}-{round(1e3 * psutil.Process(pid).create_time())}"
    except psutil.Error:
        return None


def is_running(name: str) -> bool:
    """Return whether the process with an `identity` still runs."""
    number = name.partition("-")[0]
    return number.isdigit() and identity(int(number)) == name


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Create a temporary folder that names its owner, and remove it at the end.

    Folders of owners on this machine that no longer run are removed first.
    """
    remove_abandoned()
    name = f"{PREFIX}-{host_name()}-{identity(os.getpid())}-{secrets.token_hex(4)}"
    folder = Path(tempfile.gettempdir()).resolve() / name
    folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_abandoned() -> None:
    """Remove the temporary folders of this machine's processes that were killed."""
    owned = re.compile(rf"{PREFIX}-{re.escape(host_name())}-(\d+-\d+)-[0-9a-f]{{8}}")
    with suppress(OSError):
        for path in Path(tempfile.gettempdir()).iterdir():
            named = owned.fullmatch(path.name)
            if named and not is_running(named[1]):
                shutil.rmtree(path, ignore_errors=True)
