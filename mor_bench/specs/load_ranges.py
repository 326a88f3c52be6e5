"""Ranges and plans that all tables of loads share."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

LoadKind = Literal["force", "normal", "tangential"]
Sampling = Literal["random", "latin-hypercube", "sobol"]
SEED_STEP = 7_368_787
"""Difference between the seeds of several tables, so that equal seeds give independent draws."""


def ordered(value: tuple[float, float]) -> tuple[float, float]:
    """Return a range, or raise `ValueError` if its ends are in the wrong order."""
    if value[0] > value[1]:
        raise ValueError("the lower bound must not exceed the upper one")
    return value


LEAST, MOST = 1e-12, 1e12
"""Limits of the larger end of a range, in its unit."""

Magnitude = Annotated[
    tuple[
        Annotated[float, Field(ge=0, allow_inf_nan=False)],
        Annotated[float, Field(ge=LEAST, le=MOST)],
    ],
    Field(strict=False),
    AfterValidator(ordered),
]
"""Lower and upper end of a range of forces, N, or displacements, m."""


def largest_of(magnitude: tuple[float, float]) -> float:
    """Return the largest size of a load in a range, which may begin below zero."""
    return max(map(abs, magnitude))


Steps = Annotated[int, Field(ge=1, le=1000, exclude_if=lambda value: value == 1)]
"""Number of equal steps in which each load is applied; every step is a sample."""


def _at_once(value: int) -> int:
    if value != 1:
        raise ValueError("it must be 1 or left out, as only forces and pressures act in steps")
    return value


AtOnce = Annotated[int, AfterValidator(_at_once), Field(exclude_if=lambda value: value == 1)]
"""The steps of a tool or an instrument, whose displacement is one sample."""
