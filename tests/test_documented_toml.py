"""The TOML of the documentation is what the suite reads."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mor_bench.specs import DatasetSpec, list_suite, load_generated_spec

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```toml\n(.*?)^```", re.MULTILINE | re.DOTALL)


SCENE = {"geometry", "discretisation", "material", "supports", "springs", "gravity", "loads"}
"""Tables that belong to a scene alone; those of a method's file may have `parameters`, too."""


def blocks() -> Iterator[Any]:
    for page in sorted(DOCS.glob("*.md")):
        for number, text in enumerate(BLOCK.findall(page.read_text(encoding="utf-8")), 1):
            yield pytest.param(text, id=f"{page.stem}-{number}")


def in_a_scene(tables: dict[str, Any]) -> dict[str, Any]:
    """Return a scene of the suite with the tables of a fragment in the place of its own."""
    text = list_suite("datasets")["beam-tiny"].read_text(encoding="utf-8")
    scene = tomllib.loads(text)
    if tables.keys() & {"geometry", "loads"}:
        scene.pop("tests", None)  # they may not fit another body
    return {**scene, "name": "documented", **tables}


@pytest.mark.parametrize("text", list(blocks()))
def test_a_block_is_toml_that_a_scene_can_have(text: str) -> None:
    tables = tomllib.loads(text)
    assert tables
    own_files = tables.get("geometry", {}).keys() & {"file", "surface"}  # the guide's own test
    of_scene = tables.keys() & SCENE and tables.keys() <= DatasetSpec.model_fields.keys()
    if of_scene and not own_files:
        assert load_generated_spec(in_a_scene(tables)).name == "documented"
