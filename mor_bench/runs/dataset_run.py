"""A comparison on one dataset: all configurations fitted, scored and timed, and what a full comparison adds."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.latency_intervals import latency_intervals
from mor_bench.errors import (
    MissingDependencyError,
    MorBenchError,
    SolverError,
    UnsupportedSceneError,
)
from mor_bench.machine import describe_machine
from mor_bench.measure.discretisation_error import measured
from mor_bench.measure.error_metrics import SampleErrors, summary
from mor_bench.measure.indicator_quality import indicator_summary
from mor_bench.measure.latency import (
    PROTOCOLS,
    Queries,
    TimedMethod,
    measure_latencies,
    probe_s,
)
from mor_bench.measure.method_session import CURVES
from mor_bench.measure.range_flags import flags_of
from mor_bench.measure.timing import Timing, check_answers, timing_summary
from mor_bench.reduction.basis import pod
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import LearningPoint, Memory, Row, SeedSpread, SetErrors
from mor_bench.runs.configurations import Budget, sealed_folders
from mor_bench.runs.fit_cache import (
    Entry,
    Job,
    Material,
    Outcome,
    Place,
    RemoteFit,
    TestSet,
    evaluate,
    fit,
    fit_elsewhere,
    score,
)
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.handover import arrays_of
from mor_bench.sandbox.process import MethodFailedError
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.executors import Pool, cluster_pool
from mor_bench.snapshots.fresh import fresh_test_set
from mor_bench.snapshots.generate import generation_seconds
from mor_bench.snapshots.test_sets import available_sets
from mor_bench.specs import (
    AnyDatasetSpec,
    DatasetSpec,
    ImportedDatasetSpec,
    SplitBy,
)
from mor_bench.training_options import TrainingOptions

MOST_QUERIES = 400
"""Loads of the test set from which a timing's queries are drawn."""

SINGULAR_VALUES = 400
"""Of the snapshots that a figure shows, where computing all of them would take minutes."""

SEEDS = {"quick": 1, "full": 3}
"""Trainings of a configuration unless another number is asked for: with the seed of the method's file, and those after it."""

SPREAD = ("mean_dof_m", "rel_l2_median")
"""Errors whose scatter over the seeds of a training is told."""

LEARNING_STEP = 4
LEAST_TRAINING = 20
"""A learning curve goes from all training samples down by this factor, to no fewer than these."""


@dataclass(frozen=True)
class Listener:
    """What a run tells while it goes on; each does nothing by default.

    Attributes
    ----------
    generating : callable
        (dataset, samples done, samples wanted)
    starting : callable
        (dataset, label, number of the configuration, how many there are)
    fitted : callable
        (row), scored but not yet timed
    timing : callable
        (dataset, turns done, turns in all)
    finished : callable
        (row)
    training : callable
        (iterations done, all, loss) of a single fit
    """

    generating: Callable[[str, int, int], None] = lambda *_: None
    starting: Callable[[str, str, int, int], None] = lambda *_: None
    fitted: Callable[[Row], None] = lambda *_: None
    timing: Callable[[str, int, int], None] = lambda *_: None
    finished: Callable[[Row], None] = lambda *_: None
    training: Callable[[int, int, float], None] = lambda *_: None


@dataclass(frozen=True)
class Settings:
    """The arguments of a run that its parts need."""

    profile: str
    limit: int | None
    split: SplitBy | None
    threads: int
    workers: int | None
    jobs: int
    cluster: str | None
    cache: Path
    budget: Budget
    memory_limit_bytes: float
    test_seed: int | str | None
    training: TrainingOptions
    seeds: int
    retime: bool
    fail_fast: bool
    listener: Listener


class StopRunError(Exception):
    """A row failed where the first failure ends a run."""


