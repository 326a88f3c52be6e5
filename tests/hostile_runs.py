"""A run in which every free text tries to become markup."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mor_bench.results.comparison import Comparison
from tests.synthetic import synthetic_comparison

HOSTILE = "\"'><script>alert(1)</script><img src=x onerror=alert(1)><svg onload=a()> $x_ {{ 7*7 }}"


def hostile(value: Any) -> Any:
    """Add a hostile text to every text of a table that is free text."""
    if isinstance(value, dict):
        return {key: hostile(item) for key, item in value.items()}
    if isinstance(value, list):
        return [hostile(item) for item in value]
    return value + HOSTILE if isinstance(value, str) else value


def spoiled_rows(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for i, row in enumerate(rows):
        spoiled = {name: row[name] + HOSTILE for name in ("method", "label", "split")}
        spoiled |= {"warnings": [HOSTILE, f"<b>{i}</b>"], "swept": {HOSTILE: HOSTILE}}
        spoiled["parameters"] = {HOSTILE: HOSTILE}
        if i == 1:
            spoiled |= {"status": "failed", "reason": HOSTILE + "\x1b]0;title\x07"}
        yield {**row, **spoiled}


def hostile_run(folder: Path) -> Comparison:
    """Write a run in which every free text is hostile, and whose dataset is named like a path."""
    name = "beam-coarse"
    made = synthetic_comparison(folder, name, n_regions=3, per_region=2)
    arrays = [made.samples(row) for row in made.rows[:4]]
    whole = made.dataset_arrays(name)
    path = folder / "results.json"
    content = json.loads(path.read_text())
    content["rows"] = list(spoiled_rows(content["rows"][:4]))
    content["machine"] = hostile(content["machine"])
    content["datasets"][name] = {
        **hostile(content["datasets"][name]),
        "needs": content["datasets"][name]["needs"],
    }
    content["methods"] = {key + HOSTILE: table for key, table in content["methods"].items()}
    content["learning"] = []
    text = json.dumps(content).replace('"dataset": "beam-coarse"', '"dataset": "../../escaped"')
    content = json.loads(text)
    content["datasets"] = {"../../escaped": content["datasets"][name]}
    path.write_text(json.dumps(content))
    read = Comparison.read(folder)
    for row, samples in zip(read.rows, arrays, strict=True):
        read.put(row, samples)
    read.add_dataset("../../escaped", read.datasets["../../escaped"], whole)
    read.write()
    return Comparison.read(folder)
