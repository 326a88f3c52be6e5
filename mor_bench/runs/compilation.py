"""Compile the kernels of all methods before anything is measured, once per machine.

numba keeps compiled kernels in its cache on disk. A fit that compiles takes seconds longer, so a
run first fits and queries each method on a few samples of its own dataset, in throwaway processes.
A marker beside the compiled kernels says that a method is done; it is lost with them.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from llvmlite import binding

from mor_bench.errors import MorBenchError
from mor_bench.machine import usable_cores
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.mechanics.kernels import internal_force
from mor_bench.runs.code_digest import code_digest
from mor_bench.runs.configurations import OWN, Configuration, may_train
from mor_bench.runs.run_context import RunContext
from mor_bench.runs.training_data import TrainingData
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.process import SandboxedProcess, stoppable_threads
from mor_bench.sandbox.seal import Restrictions
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.specs import AnyDatasetSpec, MethodSpec

N_SAMPLES, N_QUERIES = 40, 4
"""Number of samples of the dataset on which methods are compiled, and of queries after each fit."""

ITERATIONS = 2
"""Iterations of a training; networks have no kernels of their own."""

LIMIT_S = 300.0
"""Time limit of a request to a throwaway process, s."""


@dataclass(frozen=True)
class Uncompiled:
    """Configurations that use the same kernels, and the marker of these kernels."""

    configurations: Sequence[Configuration]
    marker: Path

    @property
    def method(self) -> MethodSpec:
        """The method."""
        return self.configurations[0].method


def compile_kernels(
    spec: AnyDatasetSpec,
    configurations: Sequence[Configuration],
    context: RunContext,
    fork_server: ForkServer | None,
    scratch: Path,
) -> None:
    """Compile what is not yet compiled; report it to the listener.

    The first method compiles the shared kernels, then one method per core compiles its own. An
    error ends the compilation of one method only. It comes again in the method's own fit, whose row
    reports it.
    """
    waiting = uncompiled(spec, configurations)
    if not waiting:
        return
    restrictions = Restrictions(memory_bytes=context.memory_limit_bytes)
    problem: TrainingData | None = None
    done, lock = 0, Lock()

    def compile_group(group: Uncompiled) -> None:
        nonlocal problem, done
        with lock:
            context.listener.compiling(group.method.name, done, len(waiting))
        with suppress(MorBenchError):
            with lock:
                if problem is None:
                    # A fork server compiles while it starts; two processes would compile twice.
                    SandboxedProcess(MethodSession, restrictions, fork_server).end()
                    problem = _small_problem(spec, context, Path(folder))
            for configuration in _ends(group.configurations):
                with SandboxedProcess(
                    MethodSession, restrictions, fork_server, scene=problem.scene
                ) as worker:
                    _fit_and_query(configuration, problem, worker)
            with suppress(OSError):
                group.marker.touch()
        with lock:
            done += 1

    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        compile_group(waiting[0])
        with stoppable_threads(usable_cores()) as threads:
            list(threads.in_order(compile_group, waiting[1:]))
        context.listener.compiling(waiting[-1].method.name, len(waiting), len(waiting))


def uncompiled(spec: AnyDatasetSpec, configurations: Sequence[Configuration]) -> list[Uncompiled]:
    """Return the configurations of this package's methods whose kernels are not yet compiled.

    Kernels depend on words and switches among the parameters, and hardly on numbers.
    """
    folder = _marker_folder()
    if folder is None:
        return []
    groups: dict[str, list[Configuration]] = {}
    for configuration in configurations:
        if configuration.method.surrogate.startswith(OWN):
            groups.setdefault(_marker(spec, configuration), []).append(configuration)
    found = [Uncompiled(group, folder / marker) for marker, group in groups.items()]
    return [group for group in found if not group.marker.exists()]


def _ends(group: Sequence[Configuration]) -> Sequence[Configuration]:
    """Return the first and last configuration: arrays with one column have another layout.

    Of trained networks return the first only, because they have no kernels of their own.
    """
    return group[:1] if may_train(group[0].method) or len(group) == 1 else [group[0], group[-1]]


def _marker_folder() -> Path | None:
    """Return the folder of compiled kernels; None if numba does not compile or keeps nothing."""
    statistics = getattr(internal_force, "stats", None)
    path = statistics and statistics.cache_path
    return Path(path) if path else None


def _marker(spec: AnyDatasetSpec, configuration: Configuration) -> str:
    """Name a marker after all that the kernels of a configuration depend on."""
    method, parameters = configuration.method, configuration.parameters
    words = {name: value for name, value in parameters.items() if isinstance(value, str | bool)}
    settings = [os.environ.get(f"NUMBA_CPU_{name}") for name in ("NAME", "FEATURES")]
    processor = [binding.get_host_cpu_name(), *settings]
    scene = [spec.digest(), spec.observed is not None]
    parts = [code_digest(method.surrogate), method.surrogate, words, processor, scene]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    return f"compiled-{method.name}-{digest[:20]}"


def _small_problem(spec: AnyDatasetSpec, context: RunContext, folder: Path) -> TrainingData:
    """Generate a few samples of a dataset in this process, which compiles the solver too."""
    limit = min(N_SAMPLES, context.options.limit or N_SAMPLES)
    data = load_dataset(spec, limit, split=context.options.split, workers=1, cache=folder)
    return TrainingData.of(data, folder)


def _fit_and_query(
    configuration: Configuration, problem: TrainingData, worker: SandboxedProcess
) -> None:
    """Make all kinds of requests that a run makes."""
    parameters = configuration.parameters
    if "iterations" in parameters:
        parameters = {**parameters, "iterations": ITERATIONS}
    request = FitRequest(
        surrogate=configuration.method.surrogate,
        parameters=parameters,
        train=problem.folder,
        model=problem.scratch / "model.safetensors",
        threads=1,
        limit_s=LIMIT_S,
        training=None,
    )
    worker.ask("fit", LIMIT_S, request=request)
    forces = problem.sets["test"].forces[:N_QUERIES]
    answers = problem.scratch / "answers.npy"
    worker.ask("predict", LIMIT_S, forces=forces, out=answers, threads=1)
    worker.ask("flag", LIMIT_S, forces=forces)
    worker.ask("cost", LIMIT_S, forces=forces)
    worker.ask("warm", LIMIT_S, forces=forces, threads=1, seed=0)
    worker.ask("time", LIMIT_S, out=answers, n=1, floor_s=0.0, most_s=1.0, threads=1)
