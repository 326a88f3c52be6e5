"""The dry run: what a run would compute, and how long that would take."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from pydantic import ValidationError

from mor_bench.checked_files import read_json
from mor_bench.errors import StoreError
from mor_bench.measure.latency import PROTOCOLS
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.options import RunOptions
from mor_bench.runs.cached_fit import CachedFit, FitRecord, RunEnvironment
from mor_bench.runs.configurations import (
    Configuration,
    checked_specs,
    configurations_of,
    draws_randomly,
)
from mor_bench.runs.extra_stages import LEARNING_STEP
from mor_bench.runs.run_context import RunContext
from mor_bench.runs.training_data import TrainingData
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.generate import (
    SHARD_SIZE,
    dataset_folder,
    n_samples_to_generate,
    shard_path,
)
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import AnyDatasetSpec, DatasetSpec

TRIAL_ITERATIONS = 100
"""Iterations after which a training that would take too long stops itself."""

REFERENCE_DOFS, REFERENCE_TRAINING = 768, 5120
"""Problem size for which method files state `fit_s`: beam-coarse, on two cores."""

PROBED = 8
"""Number of samples that are solved to measure the time per sample."""

LEARNING_POINTS = 4
"""Typical number of points of a learning curve, beside that of all samples."""

TURN_S = 0.1
"""Typical time of a turn of timed queries, s."""

START_S = 2.0
"""Typical time to start the processes of a timing, s."""


@dataclass(frozen=True)
class Step:
    """A dataset to generate or a configuration to fit.

    Attributes
    ----------
    dataset, label : str
    done : bool
        Whether the cache has it.
    seconds : float or None
        None if unknown.
    """

    dataset: str
    label: str
    done: bool
    seconds: float | None


@dataclass(frozen=True)
class Plan:
    """The steps of a run, and the seconds of timing everything."""

    steps: list[Step]
    timing_s: float

    @property
    def seconds(self) -> float:
        """Seconds of everything that is known and not done."""
        return self.timing_s + sum(step.seconds or 0.0 for step in self.steps if not step.done)

    @property
    def n_unknown(self) -> int:
        """Number of steps of unknown length."""
        return sum(step.seconds is None and not step.done for step in self.steps)

    def as_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {**asdict(self), "seconds": self.seconds, "n_unknown": self.n_unknown}


def plan(
    datasets: Sequence[str | Path | Mapping[str, Any]] = ("beam-coarse",),
    methods: Sequence[str | Path] | None = None,
    profile: str = "quick",
    **options: Any,
) -> Plan:
    """Plan the steps of `mor_bench.run` for the same arguments, without taking them.

    The time of a fit follows from earlier fits of the method in the cache, or else from the
    method's file. Both are scaled by the numbers of unknowns and of training samples. The time of
    generating data follows from a few samples that are solved here.

    Raises
    ------
    SpecError, InvalidInputError
        As `mor_bench.run`.
    """
    context = RunContext.of(RunOptions(profile=profile, **options))
    specs, methods_found = checked_specs(datasets, methods, context.options)
    configurations = [
        configuration
        for method in methods_found
        for configuration in configurations_of([method], profile, context.training)[
            : context.budget.configurations
        ]
    ]
    steps = [step for spec in specs for step in _steps(spec, configurations, context)]
    protocol = PROTOCOLS[context.options.profile]
    turns = protocol.processes * (protocol.rounds + 2) * len(configurations) * len(specs)
    return Plan(steps, turns * TURN_S + protocol.processes * START_S * len(specs))


def _steps(
    spec: AnyDatasetSpec, configurations: Sequence[Configuration], context: RunContext
) -> list[Step]:
    """Return the steps on one dataset."""
    data = _data_step(spec, context)
    done = _cached_labels(spec, configurations, context) if data.done else set()
    size = _problem_size(spec, context)
    left_s = {item.method.name: context.budget.seconds for item in configurations}
    fits = []
    for configuration in configurations:
        method, label = configuration.method.name, configuration.label
        expected = _fit_seconds(configuration, context, size)
        seconds = _within_budget(expected, left_s[method], configuration)
        left_s[method] -= seconds or 0.0
        shared = None if seconds is None else seconds / context.options.jobs
        fits.append(Step(spec.name, label, label in done, shared))
    return [data, *fits, *_extra_steps(spec.name, configurations, fits, context)]


def _within_budget(
    seconds: float | None, left_s: float, configuration: Configuration
) -> float | None:
    """Limit a fit to the seconds that its method has left.

    A training that predicts that it will exceed them stops after `TRIAL_ITERATIONS`.
    """
    if seconds is None or seconds <= left_s:
        return seconds
    iterations = configuration.parameters.get("iterations")
    if iterations is None:
        return left_s
    return float(min(left_s, seconds * TRIAL_ITERATIONS / max(iterations, TRIAL_ITERATIONS)))


def _extra_steps(
    dataset: str,
    configurations: Sequence[Configuration],
    fits: Sequence[Step],
    context: RunContext,
) -> list[Step]:
    """Return the steps of other seeds and, in a full comparison, of learning curves."""
    steps = []
    curves = context.options.profile == "full"
    for method in dict.fromkeys(item.method.name for item in configurations):
        mine = [
            (configuration, step.seconds or 0.0)
            for configuration, step in zip(configurations, fits, strict=True)
            if configuration.method.name == method
        ]
        (first, _), (_, last_s) = mine[0], mine[-1]
        names, seconds = [], 0.0
        if context.seeds > 1 and draws_randomly(first):
            names.append("other seeds")
            seconds += (context.seeds - 1) * sum(item for _, item in mine)
        if curves:
            names.append("learning curve")
            trains = "iterations" in first.parameters
            seconds += LEARNING_POINTS * last_s if trains else last_s / (LEARNING_STEP - 1)
        if names:
            steps.append(Step(dataset, f"{method}: {', '.join(names)}", False, seconds))
    return steps


def _problem_size(spec: AnyDatasetSpec, context: RunContext) -> tuple[int, int]:
    """Return the degrees of freedom and, roughly, the training samples of a dataset."""
    limit = context.options.limit
    if isinstance(spec, DatasetSpec):
        n = n_samples_to_generate(spec, limit)
    else:
        n = len(load_dataset(spec, limit).train)
    held_out = spec.split.test_fraction + spec.split.validation_fraction
    return load_scene(spec).mesh.n_dofs, max(1, round((1 - held_out) * n))


def _data_step(spec: AnyDatasetSpec, context: RunContext) -> Step:
    if not isinstance(spec, DatasetSpec):
        return Step(spec.name, "imported snapshots", True, 0.0)
    n = n_samples_to_generate(spec, context.options.limit)
    folder = dataset_folder(spec, context.cache)
    missing = sum(
        min(SHARD_SIZE, n - start)
        for start in range(0, n, SHARD_SIZE)
        if not shard_path(folder, start // SHARD_SIZE).exists()
    )
    if not missing:
        return Step(spec.name, f"{n:,} samples", True, 0.0)
    workers = context.options.workers or os.cpu_count() or 1
    seconds = missing * _sample_seconds(spec) / workers
    return Step(spec.name, f"{missing:,} of {n:,} samples", False, seconds)


def _sample_seconds(spec: DatasetSpec) -> float:
    """Measure the seconds of one full-order solution among several."""
    scene = load_scene(spec)
    model = FullOrderModel(scene)
    forces = draw_loads(scene, 0, PROBED).nodal_forces(scene.patch_weights)
    free_forces = forces.reshape(PROBED, -1)[:, scene.free_dofs]
    model.solve_many(free_forces[:1])
    start = perf_counter()
    model.solve_many(free_forces)
    return (perf_counter() - start) / PROBED


def _cached_labels(
    spec: AnyDatasetSpec, configurations: Sequence[Configuration], context: RunContext
) -> set[str]:
    """Return the labels of the configurations that the cache has."""
    options = context.options
    data = load_dataset(spec, options.limit, split=options.split, cache=context.cache)
    environment = RunEnvironment(context.cache, jobs=options.jobs, threads=options.threads)
    with TemporaryDirectory(prefix="mor-bench-") as scratch:
        training_data = TrainingData.of(data, Path(scratch))
        return {
            item.label
            for item in configurations
            if CachedFit(item, training_data, environment).record is not None
        }


def _earlier_fits(cache: Path, configuration: Configuration) -> list[FitRecord]:
    """Return records of earlier fits of a method, with the same parameters if there are any."""
    records = []
    for path in (cache / "fits").glob(f"{configuration.method.name}-*/fit.json"):
        with suppress(OSError, StoreError, ValidationError):
            records.append(FitRecord.model_validate(read_json(path)))
    wanted = configuration.parameters.items()
    same = [record for record in records if record.parameters.items() >= wanted]
    return same or records


def _fit_seconds(
    configuration: Configuration, context: RunContext, size: tuple[int, int]
) -> float | None:
    """Scale the time of a fit from earlier fits or the method's file.

    The time of an iteration is assumed not to depend on the number of training samples.
    """
    n_dofs, n_train = size
    iterates = "iterations" in configuration.parameters
    training = configuration.training
    if iterates and training and training.fit_seconds:
        return training.fit_seconds
    times: list[float] = []
    for record in _earlier_fits(context.cache, configuration):
        with suppress(ZeroDivisionError):
            grows = record.needs_snapshots and not iterates
            samples = n_train / record.n_train if grows else 1.0
            times.append(record.fit_s * n_dofs / record.n_dofs * samples)
    if times:
        return median(times)
    shipped = configuration.method.fit_seconds(context.options.profile)
    if shipped is None:
        return None
    samples = 1.0 if iterates else n_train / REFERENCE_TRAINING
    return shipped * n_dofs / REFERENCE_DOFS * samples
