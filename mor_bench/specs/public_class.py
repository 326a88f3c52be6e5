"""Public classes of another library by their import paths, which may come from a model file."""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any

from mor_bench.specs.one_line_errors import nearest_name


def public_class(target: str, package: str, form: str) -> type[Any]:
    """Import a class by ``package.module:Class``; no other package is imported.

    Parameters
    ----------
    target : str
    package : str
        The package that must hold it, such as "pymor.reductors".
    form : str
        The rule that errors state.

    Raises
    ------
    ValueError
        If the text has another form, or there is no such module or class.
    """
    module, _, name = target.partition(":")
    if not re.fullmatch(rf"{re.escape(package)}(\.[a-z][a-z0-9_]*)+:[A-Z][A-Za-z0-9]*", target):
        raise ValueError(form)
    try:
        loaded = import_module(module)
    except ModuleNotFoundError:
        raise ValueError(f"{form}; there is no module {module!r}") from None
    found = getattr(loaded, name, None)
    if found is None:
        near = nearest_name(name, dir(loaded)).rstrip(".")
        raise ValueError(f"{form}; {module} has no {name!r}{near}")
    if not isinstance(found, type):
        raise ValueError(f"{form}; {name!r} is no class")
    return found
