"""Instruments: rigid bodies that press a surface, as a dataset file describes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Discriminator, Field, Tag

from mor_bench.specs.base import Finite, Length, StrictModel, Triple


def _not_zero(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if max(map(abs, value)) < 1e-9 or max(map(abs, value)) > 1e9:
        raise ValueError("the largest component must be in [1e-09, 1e+09]; the length is ignored")
    return value


Direction = Annotated[tuple[Finite, Finite, Finite], Field(strict=False), AfterValidator(_not_zero)]
"""A direction in space; its length is ignored."""


class Sphere(StrictModel):
    """A rigid ball.

    Attributes
    ----------
    radius_m : float
    centre_m : three floats
        Its centre before it moves.
    """

    radius_m: Length
    centre_m: Triple


class Plane(StrictModel):
    """A rigid body with a flat, unbounded face.

    Attributes
    ----------
    point_m : three floats
        A point of the face before it moves.
    normal : three floats
        Out of the instrument, towards the body that it presses.
    """

    point_m: Triple
    normal: Direction


class SphereInstrument(StrictModel):
    """An instrument that is a ball."""

    sphere: Sphere


class PlaneInstrument(StrictModel):
    """An instrument that is flat."""

    plane: Plane


def _kind_of_instrument(value: Any) -> str:
    flat = isinstance(value, PlaneInstrument) or (isinstance(value, Mapping) and "plane" in value)
    return "by plane" if flat else "by sphere"


Instrument = Annotated[
    Annotated[SphereInstrument, Tag("by sphere")] | Annotated[PlaneInstrument, Tag("by plane")],
    Discriminator(_kind_of_instrument),
]