class DatasetRun:
    """All that a run does on one dataset."""

    def __init__(
        self,
        spec: AnyDatasetSpec,
        jobs: list[Job],
        comparison: Comparison,
        settings: Settings,
        scratch: Path,
        fork_server: ForkServer | None,
        suite: Path | None,
        number: int,
        n: int,
    ) -> None:
        self.spec, self.jobs, self.comparison, self.settings = spec, jobs, comparison, settings
        self.first, self.total = number * len(jobs), n * len(jobs)
        self.folder = scratch / f"{number}"
        self.discretisation = _discretisation(spec, settings.cache, suite)
        self.fork_server = fork_server
        self.spent: dict[str, float] = {}
        self.lock = Lock()

    def go(self) -> None:
        """Fit and score all configurations, time them, and what a full comparison adds."""
        self._lay_out()
        entries = self._fit_all()
        if self.settings.seeds > 1:
            self._other_seeds(entries)
        self._time(entries)
        if self.settings.profile == "full":
            self._learning_curves(entries)
        if self.settings.test_seed is not None:
            seed = self.settings.test_seed
            self._fresh_test(entries, seed if isinstance(seed, int) else secrets.randbelow(2**53))

    def _lay_out(self) -> None:
        settings, spec = self.settings, self.spec
        sets = (
            available_sets(spec)
            if settings.profile == "full" and isinstance(spec, DatasetSpec)
            else []
        )
        progress = partial(settings.listener.generating, spec.name)
        self.data = load_dataset(
            spec,
            settings.limit,
            split=settings.split,
            tests=sets,
            workers=None if settings.cluster else settings.workers,
            cluster=settings.cluster,
            cache=settings.cache,
            progress=progress,
        )
        record_dataset(self.comparison, spec, self.data)
        n = len(self.data.train)
        self.data_seconds = (
            generation_seconds(spec, settings.cache, n) if isinstance(spec, DatasetSpec) else None
        )
        self.folder.mkdir()
        tests = {
            name: TestSet.of(snapshots)
            for name, snapshots in {"test": self.data.test, **self.data.tests}.items()
        }
        self.material = Material(self.data.scene, self.data.train, tests, self.folder)
        sealed = sealed_folders(settings.cache, self.comparison.out)
        if isinstance(spec, ImportedDatasetSpec):
            sealed.append(Path(spec.snapshots.file.path))
        self.place = place_of(
            settings.cache,
            sealed,
            settings.jobs,
            settings.threads,
            settings.memory_limit_bytes,
            self.fork_server,
        )

    def _fit_all(self) -> dict[str, Entry]:
        """Every configuration's row but for its latency; the entries of those that can be timed, by label.

        A method is fitted in all its configurations before the first of them is asked for the test set.
        """
        entries: dict[str, Entry] = {}
        with ExitStack() as stack:
            pool = (
                stack.enter_context(cluster_pool(self.settings.cluster))
                if self.settings.cluster
                else None
            )
            executor = stack.enter_context(
                ThreadPoolExecutor(pool.window() if pool else self.settings.jobs)
            )
            for _, group in groupby(self.jobs, key=lambda job: job.method.name):
                jobs = list(group)
                fitted = list(executor.map(partial(self._fit_one, pool), range(len(jobs)), jobs))
                for entry, _ in fitted:
                    if entry is not None:
                        stack.callback(entry.release)
                for (entry, _), (row, samples) in zip(
                    fitted, executor.map(self._score_one, fitted), strict=True
                ):
                    self.comparison.put(row, samples)
                    self.settings.listener.fitted(row)
                    if entry is not None and row.ok:
                        entries[row.label] = entry
                    elif row.status == "failed" and self.settings.fail_fast:
                        raise StopRunError
        return entries

    def _fit_one(
        self, pool: Pool | None, number: int, job: Job
    ) -> tuple[Entry | None, dict[str, Any]]:
        """Fit a configuration, the number-th of its method: its entry, if it is fitted, and its row so far."""
        budget, method = self.settings.budget, job.method.name
        self.settings.listener.starting(
            self.spec.name, job.label, self.first + self.jobs.index(job) + 1, self.total
        )
        row = self._empty_row(job)
        with self.lock:
            left = budget.seconds - self.spent.get(method, 0.0)
        if number >= budget.configurations:
            return None, {
                **row,
                "status": "skipped",
                "reason": f"beyond the tuning budget of {budget.configurations} configurations",
            }
        if left <= 0:
            return None, {
                **row,
                "status": "skipped",
                "reason": f"beyond the tuning budget of {budget.seconds:g} s of fitting",
            }
        began = monotonic()
        entry = Entry(job, self.material, self.place)
        try:
            spent = fit(entry, left, self._remote(pool, job))["fit_s"]
        except MorBenchError as error:
            spent = monotonic() - began + entry.taken_s  # a fit that failed has cost its time, too
            return None, {**row, **_failure(error), "tuning_s": spent}
        finally:
            with self.lock:
                self.spent[method] = self.spent.get(method, 0.0) + spent
        return entry, {**row, "tuning_s": spent}

    def _score_one(self, fitted: tuple[Entry | None, dict[str, Any]]) -> tuple[Row, dict[str, Any]]:
        """A configuration's row with its errors, and the raw samples."""
        entry, row = fitted
        if entry is None:
            return Row(**row), {}
        try:
            found, samples = self._scored(entry.job, score(entry, self.settings.budget.seconds))
        except MorBenchError as error:
            return Row(**{**row, **_failure(error)}), {}
        return Row(**{**row, **found}), samples

    def _remote(self, pool: Pool | None, job: Job) -> RemoteFit | None:
        """Fitting on the cluster; a third party's class is not installed there."""
        if pool is None or job.method.folder is not None:
            return None

        def fit(entry: Entry, limit_s: float) -> tuple[dict[str, Any], bytes | None]:
            limits = (limit_s, self.place.memory_limit_bytes)
            arrays = arrays_of(self.data.train)
            return pool.executor.submit(
                fit_elsewhere,
                self.data.scene,
                arrays,
                job.method.surrogate,
                job.parameters,
                limits,
                job.training,
            ).result()

        return fit

    def _empty_row(self, job: Job) -> dict[str, Any]:
        data = self.data
        return {
            "dataset": self.spec.name,
            "split": self.settings.split or self.spec.split.by,
            "method": job.method.name,
            "label": job.label,
            "parameters": job.parameters,
            "swept": job.swept,
            "sizes": {},
            "reason": None,
            "n_train": len(data.train),
            "n_test": len(data.test),
            "n_unused": data.n_unused,
            "n_failed": None,
            "n_dofs": data.scene.mesh.n_dofs,
            "threads": self.settings.threads,
            "error": None,
            "latency_ms": None,
            "all_threads_ms": None,
            "throughput": None,
            "offline_s": None,
            "memory_bytes": None,
            "model_bytes": None,
            "cost": None,
            "indicator": None,
            "sets": {},
            "range": None,
            "hidden": None,
            "training": None,
            "seeds": None,
            **self.discretisation,
            "warnings": [],
        }

    def _scored(self, job: Job, outcome: Outcome) -> tuple[dict[str, Any], dict[str, Any]]:
        """What a fit and its scores put into a row, and the raw samples."""
        fit, scores = outcome.fit, dict(outcome.scores)
        flags = flags_of(scores) if fit["needs_snapshots"] else None
        main = scores.pop("test")
        failed = int((~np.isfinite(main["mean_dof_m"])).sum())
        if failed == len(main["mean_dof_m"]):
            raise SolverError(f"no valid prediction on any of {failed} test samples")
        told, unheeded = training_of(fit, job.training, self.settings.training.fit_seconds)
        return {
            "status": "ok",
            "n_failed": failed,
            "error": summary(_errors(main)),
            "offline_s": {
                "data": self.data_seconds if fit["needs_snapshots"] else 0.0,
                "fit": fit["fit_s"],
            },
            "memory_bytes": {"fit": fit["fit_memory_bytes"], "predict": None},
            "model_bytes": fit["model_bytes"],
            "sizes": fit.get("sizes", {}),
            "cost": outcome.cost,
            "indicator": indicator_summary(main),
            "sets": {
                name: {**set_summary(score), **(flags.of(score) if flags else {})}
                for name, score in scores.items()
            },
            "range": flags.as_dict(main) if flags else None,
            "training": told and {key: value for key, value in told.items() if key not in CURVES},
            "warnings": [*fit["warnings"], *([unheeded] if unheeded else [])],
        }, {**main, **{name: np.array(told[name]) for name in CURVES if told}}

    def _other_seeds(self, entries: Mapping[str, Entry]) -> None:
        """Train methods that draw random numbers again, and keep the errors beside those of the first seed.

        A training that fails has an infinite error, as a test sample without a prediction has.
        """
        main = self.material.with_sets({"test": self.material.sets["test"]})
        for label, entry in entries.items():
            seed = (entry.fit or {})["parameters"].get("seed")
            if not isinstance(seed, int):
                continue
            row, errors, first = self._row(label), [], entry.settled
            trainings = [
                {
                    "seed": seed,
                    "fit_s": row.offline_s and row.offline_s.fit,
                    **{name: getattr(row.error, name) for name in SPREAD},
                    "failed": None,
                }
            ]
            for other in range(seed + 1, seed + self.settings.seeds):
                job = replace(first, parameters={**first.parameters, "seed": other})
                try:
                    outcome = evaluate(Entry(job, main, self.place), self.settings.budget.seconds)
                except MorBenchError as error:
                    trainings.append(
                        {
                            "seed": other,
                            "fit_s": None,
                            **dict.fromkeys(SPREAD, float("inf")),
                            "failed": _failure(error)["reason"],
                        }
                    )
                    continue
                found = summary(_errors(outcome.scores["test"]))
                errors.append(outcome.scores["test"]["relative_l2"])
                trainings.append(
                    {
                        "seed": other,
                        "fit_s": outcome.fit["fit_s"],
                        **{name: found[name] for name in SPREAD},
                        "failed": None,
                    }
                )
            seeds = SeedSpread(**seeds_summary(trainings))
            row = row.with_parts(seeds=seeds, warnings=[*row.warnings, *seeds.failed])
            self.comparison.put(row)
            if errors:
                self.comparison.add_samples(row, {"seeds_relative_l2": np.array(errors)})

    def _row(self, label: str) -> Row:
        return self.comparison.row(self.spec.name, label)

    def _time(self, entries: Mapping[str, Entry]) -> None:
        """Time all configurations that have no timing from this machine at this speed, and complete the rows."""
        settings = self.settings
        protocol = PROTOCOLS[settings.profile]
        name = f"timing-{protocol.processes}x{protocol.rounds}-{settings.threads}-{self.material.sets['test'].digest[:12]}"
        speed = probe_s()
        timings: dict[str, Timing] = {}
        for label, entry in entries.items():
            kept = None if settings.retime else entry.arrays(name)
            if kept is not None and (timing := Timing.from_arrays(kept)).holds(speed):
                timings[label] = timing
        openers = {
            label: TimedMethod(
                partial(entry.opened, settings.budget.seconds),
                (entry.fit or {})["fit_memory_bytes"],
            )
            for label, entry in entries.items()
            if label not in timings
        }
        test = self.material.sets["test"]
        chosen = np.linspace(0, len(test.forces) - 1, min(MOST_QUERIES, len(test.forces))).astype(
            int
        )
        queries = Queries(test.forces[chosen], test.references[chosen], test.nodes, self.folder)
        fresh = measure_latencies(
            openers,
            queries,
            protocol,
            settings.threads,
            partial(settings.listener.timing, self.spec.name),
        )
        for label, timing in fresh.items():
            try:
                check_answers(
                    timing, self.comparison.samples(self._row(label))["relative_l2"][chosen]
                )
            except MethodFailedError as error:
                timing.failed = timing.failed or str(error)
            if not timing.failed:
                timing.probe_s = speed
                entries[label].keep_arrays(name, timing.arrays)
        timings |= fresh
        intervals = latency_intervals(
            {label: timing.samples for label, timing in timings.items() if not timing.failed}
        )
        for label in entries:
            row, timing = self._row(label), timings[label]
            if timing.failed:
                row = row.with_parts(status="failed", reason=timing.failed)
            else:
                figures = timing_summary(timing, intervals[label], settings.threads)
                assert row.memory_bytes is not None
                memory = Memory(fit=row.memory_bytes.fit, predict=timing.memory_bytes)
                row = Row(**{**row.as_dict(), **figures, "memory_bytes": memory})
                self.comparison.add_samples(row, timing.samples)
            self.comparison.put(row)
        for label in entries:
            settings.listener.finished(self._row(label))
        if settings.fail_fast and any(timing.failed for timing in timings.values()):
            raise StopRunError

    def _learning_curves(self, entries: Mapping[str, Entry]) -> None:
        """Errors over the number of training samples, of the most accurate configuration of each method that learns."""
        self.comparison.learning = [
            point for point in self.comparison.learning if point.dataset != self.spec.name
        ]
        for method in dict.fromkeys(entry.job.method.name for entry in entries.values()):
            rows = [
                self._row(label)
                for label, entry in entries.items()
                if entry.job.method.name == method and (entry.fit or {})["needs_snapshots"]
            ]
            if not rows:
                continue
            best = min(rows, key=lambda row: row.error.rel_l2_median if row.error else np.inf)
            for n in _learning_sizes(self.material.n_train):
                point = LearningPoint(**self._learnt(entries[best.label], n, best))
                self.comparison.learning.append(point)
                self.comparison.write()

    def _learnt(self, entry: Entry, n: int, row: Row) -> dict[str, Any]:
        record = {
            "dataset": self.spec.name,
            "method": entry.job.method.name,
            "label": entry.job.label,
            "n_train": n,
            "status": "ok",
            "reason": None,
        }
        if n == self.material.n_train:
            return {**record, "fit_s": row.offline_s and row.offline_s.fit, "error": row.error}
        try:
            outcome = evaluate(
                Entry(entry.settled, self.material.first(n), self.place),
                self.settings.budget.seconds,
            )
        except MorBenchError as error:
            return {
                **record,
                "status": "failed",
                "reason": str(error),
                "fit_s": None,
                "error": None,
            }
        return {
            **record,
            "fit_s": outcome.fit["fit_s"],
            "error": summary(_errors(outcome.scores["test"])),
        }

    def _fresh_test(self, entries: Mapping[str, Entry], seed: int) -> None:
        """Score on a test set that did not exist while anything was fitted."""
        assert isinstance(self.spec, DatasetSpec)
        by = self.settings.split or self.spec.split.by
        fresh = fresh_test_set(self.spec, self.data.scene, by, seed, len(self.data.test))
        material = self.material.with_sets({"hidden": TestSet.of(fresh)})
        for label, entry in entries.items():
            row = self._row(label)
            try:
                outcome = evaluate(
                    Entry(entry.job, material, self.place), self.settings.budget.seconds
                )
            except MorBenchError as error:
                # No answer is an infinite error here as everywhere: who fails on what is fresh does not get away with it.
                warning = f"no score on the fresh test set: {error}"
                lost = dict.fromkeys(
                    ("mean_dof_m", "rel_l2_median", "rel_l2_p95", "rel_l2_max"), float("inf")
                )
                failed = SetErrors(
                    seed=seed, n=len(fresh), n_failed=len(fresh), n_flagged=None, **lost
                )
                self.comparison.put(
                    row.with_parts(hidden=failed, warnings=[*row.warnings, warning])
                )
                continue
            found = SetErrors(seed=seed, **set_summary(outcome.scores["hidden"]))
            self.comparison.put(row.with_parts(hidden=found))
            self.comparison.add_samples(
                row, {"hidden_relative_l2": outcome.scores["hidden"]["relative_l2"]}
            )


