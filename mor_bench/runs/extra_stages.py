"""Stages after the main scores: other seeds, learning curves and a fresh test set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mor_bench.analysis.analyse import N_RESAMPLES
from mor_bench.analysis.draws import draws_of
from mor_bench.analysis.seeds import seed_interval
from mor_bench.errors import MorBenchError
from mor_bench.results.comparison import Comparison
from mor_bench.results.parts import ErrorSummary, SeedSpread, SeedTraining, Spread
from mor_bench.results.row import LearningPoint, Row
from mor_bench.runs.cached_fit import CachedFit, RunEnvironment
from mor_bench.runs.row_figures import error_summary, failed_set, failure, set_errors
from mor_bench.runs.run_context import RunContext
from mor_bench.runs.scoring import Score, ScoredFit, fit_and_score
from mor_bench.runs.training_data import TestSet, TrainingData
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.fresh import fresh_test_set
from mor_bench.specs import AnyDatasetSpec, DatasetSpec

LEARNING_STEP = 4
"""Factor between the numbers of training samples of a learning curve."""

LEAST_TRAINING = 20
"""Fewest training samples of a learning curve."""


SEED_SAMPLES = {"test": "seeds_relative_l2", "validation": "seeds_validation_relative_l2"}
"""Names of the raw samples of other seeds, by set of samples."""


@dataclass(frozen=True)
class Stage:
    """Shared inputs of the stages of a run on one dataset."""

    spec: AnyDatasetSpec
    data: Dataset
    training_data: TrainingData
    environment: RunEnvironment
    comparison: Comparison
    context: RunContext

    def row(self, label: str) -> Row:
        """Return the row of a configuration."""
        return self.comparison.row(self.spec.name, label)

    def fit_and_score(self, cached: CachedFit) -> ScoredFit:
        """Fit and score within the tuning budget's time limit, without using the budget up."""
        return fit_and_score(cached, self.context.budget.seconds)


def train_other_seeds(stage: Stage, fits: Mapping[str, CachedFit]) -> None:
    """Train randomised methods again with other seeds, and record how their errors scatter."""
    for label, cached in fits.items():
        if not isinstance(cached.fitted.parameters.get("seed"), int):
            continue
        trainings, errors = _trainings(stage, cached, stage.row(label))
        seeds = seed_spread(trainings)
        row = stage.row(label)
        stage.comparison.put(row.with_parts(seeds=seeds, warnings=[*row.warnings, *seeds.failed]))
        if errors:
            samples = {name: np.array([found[name] for found in errors]) for name in errors[0]}
            stage.comparison.add_samples(row, samples)


def _trainings(stage: Stage, cached: CachedFit, row: Row) -> tuple[list[SeedTraining], list[Score]]:
    """Train with other seeds; a failed training has an infinite error.

    The second list holds the raw samples of each training that succeeded.
    """
    seed, first = cached.fitted.parameters["seed"], cached.reproducible
    sets = stage.training_data.sets
    main = stage.training_data.with_sets(
        {name: sets[name] for name in SEED_SAMPLES if name in sets}
    )
    assert row.error is not None
    trainings = [_training(seed, cached.fitted.fit_s, row.error)]
    errors: list[Score] = []
    for other in range(seed + 1, seed + stage.context.seeds):
        configuration = replace(first, parameters={**first.parameters, "seed": other})
        stage.context.listener.repeating(stage.spec.name, row.label, "other seeds")
        try:
            scored = stage.fit_and_score(CachedFit(configuration, main, stage.environment))
        except MorBenchError as error:
            infinite = ErrorSummary(mean_dof_m=np.inf, rel_l2_median=np.inf)
            trainings.append(_training(other, None, infinite, failure(error)[1]))
            continue
        test = scored.scores["test"]
        errors.append({SEED_SAMPLES[n]: s["relative_l2"] for n, s in scored.scores.items()})
        errors[-1]["seeds_mean_dof_m"] = test["mean_dof_m"]
        trainings.append(_training(other, scored.record.fit_s, error_summary(test)))
    return trainings, errors


def _training(
    seed: int, fit_s: float | None, error: ErrorSummary, failed: str | None = None
) -> SeedTraining:
    return SeedTraining(
        seed=seed,
        fit_s=fit_s,
        mean_dof_m=error.mean_dof_m,
        rel_l2_median=error.rel_l2_median,
        failed=failed,
    )


