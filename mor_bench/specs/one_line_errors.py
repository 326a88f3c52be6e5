"""One-line error messages: the file, the key, the allowed values and the given value."""

from __future__ import annotations

import difflib
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, Discriminator, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from mor_bench.errors import MorBenchError, SpecError, printable
from mor_bench.specs.region_spec import REGIONS

_M = TypeVar("_M", bound=BaseModel)

MAX_SHOWN = 300
"""Most characters of a wrong value that a message quotes."""

MAX_PROBLEMS = 8
"""Most problems that a message lists."""

MAX_READ = 200
"""Most problems for which a sentence is made; a file may have a hundred thousand."""

_EXPECTED = "Input should be "


def validated(
    model: type[_M],
    content: Any,
    where: str,
    folder: Path | str | None = None,
    error: type[MorBenchError] = SpecError,
) -> _M:
    """Make a model of a table, or raise an error of one line.

    Parameters
    ----------
    model : pydantic model
    content : mapping
    where : str
        Beginning of the message: the file or the class.
    folder : Path or str, optional
        Folder that relative paths of files start from, or `RECORDED` for a stored specification.
    error : type of MorBenchError
        Class of the error.

    Raises
    ------
    SpecError, or the given class of errors
        Names every problem.
    """
    if not isinstance(content, Mapping):
        raise error(f"{where}: the content must be a table; got {type(content).__name__}.")
    try:
        return model.model_validate(dict(content), context=folder)
    except ValidationError as problems:
        message = _message(problems.errors(include_url=False), model)
        raise error(f"{where}: {printable(message, keep='')}") from None


def nearest_name(name: str, valid: Iterable[str]) -> str:
    """Return the end of a message: the most similar valid name, or a full stop."""
    close = difflib.get_close_matches(name, list(valid), n=1)
    return f"; did you mean {close[0]!r}?" if close else "."


def _message(problems: Sequence[ErrorDetails], model: type[BaseModel]) -> str:
    """Return a sentence for each problem; unknown keys come first."""
    ordered = sorted(problems, key=lambda problem: problem["type"] != "extra_forbidden")
    read = ordered[:MAX_READ]
    sentences = [_sentence(problem, read, model) for problem in read]
    return listed(sentences, len(ordered) - len(read))


def listed(sentences: Sequence[str], more: int = 0) -> str:
    """Return the first different sentences, and the number of all others; ``more`` have none."""
    different = list(dict.fromkeys(sentences))
    more += len(different) - MAX_PROBLEMS
    return " ".join(different[:MAX_PROBLEMS]) + (f" And {more} more." if more > 0 else "")


def _sentence(
    problem: ErrorDetails, problems: Sequence[ErrorDetails], model: type[BaseModel]
) -> str:
    steps, _ = _walk(model, problem["loc"])
    steps = [step for step in steps if step != "tables"]  # a list of tables in the file
    key = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in steps)
    key = key.lstrip(".")
    match problem["type"]:
        case "contradiction":
            return f"{problem['msg']}."
        case "extra_forbidden":
            return _unknown_key(key, str(steps[-1]), model, problem["loc"][:-1])
        case "missing":
            return f"key `{key}` is missing."
        case "union_tag_not_found":
            return f"key `{key}.{_discriminator(problem)}` is missing."
        case "union_tag_invalid":
            tags = problem["ctx"]["expected_tags"].split(", ")
            *others, last = (tag for tag in tags if tag != "'several'")
            return (
                f"`{key}.{_discriminator(problem)}` must be {', '.join(others)} or {last}; "
                f"got {problem['ctx']['tag']!r}."
            )
        case "string_pattern_mismatch":
            letters = "must consist of lower-case letters, digits and hyphens"
            return f"`{key}` {letters}; got {_shown(problem)}."
        case _:
            return _bad_value(key, problem, problems, model)


def _discriminator(problem: ErrorDetails) -> str:
    return str(problem["ctx"]["discriminator"]).strip("'")


def _unknown_key(key: str, name: str, model: type[BaseModel], table: tuple[int | str, ...]) -> str:
    _, models = _walk(model, table)
    valid = sorted({field for m in models for field in m.model_fields if field != "name"})
    allowed = f"Allowed here: {', '.join(valid)}."
    if name in REGIONS:
        return f"`{key}` cannot stand beside another key of a region. {allowed}"
    return f"unknown key `{key}`{nearest_name(name, valid)} {allowed}"


def _bad_value(
    key: str, problem: ErrorDetails, problems: Sequence[ErrorDetails], model: type[BaseModel]
) -> str:
    location = problem["loc"]
    message = problem["msg"].removeprefix("Value error, ").removeprefix(_EXPECTED).rstrip(".")
    if len(location) == 2 and not list(_models_in(model.model_fields[str(location[0])].annotation)):
        # A key of several types has one problem per type, each with a step of its own.
        expected = dict.fromkeys(
            other["msg"].removeprefix(_EXPECTED)
            for other in problems
            if other["loc"][:1] == location[:1] and other["msg"].startswith(_EXPECTED)
        )
        if len(expected) > 1:
            key, message = str(location[0]), " or ".join(expected)
    if not key:
        return f"{message}."
    verb = " must be" if problem["msg"].startswith("Input should") else ":"
    return f"`{key}`{verb} {message}; got {_shown(problem)}."


def _shown(problem: ErrorDetails) -> str:
    try:
        text = repr(problem["input"])
    except ValueError:  # an integer of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


def _walk(
    model: type[BaseModel], location: tuple[int | str, ...]
) -> tuple[list[int | str], list[type[BaseModel]]]:
    """Follow the location of an error through a model.

    Returns
    -------
    list of steps
        The keys and indices, without pydantic's names of the alternatives of a union.
    list of models
        The models that the table at the location may have.
    """
    steps: list[int | str] = []
    models = [model]
    alternative_follows = False
    for step in location:
        if alternative_follows and isinstance(step, str):
            models = [m for m in models if _is_alternative(m, step)] or models
            alternative_follows = False
            continue
        steps.append(step)
        fields = [m.model_fields[str(step)] for m in models if step in m.model_fields]
        if fields:
            alternative_follows = any(_is_discriminated(field) for field in fields)
            models = [found for field in fields for found in _models_in(field.annotation)]
    return steps, models


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield an annotation, and all annotations and metadata inside it."""
    yield annotation
    if get_origin(annotation) in (Annotated, Union, types.UnionType, tuple, list, dict):
        for part in get_args(annotation):
            yield from _parts(part)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    for part in _parts(annotation):
        if isinstance(part, type) and issubclass(part, BaseModel):
            yield part


def _is_discriminated(field: FieldInfo) -> bool:
    """Return whether a key or a part of the value chooses between the alternatives of a field."""
    return bool(field.discriminator) or any(
        isinstance(part, Discriminator) or (isinstance(part, FieldInfo) and part.discriminator)
        for part in (*field.metadata, *_parts(field.annotation))
    )


def _is_alternative(model: type[BaseModel], step: str) -> bool:
    """Return whether a step stands for a model: the key of a region, or a shape or material law."""
    if step.removeprefix("by ") in model.model_fields:
        return True
    return any(
        step in get_args(field.annotation)
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
    )
