"""Reading dataset and method files into validated specifications."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mor_bench.errors import SpecError
from mor_bench.specs.dataset_spec import (
    AnyDatasetSpec,
    DatasetSpec,
    ImportedDatasetSpec,
    generated,
)
from mor_bench.specs.inline_parameters import split_method
from mor_bench.specs.method_spec import MethodSpec
from mor_bench.specs.one_line_errors import validated
from mor_bench.specs.source_file import RECORDED
from mor_bench.specs.suite_folder import find_file, read_toml


def load_dataset_spec(
    source: str | Path | Mapping[str, Any], suite: Path | None = None
) -> AnyDatasetSpec:
    """Read and validate a dataset. A table `snapshots` makes it an imported one.

    Parameters
    ----------
    source : str, Path or mapping
        A name in the suite, the path of a TOML, or a dict with the same keys.
    suite : Path, optional
        Folder to look in first.

    Raises
    ------
    SpecError
        If the dataset is unknown or not valid.
    """
    if isinstance(source, Mapping):
        content = {"name": "scene", **source}
        return _validated_dataset({"title": content["name"], **content}, "scene")
    if not isinstance(source, str | Path):
        raise SpecError(
            f"a dataset must be a name, the path of a TOML or a dict; got {type(source).__name__}."
        )
    path = _dataset_file(source, suite)
    content = {"title": path.stem, **read_toml(path), "name": path.stem}
    return _validated_dataset(content, str(path), path.parent)


def as_spec(source: str | Path | Mapping[str, Any] | AnyDatasetSpec) -> AnyDatasetSpec:
    """Return the spec of a dataset, given by name, path, dict or spec."""
    if isinstance(source, DatasetSpec | ImportedDatasetSpec):
        return source
    return load_dataset_spec(source)


def _dataset_file(source: str | Path, suite: Path | None) -> Path:
    try:
        path = find_file("datasets", source, suite)
    except SpecError:
        path = Path(source)
        if not path.is_dir():
            raise
    if path.is_dir():
        raise SpecError(
            f"{path}: a folder; a dataset must be a name or the path of a TOML. "
            "mor_bench.adapters.dataset_folder.import_dataset_folder turns a folder with a data "
            "set card into a TOML."
        )
    return path


def load_recorded_spec(content: Any, where: str) -> AnyDatasetSpec:
    """Validate a dataset that a stored file holds. Each file that it names needs its checksum.

    Raises
    ------
    SpecError
        If it is not valid; the message begins with `where`.
    """
    if not isinstance(content, dict):
        raise SpecError(f"{where}: a dataset must be a table; got {type(content).__name__}.")
    return _validated_dataset(content, where, RECORDED)


def _validated_dataset(
    content: Mapping[str, Any], where: str, folder: Path | str | None = None
) -> AnyDatasetSpec:
    if "snapshots" in content:
        return validated(ImportedDatasetSpec, content, where, folder)
    return validated(DatasetSpec, content, where, folder)


def load_generated_spec(
    source: str | Path | Mapping[str, Any], suite: Path | None = None
) -> DatasetSpec:
    """Read a dataset whose samples are generated here; otherwise as `load_dataset_spec`.

    Raises
    ------
    SpecError
        If the dataset is unknown or not valid.
    UnsupportedSceneError
        If its samples were imported.
    """
    return generated(load_dataset_spec(source, suite))


def is_method_file(path: Path) -> bool:
    """Return whether a TOML describes a method, which names a `surrogate`, or a dataset."""
    return "surrogate" in read_toml(path) or path.resolve().parent.name == "methods"


def load_method_spec(source: str | Path, suite: Path | None = None) -> MethodSpec:
    """Read and validate a method.

    Parameters
    ----------
    source : str or Path
        A name in the suite or the path of a TOML. Values in brackets, as in
        ``"pod[n_modes=10,20]"``, replace those of the file and are swept.
    suite : Path, optional
        Folder to look in first.

    Raises
    ------
    SpecError
        If the method is unknown or its file is not valid.
    """
    asked = str(source)
    swept: dict[str, list[Any]] = {}
    if isinstance(source, str):
        source, swept = split_method(source)
    path = find_file("methods", source, suite)
    content = read_toml(path)
    own = str(content.get("surrogate", "")).startswith("mor_bench.")
    folder = None if own else path.parent.resolve()
    content |= {"name": path.stem, "folder": folder, "asked": asked}
    spec = validated(MethodSpec, content, str(path))
    return validated(MethodSpec, _with_sweep(content, swept), asked) if swept else spec


def _with_sweep(content: dict[str, Any], swept: Mapping[str, list[Any]]) -> dict[str, Any]:
    """Return a valid method file's content with some parameters swept over other values."""
    firsts = {name: values[0] for name, values in swept.items()}
    profiles = {
        name: {**profile, "sweep": {**profile["sweep"], **swept}}
        if profile.get("sweep")
        else profile
        for name, profile in content.get("profiles", {}).items()
    }
    return {
        **content,
        "parameters": {**content.get("parameters", {}), **firsts},
        "sweep": {**content.get("sweep", {}), **swept},
        "profiles": profiles,
    }
