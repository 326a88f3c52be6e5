"""The folder of a run: opened new or resumed, and written by one process at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mor_bench.checked_files import read_bytes
from mor_bench.checkout import source_commit
from mor_bench.errors import InvalidInputError, StoreError
from mor_bench.machine import describe_machine, gpu_name
from mor_bench.options import FOLDERS
from mor_bench.results.comparison import Comparison
from mor_bench.runs.run_context import RunContext
from mor_bench.sandbox.seal import isolation
from mor_bench.scratch import identity, is_running
from mor_bench.snapshots.store import remove_leftovers, write_atomically
from mor_bench.specs import AnyDatasetSpec, MethodSpec

LOCK = ".running"
"""File that names the process of a live run."""

MOST_LOCK_BYTES = 1000


def open_run(
    out: str | Path | None,
    specs: Sequence[AnyDatasetSpec],
    methods: Sequence[MethodSpec],
    context: RunContext,
    files: Mapping[str, str],
) -> Comparison:
    """Make the comparison in a folder, or resume one with the same settings and datasets.

    ``files`` has the paths of datasets that were given by their files, by name.

    Raises
    ------
    InvalidInputError
        If the folder holds another run, is in use or cannot be written.
    StoreError
        If the results in the folder are damaged.
    """
    folder = Path(out) if out else _default_folder([spec.name for spec in specs])
    _check_unused(folder)
    datasets = {spec.name: spec.model_dump(mode="json") for spec in specs}
    settings = context.recorded()
    if (folder / "results.json").exists():
        comparison = Comparison.read(folder)
        if found := [
            *_differences(comparison.settings, settings),
            *_other_datasets(comparison.datasets, datasets),
        ]:
            raise InvalidInputError(
                f"{folder} holds another run, with {'; '.join(found)}. "
                "Choose another folder or remove it."
            )
    else:
        _check_no_foreign(folder)
        gpu = {"gpu": gpu_name()} if context.training.device == "cuda" else {}
        about = {"date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", **describe_machine()}
        comparison = Comparison(folder, {**about, **isolation(), **gpu}, settings=settings)
    comparison.settings.pop(FOLDERS, None)
    if folders := {**context.folders(), **({"datasets": dict(files)} if files else {})}:
        comparison.settings[FOLDERS] = folders
    record_commit(comparison.machine)
    comparison.methods |= {
        method.name: method.model_dump(mode="json", exclude={"folder"}) for method in methods
    }
    try:
        comparison.write()
    except OSError as error:
        raise InvalidInputError(f"`out`: {folder} cannot be written: {error.strerror}.") from None
    return comparison


def record_commit(machine: dict[str, Any]) -> None:
    """Record the commit of the code; a run that continues at another one keeps both."""
    commit = source_commit() or "none: the package is not in a git checkout"
    known = machine.get("commit", "")
    if commit not in known:
        machine["commit"] = f"{known}, continued at {commit}" if known else commit


def _differences(kept: dict[str, Any], wanted: dict[str, Any]) -> list[str]:
    """Describe the settings that differ."""
    return [
        f"`{name}` = {kept.get(name)!r} instead of {wanted.get(name)!r}"
        for name in dict.fromkeys([*kept, *wanted])
        if name != FOLDERS and kept.get(name) != wanted.get(name)
    ]


def _other_datasets(kept: dict[str, Any], wanted: dict[str, Any]) -> list[str]:
    """Describe the datasets of a run that are missing now, or have changed."""
    return [
        f"the dataset {name!r}" if name not in wanted else f"another version of {name!r}"
        for name, spec in kept.items()
        if wanted.get(name) != spec
    ]


def _check_no_foreign(folder: Path) -> None:
    """Raise `InvalidInputError` if a folder without a run has files that a run would overwrite."""
    names = ("results.csv", "comparison.json", "report.html", "samples", "figures", "pages")
    if found := [name for name in names if os.path.lexists(folder / name)]:
        raise InvalidInputError(
            f"`out`: {folder} is not the folder of a run, but has a {found[0]!r}, which would be "
            "overwritten; choose another folder."
        )


def _check_unused(folder: Path) -> None:
    """Raise `InvalidInputError` if another live run writes to a folder."""
    other = ""
    with suppress(OSError, ValueError, StoreError):
        other = read_bytes(folder / LOCK, MOST_LOCK_BYTES).decode("ascii")
    if other != identity(os.getpid()) and is_running(other):
        raise InvalidInputError(
            f"{folder}: another run (process {other.partition('-')[0]}) writes to this folder; "
            "wait for it or choose another folder."
        )


def _default_folder(names: Sequence[str]) -> Path:
    return Path("reports") / "runs" / f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{'-'.join(names)}"


@contextmanager
def only_run_in(folder: Path) -> Iterator[None]:
    """Refuse to share the folder with another live run; the lock of a killed run is ignored.

    Raises
    ------
    InvalidInputError
        If another run writes there.
    """
    _check_unused(folder)
    for part in ("", "samples", "figures", "pages", "pages/shared"):
        remove_leftovers(folder / part)
    lock = folder / LOCK
    write_atomically(lock, str(identity(os.getpid())).encode())  # opening a pipe would wait
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
