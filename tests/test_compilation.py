"""The compilation stage: what it compiles, and that fits after it compile nothing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from mor_bench.runs.compilation import uncompiled
from mor_bench.runs.configurations import configurations_of
from mor_bench.specs import DatasetSpec, load_dataset_spec, load_method_spec
from tests.small_runs import method_file

SCRIPT = """
import json, sys
from pathlib import Path
from mor_bench.runs.listener import Listener
from tests.small_runs import run_small

kernels, cache, out = map(Path, sys.argv[1:])
compiled = lambda: sorted(path.name for path in kernels.rglob("*.nbc"))
heard, at_start = [], []
listener = Listener(
    compiling=lambda method, done, total: heard.append([method, done, total]),
    generating=lambda *_: at_start.append(compiled()),
)
run_small(["linear-fem", "pod"], out, cache, listener=listener)
print(json.dumps([heard, at_start[0], compiled()]))
"""


def _never_seen() -> DatasetSpec:
    """Return a dataset whose kernels no run has compiled, because no run has its stiffness."""
    spec = load_dataset_spec("beam-tiny")
    assert isinstance(spec, DatasetSpec)
    material = spec.material.model_copy(update={"young_pa": 123.4567})
    return spec.model_copy(update={"material": material})


def test_methods_that_differ_in_words_are_compiled_apart(tmp_path: Path) -> None:
    other = method_file(tmp_path, "mine", "tests.third_party:Zero")
    methods = [load_method_spec(source) for source in ("pod", "hpod", other)]
    groups = uncompiled(_never_seen(), configurations_of(methods, "full"))
    words = [
        (group.method.name, *words_of(item.parameters))
        for group in groups
        for item in group.configurations[:1]
    ]
    hpod = [("hpod", *pair) for pair in product(("points", "cells"), (False, True))]
    assert words == [("pod", None, None), *hpod]
    for group in groups:
        assert len({words_of(item.parameters) for item in group.configurations}) == 1
    assert len({group.marker for group in groups}) == 5


def words_of(parameters: Mapping[str, Any]) -> tuple[Any, Any]:
    return parameters.get("sampling"), parameters.get("static_correction")


@pytest.mark.slow
def test_a_run_compiles_before_it_generates_and_fits_and_only_once(tmp_path: Path) -> None:
    kernels = tmp_path / "kernels"
    found = []
    for out in ("first", "second"):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, kernels, tmp_path / "cache", tmp_path / out],
            env={**os.environ, "NUMBA_CACHE_DIR": str(kernels)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        found.append(json.loads(done.stdout.splitlines()[-1]))
    (heard, before, after), (again, _, at_end) = found
    assert heard == [["linear-fem", 0, 2], ["pod", 1, 2], ["pod", 2, 2]]
    assert len(before) > 10
    assert after == before  # generation, fits, scores and timings compiled nothing
    assert again == []
    assert at_end == after