def seed_spread(trainings: Sequence[SeedTraining]) -> SeedSpread:
    """Summarise how the errors of a configuration scatter over its seeds."""
    failed = [f"seed {item.seed}: {item.failed}" for item in trainings if item.failed]
    return SeedSpread(
        n=len(trainings) - len(failed),
        asked=len(trainings),
        failed=failed,
        mean_dof_m=_spread([item.mean_dof_m for item in trainings]),
        rel_l2_median=_spread([item.rel_l2_median for item in trainings]),
        trainings=list(trainings),
    )


def _spread(errors: Sequence[float]) -> Spread:
    values = np.array(errors)
    known = len(values) > 1 and np.isfinite(values).all()
    low, high = seed_interval(errors)
    return Spread(
        median=float(np.median(values)),
        min=float(values.min()),
        max=float(values.max()),
        std=float(values.std(ddof=1)) if known else np.inf,
        low=low,
        high=high,
    )


def draw_learning_curves(stage: Stage, fits: Mapping[str, CachedFit]) -> None:
    """Measure errors over the number of training samples.

    Each method that learns is measured in its most accurate configuration, by the error that the
    verdict uses.
    """
    comparison, name = stage.comparison, stage.spec.name
    comparison.learning = [point for point in comparison.learning if point.dataset != name]
    methods = [cached.configuration.method.name for cached in fits.values()]
    bounds = draws_of(comparison, name, N_RESAMPLES, np.random.default_rng(0)).error_bounds
    for method in dict.fromkeys(methods):
        mine = [
            (stage.row(label), cached)
            for label, cached in fits.items()
            if cached.configuration.method.name == method and cached.fitted.needs_snapshots
        ]
        if not mine:
            continue
        best, cached = min(mine, key=lambda pair: bounds[pair[0].label])
        for n in _learning_sizes(stage.training_data.n_train):
            comparison.learning.append(_learning_point(stage, cached, n, best))
            comparison.write()


def _learning_sizes(n_train: int) -> list[int]:
    """Return the numbers of training samples of a learning curve, smallest first."""
    sizes = [n_train]
    while sizes[-1] // LEARNING_STEP >= LEAST_TRAINING:
        sizes.append(sizes[-1] // LEARNING_STEP)
    return sizes[::-1]


def _learning_point(stage: Stage, cached: CachedFit, n: int, row: Row) -> LearningPoint:
    point = LearningPoint(
        dataset=stage.spec.name,
        method=cached.configuration.method.name,
        label=cached.configuration.label,
        n_train=n,
        status="ok",
        reason=None,
        fit_s=cached.fitted.fit_s,
        error=row.error,
    )
    if n == stage.training_data.n_train:
        return point
    stage.context.listener.repeating(stage.spec.name, row.label, "learning curve")
    smaller = CachedFit(cached.reproducible, stage.training_data.first(n), stage.environment)
    try:
        scored = stage.fit_and_score(smaller)
    except MorBenchError as error:
        changes = {"status": "failed", "reason": str(error), "fit_s": None, "error": None}
        return point.model_copy(update=changes)
    found = error_summary(scored.scores["test"])
    return point.model_copy(update={"fit_s": scored.record.fit_s, "error": found})


def score_fresh_test_set(stage: Stage, fits: Mapping[str, CachedFit], seed: int) -> None:
    """Score on a test set that is drawn after all fits."""
    assert isinstance(stage.spec, DatasetSpec)
    by = stage.context.options.split or stage.spec.split.by
    fresh = fresh_test_set(stage.spec, stage.data.scene, by, seed, len(stage.data.test))
    data = stage.training_data.with_sets({"hidden": TestSet.of(fresh)})
    for label, cached in fits.items():
        row = stage.row(label)
        again = CachedFit(cached.configuration, data, stage.environment)
        try:
            score = stage.fit_and_score(again).scores["hidden"]
        except MorBenchError as error:
            warnings = [*row.warnings, f"no score on the fresh test set: {error}"]
            hidden = failed_set(len(fresh), seed)
            stage.comparison.put(row.with_parts(hidden=hidden, warnings=warnings))
            continue
        stage.comparison.put(row.with_parts(hidden=set_errors(score, seed=seed)))
        stage.comparison.add_samples(row, {"hidden_relative_l2": score["relative_l2"]})
