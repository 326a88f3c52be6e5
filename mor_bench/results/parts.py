"""The base of all typed parts of results.json, and the parts about trainings."""

from __future__ import annotations

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
