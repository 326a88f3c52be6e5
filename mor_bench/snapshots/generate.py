"""Generation of a dataset by the full-order model: parallel, interruptible, resumable."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from math import inf
from pathlib import Path
from typing import TypedDict

import numpy as np
import platformdirs

from mor_bench.checked_files import read_bytes
from mor_bench.errors import DamagedFileWarning, NewerSchemaError, StoreError
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.executors import KEPT, check_pool, open_pool
from mor_bench.snapshots.manifest import Manifest, keep_sources, read_manifest, update_manifest
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import draw_loads, n_samples_of
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
from mor_bench.specs.load_ranges import largest_of

SHARD_SIZE = 100
"""Samples per shard."""

MOST_TIME_BYTES = 100
"""Largest file with the time of a shard."""

ROUND_OFF = 1e-9
"""Relative difference of loads that is accepted as round-off of another processor."""

Progress = Callable[[int, int], None]
"""Callback for the number of finished samples and the number of wanted samples."""


class GenerationOptions(TypedDict, total=False):
    """Options for generating missing samples; see `generate`."""

    workers: int | None
    cache: Path | None
    progress: Progress | None
    cluster: str | None


def default_cache() -> Path:
    """Return the user's cache folder for datasets."""
    return Path(platformdirs.user_cache_dir("mor-bench"))


def dataset_key(spec: DatasetSpec) -> str:
    """Return a digest of everything that determines a dataset's samples, including versions."""
    return f"{spec.digest()}-v{SCHEMA_VERSION}.{GENERATOR_VERSION}"


def dataset_folder(spec: DatasetSpec, cache: Path | None) -> Path:
    """Return the folder of a dataset, or an existing folder of a dataset with the same samples."""
    parent = Path(cache or default_cache()) / "datasets"
    own = parent / f"{spec.name}-{dataset_key(spec)}"
    return own if own.exists() else min(parent.glob(f"*-{dataset_key(spec)}"), default=own)


def shard_path(folder: Path, number: int) -> Path:
    return folder / f"shard-{number:05d}.h5"


def seconds_path(folder: Path, number: int) -> Path:
    return folder / f"seconds-{number:05d}.txt"


def n_samples_to_generate(spec: DatasetSpec, limit: int | None = None) -> int:
    """Return the number of samples of a dataset, or the limit if that is less."""
    return n_samples_of(load_scene(spec), limit)


