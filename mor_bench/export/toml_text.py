"""Texts in TOML: single strings, and whole dataset files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from mor_bench.errors import InvalidInputError


def quoted(text: str) -> str:
    """Quote a text as TOML: as JSON, with the delete character escaped and no surrogates."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_text(content: Mapping[str, Any]) -> str:
    """Write a table as TOML: first its values, then its tables and lists of tables.

    Raises
    ------
    InvalidInputError
        If a value has no form in TOML, such as None.
    """
    plain = {key: value for key, value in content.items() if not _has_heading(value)}
    lines = [f"{_key(key)} = {_value(value)}" for key, value in plain.items()]
    for key, value in content.items():
        if key not in plain:
            lines += _section(key, value)
    return "\n".join(lines) + "\n"


def _has_heading(value: Any) -> bool:
    tables = value if isinstance(value, list) else [value]
    return bool(tables) and all(isinstance(item, Mapping) for item in tables)


def _section(key: str, value: Any) -> Iterator[str]:
    many = isinstance(value, list)
    for table in value if many else [value]:
        yield ""
        yield f"[[{_key(key)}]]" if many else f"[{_key(key)}]"
        yield from (f"{_key(name)} = {_value(item)}" for name, item in table.items())


def _key(name: str) -> str:
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else quoted(name)


def _value(value: Any) -> str:
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_key(name)} = {_value(item)}" for name, item in value.items())
        return f"{{ {inner} }}"
    raise InvalidInputError(f"{value!r} has no form in TOML.")
