"""A run on one dataset: fit and score all configurations, time them, then the extra stages."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import MorBenchError, SolverError
from mor_bench.measure.discretisation_error import measured
from mor_bench.measure.error_bounds import calibrated, covered
from mor_bench.measure.indicator_quality import indicator_summary
from mor_bench.measure.mesh_limit import known_error
from mor_bench.measure.range_flags import flags_of
from mor_bench.reduction.basis import pod
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import IndicatorQuality, Memory
from mor_bench.results.row import (
    BoundQuality,
    Offline,
    RangeFlags,
    Row,
)
from mor_bench.runs.cached_fit import CachedFit, RunEnvironment
from mor_bench.runs.configurations import Configuration, sealed_folders
from mor_bench.runs.extra_stages import (
    Stage,
    draw_learning_curves,
    score_fresh_test_set,
    train_other_seeds,
)
from mor_bench.runs.fitting import ClusterFit, RemoteFit, fit_configuration, fit_on_cluster
from mor_bench.runs.row_figures import (
    error_summary,
    failed_row,
    ignored_seconds,
    loss_curves,
    n_failed,
    scaled_bound,
    set_errors,
    training_record,
)
from mor_bench.runs.run_context import RunContext
from mor_bench.runs.scoring import Score, ScoredFit, score_fit
from mor_bench.runs.shipped_models import adopt, find_shipped
from mor_bench.runs.timing_stage import StopRunError, time_configurations
from mor_bench.runs.training_data import TrainingData
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.handover import arrays_of
from mor_bench.sandbox.process import stoppable_threads
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.executors import Pool, cluster_pool
from mor_bench.snapshots.generate import generation_seconds
from mor_bench.snapshots.test_sets import available_sets
from mor_bench.specs import AnyDatasetSpec, DatasetSpec, ImportedDatasetSpec

SINGULAR_VALUES = 400
"""Limit on the singular values in a figure; computing all of a large matrix takes minutes."""


@dataclass(frozen=True)
class RunPart:
    """One dataset's part of a run.

    Attributes
    ----------
    number, n : int
        Number of this dataset, and number of datasets.
    folder : Path
        Folder for temporary files; the run creates it.
    fork_server : ForkServer or None
        Process from which worker processes are forked.
    """

    number: int
    n: int
    folder: Path
    fork_server: ForkServer | None


@dataclass(frozen=True)
class _Attempt:
    """A configuration's row so far; the fit is None if it failed or was skipped."""

    row: Row
    cached: CachedFit | None = None


