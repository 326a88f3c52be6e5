"""The range of sampled pressures, which may pull."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from mor_bench.specs.base import Finite
from mor_bench.specs.load_ranges import LEAST, MOST, largest_of, ordered


def _of_size(value: tuple[float, float]) -> tuple[float, float]:
    if not LEAST <= largest_of(value) <= MOST:
        raise ValueError(f"the larger end must have a size in [{LEAST:g}, {MOST:g}]")
    return value


PressureRange = Annotated[
    tuple[Finite, Finite],
    Field(strict=False),
    AfterValidator(ordered),
    AfterValidator(_of_size),
]
"""Lower and upper end of a range of pressures, Pa; negative ones pull."""
