"""Options of commands, made from the models in `mor_bench.options`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer
from pydantic.fields import FieldInfo

from mor_bench.options import CommandLine, DataOptions, Options, command_line

DatasetName = Annotated[str, typer.Argument(help="Name or TOML file of a dataset.")]
MethodNames = Annotated[
    list[str] | None,
    typer.Option("--method", "-m", help="Name or TOML file of a method; repeat for more."),
]
Json = Annotated[
    bool,
    typer.Option("--json", help="Print JSON to standard output, the rest to standard error."),
]


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter `options` of a command by one command-line option per field.

    The annotation of the parameter is a subclass of `Options`. The command receives an instance
    of it, so its ranges are checked in one place.
    """
    hints = get_type_hints(command, include_extras=True)
    model: type[Options] = hints["options"]
    shown = {name: (field, line) for name, field, line in command_line(model)}
    last = [name for name in DataOptions.model_fields if name in shown]
    shown = {name: shown[name] for name in (*(name for name in shown if name not in last), *last)}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        if parameter.name == "options":
            parameters += [_parameter(name, *parts) for name, parts in shown.items()]
        else:
            parameters.append(parameter.replace(annotation=hints[parameter.name]))

    @wraps(command)
    def expanded(**given: Any) -> None:
        values = {name: given.pop(name) for name in shown}
        command(**given, options=model.from_command_line(values))

    # Positional order does not matter to Typer, which passes every value by name.
    keywords = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters]
    expanded.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    expanded.__annotations__ = {p.name: p.annotation for p in keywords}
    return expanded


def _parameter(name: str, field: FieldInfo, line: CommandLine) -> inspect.Parameter:
    default = f" [default: {line.default}]" if line.default else ""
    option = typer.Option(line.flag, metavar=line.metavar, help=f"{field.description}{default}")
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=field.default,
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
