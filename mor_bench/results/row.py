"""The typed rows of results.json: `Row` for a configuration, `LearningPoint` for a learning curve.

None means that a figure was not measured. NaN means that a measured part lacks this figure.
"""

from __future__ import annotations

from math import nan
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, FailFast, Field, model_validator

from mor_bench.errors import printable
from mor_bench.results.parts import (
    ErrorSummary,
    IndicatorQuality,
    Memory,
    Part,
    Real,
    SeedSpread,
    TrainedElsewhere,
    TrainingRecord,
)
from mor_bench.results.recorded import RecordedDataset, RecordedMethod, RecordedSettings
from mor_bench.specs.base import Label
from mor_bench.specs.method_spec import Told

MOST_LETTERS = 450
"""Letters of a label before it is cut."""

MOST_SETS = 100
"""Largest number of named test sets."""

Status = Literal["ok", "failed", "skipped"]


def _few(value: Any) -> Any:
    if isinstance(value, dict) and len(value) > MOST_SETS:
        raise ValueError(f"there must be at most {MOST_SETS} of them; got {len(value):,}")
    return value


class SetErrors(Part):
    """Errors and range flags of a named test set.

    Attributes
    ----------
    n, n_failed : int
        Samples, and samples without a prediction.
    n_flagged : int or None
        Samples that the method flagged as out of range; None if the method has no flags.
    mean_dof_m, rel_l2_median, rel_l2_p95, rel_l2_max, slope, amplitude_m : float
        See `ErrorSummary`.
    n_unusual, n_unusual_flagged : int or None
        Samples with an unusually large error, and flagged samples among them.
    recall : float or None
        Flagged share of the unusual samples.
    seed : int or None
        Seed of a newly drawn test set.
    """

    seed: int | None = None
    n: int
    n_failed: int = 0
    n_flagged: int | None = None
    mean_dof_m: Real = nan
    rel_l2_median: Real = nan
    rel_l2_p95: Real = nan
    rel_l2_max: Real = nan
    slope: Real = nan
    amplitude_m: Real = nan
    n_unusual: int | None = None
    n_unusual_flagged: int | None = None
    recall: Real | None = None


class Latency(Part):
    """Latency of single queries, ms.

    Attributes
    ----------
    median, p95, p99 : float
        Percentiles over all queries.
    low, high : float or None
        95 % prediction interval for the median of a rerun.
    gc : float
        Mean time of the garbage collector per query.
    n_queries, n_processes : int
        Timed queries, and fresh processes that answered them.
    stable : bool or None
        Whether the timing is reliable.
    unstable_because : list of str
        Reasons why it is not.
    """

    median: Real
    p95: Real = nan
    p99: Real = nan
    low: Real | None = None
    high: Real | None = None
    gc: Real = nan
    n_queries: int = 0
    n_processes: int = 0
    stable: bool | None = None
    unstable_because: Annotated[list[str], FailFast()] = Field(default=[])


class AllThreadsLatency(Part):
    """Median latency of single queries on all cores, ms."""

    median: Real


class Offline(Part):
    """Offline cost.

    Attributes
    ----------
    data : float or None
        Core-seconds of generating the training samples; None if unknown.
    fit : float
        Wall time of the fit without compilation, s.
    fit_core_s : float or None
        Core-seconds of the fit without compilation; None in files of earlier versions.
    """

    data: Real | None
    fit: Real
    fit_core_s: Real | None = None


class FlagCounts(Part):
    """Range flags of the main test set; the fields are those of `SetErrors`."""

    n: int
    n_flagged: int
    n_unusual: int
    n_unusual_flagged: int
    recall: Real | None


class RangeFlags(Part):
    """Quality of the method's range flags as a warning of large errors.

    Attributes
    ----------
    in_range : str
        Test set that defines the usual error.
    usual_rel_l2 : float
        95th percentile of the relative L2 error on this set, as a fraction.
    n, n_flagged : int
        Samples in this set, and false alarms among them.
    false_alarms : float
        Share of false alarms.
    test : FlagCounts
        Counts on the main test set.
    """

    in_range: str
    usual_rel_l2: Real
    n: int
    n_flagged: int
    false_alarms: Real
    test: FlagCounts


class ScaledBound(Part):
    """A bound of the error that is a multiple of the spread of a method.

    Attributes
    ----------
    per_spread : float
        The factor; infinite if there are too few groups.
    widths, coverage : dict of str to float
        Median of the bound on each test set, as a fraction, and share of the samples within it.
    """

    per_spread: Real
    widths: Annotated[dict[str, Real], BeforeValidator(_few)] = Field(default={})
    coverage: Annotated[dict[str, Real], BeforeValidator(_few)] = Field(default={})


class BoundQuality(Part):
    """A bound of the error from the validation samples, and its coverage of each test set.

    Attributes
    ----------
    level : float
        Share of new loads for which the bound is meant to hold.
    relative_l2 : float
        The bound of the relative L2 error, as a fraction; infinite if there are too few groups.
    n, n_groups : int
        Validation samples, and independent groups among them.
    coverage : dict of str to float
        Share of the samples of each test set whose error is within the bound.
    scaled : ScaledBound or None
        The bound that follows the spread of a method.
    """

    level: Real
    relative_l2: Real
    n: int
    n_groups: int
    coverage: Annotated[dict[str, Real], BeforeValidator(_few)] = Field(default={})
    scaled: ScaledBound | None = None


