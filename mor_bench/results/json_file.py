"""JSON files of results; NaN and infinity become strings, because JSON lacks them."""

from __future__ import annotations

import json
from math import isfinite
from pathlib import Path
from typing import Any

from mor_bench.snapshots.store import write_atomically


def without_nan(value: Any) -> Any:
    """Return a copy with NaN and infinity as the strings `nan`, `inf` and `-inf`."""
    if isinstance(value, float) and not isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return value


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically."""
    text = json.dumps(without_nan(content), indent=1, allow_nan=False)
    write_atomically(path, text.encode())
