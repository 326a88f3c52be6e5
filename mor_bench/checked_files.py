"""Checked reading of files: regular files only, with limits of size, depth and memory.

Every reader of a file goes through here, and every refusal is one line that names the file. A
missing file raises `FileNotFoundError`, because callers treat it differently.
"""

from __future__ import annotations

import json
import os
import re
import stat
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mor_bench.errors import MorBenchError, StoreError, printable

KIB, MIB = 2**10, 2**20
MOST_TOML_BYTES = 256 * KIB
MOST_JSON_BYTES = 16 * MIB
MOST_BYTES = 16 * 1024 * MIB
"""Size limits of a TOML, a JSON, and any other file."""

MOST_LEVELS = 64
"""Limit of the nesting of tables and lists."""

ROOM_BYTES, ROOM_PER_BYTE = 400_000_000, 100
"""Memory that reading a file may take: a fixed part, and a part per byte of the file."""

_TOKEN = re.compile(r""""(?:[^"\\]|\\.)*"?|'[^']*'?|[\w-]+|\S""")
"""A token of a line of TOML: a string, even an unclosed one, a bare name, or one character."""

_memory_lock = threading.RLock()


def check_file(
    path: Path, most_bytes: int = MOST_BYTES, error: type[MorBenchError] = StoreError
) -> None:
    """Raise an error unless a path leads to a regular file of at most `most_bytes` bytes.

    Raises
    ------
    StoreError, or the given class of errors
        If the path leads to a folder, device or pipe, or the file is too large.
    FileNotFoundError
        If it does not exist.
    """
    try:
        _check_status(path, os.stat(path), most_bytes, error)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as reason:
        raise error(f"{path}: cannot be read: {_words(reason)}.") from None


MOST_COMMAS = 2_000_000
"""Limit of the number of commas; each value takes many times its bytes in the file as an object."""


def read_bytes(
    path: Path, most_bytes: int = MOST_BYTES, error: type[MorBenchError] = StoreError
) -> bytes:
    """Read a regular file; errors as in `check_file`."""
    return _read(path, 0, most_bytes, error)


def read_written(path: Path, folder: Path, error: type[MorBenchError] = StoreError) -> bytes:
    """Read a file that an untrusted process wrote somewhere in a folder.

    Such a process may not open every file, so it could leave a link that this process follows.

    Raises
    ------
    StoreError, or the given class of errors
        As `read_bytes`; also for links, and for a path that leads outside the folder.
    FileNotFoundError
        If the file does not exist.
    """
    if not path.parent.resolve().is_relative_to(folder.resolve()):
        raise error(f"{path}: leads outside {folder}.")
    try:
        linked = path.is_symlink() or path.lstat().st_nlink > 1
    except OSError as reason:
        linked = not isinstance(reason, FileNotFoundError)
    if linked:
        raise error(f"{path}: a link to another file.")
    return _read(path, getattr(os, "O_NOFOLLOW", 0), MOST_BYTES, error)


def _read(path: Path, more_flags: int, most_bytes: int, error: type[MorBenchError]) -> bytes:
    # Opening a named pipe would wait for a writer.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | more_flags
    try:
        with open(os.open(path, flags), "rb") as file:
            status = os.fstat(file.fileno())
            _check_status(path, status, most_bytes, error)
            content = file.read(status.st_size + 1)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as reason:
        raise error(f"{path}: cannot be read: {_words(reason)}.") from None
    if len(content) > status.st_size:
        raise error(f"{path}: grew while it was read.")
    return content


def _check_status(
    path: Path, status: os.stat_result, most_bytes: int, error: type[MorBenchError]
) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise error(f"{path}: cannot be read: Is a directory.")
    if not stat.S_ISREG(status.st_mode):
        raise error(f"{path}: a device or pipe, not a file.")
    if status.st_size > most_bytes:
        raise error(
            f"{path}: {status.st_size:,} bytes; files of this kind have at most {most_bytes:,}."
        )


