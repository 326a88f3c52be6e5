"""Dataset and method files: TOML read into validated, frozen specs, with one-line errors; and where the suite lies."""

from __future__ import annotations

import difflib
import hashlib
import inspect
import itertools
import json
import sys
import tomllib
import types
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)

from mor_bench.errors import MissingDependencyError, SpecError, UnsupportedSceneError

_M = TypeVar("_M", bound=BaseModel)

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Triple = Annotated[tuple[Finite, Finite, Finite], Field(strict=False)]


MAX_CELLS = 10_000_000
"""Cells of a mesh; more is a slip of the keyboard on the machines that this is for."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


Cells = Annotated[
    tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]],
    Field(strict=False),
]
Size = Annotated[tuple[Positive, Positive, Positive], Field(strict=False)]


class BoxGeometry(_Model):
    """A box of H8 cells with its lowest corner at the origin."""

    shape: Literal["box"]
    size_m: Size
    cells: Cells

    @field_validator("cells")
    @classmethod
    def _fits_in_memory(cls, value: tuple[int, int, int]) -> tuple[int, int, int]:
        if value[0] * value[1] * value[2] > MAX_CELLS:
            raise ValueError(f"there must be at most {MAX_CELLS:,} cells in all")
        return value


class LShapeGeometry(BoxGeometry):
    """A box without the cells in its corner of highest x and highest z: an arm along x, and a column on its end."""

    shape: Literal["l-shape"]  # type: ignore[assignment]
    cut_cells: Annotated[
        tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]], Field(strict=False)
    ]

    @model_validator(mode="after")
    def _leaves_an_l(self) -> LShapeGeometry:
        if self.cut_cells[0] >= self.cells[0] or self.cut_cells[1] >= self.cells[2]:
            raise ValueError(
                f"`cut_cells` must be less than the {self.cells[0]} cells along x and the {self.cells[2]} along z; got {self.cut_cells}"
            )
        return self


class SourceFile(_Model):
    """A file that a dataset is made from, bound to its content; in a TOML it is written as its path alone.

    Attributes
    ----------
    path : str
        Absolute; it does not enter a dataset's digest.
    sha256 : str
        Of the content.
    """

    path: str
    sha256: str

    def checked(self) -> Path:
        """The path of the file, after a look whether its content is what it was.

        Raises
        ------
        SpecError
            If the file is missing, a device or pipe, or has changed.
        """
        if _sha256(Path(self.path)) != self.sha256:
            raise SpecError(f"{self.path}: the file has changed since the dataset was read.")
        return Path(self.path)


def _sha256(path: Path) -> str:
    try:
        if path.exists() and not path.is_file() and not path.is_dir():  # it might never end
            raise SpecError(f"{path}: a device or pipe, not a file.")
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except FileNotFoundError:
        raise SpecError(f"{path}: no such file.") from None
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}.") from None


def _source_file(value: Any, info: ValidationInfo) -> Any:
    """A path, relative to the folder of the TOML, as a `SourceFile`."""
    if not isinstance(value, str):
        return value
    path = (Path(info.context or ".") / value).resolve()
    return {"path": str(path), "sha256": _sha256(path)}


File = Annotated[SourceFile, BeforeValidator(_source_file)]


def _surface(value: Any, info: ValidationInfo) -> Any:
    return value if value == "liver" else _source_file(value, info)


class VoxelsGeometry(_Model):
    """A closed surface filled with a sparse grid of H8: the cells of its bounding box's regular grid that overlap it.

    Attributes
    ----------
    surface : "liver" or SourceFile
        The two-lobed liver that comes with the package, or an STL or OBJ file.
    cells : three ints
        Of the whole grid, per axis.
    unit_m : float
        Length of the file's unit, m.
    """

    shape: Literal["voxels"]
    surface: Annotated[Literal["liver"] | SourceFile, BeforeValidator(_surface)]
    cells: Cells
    unit_m: Positive = 1.0

    _fits_in_memory = field_validator("cells")(BoxGeometry._fits_in_memory.__func__)  # type: ignore[attr-defined]


class TetrahedraGeometry(_Model):
    """The two-lobed liver that comes with the package, meshed with T4 of about one size."""

    shape: Literal["tetrahedra"]
    surface: Literal["liver"]


class FileGeometry(_Model):
    """The H8 or T4 cells of a mesh file that meshio reads: Gmsh, VTK, VTU, Abaqus and others.

    Attributes
    ----------
    file : SourceFile
    unit_m : float
        Length of the file's unit, m.
    """

    shape: Literal["file"]
    file: File
    unit_m: Positive = 1.0


Geometry = Annotated[
    BoxGeometry | LShapeGeometry | VoxelsGeometry | TetrahedraGeometry | FileGeometry,
    Field(discriminator="shape"),
]


class Discretisation(_Model):
    """The elements. Selective integration takes the volumetric part of the energy from each hexahedron's mean gradient."""

    element: Literal["hexahedron", "tetrahedron"] = "hexahedron"
    integration: Literal["full", "selective"] = "full"

    @model_validator(mode="after")
    def _has_points_to_spare(self) -> Discretisation:
        if self.element == "tetrahedron" and self.integration == "selective":
            raise ValueError(
                "`integration` of tetrahedra must be 'full', since they have one quadrature point; got 'selective'"
            )
        return self


