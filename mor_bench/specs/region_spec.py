"""Regions: how a dataset file selects nodes of the mesh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Discriminator, Field, Tag

from mor_bench.specs.base import Count, Direction, Length, StrictModel, Text, Triple
from mor_bench.specs.source_file import File


class BoxRegion(StrictModel):
    """The nodes inside an axis-aligned box, from its lowest to its highest corner, m."""

    box_m: Annotated[tuple[Triple, Triple], Field(strict=False)]


class SphereRegion(StrictModel):
    """The nodes inside a sphere: centre and radius, m."""

    sphere_m: Annotated[tuple[Triple, Length], Field(strict=False)]


class PlaneRegion(StrictModel):
    """The nodes on a plane: a point on it, m, and its normal, whose length has no meaning.

    Nodes within `within_m` of it count too; by default, only as near as round-off.
    """

    plane_m: Annotated[tuple[Triple, Direction], Field(strict=False)]
    within_m: Annotated[Length | None, Field(exclude_if=lambda value: value is None)] = None


class NearestRegion(StrictModel):
    """The surface nodes nearest to a point: its position, m, and the number of nodes."""

    nearest_m: Annotated[tuple[Triple, Count], Field(strict=False)]


class PointSetRegion(StrictModel):
    """A named set of nodes of the mesh file."""

    point_set: Text


class NearSurfaceRegion(StrictModel):
    """The surface nodes near another surface, open or closed, of an STL or OBJ file."""

    near_surface: File
    within_m: Length
    unit_m: Length = 1.0


NamedRegion = Literal["x-min", "x-max", "y-min", "y-max", "z-min", "z-max", "surface"]

REGIONS: dict[str, type[BaseModel]] = {
    "box_m": BoxRegion,
    "sphere_m": SphereRegion,
    "plane_m": PlaneRegion,
    "nearest_m": NearestRegion,
    "point_set": PointSetRegion,
    "near_surface": NearSurfaceRegion,
}
"""The key by which each kind of region is recognised."""


def _kind_of_region(value: Any) -> str:
    for key, kind in REGIONS.items():
        if isinstance(value, kind) or (isinstance(value, Mapping) and key in value):
            return f"by {key}"
    return "by box_m" if isinstance(value, Mapping) else "name"


_Placed = (
    Annotated[BoxRegion, Tag("by box_m")]
    | Annotated[SphereRegion, Tag("by sphere_m")]
    | Annotated[PlaneRegion, Tag("by plane_m")]
    | Annotated[NearestRegion, Tag("by nearest_m")]
    | Annotated[PointSetRegion, Tag("by point_set")]
    | Annotated[NearSurfaceRegion, Tag("by near_surface")]
)
Region = Annotated[Annotated[NamedRegion, Tag("name")] | _Placed, Discriminator(_kind_of_region)]
Outputs = Annotated[
    Annotated[Literal["all", NamedRegion], Tag("name")] | _Placed, Discriminator(_kind_of_region)
]
