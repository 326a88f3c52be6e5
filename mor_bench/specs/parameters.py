"""Hyperparameters of a method, checked against the annotations of its class."""

from __future__ import annotations

import dataclasses
import inspect
import numbers
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from traceback import walk_tb
from types import SimpleNamespace
from typing import Any, get_type_hints

from pydantic import ConfigDict, create_model

from mor_bench.errors import MissingDependencyError, SpecError, UnusableClassError, text_of
from mor_bench.specs.one_line_errors import nearest_name, validated

EXTRA_OF = {"torch": "learn", "pymor": "pymor"}
"""The extra that brings a library, of those that a method's module imports."""


def load_class(target: str, folder: Path | None = None) -> type[Any]:
    """Import ``package.module:Class``, also from a folder that is not on the import path.

    Raises
    ------
    MissingDependencyError
        If an optional dependency is not installed; the message names the extra.
    UnusableClassError
        If the module raises an error or ends Python, or the class is abstract or no method.
    SpecError
        If the module or the class does not exist.
    """
    module, _, name = target.partition(":")
    if folder is not None and str(folder) not in sys.path:
        sys.path.append(str(folder))
    try:
        loaded = import_module(module)
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library in EXTRA_OF:
            raise MissingDependencyError(
                f"{target} needs {library}: pip install 'mor-bench[{EXTRA_OF[library]}]'"
            ) from error
        raise SpecError(f"surrogate {target!r} cannot be imported: {error}") from error
    except (Exception, SystemExit) as error:  # foreign code runs here
        raise UnusableClassError(
            f"surrogate {target!r} cannot be imported: {type(error).__name__}: {text_of(error)}"
            f"{_line_in(folder, error)}"
        ) from error
    if not hasattr(loaded, name):
        raise SpecError(
            f"surrogate {target!r}: module {module!r} has no class {name!r}"
            f"{nearest_name(name, dir(loaded))}"
        )
    found = getattr(loaded, name)
    if not isinstance(found, type):
        raise SpecError(f"surrogate {target!r} is not a class.")
    _check_usable(found, target)
    return found


def _line_in(folder: Path | None, error: BaseException) -> str:
    """Name the last line of a folder's files that an error passed; "" if there is none."""
    places = [(Path(f.f_code.co_filename), line) for f, line in walk_tb(error.__traceback__)]
    own = [place for place in places if folder is not None and place[0].is_relative_to(folder)]
    return f" ({own[-1][0].name}, line {own[-1][1]})" if own else ""


def _check_usable(found: type[Any], target: str) -> None:
    missing = [verb for verb in ("fit", "predict") if not callable(getattr(found, verb, None))]
    if missing:
        raise UnusableClassError(
            f"surrogate {target!r} is not a subclass of mor_bench.Surrogate, and has no methods "
            "`fit` and `predict`."
        )
    if inspect.isabstract(found):
        names = ", ".join(f"`{name}`" for name in sorted(found.__abstractmethods__))
        raise UnusableClassError(f"surrogate {target!r} is abstract: it lacks {names}.")


def check_parameters(
    surrogate: type[Any], parameters: Mapping[str, Any], where: str | None = None
) -> dict[str, Any]:
    """Check hyperparameters against the annotations of a class and fill in its defaults.

    The annotations of a dataclass, or of ``__init__``, may carry pydantic's `Field` constraints:
    ``Annotated[int, Field(ge=1)]``.

    Raises
    ------
    SpecError
        If a hyperparameter is unknown, of the wrong type, or out of range.
    """
    model = create_model(
        surrogate.__name__,
        __config__=ConfigDict(extra="forbid", strict=True),
        **annotated_defaults(surrogate),
    )
    plain: Any = parameters
    if isinstance(parameters, Mapping):
        plain = {name: python_number(value) for name, value in parameters.items()}
    return validated(model, plain, where or surrogate.__name__).model_dump()


def python_number(value: Any) -> Any:
    """Return a number of NumPy as a number of Python, and everything else unchanged."""
    if isinstance(value, bool | int | float):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    return float(value) if isinstance(value, numbers.Real) else value


def annotated_defaults(surrogate: type[Any]) -> dict[str, Any]:
    """Return annotation and default of each parameter of ``__init__``; ``...`` for no default."""
    if surrogate.__init__ is object.__init__:
        return {}
    owner = next(base for base in surrogate.__mro__ if "__init__" in vars(base))
    hints, factories = {}, {}
    if "__dataclass_fields__" in vars(owner):
        own = dataclasses.fields(owner)
        hints = _field_hints(owner, {field.name for field in own})
        factories = {f.name: f.default_factory for f in own if callable(f.default_factory)}
    else:
        hints = get_type_hints(surrogate.__init__, include_extras=True)
    found: dict[str, Any] = {}
    for name, parameter in list(inspect.signature(surrogate.__init__).parameters.items())[1:]:
        default = factories[name]() if name in factories else parameter.default
        found[name] = hints.get(name, Any), ... if default is parameter.empty else default
    return found


def _field_hints(owner: type[Any], names: set[str]) -> dict[str, Any]:
    """Resolve the annotations of dataclass fields, each in the module of the class that has it.

    `get_type_hints` of the class would resolve every annotation, also of attributes whose types
    are imported for type checkers only.
    """
    hints: dict[str, Any] = {}
    for base in reversed(owner.__mro__):
        own = {k: v for k, v in vars(base).get("__annotations__", {}).items() if k in names}
        scope = vars(sys.modules[base.__module__])
        hints |= get_type_hints(SimpleNamespace(__annotations__=own), scope, include_extras=True)
    return hints
