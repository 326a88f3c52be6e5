"""The manifest of a dataset's folder: the specification to regenerate it, and environments."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError

from mor_bench.checked_files import read_bytes, read_json
from mor_bench.errors import NewerSchemaError, StoreError
from mor_bench.snapshots.store import SCHEMA_VERSION, check_version, write_atomically
from mor_bench.specs import RECORDED, DatasetSpec, SourceFile
from mor_bench.version import __version__

FORMAT = "mor-bench dataset"
NAME = "manifest.json"


@dataclass(frozen=True)
class Manifest:
    """The content of a folder of shards.

    Attributes
    ----------
    spec : DatasetSpec
        Names mesh and surface files by path and SHA-256; `keep_sources` copies them to the folder.
    generator_version : int
    n_samples : int
        Size of the whole dataset.
    shard_size : int
        Samples per shard. The last shard may have fewer.
    environments : tuple of dict of str to str
        Versions and platform of each environment that generated shards, in order of first use.
    """

    spec: DatasetSpec
    generator_version: int
    n_samples: int
    shard_size: int
    environments: tuple[dict[str, str], ...] = ()

    def to_json(self) -> bytes:
        """Return the content of the file, with a checksum."""
        content = {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "generator_version": self.generator_version,
            "n_samples": self.n_samples,
            "shard_size": self.shard_size,
            "spec": self.spec.model_dump(mode="json"),
            "environments": list(self.environments),
        }
        checked = {**content, "sha256": _digest(content)}
        return (json.dumps(checked, indent=1, sort_keys=True) + "\n").encode()


class _Rest(BaseModel):
    """The fields of a manifest beside its specification."""

    generator_version: int
    n_samples: Annotated[int, Field(ge=0)]
    shard_size: Annotated[int, Field(ge=1)]
    environments: list[dict[str, str]]


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def this_environment() -> dict[str, str]:
    """Return the platform and the versions that determine a sample's last bits."""
    libraries = {name: version(name) for name in ("numpy", "scipy", "numba", "h5py")}
    system = {"platform": platform.platform(), "machine": platform.machine()}
    return {"mor-bench": __version__, "python": platform.python_version(), **libraries, **system}


def read_manifest(folder: Path) -> Manifest:
    """Read and check the manifest of a dataset's folder.

    Raises
    ------
    StoreError
        If the file is not a manifest, has another schema, or is damaged.
    FileNotFoundError
        If it does not exist.
    """
    path = folder / NAME
    try:
        content = read_json(path)
        if content["format"] != FORMAT:
            raise StoreError(f"{path}: not the manifest of a dataset of mor-bench.")
        check_version(content["schema_version"], str(path))
        if content.pop("sha256") != _digest(content):
            raise StoreError(f"{path}: damaged: the checksum does not match.")
        spec = DatasetSpec.model_validate_json(
            json.dumps(_with_kept(content["spec"], folder)), context=RECORDED
        )
        rest = _Rest.model_validate({name: content[name] for name in _Rest.model_fields})
    except (ValueError, KeyError, TypeError) as error:
        reason = "damaged" if not isinstance(error, ValidationError) else "its `spec` is not valid"
        raise StoreError(f"{path}: not a manifest of mor-bench, or {reason}.") from None
    return Manifest(
        spec, rest.generator_version, rest.n_samples, rest.shard_size, tuple(rest.environments)
    )


def keep_sources(folder: Path, spec: DatasetSpec) -> None:
    """Copy a dataset's mesh and surface files into its folder, so that the folder is complete."""
    for file in _sources(spec.model_dump(mode="json")):
        kept = _kept(folder, file)
        if not kept.is_file():
            write_atomically(kept, read_bytes(SourceFile(**file).checked()))


def with_kept_files(spec: DatasetSpec, folder: Path) -> DatasetSpec:
    """Return a specification that names the copies of its files that `keep_sources` makes."""
    content = spec.model_dump(mode="json")
    for file in _sources(content):
        file["path"] = str(_kept(folder, file))
    return DatasetSpec.model_validate_json(json.dumps(content), context=RECORDED)


def files_of(spec: DatasetSpec) -> list[SourceFile]:
    """Return the mesh and surface files that a specification names."""
    return [SourceFile(**file) for file in _sources(spec.model_dump(mode="json"))]


def kept_name(file: SourceFile) -> str:
    """Return the name of a file's copy beside the samples."""
    return f"source-{file.sha256[:12]}{Path(file.path).suffix}"


def _kept(folder: Path, file: dict[str, str]) -> Path:
    return folder / kept_name(SourceFile(**file))


def _sources(value: Any) -> Iterator[dict[str, str]]:
    """Yield every file that a specification names, with its path and SHA-256."""
    if isinstance(value, dict):
        if value.keys() == {"path", "sha256"}:
            yield value
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _sources(item)


def _with_kept(spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Replace missing files in a specification by the folder's copies, in place; return it."""
    for file in _sources(spec):
        if not os.path.isfile(file["path"]):  # False also where the path cannot be looked at
            file["path"] = str(_kept(folder, file).resolve())
    return spec


def update_manifest(folder: Path, manifest: Manifest, *, solves: bool) -> None:
    """Write a folder's manifest if it is missing, damaged or different. Its environments are kept.

    Parameters
    ----------
    folder : Path
    manifest : Manifest
        The wanted content; its environments are added to those of the folder.
    solves : bool
        Whether shards will be generated now, so that this environment is added.
    """
    try:
        environments = read_manifest(folder).environments
    except NewerSchemaError:
        raise
    except (StoreError, FileNotFoundError):
        environments = ()
    more = (*manifest.environments, *([this_environment()] if solves else []))
    for environment in more:
        if environment not in environments:
            environments = (*environments, environment)
    content = replace(manifest, environments=environments).to_json()
    path = folder / NAME
    if not path.is_file() or read_bytes(path) != content:
        write_atomically(path, content)
