"""A dataset with its samples as an archive for a data repository."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

from mor_bench.checked_files import read_bytes
from mor_bench.errors import InvalidInputError
from mor_bench.export.archive_writer import ArchiveWriter, new_archive
from mor_bench.export.data_card import Facts, Licence, card_text, metadata_of
from mor_bench.export.toml_text import toml_text
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.archive_files import CARD, LICENCE, MAIN, MANIFEST, METADATA, SUMS, TESTS
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.generate import (
    GenerationOptions,
    ShardPlan,
    dataset_folder,
    manifest_of,
    seconds_path,
    shard_path,
)
from mor_bench.snapshots.manifest import files_of, kept_name, read_manifest, with_kept_files
from mor_bench.snapshots.sampling import n_samples_of
from mor_bench.snapshots.test_sets import available_sets, spec_of_set
from mor_bench.specs import DatasetSpec


@dataclass(frozen=True)
class Written:
    """A finished archive.

    Attributes
    ----------
    path : Path
    sums_sha256 : str
        SHA-256 of the list of checksums, which identifies the content.
    """

    path: Path
    sums_sha256: str


def write_archive(
    spec: DatasetSpec,
    out: str | Path,
    authors: Sequence[str],
    licence: Licence,
    *,
    tests: bool = False,
    **generation: Unpack[GenerationOptions],
) -> Written:
    """Write all samples of a dataset, with what a reader needs to use and to cite them.

    Missing samples are generated first. `mor_bench.snapshots.archive_import` reads the archive.

    Parameters
    ----------
    spec : DatasetSpec
    out : path
        A ZIP file if the name ends in .zip, otherwise a folder. It must not exist.
    authors : sequence of str
        Names of the creators of the data.
    licence : Licence
        Of the data.
    tests : bool
        Whether the named test sets belong to it.
    workers, cluster, cache, progress : optional
        Options of generation, see `mor_bench.snapshots.generate.generate`.

    Raises
    ------
    InvalidInputError
        If the target exists, or an author is not a name.
    StoreError
        If the target cannot be written. Nothing is left of it then.
    """
    out = Path(out)
    if out.exists() or out.is_symlink():
        raise InvalidInputError(
            f"`out`: {out} exists and is not overwritten; remove it or choose another name."
        )
    for author in authors:
        if not (author.strip() and author.isprintable() and len(author) <= 200):
            raise InvalidInputError(f"`author` must be a name of one line; got {author!r}.")
    names = available_sets(spec) if tests else []
    data = load_dataset(spec, tests=names, **generation)
    sets = {MAIN: spec, **{f"{TESTS}/{name}": spec_of_set(spec, name) for name in names}}
    with new_archive(out) as writer:
        cache = generation.get("cache")
        environments = [_add_samples(writer, *item, cache) for item in sets.items()]
        for file in files_of(spec):
            writer.add(kept_name(file), read_bytes(file.checked()))
        writer.add(f"{spec.name}.toml", _toml(spec).encode())
        facts = Facts(data, spec, tuple(authors), licence, tuple(environments[0]))
        writer.add(LICENCE, licence.text(authors).encode())
        writer.add(CARD, card_text(facts).encode())
        metadata = metadata_of(facts, writer.sums, writer.sizes)
        text = json.dumps(metadata, indent=1, ensure_ascii=False)
        writer.add(METADATA, f"{text}\n".encode())
        digest = writer.list_sums()
    return Written(out if out.suffix.lower() == ".zip" else out / SUMS, digest)


def _add_samples(
    writer: ArchiveWriter, place: str, spec: DatasetSpec, cache: Path | None
) -> tuple[dict[str, str], ...]:
    """Add manifest, shards and their times; return the environments that generated them."""
    folder, scene = dataset_folder(spec, cache), load_scene(spec)
    plan = ShardPlan(folder, scene, n_samples_of(scene))
    environments = read_manifest(folder).environments
    # Paths of this machine stay here.
    manifest = replace(manifest_of(plan, spec), spec=with_kept_files(spec, Path()))
    content = replace(manifest, environments=environments).to_json()
    writer.add(f"{place}/{MANIFEST}", content)
    for number in plan.numbers:
        for path in (seconds_path(folder, number), shard_path(folder, number)):
            if path.is_file() or path == shard_path(folder, number):
                writer.add(f"{place}/{path.name}", read_bytes(path))
    return environments


def _toml(spec: DatasetSpec) -> str:
    """Return a dataset file that names the files beside it."""
    content = spec.model_dump(mode="json", exclude_unset=True)
    del content["name"]
    table: dict[str, Any] = _with_names(content, {f.sha256: kept_name(f) for f in files_of(spec)})
    return toml_text(table)


def _with_names(value: Any, names: dict[str, str]) -> Any:
    """Replace each file by its name in the archive."""
    if isinstance(value, dict):
        if value.keys() == {"path", "sha256"}:
            return names[value["sha256"]]
        return {key: _with_names(item, names) for key, item in value.items()}
    return [_with_names(item, names) for item in value] if isinstance(value, list) else value
