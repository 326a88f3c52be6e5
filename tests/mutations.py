"""Seeded mutations of files, and the loop that gives them to a reader under limits."""

from __future__ import annotations

import json
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mor_bench.errors import MorBenchError

QUICK, SLOW = 200, 2000
"""Mutations of each reader's files in the quick and in the nightly tests."""

LIMIT_S, WAIT_S, LIMIT_BYTES = 2.0, 60.0, 500_000_000
"""Limits for one mutated file: processor time, time on the clock, and memory."""

OF_COMMANDS = {
    "check d.toml": (20, 400),
    "check m.toml": (20, 400),
    "show d.toml": (10, 200),
    "show results.json": (10, 200),
    "pick results.json": (6, 100),
    "report results.json": (2, 20),
    "export results.json": (10, 200),
}
"""Numbers of mutated files that commands read, in the quick and in the slow part."""

PAGE = Path(__file__).parents[1] / "docs" / "attacks.md"
"""The page that gives the counts of all attacks."""

LONGEST = 5000
"""Most letters of a message."""

FAILED = "failed"
"""File with the message of a process that found an error."""

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 3, 2**31, 2**63, -(2**63), 10**18, 10**40),
    *(0.5, -0.0, 1e-320, 1e308, -1e308, float("nan"), float("inf"), -float("inf")),
    *("", "nan", "inf", "true", "1", "ü", "\x1b[31m", "\u202e", "\x00", "../../x", "/dev/zero"),
    *("<script>alert(1)</script>", "a" * 20_000, "{}", "%s", "\n"),
    *([], {}, [[]], [1, "a", None], {"a": {"b": []}}, {"": 0}),
)
"""Values that take the place of others in tables."""

SNIPPETS = (
    *(b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"9" * 400, b"-1", b"nan", b"1e999", b"[" * 500),
    *(b"\n", b" ", b'"', b"{", b"}", b"true", b"\\u0000", b"\\ud800", b"<!ENTITY a 'b'>", b"'''"),
)
"""Pieces that are put between other bytes."""


def mutated_bytes(content: bytes, generator: np.random.Generator) -> bytes:
    """Flip, remove, repeat, insert or cut off some bytes."""
    changed = bytearray(content)
    for _ in range(int(generator.integers(1, 4))):
        at = int(generator.integers(0, len(changed) + 1))
        length = int(generator.choice([1, 2, 8, 100]))
        match generator.integers(6):
            case 0:
                changed[at : at + length] = generator.bytes(len(changed[at : at + length]))
            case 1:
                del changed[at : at + length]
            case 2:
                changed[at:at] = changed[at : at + length] * int(generator.integers(1, 30))
            case 3:
                changed[at:at] = SNIPPETS[generator.integers(len(SNIPPETS))]
            case 4:
                del changed[at:]
            case _:
                if at < len(changed):
                    changed[at] ^= 1 << int(generator.integers(8))
    return bytes(changed)


def mutated_words(content: bytes, generator: np.random.Generator) -> bytes:
    """Replace, drop or repeat some words of a text."""
    words = content.split(b" ")
    for _ in range(int(generator.integers(1, 4))):
        at = int(generator.integers(len(words)))
        match generator.integers(4):
            case 0:
                words[at] = str(VALUES[generator.integers(len(VALUES))]).encode()
            case 1:
                words.insert(at, words[int(generator.integers(len(words)))])
            case 2 if len(words) > 1:
                del words[at]
            case _:
                words[at] = SNIPPETS[generator.integers(len(SNIPPETS))]
    return b" ".join(words)


def mutated_json(content: bytes, generator: np.random.Generator) -> bytes:
    """Replace, drop, rename, nest or repeat some values of a JSON text."""
    value = json.loads(content)
    for _ in range(int(generator.integers(1, 4))):
        places = list(_places(value))
        table, key = places[generator.integers(len(places))]
        match generator.integers(5):
            case 0 if isinstance(table, dict):
                table[str(VALUES[generator.integers(len(VALUES))])[:50]] = table.pop(key)
            case 1:
                del table[key]
            case 2:
                for _ in range(int(generator.choice([1, 3, 100]))):
                    table[key] = [table[key]]
            case 3:
                other, name = places[generator.integers(len(places))]
                if name in other if isinstance(other, dict) else name < len(other):
                    table[key] = json.loads(json.dumps(other[name]))
            case _:
                table[key] = VALUES[generator.integers(len(VALUES))]
        if not value:
            break
    return json.dumps(value).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every table or list with each of its keys."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, item in list(items):
        yield value, key
        if isinstance(item, dict | list):
            yield from _places(item)


