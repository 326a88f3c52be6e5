"""Generation of a dataset by the full-order model, in parallel, stopped and resumed at any moment."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import platformdirs

from mor_bench.errors import DamagedFileWarning, NewerSchemaError, StoreError
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.executors import KEPT, check_pool, open_pool
from mor_bench.snapshots.manifest import Manifest, keep_sources, read_manifest, update_manifest
from mor_bench.snapshots.sampling import PatchLoads, draw_loads, n_samples_of
from mor_bench.snapshots.solve import GENERATOR_VERSION, Solved, Task, pack, solve_task
from mor_bench.snapshots.store import (
    SCHEMA_VERSION,
    STATUSES,
    Shard,
    read_shard,
    remove_leftovers,
    write_atomically,
    write_shard,
)
from mor_bench.specs import DatasetSpec

SHARD_SIZE = 100
"""Samples per shard."""

ROUND_OFF = 1e-9
"""Relative difference of loads that is another processor's round-off, and not another sample."""

Progress = Callable[[int, int], None]
"""Called with the samples done and the samples wanted."""


def default_cache() -> Path:
    """The user's cache folder for datasets."""
    return Path(platformdirs.user_cache_dir("mor-bench"))


def dataset_key(spec: DatasetSpec) -> str:
    """What tells a dataset's samples from all others: a digest of all that decides them, and the versions."""
    return f"{spec.digest()}-v{SCHEMA_VERSION}.{GENERATOR_VERSION}"


def dataset_folder(spec: DatasetSpec, cache: Path | None) -> Path:
    """Where a dataset lies: its name and its key; or that of another name, if there is one with the same samples."""
    parent = Path(cache or default_cache()) / "datasets"
    own = parent / f"{spec.name}-{dataset_key(spec)}"
    return own if own.exists() else min(parent.glob(f"*-{dataset_key(spec)}"), default=own)


def shard_path(folder: Path, number: int) -> Path:
    return folder / f"shard-{number:05d}.h5"


def n_samples_to_generate(spec: DatasetSpec, limit: int | None = None) -> int:
    """How many samples a dataset has, or the limit if that is less."""
    whole = n_samples_of(load_scene(spec))
    return whole if limit is None else min(limit, whole)


