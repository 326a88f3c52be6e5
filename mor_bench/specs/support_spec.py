"""Supports, springs and constant loads of a dataset file."""

from __future__ import annotations

from typing import Annotated, Literal, Self, get_args

from pydantic import AfterValidator, Field, model_validator

from mor_bench.specs.base import Direction, Finite, Positive, StrictModel, in_range
from mor_bench.specs.region_spec import Region

Axis = Literal["x", "y", "z"]
AXES: tuple[Axis, ...] = get_args(Axis)


def _different(value: tuple[Axis, ...]) -> tuple[Axis, ...]:
    if not value or len(set(value)) < len(value):
        raise ValueError("one to three different components must be given")
    return value


Components = Annotated[
    tuple[Axis, ...],
    Field(strict=False, exclude_if=lambda value: set(value) == set(AXES)),
    AfterValidator(_different),
]


class Support(StrictModel):
    """A region whose nodes do not move, or move only perpendicular to some directions.

    Attributes
    ----------
    region : Region
    components : tuple of str
        The components of the displacement that are zero: all three by default. One component is a
        roller; on a plane across its axis, it is a plane of symmetry.
    direction : three floats, optional
        If given, only the displacement along this direction is zero: an oblique roller. Its length
        has no meaning. Excludes `components`.
    """

    region: Region
    components: Components = AXES
    direction: Annotated[Direction | None, Field(exclude_if=lambda value: value is None)] = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if self.direction is not None and "components" in self.model_fields_set:
            raise ValueError("`direction` and `components` exclude each other; remove one")
        return self


class Spring(StrictModel):
    """A Winkler foundation: springs without mass on the surface of a region.

    Attributes
    ----------
    region : Region
        The facets with all corners in it rest on springs.
    stiffness_n_m3 : float
        Traction per displacement from the undeformed body.
    components : tuple of str
        The components of the displacement that the springs resist: all three by default.
    normal : bool
        Whether they resist only the displacement along the normal of the undeformed surface, as a
        frictionless foundation does. Excludes `components`.
    """

    region: Region
    stiffness_n_m3: Annotated[Positive, in_range(1e-12, 1e18, "N/m³")]
    components: Components = AXES
    normal: Annotated[bool, Field(exclude_if=lambda value: not value)] = False

    @model_validator(mode="after")
    def _one_direction(self) -> Self:
        if self.normal and "components" in self.model_fields_set:
            raise ValueError("`normal = true` and `components` exclude each other; remove one")
        return self


_Acceleration = Annotated[Finite, in_range(-1e12, 1e12, "m/s²")]


class Gravity(StrictModel):
    """A uniform body force that acts before and during every load.

    Attributes
    ----------
    density_kg_m3 : float
        Density of the undeformed body.
    acceleration_m_s2 : three floats
        Along x, y and z; (0, 0, -9.81) by default.
    """

    density_kg_m3: Annotated[Positive, in_range(1e-12, 1e12, "kg/m³")]
    acceleration_m_s2: Annotated[
        tuple[_Acceleration, _Acceleration, _Acceleration], Field(strict=False)
    ] = (
        0.0,
        0.0,
        -9.81,
    )


def _not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("a pressure of 0 has no effect; remove the table")
    return value


class ConstantPressure(StrictModel):
    """A uniform pressure on a region of the surface that acts before and during every load.

    Attributes
    ----------
    region : Region
        The facets with all corners in it are pressed.
    pressure_pa : float
        It pushes into the body; a negative one pulls.
    follower : bool
        Whether it acts on the deformed surface, along its normals. If not, it is a dead load along
        the normals of the undeformed body. Default: false.
    """

    region: Region
    pressure_pa: Annotated[Finite, in_range(-1e15, 1e15, "Pa"), AfterValidator(_not_zero)]
    follower: bool = False