SolverName = Literal["auto", "rotated-pcg", "jacobi-pcg", "cholesky", "superlu", "pardiso"]
"""How equilibria are solved, see `mor_bench.mechanics.model`."""


class TwoLameMaterial(_Model):
    """Saint Venant-Kirchhoff or compressible neo-Hookean, from Young's modulus and Poisson's ratio."""

    law: Literal["saint-venant-kirchhoff", "neo-hookean"]
    young_pa: Positive
    poisson: Annotated[float, Field(gt=-1, lt=0.5)]


class MooneyRivlinMaterial(_Model):
    """Mooney-Rivlin with a quadratic volumetric energy."""

    law: Literal["mooney-rivlin"]
    c10_pa: Positive
    c01_pa: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    bulk_pa: Positive


class OgdenMaterial(_Model):
    """Ogden with a quadratic volumetric energy; every term needs mu_p alpha_p > 0."""

    law: Literal["ogden"]
    mu_pa: Annotated[tuple[Finite, ...], Field(strict=False, min_length=1)]
    alpha: Annotated[tuple[Finite, ...], Field(strict=False, min_length=1)]
    bulk_pa: Positive

    @model_validator(mode="after")
    def _stable_terms(self) -> OgdenMaterial:
        if len(self.mu_pa) != len(self.alpha):
            raise ValueError(
                f"`mu_pa` and `alpha` must have equal lengths; got {len(self.mu_pa)} and {len(self.alpha)}"
            )
        if not all(mu * alpha > 0 for mu, alpha in zip(self.mu_pa, self.alpha, strict=True)):
            raise ValueError(
                f"every product of `mu_pa` and `alpha` must be > 0; got {self.mu_pa} and {self.alpha}"
            )
        return self


MaterialSpec = Annotated[
    TwoLameMaterial | MooneyRivlinMaterial | OgdenMaterial, Field(discriminator="law")
]


class BoxRegion(_Model):
    """The nodes inside an axis-aligned box, from its lowest to its highest corner, m."""

    box_m: Annotated[tuple[Triple, Triple], Field(strict=False)]


class SphereRegion(_Model):
    """The nodes inside a sphere: centre and radius, m."""

    sphere_m: Annotated[tuple[Triple, Positive], Field(strict=False)]


class NearestRegion(_Model):
    """The nodes of the surface nearest to a point: its position, m, and their number."""

    nearest_m: Annotated[tuple[Triple, Annotated[int, Field(ge=1)]], Field(strict=False)]


class PointSetRegion(_Model):
    """A named set of nodes of the mesh file."""

    point_set: str


class NearSurfaceRegion(_Model):
    """The nodes of the surface that lie near another surface, open or closed, of an STL or OBJ file."""

    near_surface: File
    within_m: Positive
    unit_m: Positive = 1.0


NamedRegion = Literal["x-min", "x-max", "y-min", "y-max", "z-min", "z-max", "surface"]

_REGIONS: dict[str, type[BaseModel]] = {
    "box_m": BoxRegion,
    "sphere_m": SphereRegion,
    "nearest_m": NearestRegion,
    "point_set": PointSetRegion,
    "near_surface": NearSurfaceRegion,
}