def read_shards(folder: Path, n_samples: int) -> Iterator[Shard]:
    """The first samples of a dataset, a shard at a time; raises `StoreError`."""
    for start in range(0, n_samples, SHARD_SIZE):
        yield read_shard(shard_path(folder, start // SHARD_SIZE)).first(n_samples - start)


@dataclass(frozen=True)
class _Plan:
    """Which shards a folder should hold, each known by its number."""

    folder: Path
    scene: Scene
    n_wanted: int

    @property
    def numbers(self) -> range:
        return range(-(-self.n_wanted // SHARD_SIZE))

    def n_wanted_of(self, number: int) -> int:
        """How many of a shard's samples are wanted; it has more if a limit ends in it."""
        return min(SHARD_SIZE, self.n_wanted - number * SHARD_SIZE)

    def loads(self, number: int) -> PatchLoads:
        start = number * SHARD_SIZE
        return draw_loads(self.scene, start, min(start + SHARD_SIZE, n_samples_of(self.scene)))

    @cached_property
    def key(self) -> str:
        return dataset_key(self.scene.generated)

    @cached_property
    def _problem(self) -> bytes:
        return pack(self.scene)

    def task(self, number: int) -> Task:
        return Task(self.key, self._problem, number * SHARD_SIZE, self.loads(number))

    def has(self, number: int) -> bool:
        """Whether a shard is there, is sound, and is the one that it should be; warns if it is there and is not."""
        path = shard_path(self.folder, number)
        try:
            shard = read_shard(path)
        except NewerSchemaError:
            raise
        except StoreError as error:
            warnings.warn(f"{error} It is made again.", DamagedFileWarning, stacklevel=3)
            return False
        except FileNotFoundError:
            return False
        named = shard.dataset == self.key and shard.start == number * SHARD_SIZE
        if named and self._is_filled(shard) and self._is_loaded(shard, self.loads(number)):
            return True
        warnings.warn(
            f"{path}: not the samples that belong there. They are made again.",
            DamagedFileWarning,
            stacklevel=3,
        )
        return False

    def _is_filled(self, shard: Shard) -> bool:
        n = len(shard.status)
        shapes = shard.displacements.shape == (
            n,
            len(self.scene.free_dofs),
        ) and shard.min_det_f.shape == (n,)
        valid = shard.status == 0
        return bool(
            shapes
            and (shard.status < len(STATUSES)).all()
            and np.isfinite(shard.displacements[valid]).all()
        )

    def _is_loaded(self, shard: Shard, loads: PatchLoads) -> bool:
        if (
            shard.patches.shape != loads.patches.shape
            or shard.vectors.shape != loads.vectors.shape
            or len(shard.status) != len(loads)
        ):
            return False
        difference = np.abs(shard.vectors - loads.vectors).max()
        return bool(
            (shard.patches == loads.patches).all()
            and difference <= ROUND_OFF * self.scene.generated.loads.magnitude_n[1]
        )


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    """Turn the system's errors into one that names the folder."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{folder}: cannot be written: {error.strerror or error}. {KEPT}"
        ) from error


def generate(
    spec: DatasetSpec,
    limit: int | None = None,
    workers: int | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
    cluster: str | None = None,
) -> Path:
    """Make sure that the shards of a dataset exist; what is there and sound is kept, what is damaged is made again.

    Several processes may generate the same dataset into the same folder at once. No more than a few shards per worker are
    in memory, however many there are. Neither what is stopped nor where it is solved changes a bit; processors of another
    kind, with other instructions, agree to the solver's tolerance.

    Parameters
    ----------
    spec : DatasetSpec
    limit : int, optional
        Only the first samples.
    workers : int, optional
        Processes, all cores by default; 1 solves in this one.
    cache : Path, optional
        Cache folder; the user's by default.
    progress : callable, optional
        Called with (samples done, samples wanted) before the first and after each shard.
    cluster : str, optional
        Solve on the workers of the Dask scheduler at this address, ``tcp://host:port``. They need this version of
        mor-bench, no disk in common, and one thread each for the best rate.

    Returns
    -------
    Path
        The dataset's folder.

    Raises
    ------
    InvalidInputError
        If ``workers`` is less than 1, ``cluster`` is no address, or both are given.
    StoreError
        If the folder cannot be written, as on a full disk, or holds files of a newer schema. Finished shards stay.
    WorkerError
        If workers were killed, or the cluster cannot be reached. Finished shards stay.
    MissingDependencyError
        If ``cluster`` is given without the extra of that name.
    """
    check_pool(workers, cluster)
    scene, folder = load_scene(spec), dataset_folder(spec, cache)
    whole = n_samples_of(scene)
    plan = _Plan(folder, scene, whole if limit is None else min(limit, whole))
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
    missing = [number for number in plan.numbers if not plan.has(number)]
    with _writing(folder):
        keep_sources(folder, spec)
        update_manifest(
            folder,
            Manifest(_owner(folder, spec), GENERATOR_VERSION, whole, SHARD_SIZE),
            solves=bool(missing),
        )
    count = _Count(plan, missing, progress)
    if missing and cluster is None:
        # Compiles the kernels, or reads them from numba's cache, here rather than in every worker at once.
        _fill(plan, missing[:1], count, workers=1)
        missing = missing[1:]
    if missing:
        _fill(plan, missing, count, workers if len(missing) > 1 else 1, cluster)
    return folder


def _owner(folder: Path, spec: DatasetSpec) -> DatasetSpec:
    """The specification that a folder's manifest is kept for: that of another dataset with the same samples, if it lies under its name."""
    if folder.name != f"{spec.name}-{dataset_key(spec)}":
        with suppress(StoreError, FileNotFoundError):
            kept = read_manifest(folder).spec
            if dataset_key(kept) == dataset_key(spec):
                return kept
    return spec


class _Count:
    """How many of the samples that are wanted are there."""

    def __init__(self, plan: _Plan, missing: list[int], progress: Progress | None) -> None:
        self._plan, self._progress = plan, progress
        self._done = plan.n_wanted - sum(map(plan.n_wanted_of, missing))
        self._tell()

    def add(self, number: int) -> None:
        self._done += self._plan.n_wanted_of(number)
        self._tell()

    def _tell(self) -> None:
        if self._progress:
            self._progress(self._done, self._plan.n_wanted)


def _fill(
    plan: _Plan, missing: list[int], count: _Count, workers: int | None, cluster: str | None = None
) -> None:
    """Solve the shards that are missing, and commit each when it is there."""

    def tasks() -> Iterator[Task]:
        for number in missing:
            if plan.has(number):  # meanwhile another process has made it
                count.add(number)
            else:
                yield plan.task(number)

    with open_pool(workers, cluster) as pool:
        for solved in pool.in_any_order(solve_task, tasks()):
            number = solved.shard.start // SHARD_SIZE
            _commit(plan.folder, number, solved)
            count.add(number)


def _commit(folder: Path, number: int, solved: Solved) -> None:
    with _writing(folder):
        write_shard(shard_path(folder, number), solved.shard)
        write_atomically(folder / f"seconds-{number:05d}.txt", f"{solved.seconds:.6f}\n".encode())


def generation_seconds(spec: DatasetSpec, cache: Path | None, n_samples: int) -> float | None:
    """Core-seconds that the full-order model took for a number of samples, from the shards solved; None if unknown.

    Kept beside the shards and not in them: a dataset generated twice is bit-identical, its timings are not.
    """
    times = []
    for path in sorted(dataset_folder(spec, cache).glob("seconds-*.txt")):
        with suppress(ValueError, OSError):  # a timing that was lost costs nothing but itself
            times.append(float(path.read_text()))
    return (
        sum(times) * n_samples / n_samples_to_generate(spec, len(times) * SHARD_SIZE)
        if times
        else None
    )
