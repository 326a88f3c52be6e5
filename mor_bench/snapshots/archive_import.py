"""Putting the samples of an archive into the cache, after all checks.

The order is: names, sizes and checksums of all files; then the dataset, the manifests and the
content of every shard; and only then the cache. Each shard must hold exactly the loads that the
dataset's plan draws. A checksum shows that files are those of the archive's author. Whether the
displacements are equilibria is not checked here.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from mor_bench.errors import MorBenchError, StoreError
from mor_bench.scene.scene import load_scene
from mor_bench.scratch import scratch_folder
from mor_bench.snapshots.archive_files import MAIN, MANIFEST, TESTS, Archive, open_archive
from mor_bench.snapshots.generate import (
    ShardPlan,
    dataset_folder,
    dataset_key,
    manifest_of,
    parse_seconds,
    seconds_path,
    shard_path,
    writing,
)
from mor_bench.snapshots.manifest import (
    Manifest,
    files_of,
    keep_sources,
    read_manifest,
    update_manifest,
    with_kept_files,
)
from mor_bench.snapshots.sampling import n_samples_of
from mor_bench.snapshots.store import parse_shard, remove_leftovers, write_atomically
from mor_bench.snapshots.test_sets import SET_NAMES, SetName, spec_of_set
from mor_bench.specs import DatasetSpec, ImportedDatasetSpec, load_dataset_spec

HDF5_BYTES = 65_536
"""Bytes of a shard's file beside its arrays, at most."""


def import_archive(
    path: Path,
    cache: Path | None = None,
    wanted: DatasetSpec | None = None,
) -> list[Path]:
    """Put the samples of an archive into the cache; return the folders of its datasets.

    The folders are those that `mor_bench.snapshots.generate.generate` makes, so all commands use
    the samples. Shards that are already there are replaced.

    Parameters
    ----------
    path : Path
        A folder or ZIP file that `mor-bench archive` wrote.
    cache : Path, optional
        Cache folder. Default: the user's cache folder.
    wanted : DatasetSpec, optional
        The dataset that the archive must hold.

    Raises
    ------
    StoreError
        If the archive is damaged, incomplete or foreign, holds links or files of other kinds, is
        of another version or dataset, or holds other samples than it says. Nothing is written then.
        Also if the cache cannot be written. Finished shards are kept then.
    FileNotFoundError
        If the archive does not exist.
    """
    with open_archive(path) as archive:
        archive.check_sums()
        with scratch_folder() as folder, _named_after(archive, folder):
            spec = _dataset(archive, folder)
            if wanted is not None and dataset_key(wanted) != dataset_key(spec):
                raise StoreError(
                    f"{path}: holds `{spec.name}` with other physics than `{wanted.name}`."
                )
            parts = [_Part(archive, folder, *item, cache) for item in _sets(archive, spec).items()]
            _check_names(archive, spec, parts)
            manifests = [part.checked() for part in parts]
            return [part.put(manifest) for part, manifest in zip(parts, manifests, strict=True)]


@contextmanager
def _named_after(archive: Archive, folder: Path) -> Iterator[None]:
    """Let errors about copied files name the archive."""
    try:
        yield
    except MorBenchError as error:
        text = str(error).replace(str(folder), str(archive.path))
        if text == str(error):
            raise
        raise StoreError(text) from None


def _dataset(archive: Archive, folder: Path) -> DatasetSpec:
    """Copy the dataset's file and the files that it names to a folder, and read it."""
    tomls = [name for name in archive.sums if name.endswith(".toml")]
    if len(tomls) != 1:
        raise StoreError(f"{archive.path}: must hold one dataset file; got {len(tomls)}.")
    sources = [name for name in archive.sums if name.startswith("source-")]
    for name in (*tomls, *sources):
        (folder / name).write_bytes(archive.read(name))
    spec = load_dataset_spec(folder / tomls[0])
    if isinstance(spec, ImportedDatasetSpec):
        raise StoreError(f"{archive.where(tomls[0])}: an archive holds no imported samples.")
    named = {Path(file.path) for file in files_of(spec)}
    if named != {folder / name for name in sources}:
        raise StoreError(
            f"{archive.where(tomls[0])}: names other files than the `source-` files of the archive."
        )
    return spec


def _sets(archive: Archive, spec: DatasetSpec) -> dict[str, DatasetSpec]:
    """Return the main set and the test sets of an archive, by the folders of their samples."""
    found = {name.rpartition("/")[0] for name in archive.sums if "/" in name}
    known: dict[str, SetName] = {f"{TESTS}/{name}": name for name in SET_NAMES}
    sets = {MAIN: spec}
    for place in sorted(found - {MAIN}):
        if place not in known:
            raise StoreError(f"{archive.where(place)}: there is no such test set.")
        sets[place] = spec_of_set(spec, known[place])
    return sets