def _kind_of_region(value: Any) -> str:
    for key, kind in _REGIONS.items():
        if isinstance(value, kind) or (isinstance(value, Mapping) and key in value):
            return f"by {key}"
    return "by box_m" if isinstance(value, Mapping) else "name"


_Placed = (
    Annotated[BoxRegion, Tag("by box_m")]
    | Annotated[SphereRegion, Tag("by sphere_m")]
    | Annotated[NearestRegion, Tag("by nearest_m")]
    | Annotated[PointSetRegion, Tag("by point_set")]
    | Annotated[NearSurfaceRegion, Tag("by near_surface")]
)
Region = Annotated[Annotated[NamedRegion, Tag("name")] | _Placed, Discriminator(_kind_of_region)]
Outputs = Annotated[
    Annotated[Literal["all"] | NamedRegion, Tag("name")] | _Placed, Discriminator(_kind_of_region)
]
_BRANCHES = {
    "geometry": ("box", "l-shape", "voxels", "tetrahedra", "file"),
    "region": ("name", *(f"by {key}" for key in _REGIONS)),
    "unseen_region": ("name", *(f"by {key}" for key in _REGIONS)),
    "outputs": ("name", *(f"by {key}" for key in _REGIONS)),
    "material": ("saint-venant-kirchhoff", "neo-hookean", "mooney-rivlin", "ogden"),
}
"""Steps that pydantic puts into an error's location to say which alternative of a key it took."""


class Support(_Model):
    """A region whose nodes do not move."""

    region: Region


LoadKind = Literal["force", "normal", "tangential"]

Sampling = Literal["random", "latin-hypercube", "sobol"]


class Loads(_Model):
    """Forces on patches of the surface, and how they are drawn; see `mor_bench.snapshots.sampling`.

    Attributes
    ----------
    region : Region
        Where patches may lie.
    kind : str
        `force`: directions uniform on the sphere. `normal`: along the surface's normal, inwards or outwards.
        `tangential`: across it.
    patch_area_m2 : float
        Of each patch, m².
    n_patches : int, optional
        So many patches, spread evenly over the region away from the supports; by default one around each node of the region.
    simultaneous : int
        Patches that are loaded at once.
    min_distance_m : float, optional
        Between the centres of patches that are loaded at once; needed with more than one.
    samples_per_patch, samples : int, optional
        Exactly one of them. With `samples` patches, or combinations of them, come in random order, each as often as the others.
    magnitude_n : two floats
        Range of each force, N.
    sampling : str
        Plan for directions and magnitudes.
    seed : int
    """

    region: Region
    kind: LoadKind
    patch_area_m2: Positive
    n_patches: Annotated[int, Field(ge=1)] | None = None
    simultaneous: Annotated[int, Field(ge=1, le=8)] = 1
    min_distance_m: Positive | None = None
    samples_per_patch: Annotated[int, Field(ge=1)] | None = None
    samples: Annotated[int, Field(ge=1)] | None = None
    magnitude_n: Annotated[
        tuple[
            Annotated[float, Field(ge=0, allow_inf_nan=False)],
            Annotated[float, Field(ge=1e-12, le=1e12)],
        ],
        Field(strict=False),
    ]
    sampling: Sampling = "random"
    seed: Annotated[int, Field(ge=0)] = 0

    @field_validator("magnitude_n")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] > value[1]:
            raise ValueError("the lower bound must not exceed the upper one")
        return value

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
                f"`min_distance_m` must be given with `simultaneous` > 1 and only then; got `simultaneous` {self.simultaneous}"
            )
        if self.kind == "normal" and self.magnitude_n[0] == self.magnitude_n[1]:
            raise ValueError(
                f"`magnitude_n` of normal forces must be a range, or samples would repeat; got {self.magnitude_n}"
            )
        return self


SplitBy = Literal["region", "sample", "direction"]


class Split(_Model):
    """Which samples are kept for the test; see `mor_bench.snapshots.dataset.split_samples`."""

    test_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.2
    by: SplitBy = "region"


class ExtraTests(_Model):
    """The named test sets beside the main one; see `mor_bench.snapshots.test_sets`.

    Attributes
    ----------
    samples : int
        In each.
    unseen_region : Region, optional
        A part of the surface where no load of the main set acts.
    """

    samples: Annotated[int, Field(ge=1)] = 200
    unseen_region: Region | None = None


