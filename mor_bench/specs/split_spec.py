"""Tables `[split]` and `[tests]` of a dataset file."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from mor_bench.specs.base import Count, StrictModel
from mor_bench.specs.load_ranges import Magnitude
from mor_bench.specs.region_spec import Region

SplitBy = Literal["region", "sample", "direction"]
Fraction = Annotated[float, Field(gt=0, lt=1)]
OUTSIDE, MAX_OUTSIDE = 1.5, 10.0
"""Usual and largest multiple of a range's half-width for parameters outside their ranges."""


class Split(StrictModel):
    """Choice of the validation and test samples; see `mor_bench.snapshots.split`.

    Attributes
    ----------
    by : str
        Default: `region`; where all samples act on the same regions, `sample`.
    """

    test_fraction: Fraction = 0.2
    validation_fraction: Fraction = 0.15
    by: SplitBy = "region"

    @model_validator(mode="after")
    def _some_left(self) -> Self:
        held_out = self.test_fraction + self.validation_fraction
        if held_out >= 1:
            raise ValueError(
                "`test_fraction` and `validation_fraction` must leave samples for training: "
                f"their sum must be less than 1; got {held_out:g}"
            )
        return self


class ImportedSplit(Split):
    """Choice of imported validation and test samples: as `Split`, or by the arrays of the file."""

    by: Literal["region", "sample", "direction", "file"] = "region"  # type: ignore[assignment]


class ExtraTests(StrictModel):
    """The named test sets beside the main one; see `mor_bench.snapshots.test_sets`.

    Attributes
    ----------
    samples : int
        Number of samples in each set.
    unseen_region : Region, optional
        A part of the surface where no load of the main set acts.
    paper_magnitude_n : two floats, optional
        Range of each force at which the set's largest deformation is that of the paper, N.
    unseen_parameters : float
        The set `unseen-parameters` draws each parameter outside its range, up to this multiple of
        the range's half-width, measured from the middle. Default: 1.5.
    """

    samples: Count = 200
    unseen_region: Region | None = None
    paper_magnitude_n: Magnitude | None = None
    unseen_parameters: Annotated[
        float, Field(gt=1, le=MAX_OUTSIDE, exclude_if=lambda value: value == OUTSIDE)
    ] = OUTSIDE
