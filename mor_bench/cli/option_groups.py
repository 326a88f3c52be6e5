"""Options of commands, made from the models in `mor_bench.options`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    get_args,
    get_origin,
    get_type_hints,
)

import typer
from pydantic import Field
from pydantic.fields import FieldInfo

from mor_bench.errors import InvalidInputError
from mor_bench.options import CommandLine, DataOptions, Options, command_line
from mor_bench.specs import list_suite

if TYPE_CHECKING:
    from mor_bench.report.console_tables import Detail

OUTPUT = "Output"
"""Panel of the options that choose what is printed."""


def complete_datasets(incomplete: str) -> list[str]:
    """Return the names of the suite's datasets that begin with a text."""
    return [name for name in list_suite("datasets") if name.startswith(incomplete)]


def complete_methods(incomplete: str) -> list[str]:
    """Return the names of the suite's methods that begin with a text."""
    return [name for name in list_suite("methods") if name.startswith(incomplete)]


DatasetName = Annotated[
    str,
    typer.Argument(help="Name or TOML file of a dataset.", autocompletion=complete_datasets),
]
OptionalDatasetName = Annotated[
    str | None,
    typer.Argument(
        metavar="[DATASET]",
        help="Name or TOML file of a dataset.",
        autocompletion=complete_datasets,
        show_default=False,
    ),
]
Json = Annotated[
    bool,
    typer.Option(
        "--json",
        help="Print JSON to standard output, the rest to standard error.",
        rich_help_panel=OUTPUT,
    ),
]


class QuietOutput(Options):
    """The option that switches progress off."""

    panel: ClassVar[str] = OUTPUT

    quiet: Annotated[
        bool,
        Field(description="Print the result only, without progress."),
        CommandLine(short="-q"),
    ] = False


class TableOutput(QuietOutput):
    """Options of commands that print the tables of a comparison."""

    panel: ClassVar[str] = OUTPUT

    verbose: Annotated[
        bool, Field(description="Also print each step and each note."), CommandLine(short="-v")
    ] = False
    wide: Annotated[
        bool,
        Field(description="Print every column and every table, in lines as long as they need."),
    ] = False

    pages: Annotated[
        bool,
        Field(
            description="Also write the folder pages: an index, and a page per dataset and method. "
            "A comparison of several datasets always has it."
        ),
    ] = False

    @property
    def detail(self) -> Detail:
        """The choice of what is printed.

        Raises
        ------
        InvalidInputError
            If the output shall be both quiet and verbose.
        """
        from mor_bench.report.console_tables import Detail  # slow to import

        if self.quiet and self.verbose:
            raise InvalidInputError("`--quiet` and `--verbose` cannot be used together.")
        return Detail(self.quiet, self.verbose, self.wide)


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each parameter of a command that is a group of options by one option per field.

    The annotation of such a parameter is a subclass of `Options`. The command receives an instance
    of it, so its ranges are checked in one place.
    """
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, type[Options]] = {
        name: hint
        for name, hint in hints.items()
        if isinstance(hint, type) and issubclass(hint, Options)
    }
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name in groups:
            fields = _fields(groups[parameter.name])
            parameters += [_parameter(name, *parts) for name, parts in fields.items()]
        else:
            parameters.append(parameter.replace(annotation=hints[parameter.name]))

    @wraps(command)
    def expanded(**given: Any) -> None:
        for group, model in groups.items():
            values = {name: given.pop(name) for name in _fields(model)}
            given[group] = model.from_command_line(values)
        command(**given)

    # Positional order does not matter to Typer, which passes every value by name.
    keywords = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters]
    expanded.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    expanded.__annotations__ = {p.name: p.annotation for p in keywords}
    return expanded


def _fields(model: type[Options]) -> dict[str, tuple[FieldInfo, CommandLine]]:
    """Return the options of a group in the order of the help: those of data come last."""
    shown = {name: (field, line) for name, field, line in command_line(model)}
    last = [name for name in DataOptions.model_fields if name in shown]
    return {name: shown[name] for name in (*(name for name in shown if name not in last), *last)}


def _parameter(name: str, field: FieldInfo, line: CommandLine) -> inspect.Parameter:
    default = f" [default: {line.default}]" if line.default else ""
    flags = (line.flag, line.short) if line.short else (line.flag,)
    option = typer.Option(
        *flags,
        metavar=line.metavar,
        help=f"{field.description}{default}",
        rich_help_panel=line.panel,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if field.is_required() else field.default,
        annotation=Annotated[_option_type(field.annotation), option],
    )


def _option_type(annotation: Any) -> Any:
    """Return a type that Typer can parse; the options check the value again."""
    types = get_args(annotation)
    if get_origin(annotation) is Literal or not types:
        return annotation
    simple = [part for part in types if part is not type(None)]
    if len(simple) > 1:  # Such as a number or a word: the options convert the text.
        return str | None
    return simple[0] | None if simple[0] in (int, float, str, Path) else annotation
