"""What a run would compute, and how long that would take, before anything is computed."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from mor_bench.measure.latency import PROTOCOLS
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.runs.compare import checked_seeds, training_options
from mor_bench.runs.configurations import BUDGETS, checked_specs, jobs_of, may_draw
from mor_bench.runs.dataset_run import LEARNING_STEP, place_of
from mor_bench.runs.fit_cache import Entry, Job, Material
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.generate import (
    SHARD_SIZE,
    dataset_folder,
    default_cache,
    n_samples_to_generate,
    shard_path,
)
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import AnyDatasetSpec, DatasetSpec, SplitBy
from mor_bench.training_options import Device

SEES = 100
"""Iterations after which a training that would take too long is ended, see `mor_bench.learning.training`."""

REFERENCE = ("beam-coarse", 768, 5120)
"""Where the `fit_s` of the method files were measured: dataset, dofs, training samples; on two cores."""

PROBED = 8
"""Samples that are solved to see how long one takes."""

LEARNING_POINTS = 4
"""Of a learning curve, about, beside that of all samples."""

TURN_S = 0.1
START_S = 2.0


@dataclass(frozen=True)
class Step:
    """A dataset to generate or a configuration to fit; seconds are None where nothing is known.

    Attributes
    ----------
    dataset, label : str
    done : bool
        Whether the cache has it.
    seconds : float or None
    """

    dataset: str
    label: str
    done: bool
    seconds: float | None


@dataclass(frozen=True)
class Plan:
    """The steps of a run.

    Attributes
    ----------
    steps : list of Step
    timing_s : float
        Of timing everything.
    """

    steps: list[Step]
    timing_s: float

    @property
    def seconds(self) -> float:
        """Of all steps that are known and not done."""
        return self.timing_s + sum(step.seconds or 0.0 for step in self.steps if not step.done)

    @property
    def n_unknown(self) -> int:
        """Steps of which nothing is known."""
        return sum(step.seconds is None and not step.done for step in self.steps)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "seconds": self.seconds, "n_unknown": self.n_unknown}


def plan(
    datasets: Sequence[str | Path | Mapping[str, Any]] = ("beam-coarse",),
    methods: Sequence[str | Path] | None = None,
    profile: str = "quick",
    *,
    limit: int | None = None,
    split: SplitBy | None = None,
    threads: int = 1,
    workers: int | None = None,
    jobs: int = 1,
    device: Device = "cpu",
    fit_seconds: float | None = None,
    seeds: int | None = None,
    cache: Path | None = None,
    suite: Path | None = None,
) -> Plan:
    """Say what `mor_bench.run` would do with the same arguments; nothing is generated, fitted or written.

    A fit's time follows from earlier fits of the method in the cache, or else from the method's file, both scaled by the
    number of unknowns and of training samples; that of generating data from a few samples that are solved.

    Raises
    ------
    SpecError, InvalidInputError
        As `mor_bench.run`.
    """
    specs, method_specs = checked_specs(datasets, methods, profile, suite)
    root = Path(cache or default_cache())
    budget = BUDGETS[profile]
    allowed = budget.configurations
    training, n_seeds = (
        training_options(device, fit_seconds, budget.seconds),
        checked_seeds(seeds, profile),
    )
    all_jobs = [
        job for method in method_specs for job in jobs_of([method], profile, training)[:allowed]
    ]
    steps: list[Step] = []
    for spec in specs:
        data = _data_step(spec, limit, workers, root)
        steps.append(data)
        done = _fitted(spec, all_jobs, limit, split, threads, jobs, root) if data.done else set()
        n_dofs, n_train = _size(spec, limit)
        left = {job.method.name: budget.seconds for job in all_jobs}
        for job in all_jobs:
            seconds = _within(
                _fit_s(job, profile, n_dofs, n_train, _earlier(root, job)),
                left[job.method.name],
                job.parameters.get("iterations"),
            )
            left[job.method.name] -= seconds or 0.0
            steps.append(
                Step(
                    spec.name,
                    job.label,
                    job.label in done,
                    None if seconds is None else seconds / jobs,
                )
            )
        steps += _extras(
            spec.name, all_jobs, steps[-len(all_jobs) :], n_seeds - 1, profile == "full"
        )
    protocol = PROTOCOLS[profile]
    turns = protocol.processes * (protocol.rounds + 2) * len(all_jobs) * len(specs)
    return Plan(steps, turns * TURN_S + protocol.processes * START_S * len(specs))


def _within(seconds: float | None, left_s: float, iterations: int | None) -> float | None:
    """What a fit takes of the seconds that its method has left; a training that sees that they will not do ends after `SEES` iterations."""
    if seconds is None or seconds <= left_s:
        return seconds
    return left_s if iterations is None else min(left_s, seconds * SEES / max(iterations, SEES))


def _extras(
    dataset: str, jobs: Sequence[Job], fits: Sequence[Step], other_seeds: int, curves: bool
) -> list[Step]:
    """What is fitted beside: other seeds of what draws random numbers, and in a full comparison learning curves."""
    extras = []
    for method in dict.fromkeys(job.method.name for job in jobs):
        mine = [
            (job, step.seconds or 0.0)
            for job, step in zip(jobs, fits, strict=True)
            if job.method.name == method
        ]
        trained, draws = (
            "iterations" in mine[0][0].parameters,
            bool(other_seeds) and may_draw(mine[0][0]),
        )
        seconds = 0.0
        if draws:
            seconds += other_seeds * sum(s for _, s in mine)
        if curves:
            seconds += (
                LEARNING_POINTS * mine[-1][1] if trained else mine[-1][1] / (LEARNING_STEP - 1)
            )
        named = [*(["other seeds"] if draws else []), *(["learning curve"] if curves else [])]
        if named:
            extras.append(Step(dataset, f"{method}: {', '.join(named)}", False, seconds))
    return extras


def _size(spec: AnyDatasetSpec, limit: int | None) -> tuple[int, int]:
    """Dofs and, about, training samples of a dataset."""
    n = (
        n_samples_to_generate(spec, limit)
        if isinstance(spec, DatasetSpec)
        else len(load_dataset(spec, limit).train)
    )
    return load_scene(spec).mesh.n_dofs, max(1, round((1 - spec.split.test_fraction) * n))


def _data_step(spec: AnyDatasetSpec, limit: int | None, workers: int | None, cache: Path) -> Step:
    if not isinstance(spec, DatasetSpec):
        return Step(spec.name, "imported snapshots", True, 0.0)
    n = n_samples_to_generate(spec, limit)
    folder = dataset_folder(spec, cache)
    missing = sum(
        min(SHARD_SIZE, n - start)
        for start in range(0, n, SHARD_SIZE)
        if not shard_path(folder, start // SHARD_SIZE).exists()
    )
    label = f"{missing:,} of {n:,} samples" if missing else f"{n:,} samples"
    return Step(
        spec.name,
        label,
        missing == 0,
        missing * _sample_s(spec) / (workers or os.cpu_count() or 1) if missing else 0.0,
    )


def _sample_s(spec: DatasetSpec) -> float:
    """Seconds of a full-order solve among others."""
    scene = load_scene(spec)
    model = FullOrderModel(scene)
    forces = (
        draw_loads(scene, 0, PROBED)
        .nodal_forces(scene.patch_weights)
        .reshape(PROBED, -1)[:, scene.free_dofs]
    )
    model.solve_many(forces[:1])
    start = perf_counter()
    model.solve_many(forces)
    return (perf_counter() - start) / PROBED


def _fitted(
    spec: AnyDatasetSpec,
    jobs: Sequence[Job],
    limit: int | None,
    split: SplitBy | None,
    threads: int,
    at_once: int,
    cache: Path,
) -> set[str]:
    """Labels that the cache has."""
    data = load_dataset(spec, limit, split=split, cache=cache)
    with TemporaryDirectory(prefix="mor-bench-") as scratch:
        material = Material(data.scene, data.train, {}, Path(scratch))
        place = place_of(cache, [], at_once, threads, float("inf"))
        return {job.label for job in jobs if Entry(job, material, place).fit is not None}


def _earlier(cache: Path, job: Job) -> list[dict[str, Any]]:
    """Records of earlier fits of a method; those of the same knobs, if there are any."""
    records = []
    for path in (cache / "fits").glob(f"{job.method.name}-*/fit.json"):
        with suppress(OSError, ValueError):
            records.append(json.loads(path.read_bytes()))
    same = [
        record
        for record in records
        if record.get("parameters", {}).items() >= job.parameters.items()
    ]
    return same or records


def _fit_s(
    job: Job, profile: str, n_dofs: int, n_train: int, earlier: Sequence[Mapping[str, Any]]
) -> float | None:
    """Scaled from earlier fits or the method's file; iterations cost the same however many samples there are, or what they are given."""
    if job.training and job.training.fit_seconds and "iterations" in job.parameters:
        return job.training.fit_seconds
    times: list[float] = []
    for record in earlier:
        with suppress(KeyError, TypeError, ZeroDivisionError):
            grows = record["needs_snapshots"] and "iterations" not in job.parameters
            times.append(
                record["fit_s"]
                * n_dofs
                / record["n_dofs"]
                * (n_train / record["n_train"] if grows else 1.0)
            )
    if times:
        return median(times)
    shipped = job.method.fit_seconds(profile)
    if shipped is None:
        return None
    return (
        shipped
        * n_dofs
        / REFERENCE[1]
        * (1.0 if "iterations" in job.parameters else n_train / REFERENCE[2])
    )
