"""The dry run: what a run would compute, and how long that would take."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mor_bench.options import RunOptions
from mor_bench.runs.cached_fit import CachedFit, RunEnvironment
from mor_bench.runs.configurations import (
    Configuration,
    checked_specs,
    configurations_of,
    draws_randomly,
    missing_library,
)
from mor_bench.runs.durations import (
    REPORT_S,
    Pace,
    compile_seconds,
    fit_seconds,
    query_seconds,
    sample_seconds,
    scoring_seconds,
    timing_seconds,
)
from mor_bench.runs.extra_stages import LEARNING_STEP
from mor_bench.runs.run_context import RunContext
from mor_bench.runs.shipped_models import find_shipped
from mor_bench.runs.training_data import TrainingData
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.generate import (
    SHARD_SIZE,
    dataset_folder,
    n_samples_to_generate,
    shard_path,
)
from mor_bench.specs import AnyDatasetSpec, DatasetSpec

TRIAL_ITERATIONS = 100
"""Iterations after which a training that would take too long stops itself."""

LEARNING_POINTS = 4
"""Typical number of points of a learning curve, beside that of all samples."""


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
    """The steps of a run, and the seconds of the stages that treat all steps.

    Attributes
    ----------
    steps : list of Step
    compilation_s : float
        To compile kernels, once per machine.
    scoring_s, timing_s : float
        To score and to time all configurations.
    report_s : float
        To start, and to write tables, figures and report.
    """

    steps: list[Step]
    compilation_s: float
    scoring_s: float
    timing_s: float
    report_s: float

    @property
    def seconds(self) -> float:
        """Seconds of everything that is known and not done."""
        stages = self.compilation_s + self.scoring_s + self.timing_s + self.report_s
        return stages + sum(step.seconds or 0.0 for step in self.steps if not step.done)

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
    method's file, scaled by this machine's speed. Both are scaled by the numbers of unknowns and of
    training samples. The time of generating data follows from a few samples that are solved here.

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
    usable = [item for item in configurations if missing_library(item.method) is None]
    pace = Pace.measured()
    steps: list[Step] = []
    compilation_s = scoring_s = timing_s = 0.0
    for spec in specs:
        own = _steps(spec, configurations, context, pace)
        n_dofs, n_train = _problem_size(spec, context)
        query_s = query_seconds(n_dofs, pace)
        held = spec.split.test_fraction + spec.split.validation_fraction
        n_scored = round(n_train * held / (1 - held))
        undone = [
            item
            for item, step in zip(configurations, own[1:], strict=False)
            if not step.done and item in usable
        ]
        compilation_s += compile_seconds(spec, usable, pace)
        scoring_s += sum(scoring_seconds(item, n_scored, query_s, pace) for item in undone)
        timing_s += timing_seconds(usable, context, query_s, pace)
        steps += own
    report_s = REPORT_S * pace.interpreter * len(specs)
    return Plan(steps, compilation_s, scoring_s, timing_s, report_s)


def _steps(
    spec: AnyDatasetSpec,
    configurations: Sequence[Configuration],
    context: RunContext,
    pace: Pace,
) -> list[Step]:
    """Return the steps on one dataset: data, configurations, and extra stages."""
    data = _data_step(spec, context)
    done = _cached_labels(spec, configurations, context) if data.done else set()
    size = _problem_size(spec, context)
    left_s = {item.method.name: context.budget.seconds for item in configurations}
    fits = []
    for configuration in configurations:
        method, label = configuration.method.name, configuration.label
        if missing := missing_library(configuration.method):
            fits.append(Step(spec.name, f"{label} (left out: {missing})", False, 0.0))
            continue
        if _is_shipped(configuration, spec, context):
            fits.append(Step(spec.name, f"{label} (trained elsewhere)", False, 0.0))
            continue
        expected = fit_seconds(configuration, context, size, pace)
        seconds = _within_budget(expected, left_s[method], configuration)
        left_s[method] -= seconds or 0.0
        shared = None if seconds is None else seconds / context.options.jobs
        fits.append(Step(spec.name, label, label in done, shared))
    return [data, *fits, *_extra_steps(spec.name, configurations, fits, context)]


def _is_shipped(configuration: Configuration, spec: AnyDatasetSpec, context: RunContext) -> bool:
    if configuration.training is None or not context.uses_shipped_weights:
        return False
    return find_shipped(configuration, spec, context.options.split) is not None


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
    seconds = missing * sample_seconds(spec) / workers
    return Step(spec.name, f"{missing:,} of {n:,} samples", False, seconds)


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
