"""A small run, to be damaged."""

from __future__ import annotations

import atexit
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from tests.synthetic import synthetic_comparison

DATASET = "beam-tiny"


@cache
def sound_run() -> Path:
    """Write a run with few rows, which are of different methods; return its folder."""
    folder = Path(mkdtemp())
    atexit.register(shutil.rmtree, folder)
    made = synthetic_comparison(folder, DATASET, n_regions=3, per_region=2)
    made.rows = list({row.method: row for row in made.rows}.values())[:4]
    made.write()
    return folder


def a_run(path: Path) -> None:
    shutil.copytree(sound_run(), path.parent, dirs_exist_ok=True)
