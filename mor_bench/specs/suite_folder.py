"""Where dataset and method files are found: the suite of the package, or a folder of the user."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, Literal

from mor_bench import checked_files
from mor_bench.errors import RenamedWarning, SpecError, UnknownNameError
from mor_bench.specs.one_line_errors import nearest_name

Kind = Literal["datasets", "methods"]

FORMER_NAMES: dict[Kind, dict[str, tuple[str, str]]] = {
    "datasets": {},
    "methods": {
        "pca-regression-force": (
            "pca-regression",
            "PCA regression on the linear response is `pca-regression-linear`.",
        ),
        "pgd": ("pgd-snapshots", "PGD from the equations alone is `pgd-weak-form`."),
        "pgd-force": ("pgd-snapshots-force", "PGD from the equations alone is `pgd-weak-form`."),
    },
}
"""New names by former names, each with a note."""


def find_suite(suite: Path | None = None) -> Path:
    """Return the folder that holds ``datasets/`` and ``methods/``.

    Parameters
    ----------
    suite : Path, optional
        The folder to use. Default: the folder of the installed package, or of the checkout.

    Raises
    ------
    SpecError
        If the folder holds neither.
    """
    package = Path(__file__).parents[1]
    folders = [suite] if suite is not None else [package / "suite", package.parent]
    for folder in folders:
        if (folder / "datasets").is_dir() or (folder / "methods").is_dir():
            return folder
    raise SpecError(f"{folders[0]}: a suite must hold a folder `datasets` or `methods`.")


def list_suite(kind: Kind, suite: Path | None = None) -> dict[str, Path]:
    """Return names and files of the suite's datasets or methods, sorted by name."""
    return {
        path.stem: path
        for path in sorted((find_suite(suite) / kind).glob("*.toml"), key=lambda path: path.stem)
    }


def find_file(kind: Kind, source: str | Path, suite: Path | None) -> Path:
    """Return the file of a name in the suite, or the path itself if one is given.

    Raises
    ------
    SpecError
        If the name is unknown; the message gives the nearest name.

    Warns
    -----
    RenamedWarning
        If the name is a former one.
    """
    if isinstance(source, Path) or source.endswith(".toml"):
        return Path(source)
    known = list_suite(kind, suite)
    if source not in known and suite is not None:
        known = {**list_suite(kind), **known}
    if source not in known and source in FORMER_NAMES[kind]:
        name, note = FORMER_NAMES[kind][source]
        warnings.warn(f"`{source}` is now `{name}`. {note}", RenamedWarning, stacklevel=3)
        source = name
    if source not in known:
        raise UnknownNameError(
            f"unknown {kind[:-1]} {source!r}{nearest_name(source, known)} "
            "`mor-bench list` shows the names.",
            kind=kind,
            name=source,
            known=known,
        )
    return known[source]


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    SpecError
        If the file cannot be read or is not valid TOML.
    """
    try:
        return checked_files.read_toml(path, SpecError)
    except FileNotFoundError:
        raise SpecError(f"{path}: no such file.") from None
