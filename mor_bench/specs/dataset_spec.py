"""A dataset file as a whole: generated samples, or samples imported from another program."""

from __future__ import annotations

import hashlib
import json
from math import prod
from typing import Annotated, Any, Self

from pydantic import (
    AfterValidator,
    Field,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)
from pydantic_core import InitErrorDetails

from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.specs.base import Name, Positive, StrictModel, Text
from mor_bench.specs.contradictions import FIXED_REGIONS, contradiction, contradictions
from mor_bench.specs.geometry_spec import Geometry
from mor_bench.specs.loads_spec import AnyLoads, LoadPlan, Motion
from mor_bench.specs.material_spec import Discretisation, MaterialSpec, SolverName
from mor_bench.specs.region_spec import Outputs, Region
from mor_bench.specs.sampled_parameters import SampledParameters
from mor_bench.specs.source_file import File, without_paths
from mor_bench.specs.split_spec import ExtraTests, ImportedSplit, Split
from mor_bench.specs.support_spec import ConstantPressure, Gravity, Spring, Support

MAX_NODES = 1_000_000
"""Largest number of nodes of the grid to which samples are interpolated."""

NO_EQUATIONS = "its snapshots were imported, so its equations are not known"
NO_FORCES = "its forces are not known, only the displacements of a part of its surface"
CONTACT = "an instrument presses it, and the method needs given forces"

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
    constant_pressures : tuple of ConstantPressure
        Pressures that are part of the pre-load, none by default.
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
    constant_pressures: Annotated[
        tuple[ConstantPressure, ...], Field(strict=False, exclude_if=lambda value: not value)
    ] = ()
    loads: LoadPlan | None = None
    parameters: SampledParameters | None = Field(
        default=None, exclude_if=lambda value: value is None
    )
    split: Annotated[Split, Field(validate_default=True)] = Split()
    tests: Annotated[ExtraTests, Field(validate_default=True)] = ExtraTests()

    @field_validator("split")
    @classmethod
    def _suits_loads(cls, split: Split, info: ValidationInfo) -> Split:
        """Split by sample where all samples act on the same regions, unless the file says more."""
        if isinstance(info.data.get("loads"), FIXED_REGIONS) and "by" not in split.model_fields_set:
            return split.model_copy(update={"by": "sample"})
        return split

    @field_validator("tests", mode="wrap")
    @classmethod
    def _no_contradictions(
        cls, value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo
    ) -> ExtraTests:
        """Check all valid tables against each other: this is the last one."""
        tables, problems = dict(info.data), []
        try:
            tables["tests"] = handler(value)
        except ValidationError as error:
            problems = [
                InitErrorDetails(
                    type=each["type"], loc=each["loc"], input=each["input"], ctx=each.get("ctx", {})
                )
                for each in error.errors(include_url=False)
            ]
        problems += [
            InitErrorDetails(type=contradiction(sentence), input=None)
            for sentence in contradictions(tables)
        ]
        if problems:
            raise ValidationError.from_exception_data(cls.__name__, problems)
        found: ExtraTests = tables["tests"]
        return found

    @property
    def motion(self) -> Motion | None:
        """The table `[loads]` if it prescribes displacements."""
        return self.loads if isinstance(self.loads, Motion) else None

    @property
    def is_preloaded(self) -> bool:
        """Whether gravity or constant pressures act before and during every load."""
        return self.gravity is not None or bool(self.constant_pressures)

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
                "constant_pressures",
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

    @field_validator("needs")
    @classmethod
    def _no_stress(cls, needs: Needs) -> Needs:
        if needs.stress:
            raise contradiction("`needs.stress` must be absent: stresses need the equations")
        return needs

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