class Row(Part):
    """One configuration of one method on one dataset.

    Attributes
    ----------
    dataset, split, method, label : str
        Names; the label lists the swept parameters.
    parameters, swept : dict
        All given parameters, and those that the sweep varies.
    told : Told or None
        Information that the method gets at query time; None if its file does not state it.
    snapshots : bool or None
        Whether the method learned from snapshots; None before its fit.
    reference : bool
        Whether the method solves the full equations on the dataset's own mesh, like the reference.
    sizes : dict
        Values chosen for parameters that were "auto".
    status, reason : str
        "ok", "failed" or "skipped", and the reason.
    n_train, n_validation, n_test, n_unused, n_failed : int
        Samples; `n_failed` test samples have no prediction.
    n_dofs, threads : int
        Degrees of freedom of the mesh, and threads of a prediction.
    error : ErrorSummary or None
        Errors on the main test set.
    validation : ErrorSummary or None
        Errors on the validation samples, which decide between configurations.
    latency_ms, all_threads_ms : Latency, AllThreadsLatency or None
    throughput : dict or None
        Queries per second by batch size.
    offline_s : Offline or None
    memory_bytes : Memory or None
    model_bytes : int or None
        Size of the saved model.
    cost : dict or None
        Mean work per query, see `mor_bench.counting.Cost`.
    indicator : IndicatorQuality or None
    sets : dict of SetErrors
        Named test sets.
    range : RangeFlags or None
    bound : BoundQuality or None
        A calibrated bound of the error, see `mor_bench.measure.error_bounds`.
    hidden : SetErrors or None
        A test set drawn after all fits.
    training : TrainingRecord or None
    trained_elsewhere : TrainedElsewhere or None
        Set if the weights are the suite's own, and were not trained in this run.
    seeds : SeedSpread or None
    discretisation_error_m, discretisation_rel_l2 : float or None
        Error of the dataset's mesh against the limit of fine meshes: mean, m; relative median.
    discretisation_at_least : bool
        Whether these are lower bounds, since no limit of fine meshes is known.
    warnings : list of str
    tuning_s : float or None
        Tuning budget that the configuration used, s.
    """

    dataset: Label
    split: Label
    method: Label
    label: Label
    parameters: dict[str, Any] = Field(default={})
    swept: dict[str, Any] = Field(default={})
    told: Told | None = None
    snapshots: bool | None = None
    reference: bool = False
    sizes: dict[str, Any] = Field(default={})
    status: Status
    reason: str | None = None
    n_train: int
    n_validation: int = 0
    n_test: int
    n_unused: int = 0
    n_failed: int | None = None
    n_dofs: int = 0
    threads: int = 1
    error: ErrorSummary | None = None
    validation: ErrorSummary | None = None
    latency_ms: Latency | None = None
    all_threads_ms: AllThreadsLatency | None = None
    throughput: dict[Annotated[str, BeforeValidator(str)], Real | None] | None = None
    offline_s: Offline | None = None
    memory_bytes: Memory | None = None
    model_bytes: int | None = None
    cost: dict[str, Real] | None = None
    indicator: IndicatorQuality | None = None
    sets: Annotated[dict[str, SetErrors], BeforeValidator(_few)] = Field(default={})
    range: RangeFlags | None = None
    bound: BoundQuality | None = None
    hidden: SetErrors | None = None
    training: TrainingRecord | None = None
    trained_elsewhere: TrainedElsewhere | None = None
    seeds: SeedSpread | None = None
    discretisation_error_m: Real | None = None
    discretisation_rel_l2: Real | None = None
    discretisation_at_least: bool = False
    warnings: Annotated[list[str], FailFast()] = Field(default=[])
    tuning_s: Real | None = None

    @property
    def ok(self) -> bool:
        """True if the configuration ran to the end."""
        return self.status == "ok"

    @property
    def fit_core_s(self) -> float | None:
        """Core-seconds of the fit; None for a training on a GPU. Old files have its wall time."""
        if self.offline_s is None or (self.training and self.training.device == "cuda"):
            return None
        cores = self.offline_s.fit_core_s
        return self.offline_s.fit if cores is None else cores

    @property
    def offline_core_s(self) -> float | None:
        """Core-seconds of data and fit; None if one of them is unknown."""
        data, fit = self.offline_s.data if self.offline_s else None, self.fit_core_s
        return None if data is None or fit is None else data + fit

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON content with all keys of a row."""
        return {**self.model_dump(), **self.model_dump(exclude_unset=True)}

    def with_parts(self, **changes: Any) -> Row:
        """Return a copy with some fields replaced."""
        return self.model_copy(update=changes)


class LearningPoint(Part):
    """One point of a learning curve: training samples, fitting time (s) and error."""

    dataset: Label
    method: Label
    label: Label
    n_train: int
    status: Status
    reason: str | None = None
    fit_s: Real | None = None
    error: ErrorSummary | None = None


class ResultsFile(Part):
    """The content of results.json."""

    schema_version: int
    machine: dict[str, Any]
    settings: RecordedSettings
    datasets: dict[Label, RecordedDataset]
    methods: dict[Label, RecordedMethod]
    rows: Annotated[list[Row], FailFast()]  # millions of wrong rows would fill the memory
    learning: Annotated[list[LearningPoint], FailFast()]

    @model_validator(mode="after")
    def _complete(self) -> ResultsFile:
        for row in self.rows:
            if row.ok and row.dataset not in self.datasets:
                raise ValueError(f"`datasets` lacks {row.dataset!r}, which rows name")
        return self


def label_of(method: str, swept: dict[str, Any]) -> str:
    """Return a configuration's name: the method, and the swept parameters in brackets."""
    inside = ", ".join(f"{key}={value}" for key, value in swept.items())
    return printable(f"{method} [{inside}]" if inside else method, MOST_LETTERS, keep="")
