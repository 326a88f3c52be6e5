"""A dataset file as a whole: generated samples, or samples imported from another program."""

from __future__ import annotations

import hashlib
import json
from math import prod
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.specs.base import Name, Positive, StrictModel, Text
from mor_bench.specs.geometry_spec import Geometry
from mor_bench.specs.loads_spec import (
    AnyLoads,
    Contact,
    LineLoads,
    LoadPlan,
    Motion,
    PointLoads,
    Pressure,
    Several,
)
from mor_bench.specs.material_spec import Discretisation, MaterialSpec, SolverName
from mor_bench.specs.region_spec import Outputs, Region
from mor_bench.specs.sampled_parameters import SampledParameters, check_parameters_of
from mor_bench.specs.source_file import File, without_paths
from mor_bench.specs.split_spec import ExtraTests, ImportedSplit, Split
from mor_bench.specs.support_spec import Gravity, Spring, Support

MAX_NODES = 1_000_000
"""Largest number of nodes of the grid to which samples are interpolated."""

NO_EQUATIONS = "its snapshots were imported, so its equations are not known"
NO_FORCES = "its forces are not known, only the displacements of a part of its surface"
CONTACT = "an instrument presses it, and the method needs given forces"

FIXED_REGIONS = (Motion, Pressure, Contact, Several)
"""Plans whose samples all act on the same regions."""

Side = Annotated[int, Field(ge=2, le=1024)]


def _few_enough(value: tuple[int, int, int]) -> tuple[int, int, int]:
    if prod(value) > MAX_NODES:
        raise ValueError(f"there must be at most {MAX_NODES:,} nodes in all")
    return value


GridNodes = Annotated[tuple[Side, Side, Side], Field(strict=False), AfterValidator(_few_enough)]


class Needs(StrictModel):
    """Requirements of the scene's user.

    Attributes
    ----------
    outputs : "all" or Region
        The nodes whose displacements are wanted. Errors count these nodes alone, and a reduced
        method computes no others.
    error : float
        Relative l2 error over the wanted nodes, median over the test set. Default: 1 %.
    latency_ms : float
        Median latency of one query, ms. Default: 16, a frame of a display with 60 Hz.
    stress : bool
        Whether stresses are wanted too: their errors are then compared. Default: no.
    """

    outputs: Outputs = "all"
    error: Positive = 0.01
    latency_ms: Positive = 16.0
    stress: bool = False

    @model_validator(mode="after")
    def _stress_of_all(self) -> Self:
        if self.stress and self.outputs != "all":
            raise ValueError(
                "`outputs` must be 'all' where `stress` is true: the stress of a cell needs all "
                "its nodes"
            )
        return self


class Observed(StrictModel):
    """The part of the surface whose displacements are known where the forces are not.

    Attributes
    ----------
    region : Region
        Its nodes that lie on the surface and are free to move are observed.
    """

    region: Region


class CommonDatasetSpec(StrictModel):
    """The keys of every dataset file.

    Attributes
    ----------
    needs : Needs
    grid_nodes : three ints, optional
        Nodes per axis of the regular grid that some methods need. Only for meshes that are not
        part of a regular grid.
    observed : Observed, optional
        If given, methods receive displacements of some nodes instead of forces. The samples
        stay the same.
    """

    name: Name
    title: Text
    source: Text = ""
    needs: Needs = Needs()
    grid_nodes: GridNodes | None = None
    observed: Observed | None = Field(default=None, exclude_if=lambda value: value is None)

    def physics(self) -> dict[str, Any]:
        """Return all settings that determine the samples: equal physics gives equal snapshots."""
        raise NotImplementedError

    def digest(self) -> str:
        """Return twelve hexadecimal digits of the SHA-256 of `physics`."""
        return hashlib.sha256(json.dumps(self.physics(), sort_keys=True).encode()).hexdigest()[:12]


