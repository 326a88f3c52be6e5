"""Every option of a run and of a single fit, declared once with its range, default and description.

`mor_bench.run`, `mor_bench.fit`, the dry run and the command line all read these models. An option
that changes results also stands in `RunContext.recorded`, which a resumed run compares. A bad value
or an unknown name raises one clear `InvalidInputError`.

>>> RunOptions(seeds=0)
Traceback (most recent call last):
mor_bench.options.InvalidOptionError: `seeds` must be an integer in [1, 100]; got 0.
>>> RunOptions(sed=3)  # doctest: +ELLIPSIS
Traceback (most recent call last):
mor_bench.options.InvalidOptionError: unknown option `sed`; did you mean 'seeds'? Options: ...
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal, Self, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic.fields import FieldInfo

from mor_bench.errors import InvalidInputError
from mor_bench.machine import usable_cores
from mor_bench.specs.base import MAX_COUNT
from mor_bench.specs.one_line_errors import nearest_name
from mor_bench.specs.parameters import python_number
from mor_bench.specs.split_spec import SplitBy

Device = Literal["auto", "cpu", "cuda"]
Profile = Literal["quick", "full"]

CORES = usable_cores()


@dataclass(frozen=True)
class CommandLine:
    """Appearance of an option on the command line.

    Attributes
    ----------
    flag : str
        Name of the flag. Default: the option's name with hyphens.
    short : str
        Short name of the flag, such as ``-q``.
    metavar : str or None
        Placeholder of the value in the help.
    default : str or None
        Description of a default that depends on something else.
    scale : float
        Factor from the number on the command line to the option's value.
    panel : str
        Heading in the help; that of the class which declares the option.
    """

    flag: str = ""
    metavar: str | None = None
    default: str | None = None
    scale: float = 1.0
    panel: str = ""
    short: str = ""


Cluster = Annotated[
    str | None,
    Field(description="Dask scheduler, tcp://host:port; its workers generate samples and fit."),
    CommandLine(metavar="ADDRESS"),
]


class InvalidOptionError(InvalidInputError):
    """The value of an option is out of range, or there is no such option; ``option`` names it."""

    def __init__(self, message: str, option: str) -> None:
        super().__init__(message)
        self.option = option


class Options(BaseModel):
    """A frozen group of options, checked at construction.

    `panel` is the heading in the help of the options that a class declares.
    """

    panel: ClassVar[str] = "Options"

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _truth_values_are_for_flags(cls, value: Any, info: ValidationInfo) -> Any:
        is_flag = cls.model_fields[str(info.field_name)].annotation is bool
        if value is not None and isinstance(value, bool) != is_flag:
            raise ValueError("true and false are the values of flags, and of nothing else")
        return python_number(value)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            name = str(problem["loc"][0])
            raise InvalidOptionError(self._message(name, values), name) from None

    @classmethod
    def from_command_line(cls, given: dict[str, Any]) -> Self:
        """Make the options from values in the units of the command line; errors name flags."""
        shown = {name: line for name, _, line in command_line(cls)}
        scaled = {name: line.scale for name, line in shown.items() if line.scale != 1}
        values = {
            name: value * scaled[name] if name in scaled and value is not None else value
            for name, value in given.items()
        }
        try:
            return cls(**values)
        except InvalidOptionError as error:
            line = shown[error.option]
            allowed = allowed_values(cls.model_fields[error.option], line.scale)
            unit = f" {line.metavar}" if line.scale != 1 else ""
            raise InvalidOptionError(
                f"`{line.flag}` must be {allowed}{unit}; got {given[error.option]!r}.", error.option
            ) from None

    @classmethod
    def _message(cls, name: str, values: dict[str, Any]) -> str:
        field = cls.model_fields.get(name)
        if field is None:
            hint = nearest_name(name, cls.model_fields)
            return f"unknown option `{name}`{hint} Options: {', '.join(cls.model_fields)}."
        return f"`{name}` must be {allowed_values(field)}; got {values[name]!r}."


class FolderOptions(Options):
    """Folders that every command with data uses."""

    panel: ClassVar[str] = "Folders"

    cache: Annotated[
        Path | None,
        Field(description="Folder for generated datasets and finished fits."),
        CommandLine(metavar="DIR", default="the user's cache folder"),
    ] = None
    suite: Annotated[
        Path | None,
        Field(description="Folder with datasets/ and methods/ to search first."),
        CommandLine(metavar="DIR"),
    ] = None


class DataOptions(FolderOptions):
    """Options of every command that reads a dataset."""

    panel: ClassVar[str] = "Data"

    limit: Annotated[
        int | None,
        Field(
            ge=1,
            le=MAX_COUNT,
            description="Use only the first samples; they cover the load regions evenly.",
        ),
        CommandLine(metavar="N", default="all samples"),
    ] = None
    workers: Annotated[
        int | None,
        Field(ge=1, description="Number of processes for data generation."),
        CommandLine(metavar="N", default="all cores"),
    ] = None


class TrainOptions(DataOptions):
    """Options of every command that fits."""

    panel: ClassVar[str] = "Training"

    split: Annotated[
        SplitBy | None,
        Field(description="Property that separates test samples from training samples."),
        CommandLine(default="the dataset's split"),
    ] = None
    device: Annotated[
        Device,
        Field(description="Device for training; auto selects a CUDA device if there is one."),
    ] = "cpu"
    fit_seconds: Annotated[
        float | None,
        Field(
            gt=0,
            description="Train for about this many seconds instead of a number of iterations.",
        ),
        CommandLine(metavar="SECONDS"),
    ] = None


class FitOptions(TrainOptions):
    """Options of `mor_bench.fit`."""

    panel: ClassVar[str] = "Training"

    threads: Annotated[
        int | None,
        Field(
            ge=1,
            le=CORES,
            description="Number of threads for the fit; another number may change the last digits.",
        ),
        CommandLine(metavar="N", default="all cores"),
    ] = None
    checkpoint: Annotated[
        Path | None,
        Field(description="Checkpoint to write during training and to resume from."),
        CommandLine(metavar="FILE", default=".NAME.checkpoint beside --out"),
    ] = None
    start_from: Annotated[
        Path | None,
        Field(description="Model of the same method; the training starts from its weights."),
        CommandLine(metavar="FILE"),
    ] = None


FOLDERS = "folders"
"""Entry of a run's settings for the folders and datasets' files that its command named.

