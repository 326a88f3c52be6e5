"""Read the evidence of published numbers: JSON and TOML files, and runs in compact form."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mor_bench.errors import MorBenchError
from mor_bench.results.comparison import Comparison

ROOT = Path(__file__).parents[2]
"""The repository."""

REPORTS = ROOT / "reports"

BLOCK = re.compile(r"<!-- from: (?P<spec>[^\n]*?) -->\n(?P<body>.*?)<!-- end -->", re.DOTALL)
"""A generated table in a page."""

REDUCE: dict[str, Callable[[Any], float]] = {
    "median": np.median,
    "mean": np.mean,
    "min": np.min,
    "max": np.max,
    "len": len,
    "sum": np.sum,
    "prod": np.prod,
}
"""How a list of numbers becomes one."""


class EvidenceError(MorBenchError):
    """A published number has no evidence, or the evidence does not contain it."""


@cache
def content_of(name: str, root: Path = ROOT) -> Any:
    """Read a JSON or TOML file, or the text of another, by its path in the repository.

    Raises
    ------
    EvidenceError
        If the file does not exist.
    """
    path = root / name
    if not path.is_file():
        raise EvidenceError(f"{name}: there is no such file; is the experiment recorded?")
    text = path.read_text(encoding="utf-8")
    read = {".toml": tomllib.loads, ".json": json.loads}.get(path.suffix, str)
    return read(text)


def look_up(content: Any, key: str) -> Any:
    """Follow a key such as ``rows/label=pod [n_modes=20]/error/rel_l2_median``.

    A part is a name, the number of an item, or conditions ``name=value`` joined by ``&``. These
    select the only item of a list that meets them; ``*training`` selects all items with a value of
    that name, for `reduce`. In a text, the key is a part of it, with ``{}``
    for the number.

    Raises
    ------
    EvidenceError
        If a part of the key leads nowhere, or to several items.
    """
    if isinstance(content, str):
        return _number_in(content, key)
    found = content
    parts = key.split("/")
    for i, part in enumerate(parts):
        if isinstance(found, list) and part.startswith("*"):
            rest = "/".join(parts[i + 1 :])
            return [look_up(item, rest) for item in found if item.get(part[1:]) is not None]
        if isinstance(found, dict) and part in found:
            found = found[part]
        elif isinstance(found, list) and part.isdecimal() and int(part) < len(found):
            found = found[int(part)]
        elif isinstance(found, list) and "=" in part:
            wanted = [condition.partition("=")[::2] for condition in part.split("&")]
            items = [
                item
                for item in found
                if all(str(item.get(name)) == value for name, value in wanted)
            ]
            if len(items) != 1:
                raise EvidenceError(f"{key}: {len(items)} items meet `{part}`.")
            found = items[0]
        else:
            raise EvidenceError(f"{key}: there is no `{part}`.")
    return found


def _number_in(text: str, key: str) -> float:
    pattern = r"\s+".join(map(re.escape, key.split())).replace(r"\{\}", r"(-?[\d._]+(?:e-?\d+)?)")
    found = {float(number) for number in re.findall(rf"(?<!\w){pattern}(?![\w.])", text)}
    if len(found) != 1:
        raise EvidenceError(f"{key}: {len(found)} different numbers in the text.")
    return found.pop()


@cache
def run_of(name: str, root: Path = ROOT) -> Comparison:
    """Read a stored run with its conclusions, by the path of its folder in the repository."""
    if not (root / name / "results.json").is_file():
        raise EvidenceError(f"{name}: there is no stored run; is the experiment recorded?")
    comparison = Comparison.read(root / name)
    comparison.analysis = content_of(f"{name}/comparison.json", root)
    return comparison


def number_of(value: Mapping[str, Any]) -> float:
    """Look a number up in the evidence."""
    content = content_of(value["file"])

    def measured(key: str) -> float:
        found = look_up(content, key)
        return float(REDUCE[value["reduce"]](found) if "reduce" in value else found)

    number = measured(value["key"]) * value.get("scale", 1.0)
    return float(number / measured(value["over"]) if "over" in value else number)
