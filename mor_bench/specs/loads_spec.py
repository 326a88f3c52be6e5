"""The table `[loads]` of a dataset file, or several tables `[[loads]]`."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from mor_bench.specs.base import (
    Area,
    Count,
    Length,
    Positive,
    StrictModel,
    Triple,
    in_range,
)
from mor_bench.specs.instrument_spec import Direction, Instrument
from mor_bench.specs.load_ranges import SEED_STEP, AtOnce, LoadKind, Magnitude, Sampling, Steps
from mor_bench.specs.pressure_range import PressureRange
from mor_bench.specs.region_spec import Region


class _SampledForces(StrictModel):
    """Keys of all tables that draw forces on places of the surface.

    Attributes
    ----------
    simultaneous : int
        Number of places that are loaded at once.
    min_distance_m : float, optional
        Least distance between the centres of places that are loaded at once, m.
        Required with `simultaneous` > 1.
    samples_per_patch, samples : int, optional
        Number of samples; give exactly one of them. With `samples`, places (or combinations of
        them) come in random order, each as often as the others.
    magnitude_n : two floats
        Range of each force, N.
    sampling : str
        Plan for directions and magnitudes.
    seed : int
    steps : int
        Each load is applied in so many equal steps; each step is a sample. Default: 1.
    """

    simultaneous: Annotated[int, Field(ge=1, le=8)] = 1
    min_distance_m: Length | None = None
    samples_per_patch: Count | None = None
    samples: Count | None = None
    magnitude_n: Magnitude
    sampling: Sampling = "random"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    steps: Steps = 1

    unit: ClassVar[str] = "N"

    @property
    def magnitude(self) -> tuple[float, float]:
        """The range of each force, N."""
        return self.magnitude_n

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        wrong = []
        if (self.samples_per_patch is None) == (self.samples is None):
            wrong.append("exactly one of `samples_per_patch` and `samples` must be given")
        elif self.simultaneous > 1 and self.samples is None:
            wrong.append("with `simultaneous` > 1 `samples` must be given, not `samples_per_patch`")
        if (self.simultaneous > 1) != (self.min_distance_m is not None):
            wrong.append(
                "`min_distance_m` must be given with `simultaneous` > 1 and only then; "
                f"got `simultaneous` {self.simultaneous}"
            )
        if wrong:
            raise ValueError("; ".join(wrong))
        return self


class Loads(_SampledForces):
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
    """

    region: Region
    kind: LoadKind
    patch_area_m2: Area
    n_patches: Count | None = None

    @model_validator(mode="after")
    def _different(self) -> Self:
        if self.kind == "normal" and self.magnitude_n[0] == self.magnitude_n[1]:
            raise ValueError(
                "`magnitude_n` of normal forces must be a range, or samples would repeat; "
                f"got {self.magnitude_n}"
            )
        return self


class PointLoads(_SampledForces):
    """Forces on single points of the surface, in directions uniform on the sphere.

    The answer depends on the mesh: the displacement of the loaded point grows without bound under
    refinement.

    Attributes
    ----------
    region : Region
        Where the points may lie: the nodes of the surface that are not fixed.
    n_patches : int, optional
        Number of points, spread evenly over the region. Default: each node of the region.
    """

    region: Region
    kind: Literal["point"]
    n_patches: Count | None = None