class DatasetRun:
    """Everything that a run does on one dataset."""

    def __init__(
        self,
        spec: AnyDatasetSpec,
        configurations: list[Configuration],
        comparison: Comparison,
        context: RunContext,
        part: RunPart,
    ) -> None:
        self.spec, self.configurations = spec, configurations
        self.comparison, self.context, self.part = comparison, context, part
        self.data = self._load()
        record_dataset(comparison, spec, self.data)
        part.folder.mkdir()
        self.training_data = TrainingData.of(self.data, part.folder)
        self.environment = self._environment()
        self.data_s = self._data_seconds()
        self.discretisation = _discretisation(spec, context)
        self._spent: dict[str, float] = {}
        self._lock = Lock()

    def run(self) -> None:
        """Fit, score and time all configurations, then run the extra stages.

        Raises
        ------
        StopRunError
            If a row failed and the run shall stop at the first failure.
        """
        context = self.context
        fits = self._fit_and_score_all()
        stage = Stage(
            self.spec, self.data, self.training_data, self.environment, self.comparison, context
        )
        if context.seeds > 1:
            train_other_seeds(stage, fits)
        time_configurations(stage, fits)
        if context.options.profile == "full":
            draw_learning_curves(stage, fits)
        test_seed = context.options.test_seed
        if test_seed is not None:
            seed = test_seed if isinstance(test_seed, int) else secrets.randbelow(2**53)
            score_fresh_test_set(stage, fits, seed)

    def _load(self) -> Dataset:
        options, spec = self.context.options, self.spec
        full = options.profile == "full"
        return load_dataset(
            spec,
            options.limit,
            split=options.split,
            tests=available_sets(spec) if full and isinstance(spec, DatasetSpec) else [],
            workers=None if options.cluster else options.workers,
            cluster=options.cluster,
            cache=self.context.cache,
            progress=partial(self.context.listener.generating, spec.name),
        )

    def _data_seconds(self) -> float | None:
        """Return the core-seconds of the training and validation samples; None if unknown."""
        if not isinstance(self.spec, DatasetSpec):
            return None
        n = len(self.data.train) + len(self.data.validation)
        return generation_seconds(self.spec, self.context.cache, n)

    def _environment(self) -> RunEnvironment:
        context = self.context
        sealed = sealed_folders(context.cache, self.comparison.out)
        if isinstance(self.spec, ImportedDatasetSpec):
            sealed.append(Path(self.spec.snapshots.file.path))
        return RunEnvironment(
            context.cache,
            tuple(sealed),
            context.options.jobs,
            context.options.threads,
            context.memory_limit_bytes,
            self.part.fork_server,
        )

    def _fit_and_score_all(self) -> dict[str, CachedFit]:
        """Write every row without its latency; return the fits that can be timed, by label.

        All configurations of a method are fitted before any of them gets the test set.
        """
        fits: dict[str, CachedFit] = {}
        cluster = self.context.options.cluster
        with ExitStack() as stack:
            pool = stack.enter_context(cluster_pool(cluster)) if cluster else None
            n_threads = pool.window() if pool else self.context.options.jobs
            executor = stack.enter_context(stoppable_threads(n_threads))
            for _, group in groupby(self.configurations, key=lambda item: item.method.name):
                mine = list(group)
                attempts = list(executor.in_order(partial(self._fit, pool), range(len(mine)), mine))
                for attempt in attempts:
                    if attempt.cached is not None:
                        stack.callback(attempt.cached.release)
                scored = executor.in_order(self._score, attempts)
                for attempt, (row, samples) in zip(attempts, scored, strict=True):
                    self.comparison.put(row, samples)
                    self.context.listener.fitted(row)
                    if attempt.cached is not None and row.ok:
                        fits[row.label] = attempt.cached
                    elif row.status == "failed" and self.context.options.fail_fast:
                        raise StopRunError
        return fits

    def _fit(self, pool: Pool | None, number: int, configuration: Configuration) -> _Attempt:
        """Fit configuration ``number`` of its method within the tuning budget."""
        budget, method = self.context.budget, configuration.method.name
        self._announce(configuration)
        row = self._new_row(configuration)
        with self._lock:
            left = budget.seconds - self._spent.get(method, 0.0)
        if number >= budget.configurations or left <= 0:
            limit = (
                f"{budget.configurations} configurations"
                if number >= budget.configurations
                else f"{budget.seconds:g} s of fitting"
            )
            reason = f"beyond the tuning budget of {limit}"
            return _Attempt(row.with_parts(status="skipped", reason=reason))
        began, spent = monotonic(), 0.0
        cached, warnings = self._cached_fit(configuration)
        row = row.with_parts(parameters=cached.configuration.parameters, warnings=warnings)
        try:
            spent = fit_configuration(cached, left, self._remote(pool, configuration)).fit_s
            attempt = _Attempt(row.with_parts(tuning_s=spent), cached)
        except MorBenchError as error:
            spent = monotonic() - began + cached.taken_s  # a failed fit uses the budget, too
            attempt = _Attempt(failed_row(row, error).with_parts(tuning_s=spent))
        with self._lock:
            self._spent[method] = self._spent.get(method, 0.0) + spent
        return attempt

    def _cached_fit(self, configuration: Configuration) -> tuple[CachedFit, list[str]]:
        """Return a configuration's fit, with shipped weights if there are any; and warnings."""
        own = CachedFit(configuration, self.training_data, self.environment)
        if configuration.training is None or not self.context.uses_shipped_weights:
            return own, []
        try:
            found = find_shipped(configuration, self.spec, self.context.options.split)
            if found is None or not found[1].agrees_with(self.training_data):
                return own, []
            return adopt(*found, configuration, self.training_data, self.environment), []
        except MorBenchError as error:
            return own, [f"trained here, because the suite's weights cannot be used: {error}"]

    def _announce(self, configuration: Configuration) -> None:
        n = len(self.configurations)
        number = self.part.number * n + self.configurations.index(configuration) + 1
        label = configuration.label
        self.context.listener.starting(self.spec.name, label, number, self.part.n * n)

    def _remote(self, pool: Pool | None, configuration: Configuration) -> RemoteFit | None:
        """Return a fit on the cluster; None without a cluster or for a third party's class."""
        if pool is None or configuration.method.folder is not None:
            return None

        def remote(cached: CachedFit, limit_s: float) -> tuple[dict[str, Any], bytes | None]:
            memory = self.environment.memory_limit_bytes
            samples = arrays_of(self.data.train), arrays_of(self.data.validation)
            task = ClusterFit(self.data.scene, *samples, configuration, limit_s, memory)
            return pool.executor.submit(fit_on_cluster, task).result()

        return remote

    def _score(self, attempt: _Attempt) -> tuple[Row, Mapping[str, NDArray[Any]]]:
        """Return a configuration's row with its errors, and the raw samples."""
        if attempt.cached is None:
            return attempt.row, {}
        try:
            scored = score_fit(attempt.cached, self.context.budget.seconds)
            return self._scored_row(attempt.row, attempt.cached.configuration, scored)
        except MorBenchError as error:
            return failed_row(attempt.row, error), {}

    def _new_row(self, configuration: Configuration) -> Row:
        data = self.data
        return Row(
            dataset=self.spec.name,
            split=self.context.options.split or self.spec.split.by,
            method=configuration.method.name,
            label=configuration.label,
            parameters=configuration.parameters,
            swept=configuration.swept,
            told=configuration.method.told_with(configuration.parameters),
            reference=configuration.method.reference,
            status="ok",
            n_train=len(data.train),
            n_validation=len(data.validation),
            n_test=len(data.test),
            n_unused=data.n_unused,
            n_dofs=data.scene.mesh.n_dofs,
            threads=self.environment.threads,
            **self.discretisation,
        )

    def _scored_row(
        self, row: Row, configuration: Configuration, scored: ScoredFit
    ) -> tuple[Row, Score]:
        """Add a fit's figures and scores to a row; return the raw samples as well."""
        record, others = scored.record, dict(scored.scores)
        flags = flags_of(scored.scores) if record.needs_snapshots else None
        main, held = others.pop("test"), others.pop("validation", None)
        failed = n_failed(main)
        if failed == len(main["mean_dof_m"]):
            raise SolverError(f"no valid prediction on any of {failed} test samples")
        indicator = indicator_summary(main)
        asked_s = self.context.options.fit_seconds
        row = row.with_parts(
            snapshots=record.needs_snapshots,
            n_failed=failed,
            error=error_summary(main),
            validation=None if held is None else error_summary(held),
            offline_s=Offline(
                data=self.data_s if record.needs_snapshots else 0.0,
                fit=record.fit_s,
                fit_core_s=record.fit_core_s,
            ),
            memory_bytes=Memory(fit=record.fit_memory_bytes, predict=None),
            model_bytes=record.model_bytes,
            sizes=record.sizes,
            cost=scored.cost,
            indicator=None if indicator is None else IndicatorQuality(**indicator),
            sets={name: set_errors(score, flags) for name, score in others.items()},
            range=RangeFlags.model_validate(flags.as_dict(main)) if flags else None,
            bound=self._bound(held, {"test": main, **others}),
            training=training_record(record, configuration.training),
            trained_elsewhere=record.trained_elsewhere,
            warnings=[*row.warnings, *record.warnings, *ignored_seconds(record, asked_s)],
        )
        return row, {**main, **_validation_samples(held), **loss_curves(record)}

    def _bound(self, held: Score | None, tests: Mapping[str, Score]) -> BoundQuality | None:
        """Return the bound of the error that the validation samples give, and its coverage."""
        if held is None:
            return None
        by = self.context.options.split or self.spec.split.by
        regions = self.data.validation.regions if by == "region" else None
        bound = calibrated(held["relative_l2"], regions, spreads=held.get("spread"))
        return BoundQuality(
            level=bound.level,
            relative_l2=bound.relative_l2,
            n=bound.n_samples,
            n_groups=bound.n_groups,
            coverage=covered(bound, tests),
            scaled=scaled_bound(bound, tests),
        )