class DatasetSpec(CommonDatasetSpec):
    """A dataset file whose samples the full-order model generates.

    Attributes
    ----------
    springs : tuple of Spring
        Foundations, none by default.
    gravity : Gravity, optional
        A constant pre-load: displacements are measured from the rest state under it.
    loads : Loads, PointLoads, LineLoads, Motion, Pressure, Contact or Several, optional
        Sampled forces, displacements of a tool, pressures, motions of an instrument, or several of
        them together. Without it the scene can be solved for given forces, but no samples can be
        drawn.
    parameters : SampledParameters, optional
        Properties of the body that vary between samples, beside the loads.
    """

    geometry: Geometry
    discretisation: Discretisation = Discretisation()
    solver: SolverName = "auto"
    material: MaterialSpec
    supports: Annotated[tuple[Support, ...], Field(strict=False)] = ()
    springs: Annotated[
        tuple[Spring, ...], Field(strict=False, exclude_if=lambda value: not value)
    ] = ()
    gravity: Gravity | None = None
    loads: LoadPlan | None = None
    parameters: SampledParameters | None = Field(
        default=None, exclude_if=lambda value: value is None
    )
    split: Annotated[Split, Field(validate_default=True)] = Split()
    tests: ExtraTests = ExtraTests()

    @field_validator("split")
    @classmethod
    def _suits_loads(cls, split: Split, info: ValidationInfo) -> Split:
        """Split by sample where all samples act on the same regions, unless the file says more."""
        if isinstance(info.data.get("loads"), FIXED_REGIONS) and "by" not in split.model_fields_set:
            return split.model_copy(update={"by": "sample"})
        return split

    @model_validator(mode="after")
    def _fixed_regions(self) -> Self:
        """Check what a plan excludes whose samples do not act on one region each."""
        if not isinstance(self.loads, FIXED_REGIONS):
            return self
        where = f"where `loads.kind` is {self.loads.kind!r}"
        why = "all samples act on the same regions"
        if isinstance(self.loads, Several):
            where, why = "with several tables `[[loads]]`", "they act on several regions at once"
        moves = isinstance(self.loads, Motion | Contact)
        possible = ("sample", "direction") if moves else ("sample",)
        if self.split.by not in possible:
            raise ValueError(
                f"`split.by` must be {' or '.join(map(repr, possible))} {where}, since {why}; "
                f"got {self.split.by!r}"
            )
        if self.observed is not None and moves:
            given = "displacements of `loads.region`"
            if isinstance(self.loads, Contact):
                given = "displacement of `loads.instrument`"
            raise ValueError(f"`observed` must be absent {where}: the methods get the {given}")
        oblique = any(support.direction is not None for support in self.supports)
        if oblique and isinstance(self.loads, Contact):
            raise ValueError(f"`supports.direction` must be absent {where}")
        for name in ("unseen_region", "paper_magnitude_n"):
            if getattr(self.tests, name) is not None:
                raise ValueError(f"`tests.{name}` must be absent {where}")
        return self

    @model_validator(mode="after")
    def _sampled_parameters(self) -> Self:
        """Check that the scene can take its sampled parameters."""
        if self.parameters is None:
            if "unseen_parameters" in self.tests.model_fields_set:
                raise ValueError(
                    "`tests.unseen_parameters` must be absent without the table `parameters`"
                )
            return self
        check_parameters_of(self.parameters, self.material)
        others = {
            "`loads.kind` is 'displacement'": isinstance(self.loads, Motion),
            "`loads.kind` is 'contact'": isinstance(self.loads, Contact),
            "several tables `[[loads]]` are given": isinstance(self.loads, Several),
            "`loads.steps` is above 1": self.loads is not None and self.loads.steps > 1,
            "`supports.direction` is given": any(
                support.direction is not None for support in self.supports
            ),
            "`observed` is given": self.observed is not None,
            "`needs.stress` is true": self.needs.stress,
            "`loads.follower` is true": isinstance(self.loads, Pressure) and self.loads.follower,
        }
        if found := [other for other, present in others.items() if present]:
            raise ValueError(f"`parameters` must be absent where {found[0]}")
        fixed_shape = {
            "the loads are pressures": isinstance(self.loads, Pressure),
            "the loads act on points or lines": isinstance(self.loads, PointLoads | LineLoads),
            "`springs` are given": bool(self.springs),
        }
        found = [other for other, present in fixed_shape.items() if present]
        if self.parameters.scale is not None and found:
            raise ValueError(f"`parameters.scale` must be absent where {found[0]}")
        return self

    @property
    def motion(self) -> Motion | None:
        """The table `[loads]` if it prescribes displacements."""
        return self.loads if isinstance(self.loads, Motion) else None

    @property
    def load_plan(self) -> AnyLoads:
        """The table `[loads]`, from which samples are drawn; `SpecError` if there is none."""
        if self.loads is None:
            raise SpecError(
                f"{self.name}: the table `loads` is missing, so no samples can be drawn."
            )
        return self.loads

    def physics(self) -> dict[str, Any]:
        dumped = self.model_dump(
            mode="json",
            include={
                "geometry",
                "discretisation",
                "material",
                "supports",
                "springs",
                "gravity",
                "loads",
                "parameters",
            },
            exclude_none=True,
        )
        physics: dict[str, Any] = without_paths(dumped)
        # Solvers agree only to the tolerance. The default solver stays out of the digest.
        return physics if self.solver == "auto" else {**physics, "solver": self.solver}


class SnapshotsFile(StrictModel):
    """A file with snapshots of another program, see `mor_bench.scene.snapshot_file`."""

    file: File


class ImportedDatasetSpec(CommonDatasetSpec):
    """A dataset file whose samples come from another program."""

    snapshots: SnapshotsFile
    split: ImportedSplit = ImportedSplit()

    @model_validator(mode="after")
    def _no_stress(self) -> Self:
        if self.needs.stress:
            raise ValueError("`needs.stress` must be absent: stresses need the equations")
        return self

    def physics(self) -> dict[str, Any]:
        physics: dict[str, Any] = without_paths(self.model_dump(mode="json", include={"snapshots"}))
        return physics


AnyDatasetSpec = DatasetSpec | ImportedDatasetSpec


def generated(spec: AnyDatasetSpec) -> DatasetSpec:
    """Return the specification if its samples are generated here.

    Raises
    ------
    UnsupportedSceneError
        If the samples were imported.
    """
    if isinstance(spec, ImportedDatasetSpec):
        raise UnsupportedSceneError(f"{spec.name}: {NO_EQUATIONS}.")
    return spec