def _check_names(archive: Archive, spec: DatasetSpec, parts: list[_Part]) -> None:
    """Check that the files of samples are those of the plans, no more and no fewer."""
    needed = {name for part in parts for name in part.needed}
    if lost := sorted(needed - archive.sums.keys()):
        raise StoreError(
            f"{archive.path}: incomplete: `{spec.name}` needs {lost[0]}"
            f"{f' and {len(lost) - 1:,} more files' if len(lost) > 1 else ''}."
        )
    times = {part.seconds(number) for part in parts for number in part.plan.numbers}
    samples = {name for name in archive.sums if "/" in name}
    if extra := sorted(samples - needed - times):
        raise StoreError(f"{archive.where(extra[0])}: `{spec.name}` has no such shard.")


class _Part:
    """The samples of the main set or of a test set in an archive."""

    def __init__(
        self, archive: Archive, folder: Path, place: str, spec: DatasetSpec, cache: Path | None
    ) -> None:
        self._archive, self._scratch, self._place, self.spec = archive, folder, place, spec
        scene = load_scene(spec)
        self.plan = ShardPlan(dataset_folder(spec, cache), scene, n_samples_of(scene))

    def shard(self, number: int) -> str:
        return shard_path(Path(self._place), number).as_posix()

    def seconds(self, number: int) -> str:
        return seconds_path(Path(self._place), number).as_posix()

    @property
    def needed(self) -> set[str]:
        """The names of the manifest and of all shards."""
        return {f"{self._place}/{MANIFEST}", *map(self.shard, self.plan.numbers)}

    def checked(self) -> Manifest:
        """Check the manifest and every shard; return the manifest."""
        manifest = self._checked_manifest()
        for number in self.plan.numbers:
            name = self.shard(number)
            self._check_size(name, number)
            shard = parse_shard(self._archive.read(name), self._archive.where(name))
            self.plan.check(shard, number, self._archive.where(name))
            self._time(number)
        return manifest

    def _checked_manifest(self) -> Manifest:
        name = f"{self._place}/{MANIFEST}"
        copy = self._scratch / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(self._archive.read(name))
        found, wanted = read_manifest(copy.parent), manifest_of(self.plan, self.spec)
        if found.generator_version != wanted.generator_version:
            raise StoreError(
                f"{self._archive.where(name)}: samples of version {found.generator_version}; this "
                f"version of mor-bench generates version {wanted.generator_version}. "
                "Use the version of mor-bench that its README.md names."
            )
        same = dataset_key(found.spec) == dataset_key(self.spec)
        sizes = (found.n_samples, found.shard_size)
        if not same or sizes != (wanted.n_samples, wanted.shard_size):
            raise StoreError(f"{self._archive.where(name)}: is about other samples.")
        return found

    def _check_size(self, name: str, number: int) -> None:
        """Refuse a file that is larger than the arrays of its samples, before it is read."""
        loads = self.plan.loads(number)
        arrays = (loads.patches, loads.vectors, loads.parameters)
        per_sample = 8 * len(self.plan.scene.free_dofs) + 9
        most = sum(array.nbytes for array in arrays) + len(loads) * per_sample + HDF5_BYTES
        if (size := self._archive.sizes[name]) > most:
            raise StoreError(
                f"{self._archive.where(name)}: {size:,} bytes; its samples take at most {most:,}."
            )

    def _time(self, number: int) -> bytes | None:
        """Return the content of the file with a shard's time; None without any."""
        name = self.seconds(number)
        if name not in self._archive.sums:
            return None
        content = self._archive.read(name)
        if parse_seconds(content) is None:
            raise StoreError(f"{self._archive.where(name)}: must hold a number of seconds.")
        return content

    def put(self, found: Manifest) -> Path:
        """Write a checked manifest and the shards to the cache, and return the folder."""
        folder = self.plan.folder
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            remove_leftovers(folder)
            keep_sources(folder, self.spec)
            spec = with_kept_files(self.spec, folder.resolve())
            manifest = replace(manifest_of(self.plan, spec), environments=found.environments)
            update_manifest(folder, manifest, solves=False)
            for number in self.plan.numbers:
                content = self._archive.read(self.shard(number))
                if time := self._time(number):
                    write_atomically(seconds_path(folder, number), time)
                write_atomically(shard_path(folder, number), content)
        return folder
