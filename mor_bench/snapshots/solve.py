"""The part of generation that runs in a worker process or on another machine. It reads no file."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from time import thread_time

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from mor_bench.compile_clock import compile_clock
from mor_bench.errors import InvertedElementError, SolverError, WorkerError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.moved_bodies import generator_of
from mor_bench.mechanics.newton import Solution
from mor_bench.mechanics.parametric import Generator, OneBody
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.load_paths import solve_paths
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.store import STATUSES, Shard

GENERATOR_VERSION = 3
"""Increase this version if a change of the full-order model or sampling changes samples.

It is part of a dataset's folder name.
"""


@dataclass(frozen=True)
class Task:
    """The unsolved samples of one shard.

    Attributes
    ----------
    dataset : str
        See `Shard`.
    problem : bytes
        Output of `pack`.
    start : int
        Number of the first sample.
    loads : PatchLoads
    generator_version : int
        The sender's version.
    steps : int
        Samples of each load path.
    """

    dataset: str
    problem: bytes
    start: int
    loads: PatchLoads
    generator_version: int = GENERATOR_VERSION
    steps: int = 1


@dataclass(frozen=True)
class Solved:
    """A shard, and the solving time, s."""

    shard: Shard
    seconds: float


def pack(scene: Scene) -> bytes:
    """Serialise the input of a worker: mesh, material, supports and patch weights."""
    mesh = replace(scene.mesh)  # a copy without cached properties
    # A moved region, or one under a pressure that follows it, may be one of the sets.
    sets = scene.point_sets if scene.motion or scene.follows or scene.contact else {}
    touched = scene.embedded_surface if scene.contact else None
    sent = replace(scene, mesh=mesh, embedded_surface=touched, point_sets=sets)
    return pickle.dumps((sent, scene.patch_weights))


class _Kept(threading.local):
    """The last model of each thread. Models have buffers, so threads do not share them."""

    problem: bytes = b""
    model: Generator
    weights: sp.csr_array

    def of(self, problem: bytes) -> tuple[Generator, sp.csr_array]:
        if self.problem != problem:
            scene, self.weights = pickle.loads(problem)
            self.model, self.problem = generator_of(scene), problem
        return self.model, self.weights


_kept = _Kept()


class _SingleThreaded:
    """Keeps BLAS and OpenMP on one thread while any thread of the process solves."""

    def __init__(self) -> None:
        self._lock, self._n = threading.Lock(), 0

    @contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if self._n == 0:
                self._limits = threadpool_limits(1)
            self._n += 1
        try:
            yield
        finally:
            with self._lock:
                self._n -= 1
                if self._n == 0:
                    self._limits.restore_original_limits()


_single_threaded = _SingleThreaded()


def _solutions(
    model: Generator,
    values: NDArray[np.float64],
    task: Task,
    parameters: NDArray[np.float64],
) -> list[Solution | SolverError]:
    if task.steps == 1:
        return model.solve_many(values, parameters)
    assert isinstance(model, OneBody)
    assert isinstance(model.model, FullOrderModel)
    return solve_paths(model.model, values, task.start, task.steps)


def solve_task(task: Task) -> Solved:
    """Solve the samples of one shard, on one thread.

    Raises
    ------
    WorkerError
        If the sender's version of mor-bench generates other samples.
    """
    if task.generator_version != GENERATOR_VERSION:
        raise WorkerError(
            f"a worker generates samples of version {GENERATOR_VERSION}, but version "
            f"{task.generator_version} is required; update its mor-bench."
        )
    model, weights = _kept.of(task.problem)
    loads = task.loads
    values = model.scene.at_free_dofs(loads.nodal_forces(weights).reshape(len(loads), -1))
    displacements = np.full(values.shape, np.nan)
    min_det_f: NDArray[np.float64] = np.full(len(loads), np.nan)
    status = np.zeros(len(loads), dtype=np.uint8)
    with _single_threaded(), compile_clock() as compilation:
        begun = thread_time()  # core-seconds, which other programs hardly change
        for row, found in enumerate(_solutions(model, values, task, loads.parameters)):
            if isinstance(found, Solution):
                displacements[row], min_det_f[row] = found.displacement, found.min_det_f
            else:
                inverted = isinstance(found, InvertedElementError)
                status[row] = STATUSES.index("inverted" if inverted else "no-equilibrium")
        seconds = max(thread_time() - begun - compilation.core_s, 0.0)
    columns = loads.patches, loads.vectors, displacements, min_det_f, status, loads.parameters
    return Solved(Shard(task.dataset, task.start, *columns), seconds)
