"""The JSON Schema of results.json; `python -m mor_bench.results.schema` rewrites it."""

from __future__ import annotations

import json
from pathlib import Path

from mor_bench.results.json_file import without_nan
from mor_bench.results.row import ResultsFile

SCHEMA_FILE = Path(__file__).parent / "results.schema.json"


def schema_text() -> str:
    """Return the JSON Schema of results.json as text."""
    return json.dumps(without_nan(ResultsFile.model_json_schema()), indent=1) + "\n"


if __name__ == "__main__":
    SCHEMA_FILE.write_text(schema_text(), encoding="utf-8")