class Needs(_Model):
    """What the scene's user wants.

    Attributes
    ----------
    outputs : "all" or Region
        The nodes whose displacements are wanted: errors count these alone, and a reduced method computes no others.
    error : float
        Relative l2 over the wanted nodes, median over the test set.
    latency_ms : float
        Of one query, median.
    """

    outputs: Outputs = "all"
    error: Positive
    latency_ms: Positive


class Observed(_Model):
    """What is known of a scene whose forces are not: the displacements of a part of the surface.

    Attributes
    ----------
    region : Region
        Of its nodes those that lie on the surface and are free to move are observed.
    """

    region: Region


Side = Annotated[int, Field(ge=2, le=1024)]


def _without_paths(value: Any) -> Any:
    """A copy in which a file is known by its content, wherever it lies."""
    if isinstance(value, dict):
        return {
            key: _without_paths(item)
            for key, item in value.items()
            if not (key == "path" and "sha256" in value)
        }
    return [_without_paths(item) for item in value] if isinstance(value, list) else value


class _AnyDataset(_Model):
    """What every dataset file has.

    `grid_nodes` are the nodes per axis of the regular grid for methods that need one, where the mesh lies in none. With
    `observed` methods are given displacements of some nodes in the place of forces; the samples stay the same.
    """

    name: str
    title: str
    source: str
    needs: Needs
    grid_nodes: Annotated[tuple[Side, Side, Side], Field(strict=False)] | None = None
    observed: Observed | None = Field(default=None, exclude_if=lambda value: value is None)

    def physics(self) -> dict[str, Any]:
        """All that decides the samples: two datasets with equal physics have equal snapshots."""
        raise NotImplementedError

    def digest(self) -> str:
        """Twelve hexadecimal digits of SHA-256 over `physics`."""
        return hashlib.sha256(json.dumps(self.physics(), sort_keys=True).encode()).hexdigest()[:12]


class DatasetSpec(_AnyDataset):
    """A dataset file whose samples the full-order model generates."""

    geometry: Geometry
    discretisation: Discretisation = Discretisation()
    solver: SolverName = "auto"
    material: MaterialSpec
    supports: Annotated[tuple[Support, ...], Field(strict=False)] = ()
    loads: Loads
    split: Split = Split()
    tests: ExtraTests = ExtraTests()

    def physics(self) -> dict[str, Any]:
        dumped = self.model_dump(
            mode="json",
            include={"geometry", "discretisation", "material", "supports", "loads"},
            exclude_none=True,
        )
        physics: dict[str, Any] = _without_paths(dumped)
        # Solvers agree to the tolerance only; the default one leaves no trace.
        return physics if self.solver == "auto" else {**physics, "solver": self.solver}


class SnapshotsFile(_Model):
    """Arrays of snapshots from another program, see `mor_bench.scene.snapshot_file`."""

    file: File


class ImportedSplit(_Model):
    """Which imported samples are kept for the test: as `Split`, or by the file's own array `test`."""

    test_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.2
    by: Literal["region", "sample", "direction", "file"] = "region"


class ImportedDatasetSpec(_AnyDataset):
    """A dataset file whose samples come from another program."""

    snapshots: SnapshotsFile
    split: ImportedSplit = ImportedSplit()

    def physics(self) -> dict[str, Any]:
        physics: dict[str, Any] = _without_paths(
            self.model_dump(mode="json", include={"snapshots"})
        )
        return physics


AnyDatasetSpec = DatasetSpec | ImportedDatasetSpec

NO_EQUATIONS = "its snapshots were imported, so its equations are not known"
NO_FORCES = "its forces are not known, only the displacements of a part of its surface"


def generated(spec: AnyDatasetSpec) -> DatasetSpec:
    """The spec itself, if its samples are generated here.

    Raises
    ------
    UnsupportedSceneError
        If they were imported.
    """
    if isinstance(spec, ImportedDatasetSpec):
        raise UnsupportedSceneError(f"{spec.name}: {NO_EQUATIONS}.")
    return spec


class Profile(_Model):
    """What a profile changes: parameters replaced, swept values replaced, seconds of a fit."""

    parameters: dict[str, Any] = {}
    sweep: dict[str, list[Any]] = {}
    fit_s: Positive | None = None


