"""Every excerpt of the documentation runs as it stands, on few samples."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from tests.small_runs import short_timing
from tests.test_documented_commands import BLOCKS

LIMIT = 60
"""Samples of a dataset."""

EXCERPTS = [(page, block) for page, mark, block in BLOCKS if mark == "excerpt"]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "block"), EXCERPTS)
def test_every_excerpt_runs(
    page: str, block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "Comparison.read" not in block:
        monkeypatch.chdir(tmp_path)
    cache = tmp_path / "cache"
    for name, few in (("load_dataset", {"limit": LIMIT}), ("run", {"limit": LIMIT})):
        function: Any = getattr(mor_bench, name)
        monkeypatch.setattr(mor_bench, name, partial(function, cache=cache, **few))
    with short_timing():
        exec(
            compile(block, page, "exec"), {"__name__": "excerpt", "np": np, "mor_bench": mor_bench}
        )


def test_there_are_excerpts() -> None:
    assert len(EXCERPTS) > 8
