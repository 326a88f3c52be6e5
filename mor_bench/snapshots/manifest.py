"""The manifest of a dataset's folder: all that is needed to generate the dataset again, and what it was generated with."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mor_bench.errors import NewerSchemaError, StoreError
from mor_bench.snapshots.store import SCHEMA_VERSION, check_version, write_atomically
from mor_bench.specs import DatasetSpec, SourceFile
from mor_bench.version import __version__

FORMAT = "mor-bench dataset"
NAME = "manifest.json"


@dataclass(frozen=True)
class Manifest:
    """What a folder of shards is.

    Attributes
    ----------
    spec : DatasetSpec
        A mesh or surface file is known by its path and its SHA-256; `keep_sources` puts a copy into the folder.
    generator_version : int
    n_samples : int
        Of the whole dataset.
    shard_size : int
        Samples per shard; the last one may have fewer.
    environments : tuple of dict of str to str
        Versions and platform of every environment that shards were generated in, in the order of their first use.
    """

    spec: DatasetSpec
    generator_version: int
    n_samples: int
    shard_size: int
    environments: tuple[dict[str, str], ...] = ()

    def to_json(self) -> bytes:
        """The content of the file, with a checksum."""
        content = {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "generator_version": self.generator_version,
            "n_samples": self.n_samples,
            "shard_size": self.shard_size,
            "spec": self.spec.model_dump(mode="json"),
            "environments": list(self.environments),
        }
        return (
            json.dumps({**content, "sha256": _digest(content)}, indent=1, sort_keys=True) + "\n"
        ).encode()


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def this_environment() -> dict[str, str]:
    """Versions of this package, Python and the libraries that decide a sample's last bits, and the platform."""
    libraries = {name: version(name) for name in ("numpy", "scipy", "numba", "h5py")}
    system = {"platform": platform.platform(), "machine": platform.machine()}
    return {"mor-bench": __version__, "python": platform.python_version(), **libraries, **system}


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a dataset's folder and check it.

    Raises
    ------
    StoreError
        If the file is foreign, of another schema, or damaged.
    FileNotFoundError
        If there is none.
    """
    path = folder / NAME
    try:
        content = json.loads(path.read_bytes())
        if content["format"] != FORMAT:
            raise StoreError(f"{path}: not the manifest of a dataset of mor-bench.")
        check_version(content["schema_version"], str(path))
        if content.pop("sha256") != _digest(content):
            raise StoreError(f"{path}: damaged: the checksum does not match.")
        spec = DatasetSpec.model_validate_json(json.dumps(_with_kept(content["spec"], folder)))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        reason = "damaged" if not isinstance(error, ValidationError) else "its `spec` is not valid"
        raise StoreError(f"{path}: not a manifest of mor-bench, or {reason}.") from None
    return Manifest(
        spec,
        content["generator_version"],
        content["n_samples"],
        content["shard_size"],
        tuple(content["environments"]),
    )


def keep_sources(folder: Path, spec: DatasetSpec) -> None:
    """Copy the files that a dataset is made from into its folder, so that it can be made again from there alone."""
    for file in _sources(spec.model_dump(mode="json")):
        kept = _kept(folder, file)
        if not kept.is_file():
            write_atomically(kept, SourceFile(**file).checked().read_bytes())


def _kept(folder: Path, file: dict[str, str]) -> Path:
    return folder / f"source-{file['sha256'][:12]}{Path(file['path']).suffix}"


def _sources(value: Any) -> Iterator[dict[str, str]]:
    """Every file, as its path and SHA-256, that a specification names."""
    if isinstance(value, dict):
        if value.keys() == {"path", "sha256"}:
            yield value
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from _sources(item)


def _with_kept(spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The specification with the folder's copies in the place of files that are gone."""
    for file in _sources(spec):
        if not Path(file["path"]).is_file():
            file["path"] = str(_kept(folder, file).resolve())
    return spec


def update_manifest(folder: Path, manifest: Manifest, *, solves: bool) -> None:
    """Write a folder's manifest if it is missing, damaged or another one; environments that are named there are kept.

    Parameters
    ----------
    folder : Path
    manifest : Manifest
        As it should be, without environments.
    solves : bool
        Whether shards are about to be generated, so that this environment belongs into it.
    """
    try:
        environments = read_manifest(folder).environments
    except NewerSchemaError:
        raise
    except (StoreError, FileNotFoundError):
        environments = ()
    if solves and this_environment() not in environments:
        environments = (*environments, this_environment())
    content = replace(manifest, environments=environments).to_json()
    path = folder / NAME
    if not path.is_file() or path.read_bytes() != content:
        write_atomically(path, content)