class Regime(_Model):
    """What a method was built for; a comparison without it says nothing final about the method.

    `says` is that in words; `min_dofs`, `min_train` and `min_iterations` the least degrees of freedom, training samples and
    iterations; `split` how training and test are parted; `gpu` whether it needs a graphics processor.
    """

    says: str
    min_dofs: Annotated[int, Field(ge=1)] | None = None
    min_train: Annotated[int, Field(ge=1)] | None = None
    min_iterations: Annotated[int, Field(ge=1)] | None = None
    split: SplitBy | None = None
    gpu: bool = False


class MethodSpec(_Model):
    """A method file. `limits` says in plain words where the method fails.

    `folder` is where the file lies, and a third party's module may; None for the suite's own. `fit_s` is about how long a fit
    on beam-coarse takes on two cores.
    """

    name: str
    title: str
    surrogate: str
    source: str
    limits: str = ""
    regime: Regime | None = None
    folder: Path | None = None
    fit_s: Positive | None = None
    parameters: dict[str, Any] = {}
    sweep: dict[str, list[Any]] = {}
    profiles: dict[Literal["quick", "full"], Profile] = {}

    @field_validator("surrogate")
    @classmethod
    def _importable(cls, value: str) -> str:
        module, _, name = value.partition(":")
        if not module or not name:
            raise ValueError("it must read `package.module:Class`")
        return value

    @model_validator(mode="after")
    def _no_empty_sweep(self) -> MethodSpec:
        for sweep in (self.sweep, *(profile.sweep for profile in self.profiles.values())):
            for key, values in sweep.items():
                if not values:
                    raise ValueError(f"the sweep of `{key}` is empty")
        return self

    def load_class(self) -> type[Any]:
        """Import the surrogate's class, from beside its file if it lies there."""
        return load_class(self.surrogate, self.folder)

    def parameters_of(self, profile: str) -> dict[str, Any]:
        """The file's parameters with the profile's on top, swept ones not included."""
        chosen = self.profiles.get(profile, Profile())  # type: ignore[call-overload]
        return {**self.parameters, **chosen.parameters}

    def fit_seconds(self, profile: str) -> float | None:
        """About how long a fit takes on beam-coarse on two cores, if the file says so."""
        return self.profiles.get(profile, Profile()).fit_s or self.fit_s  # type: ignore[call-overload]

    def _sweep_of(self, profile: str) -> dict[str, list[Any]]:
        return self.profiles.get(profile, Profile()).sweep or self.sweep  # type: ignore[call-overload]

    def swept_keys(self, profile: str) -> list[str]:
        """The parameters that the profile's sweep, or else the file's, varies."""
        return list(self._sweep_of(profile))

    def configurations(self, profile: str) -> list[dict[str, Any]]:
        """The parameters of every swept configuration, first key slowest."""
        sweep = self._sweep_of(profile)
        return [
            {**self.parameters_of(profile), **dict(zip(sweep, row, strict=True))}
            for row in itertools.product(*sweep.values())
        ]


def load_class(target: str, folder: Path | None = None) -> type[Any]:
    """Import ``package.module:Class``, also from a folder that is not on the import path.

    Raises
    ------
    MissingDependencyError
        If an optional dependency is not installed; the message names the extra.
    SpecError
        If the module or the class does not exist.
    """
    module, _, name = target.partition(":")
    if folder is not None and str(folder) not in sys.path:
        sys.path.append(str(folder))
    try:
        loaded = import_module(module)
    except ModuleNotFoundError as error:
        if error.name == "torch":
            raise MissingDependencyError(
                f"{target} needs torch: pip install 'mor-bench[learn]'"
            ) from error
        raise SpecError(f"surrogate {target!r} cannot be imported: {error}") from error
    if not hasattr(loaded, name):
        raise SpecError(
            f"surrogate {target!r}: module {module!r} has no class {name!r}{_nearest(name, dir(loaded))}"
        )
    found = getattr(loaded, name)
    if not isinstance(found, type):
        raise SpecError(f"surrogate {target!r} is not a class.")
    return found


def _nearest(name: str, valid: Any) -> str:
    close = difflib.get_close_matches(name, list(valid), n=1)
    return f"; did you mean {close[0]!r}?" if close else "."