def _words(reason: Exception) -> str:
    return (reason.strerror if isinstance(reason, OSError) else None) or str(reason)


def read_json(path: Path, error: type[MorBenchError] = StoreError) -> Any:
    """Read a JSON file; errors as in `check_file`, also for invalid or deeply nested content."""
    return _parsed(json.loads, read_bytes(path, MOST_JSON_BYTES, error), str(path), "JSON", error)


def parse_json(content: str | bytes, where: str, error: type[MorBenchError] = StoreError) -> Any:
    """Parse JSON; errors name `where`."""
    return _parsed(json.loads, content, where, "JSON", error)


def read_toml(path: Path, error: type[MorBenchError] = StoreError) -> dict[str, Any]:
    """Read a TOML file, with or without a byte order mark; errors as in `read_json`."""

    def load(text: str) -> dict[str, Any]:
        if any(map(_has_long_key, text.split("\n"))):
            raise RecursionError
        return tomllib.loads(text)

    content = read_bytes(path, MOST_TOML_BYTES, error)
    table: dict[str, Any] = _parsed(load, content, str(path), "TOML", error)
    return table


def _has_long_key(line: str) -> bool:
    """Return whether a key may have many dots; the TOML reader takes their number squared."""
    if line.count(".") < MOST_LEVELS:
        return False
    dots, after_name = 0, False
    for token in _TOKEN.findall(line):
        is_name = token[0] in "\"'_-" or token[0].isalnum()
        if token != "." or not after_name:
            dots = dots if is_name and not after_name else 0
        else:
            dots += 1
        after_name = is_name
        if dots >= MOST_LEVELS:
            return True
    return False


def _parsed(
    load: Callable[[str], Any],
    content: str | bytes,
    where: str,
    kind: str,
    error: type[MorBenchError],
) -> Any:
    try:
        text = content.decode("utf-8-sig") if isinstance(content, bytes) else content
        if text.count(",") > MOST_COMMAS:
            raise ValueError(f"more than {MOST_COMMAS:,} values")
        value = load(text)
        deep = _is_deep(value)
        if re.search(r"\\u[dD][89a-fA-F]", text):
            json.dumps(value, ensure_ascii=False, default=str).encode()  # half a character?
    except RecursionError:
        deep = True
    except (ValueError, ArithmeticError) as reason:
        raise error(f"{where}: not valid {kind}: {printable(str(reason), 500, '')}") from None
    if deep:
        raise error(f"{where}: tables and lists are nested more than {MOST_LEVELS} deep.")
    return value


def _is_deep(value: Any) -> bool:
    """Return whether tables and lists are nested too deep; refuse integers beyond 64 bits."""
    layer = [value]
    for _ in range(MOST_LEVELS):
        if any(type(item) is int and not -(2**63) <= item < 2**64 for item in layer):
            raise ValueError("an integer has more than 64 bits")
        layer = [
            item
            for part in layer
            if isinstance(part, dict | list)
            for item in (part.values() if isinstance(part, dict) else part)
        ]
    return any(isinstance(item, dict | list) for item in layer)


@contextmanager
def limited_memory(path: Path, error: type[MorBenchError]) -> Iterator[None]:
    """Limit the memory that another library may take to read a file.

    A small compressed file can claim to hold gigabytes. Only Linux enforces the limit.

    Raises
    ------
    The given class of errors
        If the memory does not suffice.
    """
    room = ROOM_BYTES + ROOM_PER_BYTE * path.stat().st_size
    try:
        with _memory_lock, _lowered_limit(room):
            yield
    except MemoryError:
        raise error(
            f"{path}: reading it takes more than {room / 1e6:,.0f} MB of memory; "
            "its content is too large for the size of the file."
        ) from None


@contextmanager
def _lowered_limit(room: int) -> Iterator[None]:
    if sys.platform != "linux":
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    wanted = pages * resource.getpagesize() + room
    if soft != resource.RLIM_INFINITY:
        wanted = min(wanted, soft)
    resource.setrlimit(resource.RLIMIT_AS, (wanted, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
