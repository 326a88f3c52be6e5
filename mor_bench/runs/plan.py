"""The dry run: what a run would compute, and how long that would take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from mor_bench.errors import StoreError
from mor_bench.machine import usable_cores
from mor_bench.options import RunOptions
from mor_bench.runs.cached_fit import CachedFit, RunEnvironment
from mor_bench.runs.configurations import (
    Configuration,
    checked_specs,
    configurations_of,
    draws_randomly,
)
from mor_bench.runs.durations import (
    REPORT_S,
    Pace,
    compile_seconds,
    fit_seconds,
    needs_torch,
    query_seconds,
    sample_seconds,
    scoring_seconds,
    timing_seconds,
)
from mor_bench.runs.extra_stages import LEARNING_STEP
from mor_bench.runs.run_context import RunContext
from mor_bench.runs.shipped_models import check_weights, find_shipped
from mor_bench.runs.training_data import TrainingData
from mor_bench.scene.scene import load_scene
from mor_bench.scratch import scratch_folder
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


StageName = Literal[
    "samples", "compilation", "fit", "scores", "other seeds", "timing", "learning curve", "report"
]


@dataclass(frozen=True)
class Step:
    """A dataset to generate, a configuration to fit, or a stage that treats all configurations.

    Attributes
    ----------
    dataset, label : str
    done : bool
        Whether the cache has it.
    seconds : float or None
        None if unknown.
    stage : str
    method : str
        Empty if the step belongs to no method.
    """

    dataset: str
    label: str
    done: bool
    seconds: float | None
    stage: StageName = "fit"
    method: str = ""


@dataclass(frozen=True)
class Plan:
    """The steps of a run, and the stages that treat all steps.

    Attributes
    ----------
    steps : list of Step
        Samples, fits, and further fits of learning curves and other seeds.
    stages : list of Step
        Per dataset: compilation (once per machine), scores of each method, timing, and the report.
    """

    steps: list[Step]
    stages: list[Step]

    def stage_seconds(self, stage: StageName) -> float:
        """Return the seconds of a stage on all datasets."""
        return sum(step.seconds or 0.0 for step in self.stages if step.stage == stage)

    @property
    def seconds(self) -> float:
        """Seconds of everything that is known and not done."""
        steps = (*self.steps, *self.stages)
        return sum(step.seconds or 0.0 for step in steps if not step.done)

    @property
    def n_unknown(self) -> int:
        """Number of steps of unknown length."""
        return sum(step.seconds is None and not step.done for step in self.steps)

    def as_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {
            "steps": [asdict(step) for step in self.steps],
            "compilation_s": self.stage_seconds("compilation"),
            "scoring_s": self.stage_seconds("scores"),
            "timing_s": self.stage_seconds("timing"),
            "report_s": self.stage_seconds("report"),
            "seconds": self.seconds,
            "n_unknown": self.n_unknown,
        }


def plan(
    datasets: Sequence[str | Path | Mapping[str, Any]] = ("beam-coarse",),
    methods: Sequence[str | Path] | None = None,
    profile: str = "quick",
    **options: Any,
) -> Plan:
    """Plan the steps of `mor_bench.run` for the same arguments, without taking them.

    The time of a fit follows from earlier fits of the method in the cache. Without any, it is that
    of the method's file, scaled by this machine's speed. Both are scaled by the numbers of unknowns
    and of training samples. The time of generating data follows from a few samples that are solved
    here.

    Raises
    ------
    SpecError, InvalidInputError
        As `mor_bench.run`.
    """
    context = RunContext.of(RunOptions(profile=profile, **options))
    specs, methods_found, unusable = checked_specs(datasets, methods, context.options)
    configurations = [
        configuration
        for method in methods_found
        for configuration in configurations_of([method], profile, context.training)[
            : context.budget.configurations
        ]
    ]
    usable = [item for item in configurations if item.method.name not in unusable]
    pace = Pace.measured(any(map(needs_torch, usable)))
    steps: list[Step] = []
    stages: list[Step] = []
    for spec in specs:
        own = _steps(spec, configurations, unusable, context, pace)
        steps += own
        undone = [
            item
            for item, step in zip(configurations, own[1:], strict=False)
            if not step.done and item in usable
        ]
        stages += _stages(spec, usable, undone, context, pace)
    return Plan(steps, stages)


def _stages(
    spec: AnyDatasetSpec,
    configurations: Sequence[Configuration],
    undone: Sequence[Configuration],
    context: RunContext,
    pace: Pace,
) -> list[Step]:
    """Return the stages on one dataset that treat all its steps; scores are listed by method."""
    n_dofs, n_train = _problem_size(spec, context)
    query_s = query_seconds(n_dofs, pace)
    held = spec.split.test_fraction + spec.split.validation_fraction
    n_scored = round(n_train * held / (1 - held))
    scores = dict.fromkeys((item.method.name for item in undone), 0.0)
    for item in undone:
        scores[item.method.name] += scoring_seconds(item, n_scored, query_s, pace)
    name = spec.name
    compiled = compile_seconds(spec, configurations, pace)
    timed = timing_seconds(configurations, context, query_s, pace)
    return [
        Step(name, "compilation", False, compiled, "compilation"),
        *(Step(name, f"{m}: scores", False, s, "scores", m) for m, s in scores.items()),
        Step(name, "timing", False, timed, "timing"),
        Step(name, "report", False, REPORT_S * pace.interpreter, "report"),
    ]


def _steps(
    spec: AnyDatasetSpec,
    configurations: Sequence[Configuration],
    unusable: Mapping[str, str],
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
        if reason := unusable.get(method):
            title = f"{label} (left out: {reason})"
            fits.append(Step(spec.name, title, False, 0.0, method=method))
            continue
        if _is_shipped(configuration, spec, context):
            title = f"{label} (trained elsewhere)"
            fits.append(Step(spec.name, title, False, 0.0, method=method))
            continue
        expected = fit_seconds(configuration, context, size, pace)
        seconds = _within_budget(expected, left_s[method], configuration)
        left_s[method] -= seconds or 0.0
        shared = None if seconds is None else seconds / context.options.jobs
        fits.append(Step(spec.name, label, label in done, shared, method=method))
    return [data, *fits, *_extra_steps(spec.name, configurations, fits, context)]


def _is_shipped(configuration: Configuration, spec: AnyDatasetSpec, context: RunContext) -> bool:
    if configuration.training is None or not context.uses_shipped_weights:
        return False
    try:
        found = find_shipped(configuration, spec, context.options.split)
        if found is not None:
            check_weights(*found)
    except StoreError:
        return False
    return found is not None


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
        extra: dict[StageName, float] = {}
        if context.seeds > 1 and draws_randomly(first):
            extra["other seeds"] = (context.seeds - 1) * sum(item for _, item in mine)
        if curves:
            trains = "iterations" in first.parameters
            extra["learning curve"] = (
                LEARNING_POINTS * last_s if trains else last_s / (LEARNING_STEP - 1)
            )
        for stage, seconds in extra.items():
            steps.append(Step(dataset, f"{method}: {stage}", False, seconds, stage, method))
    return steps


def _problem_size(spec: AnyDatasetSpec, context: RunContext) -> tuple[int, int]:
    """Return the degrees of freedom and, roughly, the training samples of a dataset."""
    n_dofs, options = load_scene(spec).mesh.n_dofs, context.options
    if not isinstance(spec, DatasetSpec):
        return n_dofs, len(load_dataset(spec, options.limit, split=options.split).train)
    held_out = spec.split.test_fraction + spec.split.validation_fraction
    n = n_samples_to_generate(spec, options.limit)
    return n_dofs, max(1, round((1 - held_out) * n))


def _data_step(spec: AnyDatasetSpec, context: RunContext) -> Step:
    if not isinstance(spec, DatasetSpec):
        return Step(spec.name, "imported snapshots", True, 0.0, "samples")
    n = n_samples_to_generate(spec, context.options.limit)
    folder = dataset_folder(spec, context.cache)
    missing = sum(
        min(SHARD_SIZE, n - start)
        for start in range(0, n, SHARD_SIZE)
        if not shard_path(folder, start // SHARD_SIZE).exists()
    )
    if not missing:
        return Step(spec.name, f"{n:,} samples", True, 0.0, "samples")
    workers = context.options.workers or usable_cores()
    seconds = missing * sample_seconds(spec) / workers
    return Step(spec.name, f"{missing:,} of {n:,} samples", False, seconds, "samples")


def _cached_labels(
    spec: AnyDatasetSpec, configurations: Sequence[Configuration], context: RunContext
) -> set[str]:
    """Return the labels of the configurations that the cache has."""
    options = context.options
    data = load_dataset(spec, options.limit, split=options.split, cache=context.cache)
    environment = RunEnvironment(context.cache, jobs=options.jobs, threads=options.threads)
    with scratch_folder() as scratch:
        training_data = TrainingData.of(data, scratch)
        return {
            item.label
            for item in configurations
            if CachedFit(item, training_data, environment).record is not None
        }
