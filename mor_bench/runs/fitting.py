"""Fitting a configuration in a worker process, here or on a cluster, unless the cache has it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from mor_bench.checked_files import read_written
from mor_bench.errors import InvalidInputError, MorBenchError, OutOfTimeError, StoreError
from mor_bench.machine import usable_cores
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.runs.cached_fit import CachedFit, FitRecord
from mor_bench.runs.configurations import Configuration
from mor_bench.sandbox.handover import write_arrays
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess
from mor_bench.sandbox.seal import Restrictions
from mor_bench.scene.scene import Scene
from mor_bench.scratch import scratch_folder

RemoteFit = Callable[[CachedFit, float], tuple[dict[str, Any], bytes | None]]
"""A fit on another machine within a time limit, s; it returns the worker's answer and the model."""


def fit_configuration(
    cached: CachedFit, limit_s: float, remote: RemoteFit | None = None
) -> FitRecord:
    """Fit a configuration, unless the cache has it. The process never gets a test set.

    Parameters
    ----------
    cached : CachedFit
    limit_s : float
        Time limit of the fit, s.
    remote : callable, optional
        Function that fits on another machine.

    Raises
    ------
    MethodFailedError
        If the method crashes, hangs, takes too much memory or changes the training samples.
    MorBenchError
        If the method raises an error. Its type is the same here.
    """
    if cached.record is not None:
        return cached.record
    if remote is not None:
        answer, content = remote(cached, limit_s)
        return cached.keep(_record(cached, answer), content)
    worker, answer, model = _fit_in_worker(cached, limit_s)
    try:
        _add_earlier_processes(answer, cached.taken_s)
        saved = answer["model_bytes"] is not None
        content = read_written(model, cached.data.scratch) if saved else None
        record = cached.keep(_record(cached, answer), content)
        shutil.rmtree(model.parent, ignore_errors=True)
        cached.end_training()
    except BaseException:
        worker.end()
        raise
    if saved:
        worker.end()
    else:
        cached.hold(worker)
    return record


def _add_earlier_processes(answer: dict[str, Any], taken_s: float) -> None:
    """Add a training's wall time before it was stopped; it is taken to have used as many cores."""
    cores = answer["fit_core_s"] / answer["fit_s"] if answer["fit_s"] else 1.0
    answer["fit_core_s"] += taken_s * cores
    answer["fit_s"] += taken_s


def _fit_in_worker(
    cached: CachedFit, limit_s: float
) -> tuple[SandboxedProcess, dict[str, Any], Path]:
    """Fit from a checkpoint if there is one; start again if the checkpoint caused a failure."""
    resumed = cached.checkpoint.exists()
    worker = _worker_for(cached)
    try:
        try:
            left_s = _time_left(limit_s, cached.taken_s)
            return worker, *cached.fit_in(worker, left_s, cached.checkpoint)
        except (MethodFailedError, OutOfTimeError):
            raise  # a later run with more time resumes from the checkpoint
        except MorBenchError as error:
            cached.end_training()
            if not (resumed and isinstance(error, StoreError | InvalidInputError)):
                raise
        worker.end()
        worker = _worker_for(cached)
        return worker, *cached.fit_in(worker, limit_s, cached.checkpoint)
    except BaseException:
        worker.end()
        raise


def _worker_for(cached: CachedFit) -> SandboxedProcess:
    """Start a worker for a fit; one that may train can open the folder of its checkpoint."""
    if cached.configuration.training is None:
        return cached.worker()
    cached.begin_training()
    return cached.worker(exempt=cached.checkpoint.parent)


def _time_left(limit_s: float, taken_s: float) -> float:
    if taken_s >= limit_s:
        raise MethodFailedError(
            f"fitting took longer than the limit of {limit_s:g} s; it was stopped after "
            f"{taken_s:.0f} s"
        )
    return limit_s - taken_s


def _record(cached: CachedFit, answer: dict[str, Any]) -> FitRecord:
    return FitRecord(
        method=cached.configuration.method.name,
        n_train=cached.data.n_train,
        n_dofs=cached.data.scene.mesh.n_dofs,
        **answer,
    )


@dataclass(frozen=True)
class ClusterFit:
    """A fit to do on another machine: scene, samples, configuration and limits.

    Attributes
    ----------
    scene : Scene
    train, validation : dict
        Arrays of the samples, see `mor_bench.sandbox.handover`.
    configuration : Configuration
    limit_s, memory_limit_bytes : float
    """

    scene: Scene
    train: dict[str, NDArray[Any]]
    validation: dict[str, NDArray[Any]]
    configuration: Configuration
    limit_s: float
    memory_limit_bytes: float


def fit_on_cluster(task: ClusterFit) -> tuple[dict[str, Any], bytes | None]:
    """Fit on this machine in a worker process; return its answer and the model's file."""
    with scratch_folder() as folder:
        train, validation = folder / "train", folder / "validation"
        model = folder / "model.safetensors"
        write_arrays(train, task.train)
        write_arrays(validation, task.validation)
        request = FitRequest(
            surrogate=task.configuration.method.surrogate,
            parameters=task.configuration.parameters,
            train=train,
            model=model,
            threads=usable_cores(),
            limit_s=task.limit_s,
            training=task.configuration.training,
            validation=validation,
        )
        restrictions = Restrictions(memory_bytes=task.memory_limit_bytes)
        with SandboxedProcess(MethodSession, restrictions, scene=task.scene) as worker:
            answer = worker.ask("fit", task.limit_s, request=request)
        written = answer["model_bytes"] is not None
        return answer, read_written(model, folder) if written else None
