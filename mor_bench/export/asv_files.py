"""The three kinds of result files of asv (airspeed velocity), and the commit they belong to."""

from __future__ import annotations

import itertools
import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, Strict, ValidationError, model_validator

from mor_bench.checked_files import read_json, read_toml
from mor_bench.errors import InvalidInputError, StoreError, printable
from mor_bench.machine import describe_machine
from mor_bench.snapshots.store import write_atomically

VERSION = {"machine": 1, "benchmarks": 2, "results": 2}
"""asv's version of each kind of file."""

STATISTICS = ("ci_99_a", "ci_99_b", "q_25", "q_75", "number", "repeat")
COLUMNS = ("result", "params", "version", *(f"stats_{name}" for name in STATISTICS))
"""asv's columns of a result."""


def _fit_for_page(text: str) -> str:
    if re.search("[<>&]", text) or not text.isprintable():
        raise ValueError(f"{printable(text, 100, '')!r} is not fit for a page")
    return text


_Text = Annotated[str, AfterValidator(_fit_for_page)]
_Column = list[Annotated[float, Strict()] | None]
_Statistics = _Column | None
_Row = tuple[
    _Column,
    tuple[list[_Text], list[_Text]],
    str,
    _Statistics,
    _Statistics,
    _Statistics,
    _Statistics,
    _Statistics,
    _Statistics,
]


class StoredResults(BaseModel):
    """The parts of a file of results that are read again; the page of asv shows its texts."""

    commit_hash: str
    date: Annotated[int, Strict()]
    result_columns: list[str]
    results: dict[_Text, _Row]

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.result_columns != list(COLUMNS):
            raise ValueError("its columns are others")
        for name, (values, parameters, _, *statistics) in self.results.items():
            n = math.prod(map(len, parameters))
            if any(len(column) != n for column in (values, *filter(None, statistics))):
                raise ValueError(f"{name}: a column must have {n} values")
        return self


def check_results(content: Mapping[str, Any], path: Path) -> None:
    """Raise `StoreError` unless a file of results is whole and its texts are fit for a page."""
    try:
        StoredResults.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))[:100]
        reason = printable(f"`{where}`: {first['msg']}", keep="")
        raise StoreError(f"{path}: not written by mor-bench: {reason}.") from None


def check_texts(texts: Iterable[str], path: Path) -> None:
    """Raise `StoreError` if a text could become markup; asv's page shows some as they are."""
    try:
        for text in texts:
            _fit_for_page(text)
    except ValueError as error:
        raise StoreError(f"{path}: the text {error}.") from None


Key = tuple[str, ...]
"""Values of a benchmark's parameters, stored by asv as Python prints them."""


@dataclass(frozen=True)
class Figure:
    """A value with its statistics. NaN means not measured, and None means failed."""

    value: float | None
    statistics: Mapping[str, float] = field(default_factory=dict)


Figures = dict[Key, Figure]


def to_columns(figures: Figures) -> list[Any]:
    """List figures in asv's order: the product of the parameters' values."""
    parameters = [list(dict.fromkeys(column)) for column in zip(*figures, strict=True)]
    listed = [figures.get(key, Figure(math.nan)) for key in itertools.product(*parameters)]
    columns = [[figure.statistics.get(name) for figure in listed] for name in STATISTICS]
    return [
        [figure.value for figure in listed],
        parameters,
        "1",
        *(column if any(x is not None for x in column) else None for column in columns),
    ]


def from_columns(content: list[Any]) -> Figures:
    """Invert `to_columns`."""
    values, parameters, _, *columns = content
    named = {name: column for name, column in zip(STATISTICS, columns, strict=True) if column}
    return {
        key: Figure(
            values[i],
            {name: column[i] for name, column in named.items() if column[i] is not None},
        )
        for i, key in enumerate(itertools.product(*parameters))
    }


def read_file(path: Path, kind: str) -> dict[str, Any] | None:
    """Read one of asv's files without its version number; None if it does not exist.

    Raises
    ------
    StoreError
        If the file is not asv's, or has another version.
    """
    try:
        content = read_json(path)
        version = content.pop("version")
    except FileNotFoundError:
        return None
    except (KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"{path}: not an asv file: {error!r}") from None
    if version != VERSION[kind]:
        raise StoreError(
            f"{path}: the file has asv's {kind} in version {printable(str(version), 50, '')}; "
            f"this version of mor-bench reads version {VERSION[kind]}."
        )
    return dict(content)


def write_file(path: Path, content: Mapping[str, Any], kind: str) -> None:
    """Write one of asv's files atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({**content, "version": VERSION[kind]}, indent=1).encode())


def machine_name(ran_on: Mapping[str, Any], name: str | None) -> str:
    """Check and return the name of a machine on the dashboard; the default is this machine's.

    Raises
    ------
    InvalidInputError
        If the name has characters that are not allowed in file names, or if it is missing and the
        comparison ran on another machine.
    """
    if name is None:
        here = describe_machine()
        if any(here[key] != ran_on.get(key) for key in ("processor", "cores")):
            raise InvalidInputError(
                "the comparison ran on another machine "
                f"({ran_on.get('processor')}, {ran_on.get('cores')} cores); "
                "give its name as `machine`."
            )
        name = platform.node()
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise InvalidInputError(
            "`machine` must consist of letters, digits, '.', '-' and '_', and begin with "
            f"a letter, a digit or '_'; got {name!r}."
        )
    return name


def describe_for_asv(ran_on: Mapping[str, Any], name: str) -> dict[str, str]:
    """Describe a machine as asv does, so that asv files both results under one machine."""
    here = name == platform.node()
    return {
        "arch": platform.machine() if here else "",
        "cpu": str(ran_on["processor"]),
        "machine": name,
        "num_cpu": str(ran_on["cores"]),
        "os": str(ran_on["system"]),
        "ram": _memory() if here else "",
    }


def _memory() -> str:
    try:
        return str(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # unknown on Windows and some others
        return ""


def is_own_project(path: Path) -> bool:
    """Return whether a `pyproject.toml` exists and is that of mor-bench.

    Raises
    ------
    StoreError
        If the file is damaged.
    """
    project = read_toml(path).get("project") if path.is_file() else None
    return isinstance(project, dict) and project.get("name") == "mor-bench"


def commit_and_date(commit: str | None) -> tuple[str, int]:
    """Look up the hash of a commit in the working folder's checkout, and its date, ms since 1970.

    Raises
    ------
    InvalidInputError
        If the working folder is not in a checkout of mor-bench, or the commit does not exist.
    """
    top = _git("rev-parse", "--show-toplevel")
    if not top or not is_own_project(Path(top) / "pyproject.toml"):
        raise InvalidInputError(
            f"{Path().resolve()} is not in a git checkout of mor-bench; use the checkout "
            "with the commit that ran the comparison."
        )
    wanted = f"{commit or 'HEAD'}^{{commit}}"
    found = _git("rev-parse", "--verify", "--quiet", "--end-of-options", wanted)
    if not found:
        raise InvalidInputError(f"`commit` must name a commit of {top}; got {commit or 'HEAD'!r}.")
    return found, 1000 * int(_git("show", "-s", "--format=%at", found) or 0)


def _git(*arguments: str) -> str | None:
    """Output of git; None if it fails or is not installed."""
    try:
        done = subprocess.run(
            ["git", *arguments], check=True, capture_output=True, text=True, encoding="utf-8"
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