def _validation_samples(score: Score | None) -> Score:
    """Return the raw samples that a row keeps of its validation errors."""
    return {} if score is None else {"validation_relative_l2": score["relative_l2"]}


def _discretisation(spec: AnyDatasetSpec, context: RunContext) -> dict[str, float | None]:
    """Return the recorded error of the dataset's mesh; None where it was not measured."""
    record = None
    if isinstance(spec, DatasetSpec):
        record = measured(spec, context.cache, context.options.suite)
    error_m, relative, at_least = known_error(record)
    return {
        "discretisation_error_m": error_m,
        "discretisation_rel_l2": relative,
        "discretisation_at_least": at_least,
    }


def record_dataset(comparison: Comparison, spec: AnyDatasetSpec, data: Dataset) -> None:
    """Record the arrays of a dataset that figures need."""
    displacements = data.train.free_displacements
    few = min(displacements.shape) <= SINGULAR_VALUES * 5
    arrays: dict[str, NDArray[Any]] = {
        "snapshots_norm": np.asarray(np.linalg.norm(displacements)),
        "singular_values": pod(displacements, None if few else SINGULAR_VALUES).singular_values,
        "points": data.scene.mesh.points,
        "cells": data.scene.mesh.cells,
        "test_regions": data.test.loads.patches,
        "validation_regions": data.validation.loads.patches,
        "n_refused": np.asarray(data.n_refused),
    }
    if data.scene.observed_nodes is None:
        arrays["test_force_n"] = np.linalg.norm(data.test.forces.sum(axis=1), axis=-1)
    if isinstance(spec, DatasetSpec):
        arrays["patch_centres"] = data.scene.patch_centres
    comparison.add_dataset(spec.name, spec.model_dump(mode="json"), arrays)
