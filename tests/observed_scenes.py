"""beam-tiny with observed displacements, for several test modules."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mor_bench
from mor_bench.scene.scene import Scene
from mor_bench.specs import list_suite, load_generated_spec

TOP = '[observed]\nregion = "z-max"\n'


def written(folder: Path, observed: str, name: str = "beam-tiny-observed") -> Path:
    """Return beam-tiny with a table of observed displacements."""
    path = folder / f"{name}.toml"
    path.write_text(
        list_suite("datasets")["beam-tiny"].read_text(encoding="utf-8") + observed, encoding="utf-8"
    )
    return path


def scene_of(observed: Any, **changed: Any) -> Scene:
    content = load_generated_spec("beam-tiny").model_dump(mode="json")
    return mor_bench.load_scene({**content, "observed": observed, **changed})
