"""Short names of configurations: the method, and the values that tell its configurations apart."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mor_bench.report.number_format import MEANINGS, short_name
from mor_bench.results.row import Row


@dataclass(frozen=True)
class ShortName:
    """The short name of a configuration, such as ``hpod · r5``.

    Attributes
    ----------
    method : str
    values : str
        Values that vary among the method's configurations, such as ``r5``; empty if none does.
    """

    method: str
    values: str = ""

    def __str__(self) -> str:
        return f"{self.method} · {self.values}" if self.values else self.method


def short_names(rows: Iterable[Row]) -> dict[str, ShortName]:
    """Return the short name of each configuration of one dataset, by its label."""
    names: dict[str, ShortName] = {}
    for method, mine in _by_method(rows).items():
        varied = varied_keys(mine)
        values = [value_text({key: row.swept.get(key) for key in varied}) for row in mine]
        if len(set(values)) < len(values):  # rounded values may coincide
            values = [", ".join(f"{k}={v}" for k, v in row.swept.items()) for row in mine]
        names |= {
            row.label: ShortName(method, text) for row, text in zip(mine, values, strict=True)
        }
    return names


def renamed(text: str, names: Mapping[str, ShortName | str]) -> str:
    """Return a text with the short names of configurations instead of their labels."""
    labels = [label for label, name in names.items() if str(name) != label]
    if not labels:
        return text
    longest_first = "|".join(map(re.escape, sorted(labels, key=len, reverse=True)))
    return re.sub(rf"(?<![\w-])({longest_first})", lambda found: str(names[found[0]]), text)


def varied_keys(rows: Sequence[Row]) -> list[str]:
    """List the swept parameters that have different values in the rows of one method."""
    keys = dict.fromkeys(key for row in rows for key in row.swept)
    return [key for key in keys if len({repr(row.swept.get(key)) for row in rows}) > 1]


def constants(rows: Iterable[Row]) -> str:
    """List the swept parameters without effect on names, such as ``hpod: ctol 0.005``."""
    texts = []
    for method, mine in _by_method(rows).items():
        varied = varied_keys(mine)
        fixed = {key: value for key, value in mine[0].swept.items() if key not in varied}
        texts += [f"{method}: {value_text(fixed)}"] if fixed else []
    return "; ".join(texts)


def value_text(values: Mapping[str, Any]) -> str:
    """Format parameters, such as ``r5, ctol 0.001, points``; parameters without a value drop."""
    names = [short_name(key) for key in values]
    return ", ".join(
        _one(name if names.count(name) == 1 else key, value)
        for key, name, value in zip(values, names, values.values(), strict=True)
        if value is not None
    )


def explained_values(rows: Iterable[Row], text: str) -> str:
    """Explain the names of values that a text uses, such as ``r5: number of modes``."""
    found: dict[str, str] = {}
    for mine in _by_method(rows).values():
        for key in varied_keys(mine):
            name = short_name(key)
            values = {value_text({key: row.swept[key]}) for row in mine if key in row.swept}
            used = [v for v in values if re.search(rf"(?<![\w.]){re.escape(v)}(?![\w.])", text)]
            if name != key and used:
                found[name] = MEANINGS.get(key, key)
    return " · ".join(f"{name}: {meaning}" for name, meaning in found.items())


def _one(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return f"{name} {'on' if value else 'off'}"
    if isinstance(value, str):
        return value
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return f"{name}{text}" if len(name) == 1 else f"{name} {text}"


def _by_method(rows: Iterable[Row]) -> dict[str, list[Row]]:
    methods: dict[str, list[Row]] = {}
    for row in rows:
        methods.setdefault(row.method, []).append(row)
    return methods
