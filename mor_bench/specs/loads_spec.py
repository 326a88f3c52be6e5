"""Tables `[loads]`, `[[supports]]`, `[split]` and `[tests]` of a dataset file."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self, get_args

from pydantic import AfterValidator, Field, model_validator

from mor_bench.specs.base import Area, Count, Finite, Length, Positive, StrictModel, in_range
from mor_bench.specs.region_spec import Region

LoadKind = Literal["force", "normal", "tangential"]
Sampling = Literal["random", "latin-hypercube", "sobol"]
SplitBy = Literal["region", "sample", "direction"]
Fraction = Annotated[float, Field(gt=0, lt=1)]

OUTSIDE, MAX_OUTSIDE = 1.5, 10.0
"""Usual and largest multiple of a range's half-width for parameters outside their ranges."""


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError("the lower bound must not exceed the upper one")
    return value


Magnitude = Annotated[
    tuple[
        Annotated[float, Field(ge=0, allow_inf_nan=False)],
        Annotated[float, Field(ge=1e-12, le=1e12)],
    ],
    Field(strict=False),
    AfterValidator(_ordered),
]
"""Lower and upper end of a range of forces, N, displacements, m, or pressures, Pa."""


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
    """A region whose nodes do not move, or move only perpendicular to some axes.

    Attributes
    ----------
    region : Region
    components : tuple of str
        The components of the displacement that are zero: all three by default. One component is a
        roller; on a plane across its axis, it is a plane of symmetry.
    """

    region: Region
    components: Components = AXES


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


class Loads(StrictModel):
    """Forces on patches of the surface and how to draw them; see `mor_bench.snapshots.sampling`.

    Attributes
    ----------
    region : Region
        Where patches may lie.
    kind : str
        `force`: directions uniform on the sphere. `normal`: along the surface normal, inwards
        or outwards. `tangential`: perpendicular to the normal.
    patch_area_m2 : float
        Area of each patch, m².
    n_patches : int, optional
        Number of patches, spread evenly over the region away from the supports.
        Default: one patch around each node of the region.
    simultaneous : int
        Number of patches that are loaded at once.
    min_distance_m : float, optional
        Least distance between the centres of patches that are loaded at once, m.
        Required with `simultaneous` > 1.
    samples_per_patch, samples : int, optional
        Number of samples; give exactly one of them. With `samples`, patches (or combinations of
        them) come in random order, each as often as the others.
    magnitude_n : two floats
        Range of each force, N.
    sampling : str
        Plan for directions and magnitudes.
    seed : int
    """

    region: Region
    kind: LoadKind
    patch_area_m2: Area
    n_patches: Count | None = None
    simultaneous: Annotated[int, Field(ge=1, le=8)] = 1
    min_distance_m: Length | None = None
    samples_per_patch: Count | None = None
    samples: Count | None = None
    magnitude_n: Magnitude
    sampling: Sampling = "random"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0

    unit: ClassVar[str] = "N"

    @property
    def magnitude(self) -> tuple[float, float]:
        """The range of each force, N."""
        return self.magnitude_n

    @model_validator(mode="after")
    def _consistent(self) -> Loads:
        if (self.samples_per_patch is None) == (self.samples is None):
            raise ValueError("exactly one of `samples_per_patch` and `samples` must be given")
        if self.simultaneous > 1 and self.samples is None:
            raise ValueError(
                "with `simultaneous` > 1 `samples` must be given, not `samples_per_patch`"
            )
        if (self.simultaneous > 1) != (self.min_distance_m is not None):
            raise ValueError(
                "`min_distance_m` must be given with `simultaneous` > 1 and only then; "
                f"got `simultaneous` {self.simultaneous}"
            )
        if self.kind == "normal" and self.magnitude_n[0] == self.magnitude_n[1]:
            raise ValueError(
                "`magnitude_n` of normal forces must be a range, or samples would repeat; "
                f"got {self.magnitude_n}"
            )
        return self


class Motion(StrictModel):
    """Prescribed displacements: a rigid tool holds a region of the surface and moves it.

    All nodes of the region move by the same vector, in directions uniform on the sphere.

    Attributes
    ----------
    region : Region
        What the tool holds: its nodes that lie on the surface. It must be apart from all supports.
    magnitude_m : two floats
        Range of the displacement, m.
    samples : int
        Number of samples.
    sampling : str
        Plan for directions and magnitudes.
    seed : int
    """

    simultaneous: ClassVar[int] = 1
    samples_per_patch: ClassVar[int | None] = None
    min_distance_m: ClassVar[float | None] = None
    unit: ClassVar[str] = "m"

    region: Region
    kind: Literal["displacement"]
    samples: Count
    magnitude_m: Magnitude
    sampling: Sampling = "random"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0

    @property
    def magnitude(self) -> tuple[float, float]:
        """The range of the displacement, m."""
        return self.magnitude_m


class Pressure(StrictModel):
    """Uniform pressures on regions of the surface, each drawn independently.

    Attributes
    ----------
    regions : list of Region
        The facets with all corners in a region are pressed.
    follower : bool
        Whether the pressures act on the deformed surface, along its normals. If not, they are dead
        loads along the normals of the undeformed body. Default: false.
    magnitude_pa : two floats
        Range of each pressure, Pa. It pushes into the body.
    samples : int
        Number of samples.
    sampling : str
        Plan for the pressures.
    seed : int
    """

    samples_per_patch: ClassVar[int | None] = None
    min_distance_m: ClassVar[float | None] = None
    unit: ClassVar[str] = "Pa"

    regions: Annotated[tuple[Region, ...], Field(strict=False, min_length=1, max_length=8)]
    kind: Literal["pressure"]
    samples: Count
    magnitude_pa: Magnitude
    follower: bool = False
    sampling: Sampling = "random"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0

    @property
    def simultaneous(self) -> int:
        """Number of loads of a sample: three components of a force per region."""
        return 3 * len(self.regions)

    @property
    def magnitude(self) -> tuple[float, float]:
        """The range of each pressure, Pa."""
        return self.magnitude_pa


AnyLoads = Loads | Motion | Pressure
LoadPlan = Annotated[AnyLoads, Field(discriminator="kind")]


class Split(StrictModel):
    """Choice of the validation and test samples; see `mor_bench.snapshots.split`."""

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