class LineLoads(_SampledForces):
    """Forces spread evenly along straight lines, in directions uniform on the sphere.

    Attributes
    ----------
    lines : list of pairs of points
        Both ends of each line, m: on an edge, across a face, or inside the body.
    """

    kind: Literal["line"]
    lines: Annotated[
        tuple[Annotated[tuple[Triple, Triple], Field(strict=False)], ...],
        Field(strict=False, min_length=1, max_length=1000),
    ]

    @model_validator(mode="after")
    def _lengths(self) -> Self:
        for number, (begin, end) in enumerate(self.lines):
            if begin == end:
                raise ValueError(f"the two ends of `lines[{number}]` must differ; got {begin}")
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
    steps: AtOnce = 1
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
        Whether the pressures follow the deformed surface. Default: false, dead loads along normals.
    magnitude_pa : two floats
        Range of each pressure, Pa. It pushes into the body; a negative one pulls.
    samples : int
        Number of samples.
    sampling : str
        Plan for the pressures.
    seed : int
    steps : int
        Each load is applied in so many equal steps; each step is a sample. Default: 1.
    """

    samples_per_patch: ClassVar[int | None] = None
    min_distance_m: ClassVar[float | None] = None
    unit: ClassVar[str] = "Pa"

    regions: Annotated[tuple[Region, ...], Field(strict=False, min_length=1, max_length=8)]
    kind: Literal["pressure"]
    samples: Count
    magnitude_pa: PressureRange
    follower: bool = False
    sampling: Sampling = "random"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    steps: Steps = 1

    @property
    def simultaneous(self) -> int:
        """Number of loads of a sample: three components of a force per region."""
        return 3 * len(self.regions)

    @property
    def magnitude(self) -> tuple[float, float]:
        """The range of each pressure, Pa."""
        return self.magnitude_pa


class Contact(StrictModel):
    """A rigid instrument without friction that moves against a part of the surface.

    Each sample is a displacement of the instrument from its place at rest. The penalty traction on
    the undeformed surface is the stiffness times the penetration, along the instrument's normal.

    Attributes
    ----------
    region : Region
        What the instrument may touch: the facets with all corners in it. All others pass through.
    instrument : SphereInstrument or PlaneInstrument
        It must not penetrate the region at rest.
    direction : three floats, optional
        Axis of the directions in which it moves; the length is ignored. Default: against the
        outward normal of the region at the point nearest to the instrument.
    spread_deg : float
        Largest angle between a motion and the axis. The directions are uniform on the sphere
        within it. Default: 0, always along the axis.
    magnitude_m : two floats
        Range of the displacement, m.
    samples : int
        Number of samples.
    penalty_n_m3 : float, optional
        Stiffness of the contact: traction per penetration, N/m³. Default: see
        `mor_bench.scene.contact_surface`.
    sampling : str
        Plan for directions and magnitudes.
    seed : int
    """

    simultaneous: ClassVar[int] = 1
    samples_per_patch: ClassVar[int | None] = None
    min_distance_m: ClassVar[float | None] = None
    unit: ClassVar[str] = "m"

    region: Region
    kind: Literal["contact"]
    instrument: Instrument
    direction: Annotated[Direction | None, Field(exclude_if=lambda value: value is None)] = None
    spread_deg: Annotated[float, Field(ge=0, le=180)] = 0.0
    magnitude_m: Magnitude
    samples: Count
    steps: AtOnce = 1
    penalty_n_m3: Annotated[Positive, in_range(1e-12, 1e24, "N/m³")] | None = None
    sampling: Sampling = "random"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0

    @property
    def magnitude(self) -> tuple[float, float]:
        """The range of the displacement, m."""
        return self.magnitude_m

    @model_validator(mode="after")
    def _different_samples(self) -> Self:
        if self.spread_deg == 0 and self.magnitude_m[0] == self.magnitude_m[1]:
            raise ValueError(
                "`magnitude_m` must be a range where `spread_deg` is 0, or samples would repeat; "
                f"got {self.magnitude_m}"
            )
        return self


AnyTable = Loads | PointLoads | LineLoads | Motion | Pressure | Contact
Table = Annotated[AnyTable, Field(discriminator="kind")]


class Several(StrictModel):
    """Several tables `[[loads]]`, which act together: each sample has a draw of each table.

    Attributes
    ----------
    tables : list of tables
        Dead loads; their nodal forces are added. All have the same `samples` and `steps`.
    """

    samples_per_patch: ClassVar[int | None] = None
    min_distance_m: ClassVar[float | None] = None
    unit: ClassVar[str] = "N or Pa"

    kind: Literal["several"]
    tables: Annotated[tuple[Table, ...], Field(strict=False, min_length=2, max_length=8)]

    @property
    def magnitude(self) -> tuple[float, float]:
        """The least and the largest load of all tables, in their units."""
        ends = [table.magnitude for table in self.tables]
        return min(low for low, _ in ends), max(high for _, high in ends)

    @property
    def simultaneous(self) -> int:
        """Number of loads of a sample."""
        return sum(table.simultaneous for table in self.tables)

    @property
    def samples(self) -> int:
        """Number of samples, or of loads that are applied in steps."""
        found = self.tables[0].samples
        assert found is not None
        return found

    @property
    def seed(self) -> int:
        return self.tables[0].seed

    @property
    def sampling(self) -> Sampling:
        return self.tables[0].sampling

    @property
    def steps(self) -> int:
        return self.tables[0].steps

    @model_validator(mode="after")
    def _together(self) -> Self:
        kinds = [
            "follower pressure" if getattr(table, "follower", False) else str(table.kind)
            for table in self.tables
        ]
        wrong = [
            f"`loads` cannot combine the kinds {kind!r} and {kinds[int(kinds[0] == kind)]!r}: only "
            "dead loads act together; pressures that do not vary belong in `constant_pressures`"
            for kind in ("displacement", "contact", "follower pressure")
            if kind in kinds
        ][:1]
        for name in ("samples", "steps"):
            values = [getattr(table, name) for table in self.tables]
            if None in values or len(set(values)) > 1:
                wrong.append(
                    f"all tables `[[loads]]` must give the same `{name}`; got "
                    f"{', '.join('none' if value is None else str(value) for value in values)}"
                )
        if wrong:
            raise ValueError("; ".join(wrong))
        return self


AnyLoads = AnyTable | Several


def tables_of(loads: AnyLoads) -> tuple[AnyTable, ...]:
    """Return the tables of a plan. Those of several have different seeds."""
    if not isinstance(loads, Several):
        return (loads,)
    return tuple(
        table.model_copy(update={"seed": (table.seed + SEED_STEP * number) % 2**63})
        for number, table in enumerate(loads.tables)
    )


def with_seed(loads: AnyLoads, seed: int) -> AnyLoads:
    """Return the same plan with another seed."""
    if isinstance(loads, Several):
        tables = tuple(table.model_copy(update={"seed": seed}) for table in loads.tables)
        return loads.model_copy(update={"tables": tables})
    return loads.model_copy(update={"seed": seed})


def _wrapped(value: Any) -> Any:
    """Return a list of tables as one table of a plan."""
    if isinstance(value, list | tuple):
        return value[0] if len(value) == 1 else {"kind": "several", "tables": value}
    return value


LoadPlan = Annotated[
    Annotated[AnyTable | Several, Field(discriminator="kind")], BeforeValidator(_wrapped)
]