A resumed run may change it.
"""

DEFAULT_SEEDS: dict[str, int] = {"quick": 1, "full": 3}
"""Number of trainings of a configuration that has a seed, by profile."""

DEFAULT_TIME_LIMIT_S: dict[str, float] = {"quick": 1200.0, "full": 1800.0}
"""Limit of the fitting time per method and dataset in seconds, by profile."""


def _by_profile(defaults: Mapping[str, float]) -> str:
    return f"{defaults['quick']:g}; full: {defaults['full']:g}"


class RunOptions(TrainOptions):
    """Options of `mor_bench.run`."""

    panel: ClassVar[str] = "Comparison"

    profile: Annotated[
        Profile,
        Field(description="Parameter sweep and budget; full adds test sets and learning curves."),
    ] = "quick"
    threads: Annotated[
        int,
        Field(
            ge=1, le=CORES, description="Number of threads for a prediction; fits use all cores."
        ),
        CommandLine(metavar="N"),
    ] = 1
    jobs: Annotated[
        int,
        Field(
            ge=1,
            le=CORES,
            description="Number of fits at the same time; they share the cores and so take longer.",
        ),
        CommandLine(metavar="N"),
    ] = 1
    cluster: Cluster = None
    test_seed: Annotated[
        Literal["fresh"] | Annotated[int, Field(ge=0, lt=2**63)] | None,
        Field(
            description=(
                "Also score on a test set that is drawn after all fits, with this seed or a "
                "fresh one."
            )
        ),
        CommandLine(metavar="N|fresh"),
    ] = None
    seeds: Annotated[
        int | None,
        Field(
            ge=1,
            le=100,
            description=(
                "Number of trainings, each with its own seed, for configurations that have a seed."
            ),
        ),
        CommandLine(metavar="N", default=_by_profile(DEFAULT_SEEDS)),
    ] = None
    time_limit_s: Annotated[
        float | None,
        Field(
            gt=0, description="Limit of the total fitting time per method and dataset, in seconds."
        ),
        CommandLine("--time-limit", metavar="SECONDS", default=_by_profile(DEFAULT_TIME_LIMIT_S)),
    ] = None
    memory_limit_bytes: Annotated[
        float | None,
        Field(ge=1e8, description="Memory limit of a method's process, in GB."),
        CommandLine("--memory-limit", metavar="GB", default="3/4 of the memory", scale=1e9),
    ] = None
    train: Annotated[
        bool,
        Field(
            description=(
                "Train networks here instead of using the suite's trained weights. The full "
                "profile always does."
            )
        ),
    ] = False
    retime: Annotated[
        bool, Field(description="Repeat timings instead of reading them from the cache.")
    ] = False
    fail_fast: Annotated[bool, Field(description="Stop at the first row that fails.")] = False


def command_line(options: type[Options]) -> Iterator[tuple[str, FieldInfo, CommandLine]]:
    """Yield each option's name, its field and its appearance on the command line."""
    for name, field in options.model_fields.items():
        shown = next((item for item in field.metadata if isinstance(item, CommandLine)), None)
        shown = shown or CommandLine()
        flag = shown.flag or f"--{name.replace('_', '-')}"
        yield name, field, replace(shown, flag=flag, panel=_owner(options, name).panel)


def _owner(options: type[Options], name: str) -> type[Options]:
    """Return the class that declares an option."""
    groups = [base for base in options.__mro__ if issubclass(base, Options)]
    return next(base for base in reversed(groups) if name in base.model_fields)


def allowed_values(field: FieldInfo, scale: float = 1.0) -> str:
    """Describe the values that an option may have, such as "an integer in [1, 100]".

    Bounds are divided by the scale of the command line.
    """
    return " or ".join(_described(field.annotation, field.metadata, scale))


def _described(annotation: Any, metadata: list[Any], scale: float) -> Iterator[str]:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        yield " or ".join(map(repr, parts))
    elif origin is Annotated:
        inner = [item for extra in parts[1:] for item in getattr(extra, "metadata", [])]
        yield from _described(parts[0], inner, scale)
    elif parts:
        for part in parts:
            yield from _described(part, metadata, scale)
    elif annotation is not NoneType:
        names = {int: "an integer", float: "a number", bool: "true or false", Path: "a path"}
        yield names.get(annotation, "a text") + _bounds(metadata, scale)


def _bounds(metadata: list[Any], scale: float) -> str:
    bounds: dict[str, float] = {}
    for item in metadata:
        bounds |= {name: getattr(item, name) for name in ("ge", "gt", "le") if hasattr(item, name)}
    if "ge" in bounds and "le" in bounds:
        return f" in [{bounds['ge']}, {bounds['le']}]"
    if "ge" in bounds:
        return f" of at least {bounds['ge'] / scale:g}"
    return f" above {bounds['gt'] / scale:g}" if "gt" in bounds else ""