def read_shards(folder: Path, n_samples: int) -> Iterator[Shard]:
    """Yield the first samples of a dataset, one shard at a time; errors as in `read_shard`."""
    for start in range(0, n_samples, SHARD_SIZE):
        yield read_shard(shard_path(folder, start // SHARD_SIZE)).first(n_samples - start)


@dataclass(frozen=True)
class ShardPlan:
    """The shards that a folder should hold, by number.

    Attributes
    ----------
    folder : Path
    scene : Scene
    n_wanted : int
        Number of samples that the shards should hold.
    """

    folder: Path
    scene: Scene
    n_wanted: int

    @property
    def numbers(self) -> range:
        return range(-(-self.n_wanted // SHARD_SIZE))

    def n_wanted_of(self, number: int) -> int:
        """Return the number of wanted samples of a shard; the shard may hold more."""
        return min(SHARD_SIZE, self.n_wanted - number * SHARD_SIZE)

    def loads(self, number: int) -> PatchLoads:
        start = number * SHARD_SIZE
        return draw_loads(self.scene, start, n_samples_of(self.scene, start + SHARD_SIZE))

    @cached_property
    def key(self) -> str:
        return dataset_key(self.scene.generated)

    @cached_property
    def _problem(self) -> bytes:
        return pack(self.scene)

    def task(self, number: int) -> Task:
        steps = self.scene.generated.load_plan.steps
        return Task(self.key, self._problem, number * SHARD_SIZE, self.loads(number), steps=steps)

    def has(self, number: int) -> bool:
        """Return whether the right shard exists; warn if an existing one is damaged or wrong."""
        path = shard_path(self.folder, number)
        try:
            self.check(read_shard(path), number, str(path))
        except NewerSchemaError:
            raise
        except StoreError as error:
            warnings.warn(f"{error} It is generated again.", DamagedFileWarning, stacklevel=3)
            return False
        except FileNotFoundError:
            return False
        return True

    def check(self, shard: Shard, number: int, where: str) -> None:
        """Raise `StoreError`, beginning with ``where``, unless a shard holds the right samples."""
        named = shard.dataset == self.key and shard.start == number * SHARD_SIZE
        if not (named and self._is_filled(shard) and self._is_loaded(shard, self.loads(number))):
            raise StoreError(f"{where}: holds the wrong samples.")

    def _is_filled(self, shard: Shard) -> bool:
        n, n_free = len(shard.status), len(self.scene.free_dofs)
        return bool(
            shard.displacements.shape == (n, n_free)
            and shard.min_det_f.shape == (n,)
            and (shard.status < len(STATUSES)).all()
            and np.isfinite(shard.displacements[shard.status == 0]).all()
        )

    def _is_loaded(self, shard: Shard, loads: PatchLoads) -> bool:
        largest = largest_of(self.scene.generated.load_plan.magnitude)
        return bool(
            shard.patches.shape == loads.patches.shape
            and shard.vectors.shape == loads.vectors.shape
            and shard.parameters.shape == loads.parameters.shape
            and len(shard.status) == len(loads)
            and (shard.patches == loads.patches).all()
            and np.abs(shard.vectors - loads.vectors).max() <= ROUND_OFF * largest
            and np.allclose(shard.parameters, loads.parameters, rtol=ROUND_OFF, atol=0.0)
        )


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn errors of the operating system into one that names the folder."""
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
    """Generate the missing or damaged shards of a dataset; return its folder.

    Several processes may generate the same dataset in the same folder. Only a few shards per worker
    are in memory. Interruptions, workers and clusters do not change a bit of the result. Processors
    with other instructions agree to the solver's tolerance.

    Parameters
    ----------
    spec : DatasetSpec
    limit : int, optional
        Generate only the first samples.
    workers : int, optional
        Number of processes. Default: all cores. 1 solves in this process.
    cache : Path, optional
        Cache folder. Default: the user's cache folder.
    progress : callable, optional
        Called with (finished samples, wanted samples) before the first and after each shard.
    cluster : str, optional
        Address of a Dask scheduler, ``tcp://host:port``, whose workers solve instead. They need
        this version of mor-bench and no shared disk; one thread each gives the best rate.

    Raises
    ------
    InvalidInputError
        If ``workers`` is less than 1, ``cluster`` is not an address, or both are given.
    StoreError
        If the folder cannot be written, as on a full disk, or holds files of a newer schema.
    WorkerError
        If workers were killed, or the cluster cannot be reached. Finished shards are kept.
    MissingDependencyError
        If ``cluster`` is given and the extra `cluster` is not installed.
    """
    check_pool(workers, cluster)
    scene, folder = load_scene(spec), dataset_folder(spec, cache)
    plan = ShardPlan(folder, scene, n_samples_of(scene, limit))
    missing = _prepare_folder(plan, spec)
    count = _Count(plan, missing, progress)
    if missing and cluster is None:
        # Compile the kernels, or read them from numba's cache, once here and not in every worker.
        _fill(plan, missing[:1], count, workers=1)
        missing = missing[1:]
    if missing:
        _fill(plan, missing, count, workers if len(missing) > 1 else 1, cluster)
    return folder


def _prepare_folder(plan: ShardPlan, spec: DatasetSpec) -> list[int]:
    """Create the folder with its manifest, and return the numbers of missing shards."""
    folder = plan.folder
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
    missing = [number for number in plan.numbers if not plan.has(number)]
    with writing(folder):
        keep_sources(folder, spec)
        update_manifest(folder, manifest_of(plan, spec), solves=bool(missing))
    return missing


def manifest_of(plan: ShardPlan, spec: DatasetSpec) -> Manifest:
    """Return the manifest of a plan's folder, without environments."""
    whole = n_samples_of(plan.scene)
    return Manifest(_owner(plan.folder, spec), GENERATOR_VERSION, whole, SHARD_SIZE)


def _owner(folder: Path, spec: DatasetSpec) -> DatasetSpec:
    """Return the specification for a folder's manifest.

    If the folder is named after another dataset with the same samples, it is that dataset's.
    """
    if folder.name != f"{spec.name}-{dataset_key(spec)}":
        with suppress(StoreError, FileNotFoundError):
            kept = read_manifest(folder).spec
            if dataset_key(kept) == dataset_key(spec):
                return kept
    return spec


class _Count:
    def __init__(self, plan: ShardPlan, missing: list[int], progress: Progress | None) -> None:
        self._plan, self._progress = plan, progress
        self._done = plan.n_wanted - sum(map(plan.n_wanted_of, missing))
        self._report()

    def add(self, number: int) -> None:
        self._done += self._plan.n_wanted_of(number)
        self._report()

    def _report(self) -> None:
        if self._progress:
            self._progress(self._done, self._plan.n_wanted)


def _fill(
    plan: ShardPlan,
    missing: list[int],
    count: _Count,
    workers: int | None,
    cluster: str | None = None,
) -> None:
    def tasks() -> Iterator[Task]:
        for number in missing:
            if plan.has(number):  # another process has generated it in the meantime
                count.add(number)
            else:
                yield plan.task(number)

    with open_pool(workers, cluster) as pool:
        for solved in pool.in_any_order(solve_task, tasks()):
            number = solved.shard.start // SHARD_SIZE
            _commit(plan.folder, number, solved)
            count.add(number)


def _commit(folder: Path, number: int, solved: Solved) -> None:
    with writing(folder):  # a kill in between must not lose the time of a shard that exists
        write_atomically(seconds_path(folder, number), f"{solved.seconds:.6f}\n".encode())
        write_shard(shard_path(folder, number), solved.shard)


def shard_seconds(path: Path) -> float | None:
    """Return the seconds that a timing of a shard states; None if it is missing or damaged."""
    with suppress(OSError, StoreError):
        return parse_seconds(read_bytes(path, MOST_TIME_BYTES))
    return None


def parse_seconds(content: bytes) -> float | None:
    """Return the seconds in the content of a timing; None if it is damaged."""
    with suppress(ValueError):
        seconds = float(content)
        if 0.0 <= seconds < inf:
            return seconds
    return None


def generation_seconds(spec: DatasetSpec, cache: Path | None, n_samples: int) -> float | None:
    """Return the core-seconds for a number of samples, from the timings of shards; None if unknown.

    Timings are stored beside the shards, because repeated generations give bit-identical shards.
    """
    times = []
    for path in sorted(dataset_folder(spec, cache).glob("seconds-*.txt")):
        seconds = shard_seconds(path)
        if seconds is not None:
            times.append(seconds)
    if not times:
        return None
    return sum(times) * n_samples / n_samples_to_generate(spec, len(times) * SHARD_SIZE)
