"""Hyperparameters beside the name of a method, such as ``pod[n_modes=10,20]``."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from typing import Any

from mor_bench.errors import SpecError

OPENING, CLOSING = "[{(", "]})"


def split_method(source: str) -> tuple[str, dict[str, list[Any]]]:
    """Split a method's name or file from the values in brackets, each parameter with its list.

    >>> split_method("hpod[n_modes=10,20, sampling=points]")
    ('hpod', {'n_modes': [10, 20], 'sampling': ['points']})

    Raises
    ------
    SpecError
        If the text in brackets is not of this form.
    """
    name, bracket, inside = source.partition("[")
    if not bracket or source.endswith(".toml"):
        return source, {}
    wrong = SpecError(
        f"method {source!r}: write parameters as NAME[PARAMETER=VALUE,VALUE,PARAMETER=VALUE]."
    )
    if not inside.endswith("]"):
        raise wrong
    values: dict[str, list[Any]] = {}
    for item in _items(inside[:-1]):
        key, equals, value = item.partition("=")
        if equals and key.strip().isidentifier():
            values.setdefault(key.strip(), [])
        elif values:
            value = item
        if not values or not value.strip():
            raise wrong
        values[list(values)[-1]].append(parse_value(value))
    return name.strip(), values


def parse_value(text: str) -> Any:
    """Read a value as TOML would; anything else is text.

    >>> parse_value("1e-4"), parse_value("[1, 2]"), parse_value("constant")
    (0.0001, [1, 2], 'constant')
    >>> parse_value("3\\nother = 4")
    '3\\nother = 4'
    """
    try:
        content = tomllib.loads(f"value = {text}")
        return content["value"] if len(content) == 1 else text.strip()
    except (ValueError, RecursionError):  # also an integer of thousands of digits
        return text.strip()


def _items(text: str) -> Iterator[str]:
    """Split a text at the commas that stand in no brackets and no quotes."""
    depth, quote, start = 0, "", 0
    for place, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter == "," and depth == 0:
            yield text[start:place]
            start = place + 1
        else:
            depth += (letter in OPENING) - (letter in CLOSING)
    yield text[start:]
