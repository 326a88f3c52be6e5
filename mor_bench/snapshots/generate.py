"""Generation of a dataset by the full-order model, in parallel, stopped and resumed at any moment."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, as_completed
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from threading import Thread
from time import perf_counter, sleep

import numpy as np
import platformdirs
from threadpoolctl import threadpool_limits

from mor_bench.errors import InvertedElementError, StoreError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import Solution
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.sampling import draw_loads, n_samples_of
from mor_bench.snapshots.store import SCHEMA_VERSION, STATUSES, Shard, read_shard, write_atomically, write_shard
from mor_bench.specs import DatasetSpec

SHARD_SIZE = 100
"""Samples per shard."""

GENERATOR_VERSION = 3
"""Raised when a change of the full-order model or of the sampling changes samples; part of a dataset's folder name."""

Progress = Callable[[int, int], None]
"""Called with the samples done and the samples wanted."""


def default_cache() -> Path:
    """The user's cache folder for datasets."""
    return Path(platformdirs.user_cache_dir("mor-bench"))


def dataset_folder(spec: DatasetSpec, cache: Path | None) -> Path:
    """Where a dataset lies: its name, and a digest of all that decides its samples."""
    return (cache or default_cache()) / "datasets" / f"{spec.name}-{spec.digest()}-v{SCHEMA_VERSION}.{GENERATOR_VERSION}"


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


@lru_cache(maxsize=1)
def _model(spec_json: str) -> FullOrderModel:
    """A worker builds the model once and keeps it for its later shards."""
    return FullOrderModel(load_scene(DatasetSpec.model_validate_json(spec_json)))


def solve_shard(spec_json: str, number: int) -> tuple[Shard, float]:
    """Solve the samples of one shard, on one thread; also the seconds that the solves took. Runs in a worker."""
    model = _model(spec_json)
    scene = model.scene
    start = number * SHARD_SIZE
    loads = draw_loads(scene, start, min(start + SHARD_SIZE, n_samples_of(scene)))
    forces = loads.nodal_forces(scene.patch_weights).reshape(len(loads), -1)[:, scene.free_dofs]
    displacements = np.full((len(loads), model.n_unknowns), np.nan)
    min_det_f, status = np.full(len(loads), np.nan), np.zeros(len(loads), dtype=np.uint8)
    with threadpool_limits(1):
        begun = perf_counter()
        for row, found in enumerate(model.solve_many(forces)):
            if isinstance(found, Solution):
                displacements[row], min_det_f[row] = found.displacement, found.min_det_f
            else:
                status[row] = STATUSES.index("inverted" if isinstance(found, InvertedElementError) else "no-equilibrium")
        seconds = perf_counter() - begun
    return Shard(start, loads.patches, loads.vectors, displacements, min_det_f, status), seconds


def _is_sound(path: Path) -> bool:
    try:
        read_shard(path)
    except (StoreError, FileNotFoundError):
        return False
    return True


def _end_with(parent: int) -> None:
    """Let this worker end when its parent has died by a signal that no one can catch; otherwise it would wait for ever."""

    def watch() -> None:
        while os.getppid() == parent:
            sleep(1.0)
        os._exit(1)

    Thread(target=watch, daemon=True).start()


@contextmanager
def worker_pool(workers: int) -> Iterator[Executor]:
    """Worker processes that need no `if __name__ == "__main__"` in the caller's script, and end with their parent."""
    from loky import ProcessPoolExecutor

    executor = ProcessPoolExecutor(max_workers=workers, initializer=_end_with, initargs=(os.getpid(),))
    try:
        yield executor
    except BaseException:
        executor.shutdown(kill_workers=True)
        raise
    executor.shutdown()


def generate(
    spec: DatasetSpec, limit: int | None = None, workers: int = 1, cache: Path | None = None, progress: Progress | None = None
) -> Path:  # fmt: skip
    """Make sure that the shards of a dataset exist; what is there and sound is kept, what is damaged is made again.

    Parameters
    ----------
    spec : DatasetSpec
    limit : int, optional
        Only the first samples.
    workers : int
        Processes; 1 solves in this one.
    cache : Path, optional
        Cache folder; the user's by default.
    progress : callable, optional
        Called with (samples done, samples wanted) after each shard.

    Returns
    -------
    Path
        The dataset's folder.
    """
    folder = dataset_folder(spec, cache)
    folder.mkdir(parents=True, exist_ok=True)
    total = n_samples_to_generate(spec, limit)
    numbers = range(-(-total // SHARD_SIZE))
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "generator_version": GENERATOR_VERSION,
        "shard_size": SHARD_SIZE,
        "spec": spec.model_dump(mode="json"),
    }
    write_atomically(folder / "manifest.json", json.dumps(manifest, indent=1, sort_keys=True).encode())
    missing = [number for number in numbers if not _is_sound(shard_path(folder, number))]
    done = total - len(missing) * SHARD_SIZE

    def commit(number: int, shard: Shard, seconds: float) -> None:
        nonlocal done
        write_shard(shard_path(folder, number), shard)
        write_atomically(folder / f"seconds-{number:05d}.txt", f"{seconds:.6f}\n".encode())
        done += SHARD_SIZE
        if progress:
            progress(min(max(done, 0), total), total)

    text = spec.model_dump_json()
    if missing:
        # Compiles the kernels, or reads them from numba's cache, here rather than in every worker at once.
        commit(missing[0], *solve_shard(text, missing[0]))
    if len(missing) > 1 and workers > 1:
        with worker_pool(workers) as executor:
            futures: dict[Future[tuple[Shard, float]], int] = {executor.submit(solve_shard, text, number): number for number in missing[1:]}
            for future in as_completed(futures):
                commit(futures[future], *future.result())
    else:
        for number in missing[1:]:
            commit(number, *solve_shard(text, number))
    return folder


def generation_seconds(spec: DatasetSpec, cache: Path | None, n_samples: int) -> float | None:
    """Core-seconds that the full-order model took for a number of samples, from the shards solved; None if unknown.

    Kept beside the shards and not in them: a dataset generated twice is bit-identical, its timings are not.
    """
    times = []
    for path in sorted(dataset_folder(spec, cache).glob("seconds-*.txt")):
        with suppress(ValueError, OSError):  # a timing that was lost costs nothing but itself
            times.append(float(path.read_text()))
    return sum(times) * n_samples / n_samples_to_generate(spec, len(times) * SHARD_SIZE) if times else None