def _models_within(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models that an annotation mentions, however nested."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    elif get_origin(annotation) in (Annotated, Union, types.UnionType, tuple, list, dict):
        for part in get_args(annotation):
            yield from _models_within(part)


def _is_branch(model: type[BaseModel], step: int | str) -> bool:
    """Whether a step of an error's location is the alternative that a model stands for: a region's key, or a shape or law."""
    named = isinstance(step, str) and step.removeprefix("by ") in model.model_fields
    return named or any(
        step in get_args(field.annotation)
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
    )


def _valid_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The keys that the table at a location may hold."""
    models = [model]
    for step in location:
        fields = [
            m.model_fields[step].annotation
            for m in models
            if isinstance(step, str) and step in m.model_fields
        ]
        within = [found for field in fields for found in _models_within(field)]
        models = within if fields else [m for m in models if _is_branch(m, step)] or models
    return sorted({key for m in models for key in m.model_fields if key != "name"})


def _one_line(error: ValidationError, model: type[BaseModel], where: str) -> str:
    """The first problem of a validation, as one line: file, key, what is allowed, what came."""
    problems = error.errors(include_url=False)
    unknown = [p for p in problems if p["type"] == "extra_forbidden"]
    problem = (unknown or problems)[0]
    location = problem["loc"]
    shown = [
        s
        for i, s in enumerate(location)
        if not (i and s in _BRANCHES.get(str(location[i - 1]), ()))
    ]
    key = "".join(f"[{s}]" if isinstance(s, int) else f".{s}" for s in shown).lstrip(".")
    if problem["type"] == "extra_forbidden":
        valid = _valid_keys(model, problem["loc"][:-1])
        if shown[-1] in _REGIONS:
            return f"{where}: `{key}` cannot stand beside another key of a region. Allowed here: {', '.join(valid)}."
        return f"{where}: unknown key `{key}`{_nearest(str(shown[-1]), valid)} Allowed here: {', '.join(valid)}."
    if problem["type"] == "union_tag_invalid":
        context = problem["ctx"]
        *others, last = context["expected_tags"].split(", ")
        return f"{where}: `{key}.{context['discriminator'].strip(chr(39))}` must be {', '.join(others)} or {last}; got {context['tag']!r}."
    if problem["type"] == "union_tag_not_found":
        return f"{where}: key `{key}.{problem['ctx']['discriminator'].strip(chr(39))}` is missing."
    if problem["type"] == "missing":
        return f"{where}: key `{key}` is missing."
    message = (
        problem["msg"].removeprefix("Value error, ").removeprefix("Input should be ").rstrip(".")
    )
    alternatives = [
        p
        for p in problems
        if p["loc"][:1] == location[:1] and p["msg"].startswith("Input should be ")
    ]
    if (
        len(location) == 2
        and len(alternatives) > 1
        and not list(_models_within(model.model_fields[str(location[0])].annotation))
    ):
        # A knob of several types: each alternative has a problem, and a step of its own in the location.
        key, message = (
            str(location[0]),
            " or ".join(p["msg"].removeprefix("Input should be ") for p in alternatives),
        )
    came = "" if problem["type"] == "value_error" and not key else f"; got {problem['input']!r}"
    return (
        f"{where}: `{key}` must be {message}{came}."
        if problem["msg"].startswith("Input should")
        else f"{where}: `{key}`: {message}{came}."
    )


def _validated(
    model: type[_M], content: Mapping[str, Any], where: str, folder: Path | None = None
) -> _M:
    try:
        return model.model_validate(dict(content), context=folder)
    except ValidationError as error:
        raise SpecError(_one_line(error, model, where)) from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SpecError(f"{path}: no such file.") from None
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SpecError(f"{path}: not valid TOML: {error}") from None


def find_suite(suite: Path | None = None) -> Path:
    """The folder that holds ``datasets/`` and ``methods/``: the one given, the installed one, or the checkout's.

    Raises
    ------
    SpecError
        If the folder has neither.
    """
    package = Path(__file__).parents[1]
    places = [suite] if suite is not None else [package / "suite", package.parent]
    for place in places:
        if (place / "datasets").is_dir() or (place / "methods").is_dir():
            return place
    raise SpecError(f"{places[0]}: a suite must hold a folder `datasets` or `methods`.")


def list_suite(kind: Literal["datasets", "methods"], suite: Path | None = None) -> dict[str, Path]:
    """Names and files of the suite's datasets or methods, sorted by name."""
    return {
        path.stem: path
        for path in sorted((find_suite(suite) / kind).glob("*.toml"), key=lambda path: path.stem)
    }


def _resolve(kind: Literal["datasets", "methods"], source: str | Path, suite: Path | None) -> Path:
    if isinstance(source, Path) or source.endswith(".toml"):
        return Path(source)
    known = list_suite(kind, suite)
    if source not in known and suite is not None:
        known = {**list_suite(kind), **known}
    if source not in known:
        raise SpecError(
            f"unknown {kind[:-1]} {source!r}{_nearest(source, known)} Known: {', '.join(known)}."
        )
    return known[source]


def load_dataset_spec(
    source: str | Path | Mapping[str, Any], suite: Path | None = None
) -> AnyDatasetSpec:
    """Read and validate a dataset: a name in the suite, the path of a TOML, or a dict with the same keys.

    One with a table `snapshots` is an imported one.
    """
    if not isinstance(source, str | Path | Mapping):
        raise SpecError(
            f"a dataset must be a name, the path of a TOML or a dict; got {type(source).__name__}."
        )
    if isinstance(source, Mapping):
        content = {"name": "scene", **source}
        return _validated_dataset({"title": content["name"], "source": "", **content}, "scene")
    path = _resolve("datasets", source, suite)
    return _validated_dataset({**_read_toml(path), "name": path.stem}, str(path), path.parent)


def _validated_dataset(
    content: Mapping[str, Any], where: str, folder: Path | None = None
) -> AnyDatasetSpec:
    if "snapshots" in content:
        return _validated(ImportedDatasetSpec, content, where, folder)
    return _validated(DatasetSpec, content, where, folder)


def load_generated_spec(
    source: str | Path | Mapping[str, Any], suite: Path | None = None
) -> DatasetSpec:
    """As `load_dataset_spec`, of a dataset whose samples are generated here.

    Raises
    ------
    SpecError
        If the dataset is not valid.
    UnsupportedSceneError
        If its samples were imported.
    """
    return generated(load_dataset_spec(source, suite))


def is_method_file(path: Path) -> bool:
    """Whether a TOML describes a method, which names a `surrogate`, rather than a dataset."""
    return "surrogate" in _read_toml(path) or path.resolve().parent.name == "methods"


def load_method_spec(source: str | Path, suite: Path | None = None) -> MethodSpec:
    """Read and validate a method: a name in the suite or the path of a TOML."""
    path = _resolve("methods", source, suite)
    content = _read_toml(path)
    folder = (
        None
        if str(content.get("surrogate", "")).startswith("mor_bench.")
        else path.parent.resolve()
    )
    return _validated(MethodSpec, {**content, "name": path.stem, "folder": folder}, str(path))


def check_parameters(
    surrogate: type[Any], parameters: Mapping[str, Any], where: str | None = None
) -> dict[str, Any]:
    """Check knobs against the annotations of a surrogate's ``__init__`` and fill in its defaults.

    The annotations may carry pydantic's `Field` constraints, e.g. ``Annotated[int, Field(ge=1)]``.

    Raises
    ------
    SpecError
        If a knob is unknown, of the wrong type, or out of range.
    """
    if surrogate.__init__ is object.__init__:
        fields: dict[str, Any] = {}
    else:
        hints = get_type_hints(surrogate.__init__, include_extras=True)
        knobs = list(inspect.signature(surrogate.__init__).parameters.values())[1:]
        fields = {
            knob.name: (
                hints.get(knob.name, Any),
                ... if knob.default is knob.empty else knob.default,
            )
            for knob in knobs
        }
    model = create_model(
        surrogate.__name__, __config__=ConfigDict(extra="forbid", strict=True), **fields
    )
    return _validated(model, parameters, where or surrogate.__name__).model_dump()


def check_method(spec: MethodSpec) -> None:
    """Check every configuration of a method, in both profiles, against its class.

    Raises
    ------
    SpecError, MissingDependencyError
    """
    surrogate = spec.load_class()
    for profile in ("quick", "full"):
        for configuration in spec.configurations(profile):
            check_parameters(surrogate, configuration, f"method {spec.name} ({profile})")
