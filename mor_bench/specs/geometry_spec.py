"""Table `[geometry]` of a dataset file: the shapes that can be meshed."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from mor_bench.specs.base import Count, Length, StrictModel
from mor_bench.specs.source_file import File, SourceFile, read_source_file

MAX_CELLS = 400_000
"""Largest number of cells of a grid, with 1.2 million unknowns."""


LIVER_SPACING_M = 0.013
"""Default spacing of the liver's tetrahedra, which gives 4,567 cells."""


def _fits_in_memory(value: tuple[int, int, int]) -> tuple[int, int, int]:
    if value[0] * value[1] * value[2] > MAX_CELLS:
        raise ValueError(f"there must be at most {MAX_CELLS:,} cells in all")
    return value


Cells = Annotated[tuple[Count, Count, Count], Field(strict=False), AfterValidator(_fits_in_memory)]
Size = Annotated[tuple[Length, Length, Length], Field(strict=False)]


class BoxGeometry(StrictModel):
    """A box of H8 cells with its lowest corner at the origin."""

    shape: Literal["box"]
    size_m: Size
    cells: Cells


class LShapeGeometry(BoxGeometry):
    """A box without the cells in its corner of highest x and highest z."""

    shape: Literal["l-shape"]  # type: ignore[assignment]
    cut_cells: Annotated[tuple[Count, Count], Field(strict=False)]

    @model_validator(mode="after")
    def _leaves_an_l(self) -> LShapeGeometry:
        if self.cut_cells[0] >= self.cells[0] or self.cut_cells[1] >= self.cells[2]:
            raise ValueError(
                f"`cut_cells` must be less than the {self.cells[0]} cells along x and "
                f"the {self.cells[2]} along z; got {self.cut_cells}"
            )
        return self


CellRange = Annotated[
    tuple[
        Annotated[tuple[Count, Count, Count], Field(strict=False)],
        Annotated[tuple[Count, Count, Count], Field(strict=False)],
    ],
    Field(strict=False),
]


class ChamberedGeometry(BoxGeometry):
    """A box of H8 cells around closed chambers, such as a soft robot's.

    The walls of the first chamber are the set of nodes `chamber-a`, and so on.

    Attributes
    ----------
    size_m, cells
        As of a box.
    chambers : list of two times three ints
        For each chamber: the numbers of cells before its begin and up to its end, per axis. A cell
        or more lies between chambers, and between a chamber and the outside.
    """

    shape: Literal["chambered-box"]  # type: ignore[assignment]
    chambers: Annotated[tuple[CellRange, ...], Field(strict=False, min_length=1, max_length=8)]

    @model_validator(mode="after")
    def _has_walls(self) -> ChamberedGeometry:
        for i, (low, high) in enumerate(self.chambers):
            inside = all(0 < a < b < n for a, b, n in zip(low, high, self.cells, strict=True))
            if not inside:
                raise ValueError(
                    f"`chambers` must lie inside of the {self.cells} cells, each with a begin "
                    f"below its end and a wall around it; got {[low, high]}"
                )
            for other_low, other_high in self.chambers[:i]:
                if all(
                    a <= d and c <= b
                    for a, b, c, d in zip(low, high, other_low, other_high, strict=True)
                ):
                    raise ValueError(
                        "`chambers` must have a wall between each other; "
                        f"got {[other_low, other_high]} and {[low, high]}"
                    )
        return self


class TubeGeometry(StrictModel):
    """A tube of H8 cells along the z axis, or a sector of one that begins at the x axis.

    Its sets of nodes `inner` and `outer` are regions.

    Attributes
    ----------
    radii_m : two floats
        Inner and outer radius.
    length_m : float
    angle_deg : float
        Angle of the sector, in (0, 360]; the whole tube by default.
    cells : three ints
        Cells across the wall, around and along the axis. A whole tube has at least 3 around.
    """

    shape: Literal["tube"]
    radii_m: Annotated[tuple[Length, Length], Field(strict=False)]
    length_m: Length
    angle_deg: Annotated[float, Field(gt=0, le=360)] = 360.0
    cells: Cells

    @model_validator(mode="after")
    def _has_a_wall(self) -> TubeGeometry:
        inner, outer = self.radii_m
        if inner >= outer:
            raise ValueError(
                f"the inner radius of `radii_m` must be less than the outer one; got {self.radii_m}"
            )
        if self.angle_deg / self.cells[1] > 120:
            raise ValueError(
                "`cells` around the axis must cover at most 120 degrees each; "
                f"got {self.cells[1]} for {self.angle_deg:g} degrees"
            )
        return self


def _surface(value: Any, info: ValidationInfo) -> Any:
    return value if value == "liver" else read_source_file(value, info)


class VoxelsGeometry(StrictModel):
    """The H8 cells of a regular grid that overlap the inside of a closed surface.

    Attributes
    ----------
    surface : "liver" or SourceFile
        The two-lobed liver that comes with the package, or an STL or OBJ file.
    cells : three ints
        Cells of the whole grid over the surface's bounding box, per axis.
    unit_m : float
        Length of the file's unit, m.
    """

    shape: Literal["voxels"]
    surface: Annotated[Literal["liver"] | SourceFile, BeforeValidator(_surface)]
    cells: Cells
    unit_m: Length = 1.0


class TetrahedraGeometry(StrictModel):
    """The two-lobed liver that comes with the package, meshed with tetrahedra of about one size.

    Attributes
    ----------
    spacing_m : float
        Edge of the cubes that the tetrahedra come from. A third of the tetrahedra have an edge of
        this length.
    """

    shape: Literal["tetrahedra"]
    surface: Literal["liver"]
    spacing_m: Annotated[
        float, Field(ge=0.008, le=0.03, exclude_if=lambda value: value == LIVER_SPACING_M)
    ] = LIVER_SPACING_M


class FileGeometry(StrictModel):
    """The H8 or T4 cells of a mesh file that meshio reads: Gmsh, VTK, VTU, Abaqus and others.

    Attributes
    ----------
    file : SourceFile
    unit_m : float
        Length of the file's unit, m.
    """

    shape: Literal["file"]
    file: File
    unit_m: Length = 1.0


Geometry = Annotated[
    BoxGeometry
    | LShapeGeometry
    | ChamberedGeometry
    | TubeGeometry
    | VoxelsGeometry
    | TetrahedraGeometry
    | FileGeometry,
    Field(discriminator="shape"),
]