def place_of(
    cache: Path,
    sealed: Sequence[Path],
    jobs: int,
    threads: int,
    memory_limit_bytes: float,
    fork_server: ForkServer | None = None,
) -> Place:
    """Where methods run, and what they must not open."""
    machine = describe_machine()
    cores = machine["cores"]
    return Place(
        cache,
        tuple(sealed),
        f"{machine['processor']} x {cores}",
        max(1, cores // jobs),
        threads,
        memory_limit_bytes,
        fork_server,
    )


def _failure(error: MorBenchError) -> dict[str, str]:
    """The part of a row that says why there is no more of it."""
    if isinstance(error, MissingDependencyError | UnsupportedSceneError):
        return {"status": "skipped", "reason": str(error)}
    if isinstance(error, MethodFailedError):
        return {"status": "failed", "reason": str(error)}
    return {"status": "failed", "reason": f"{type(error).__name__}: {error}"}


def training_of(
    fit: Mapping[str, Any], options: TrainingOptions | None, asked_s: float | None
) -> tuple[dict[str, Any] | None, str | None]:
    """What a fit told of its training, with the curves; and a warning where the seconds that were asked for were not heeded."""
    knob, told, options = (
        fit["parameters"].get("iterations"),
        fit.get("training"),
        options or TrainingOptions(),
    )
    unheeded = None
    if asked_s is not None and knob is not None and (told or {}).get("iterations") is None:
        unheeded = (
            f"it does not size its training to seconds: its knob `iterations`, {knob:,}, counts"
        )
    if not told:
        return None, unheeded
    curves = {name: told[name] for name in CURVES}
    iterations = knob if told["iterations"] is None else told["iterations"]
    ends = {
        name: curve[-1] if curve else None
        for name, curve in zip(("loss", "validation_loss"), curves.values(), strict=True)
    }
    return {
        "device": options.device,
        "fit_seconds": options.fit_seconds,
        "iterations": iterations,
        **ends,
        **curves,
    }, unheeded


def seeds_summary(trainings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How the errors of a configuration scatter over the seeds of its training; a training that failed counts with an infinite error."""
    spread: dict[str, Any] = {}
    for name in SPREAD:
        values = np.array([training[name] for training in trainings])
        deviation = (
            float(values.std(ddof=1))
            if len(values) > 1 and np.isfinite(values).all()
            else float("inf")
        )
        spread[name] = {
            "median": float(np.median(values)),
            "min": float(values.min()),
            "max": float(values.max()),
            "std": deviation,
        }
    failed = [
        f"seed {training['seed']}: {training['failed']}"
        for training in trainings
        if training["failed"]
    ]
    return {
        "n": len(trainings) - len(failed),
        "asked": len(trainings),
        "failed": failed,
        **spread,
        "trainings": list(trainings),
    }


def _errors(score: Mapping[str, Any]) -> SampleErrors:
    return SampleErrors(
        *(score[name] for name in ("mean_dof_m", "relative_l2", "max_nodal_m", "amplitude_m"))
    )


def set_summary(score: Mapping[str, Any]) -> dict[str, Any]:
    """What a row says of a named test set."""
    figures = summary(_errors(score))
    kept = {
        name: figures[name] for name in ("mean_dof_m", "rel_l2_median", "rel_l2_p95", "rel_l2_max")
    }
    failed = int((~np.isfinite(score["mean_dof_m"])).sum())
    return {
        "n": len(score["mean_dof_m"]),
        "n_failed": failed,
        "n_flagged": int(score["flagged"].sum()) if "flagged" in score else None,
        **kept,
    }


def _learning_sizes(n_train: int) -> list[int]:
    """All training samples, and fewer and fewer of the first."""
    sizes = [n_train]
    while sizes[-1] // LEARNING_STEP >= LEAST_TRAINING:
        sizes.append(sizes[-1] // LEARNING_STEP)
    return sizes[::-1]


def _discretisation(
    spec: AnyDatasetSpec, cache: Path | None, suite: Path | None
) -> dict[str, float | None]:
    """The part of every row that says how far the dataset's mesh is from the body; None where it was not measured."""
    record = (measured(spec, cache, suite) if isinstance(spec, DatasetSpec) else None) or {}
    return {
        "discretisation_error_m": record.get("error_m"),
        "discretisation_rel_l2": record.get("relative_l2_median"),
    }


def _singular_values(displacements: NDArray[np.float64]) -> NDArray[np.float64]:
    """All of them, or the first of a large matrix."""
    n = min(displacements.shape)
    return pod(displacements, None if n <= SINGULAR_VALUES * 5 else SINGULAR_VALUES).singular_values


def record_dataset(comparison: Comparison, spec: AnyDatasetSpec, data: Dataset) -> None:
    """Record what every figure of a dataset needs."""
    arrays = {
        "singular_values": _singular_values(data.train.free_displacements),
        "points": data.scene.mesh.points,
        "cells": data.scene.mesh.cells,
        "test_regions": data.test.loads.patches,
    }
    comparison.add_dataset(spec.name, spec.model_dump(mode="json"), arrays)