Mutator = Callable[[bytes, np.random.Generator], bytes]


TEXT: list[Mutator] = [mutated_words, mutated_bytes]
JSON: list[Mutator] = [mutated_json, mutated_json, mutated_bytes]


def documented() -> dict[str, int]:
    """Return the counts in the tables of the page, by the text of their first column."""
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    counts = {row[0]: row[-1].replace(",", "") for row in rows}
    return {name: int(count) for name, count in counts.items() if count.isdigit()}


@dataclass(frozen=True)
class Reader:
    """A reader of files, how to write a sound file for it, and how to damage the file."""

    name: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]
    mutators: list[Mutator]
    limit_s: float = LIMIT_S


def attacked(reader: Reader, folder: Path, n: int) -> None:
    """Write n mutations of a file one by one and read each, a share of them per core.

    Anything but success or a `MorBenchError` of one line, and every excess of a limit, is an error
    with the number of the mutation, which is also its seed.
    """
    reader.read(_sound(reader, folder / "sound"))  # it also imports what is imported on demand
    shares = (os.cpu_count() or 1) if hasattr(os, "fork") else 1
    seeds = [range(first, n, shares) for first in range(shares)]
    own, *others = ((folder / str(share[0]), share) for share in seeds if share)
    children = [(there, _forked(reader, there, n, share)) for there, share in others]
    try:
        _attack(reader, own[0], n, own[1])
    finally:
        ended = [(there, os.waitpid(child, 0)[1]) for there, child in children]
    for there, status in ended:
        said = there / FAILED
        assert status == 0, said.read_text(encoding="utf-8") if said.exists() else str(status)


def _forked(reader: Reader, folder: Path, n: int, seeds: range) -> int:
    """Attack in a process of its own; return its number."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        _attack(reader, folder, n, seeds)
        status = 0
    except BaseException as error:
        (folder / FAILED).write_text(str(error), encoding="utf-8")
    finally:
        os._exit(status)


def _sound(reader: Reader, folder: Path) -> Path:
    """Write the sound file, and return its path."""
    (folder / "datasets").mkdir(parents=True)
    path = folder / "datasets" / reader.name
    reader.write(path)
    return path


def _attack(reader: Reader, folder: Path, n: int, seeds: range) -> None:
    path = _sound(reader, folder)
    original = path.read_bytes()
    with warnings.catch_warnings(), np.errstate(all="ignore"), _less_memory():
        warnings.simplefilter("ignore")
        for seed in seeds:
            generator = np.random.default_rng([seed, n])
            content = reader.mutators[seed % len(reader.mutators)](original, generator)
            path.write_bytes(content)
            try:
                with _less_time(reader.limit_s):
                    reader.read(path)
            except MorBenchError as error:
                if "\n" in str(error) or len(str(error)) > LONGEST:
                    raise AssertionError(f"mutation {seed} of {path}: {error}") from error
            except BaseException as error:
                path.with_name(f"mutation-{seed}").write_bytes(content)
                raise AssertionError(f"mutation {seed} of {path}: {error!r}") from error


class _TooSlowError(BaseException):
    """No reader takes it for an error of the file."""


@contextmanager
def _less_time(limit_s: float) -> Iterator[None]:
    if not hasattr(signal, "setitimer"):
        yield
        return

    def late(*_: Any) -> None:
        raise _TooSlowError(f"it takes more than {limit_s} s of work, or waits for {WAIT_S} s")

    clocks = {
        signal.SIGPROF: (signal.ITIMER_PROF, limit_s),
        signal.SIGALRM: (signal.ITIMER_REAL, WAIT_S),
    }
    before = {number: signal.signal(number, late) for number in clocks}
    for clock, limit_s in clocks.values():
        signal.setitimer(clock, limit_s)
    try:
        yield
    finally:
        for clock, _ in clocks.values():
            signal.setitimer(clock, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _less_memory() -> Iterator[None]:
    if sys.platform != "linux":
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + LIMIT_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
