"""The strict base of every specification, and the numbers and words that they share."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

MAX_COUNT = 10_000_000
"""Largest count that a file may ask for. Ten million samples take days to generate."""


def in_range(low: float, high: float, unit: str) -> AfterValidator:
    """Return a check of a number against the range in which double precision can answer."""

    def check(value: float) -> float:
        if not low <= value <= high:
            raise ValueError(
                f"it must be in [{low:.9g}, {high:.9g}]{unit and f' {unit}'}, "
                "the range in which double precision suffices"
            )
        return value

    return AfterValidator(check)


def _one_line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("it must not hold control characters")
    return text


def _printable(text: str) -> str:
    if not all(letter.isprintable() or letter in "\n\t" for letter in text):
        raise ValueError("it must not hold control characters")
    return text


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=MAX_COUNT)]
Length = Annotated[Positive, in_range(1e-9, 1e9, "m")]
Area = Annotated[Positive, in_range(1e-18, 1e18, "m²")]
Modulus = Annotated[Positive, in_range(1e-6, 1e15, "Pa")]
Coordinate = Annotated[Finite, in_range(-1e9, 1e9, "m")]
Triple = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]


def _not_zero(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if not 1e-150 < max(map(abs, value)) < 1e150:
        raise ValueError("the largest component must be between 1e-150 and 1e150 in size")
    return value


Direction = Annotated[tuple[Finite, Finite, Finite], Field(strict=False), AfterValidator(_not_zero)]
"""A direction in space; its length has no meaning."""

Text = Annotated[str, Field(max_length=10_000), AfterValidator(_printable)]
Label = Annotated[str, Field(max_length=500), AfterValidator(_one_line)]
"""A name in tables and in names of files."""

NAME_PATTERN = r"^[a-z0-9-]+$"
Name = Annotated[str, Field(pattern=NAME_PATTERN, max_length=100)]
"""A name that is safe in the names of folders."""


class StrictModel(BaseModel):
    """A frozen table without unknown keys. Values are never converted from another type."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
