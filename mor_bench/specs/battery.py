"""Table `[battery]` of a method file: settings of shared tests and benchmarks.

No comparison reads this table. It lets a new method join every test and benchmark by itself.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from mor_bench.specs.base import Positive, StrictModel


class Race(StrictModel):
    """A method and a baseline take turns at one query; the method must be faster.

    Attributes
    ----------
    scene : str
        Name of the dataset.
    parameters : dict
        Hyperparameters of the method.
    baseline : str
        Name of the baseline method.
    baseline_parameters : dict
        Hyperparameters of the baseline.
    least_speedup : float
        Lower bound on the baseline's time over the method's. Set it to about a third of the
        measured ratio.
    difference : float
        Upper bound on the relative l2 difference between both answers.
    """

    scene: str = "l-shape"
    parameters: dict[str, Any] = Field(default_factory=dict)
    baseline: str = "fem"
    baseline_parameters: dict[str, Any] = Field(default_factory=dict)
    least_speedup: Positive
    difference: Positive


class Battery(StrictModel):
    """Hyperparameters and bounds for the shared tests and benchmarks.

    Attributes
    ----------
    parameters : dict
        Hyperparameters for a cheap fit on beam-tiny.
    error : float
        Upper bound on the mean training error, relative to that of zero displacement. Default: 0.2.
    observed_parameters : dict
        Hyperparameters for a cheap fit on scenes with observed nodes. Default: `parameters`.
    observed_error : float
        Upper bound on the median relative l2 error there. Default: 0.1.
    falls_short : tuple of str
        Hard cases that the method is known to fall short of.
    benchmark : dict
        Hyperparameters that asv follows over commits.
    races : list of Race
    """

    parameters: dict[str, Any] = Field(default_factory=dict)
    error: Annotated[float, Field(gt=0, le=1)] = 0.2
    observed_parameters: dict[str, Any] | None = None
    observed_error: Annotated[float, Field(gt=0, le=1)] = 0.1
    falls_short: Annotated[tuple[str, ...], Field(strict=False)] = ()
    benchmark: dict[str, Any] = Field(default_factory=dict)
    races: Annotated[tuple[Race, ...], Field(strict=False)] = ()

    def parameters_for(self, observed: bool) -> dict[str, Any]:
        """Return the cheap hyperparameters for scenes with or without observed nodes."""
        if observed and self.observed_parameters is not None:
            return self.observed_parameters
        return self.parameters
