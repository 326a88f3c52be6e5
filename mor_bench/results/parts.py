"""The base of all typed parts of results.json, and the parts about trainings and errors."""

from __future__ import annotations

from math import nan
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

Real = Annotated[
    float,
    WithJsonSchema({"anyOf": [{"type": "number"}, {"enum": ["nan", "inf", "-inf"]}]}),
]
"""A float. Files hold NaN and infinity as strings, because JSON lacks them."""


class Part(BaseModel):
    """A frozen group of figures."""

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="constants")

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON content; fields that were not set are left out."""
        return self.model_dump(exclude_unset=True)


class TrainingRecord(Part):
    """Device, time limit (s), iterations and last losses of a training; None where unknown."""

    device: str
    fit_seconds: Real | None = None
    iterations: int | None = None
    loss: Real | None = None
    validation_loss: Real | None = None


class TrainedElsewhere(Part):
    """Where and how the suite's own weights were trained; the offline cost of the row is theirs.

    Attributes
    ----------
    machine : str
        Processor and number of cores.
    core_s, wall_s : float
        Core-seconds and wall time of the training, s.
    threads, iterations, seed : int
    commit, date : str
        Commit of the code, and day of the training (UTC).
    versions : dict of str to str
        Versions of the libraries that results depend on.
    """

    machine: str
    core_s: Real
    wall_s: Real
    threads: int
    iterations: int
    seed: int
    commit: str
    date: str
    versions: dict[str, str] = Field(default={})


class Spread(Part):
    """Scatter of one figure over the seeds of a training.

    Attributes
    ----------
    median, min, max, std : float
    low, high : float or None
        95 % prediction interval for the figure of another training on the same test set, from
        Student's t on the logarithms; None in files of earlier versions.
    """

    median: Real
    min: Real
    max: Real
    std: Real
    low: Real | None = None
    high: Real | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The prediction interval; None where the file lacks it."""
        return None if self.low is None or self.high is None else (self.low, self.high)


class SeedTraining(Part):
    """One training: its seed, its fitting time (s), its errors, and the reason for a failure."""

    seed: int
    fit_s: Real | None
    mean_dof_m: Real
    rel_l2_median: Real
    failed: str | None = None


class SeedSpread(Part):
    """Errors over the seeds of a training; a failed training has an infinite error.

    Attributes
    ----------
    n, asked : int
        Trainings that succeeded, and trainings that were started.
    failed : list of str
        Reasons of the failures.
    mean_dof_m, rel_l2_median : Spread
    trainings : list of SeedTraining
    """

    n: int
    asked: int = 0
    failed: list[str] = []
    mean_dof_m: Spread | None = None
    rel_l2_median: Spread | None = None
    trainings: list[SeedTraining] = []


class IndicatorQuality(Part):
    """Agreement of errors estimated from the equilibrium residual with measured errors.

    Attributes
    ----------
    n : int
        Compared samples.
    rank_correlation, residual_rank_correlation : float
        Spearman correlation of the measured error with the correction and with the residual.
    ratio_p5, ratio_median, ratio_p95 : float
        Percentiles of estimated over measured error.
    """

    n: int
    rank_correlation: Real
    residual_rank_correlation: Real
    ratio_p5: Real
    ratio_median: Real
    ratio_p95: Real


class Memory(Part):
    """Peak resident memory of a process during fitting and during prediction, bytes."""

    fit: int | float
    predict: int | float | None = None


class ErrorSummary(Part):
    """Errors of a test set, from `mor_bench.measure.error_metrics.summary`.

    Attributes
    ----------
    mean_dof_m, std_dof_m, max_dof_m : float
        Mean, standard deviation and maximum of the mean absolute error per degree of freedom, m.
        The degrees of freedom of the supports count.
    mean_free_dof_m : float
        The mean over the free degrees of freedom alone, m.
    rel_l2_median, rel_l2_p95, rel_l2_max : float
        Relative L2 error, as a fraction: median, 95th percentile and maximum.
    max_nodal_m : float
        Largest nodal error, m.
    slope : float
        Slope of the error over the largest displacement, through the origin.
    amplitude_m : float
        Largest displacement of a node in the test set's reference, m.
    tip_max_m : float
        Largest error at the tip, the node that moves most in a sample, m.
    tip_rel_median, tip_rel_p95, tip_rel_max : float
        Error at the tip over its displacement, as a fraction: median, 95th percentile and maximum.
    tip_rel_at_max_e, tip_rel_at_largest : float
        The same of the sample with the largest e, and of the sample with the largest displacement.
    reaction_rel_median, reaction_rel_p95, reaction_rel_max : float
        Error of the force that a moved tool feels over that force, as a fraction; NaN without a
        tool.
    stress_rel_median, stress_rel_p95, stress_rel_max : float
        Relative L2 error of the Cauchy stress over the cells' centroids, as a fraction; NaN unless
        the dataset asks for stresses.
    peak_stress_rel_median, peak_stress_rel_p95, peak_stress_rel_max : float
        Error of the largest von Mises stress over that stress, as a fraction; NaN likewise.
    peak_tension_rel_median, peak_tension_rel_p95, peak_tension_rel_max : float
        Error of the largest principal stress over the largest magnitude of a principal stress, as a
        fraction; NaN likewise, and in results of earlier versions.
    """

    mean_dof_m: Real = nan
    std_dof_m: Real = nan
    max_dof_m: Real = nan
    mean_free_dof_m: Real = nan
    rel_l2_median: Real = nan
    rel_l2_p95: Real = nan
    rel_l2_max: Real = nan
    max_nodal_m: Real = nan
    slope: Real = nan
    amplitude_m: Real = nan
    tip_max_m: Real = nan
    tip_rel_median: Real = nan
    tip_rel_p95: Real = nan
    tip_rel_max: Real = nan
    tip_rel_at_max_e: Real = nan
    tip_rel_at_largest: Real = nan
    reaction_rel_median: Real = nan
    reaction_rel_p95: Real = nan
    reaction_rel_max: Real = nan
    stress_rel_median: Real = nan
    stress_rel_p95: Real = nan
    stress_rel_max: Real = nan
    peak_stress_rel_median: Real = nan
    peak_stress_rel_p95: Real = nan
    peak_stress_rel_max: Real = nan
    peak_tension_rel_median: Real = nan
    peak_tension_rel_p95: Real = nan
    peak_tension_rel_max: Real = nan
