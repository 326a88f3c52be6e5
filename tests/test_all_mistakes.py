"""Scenes without some tables, and files with several mistakes, which one message lists."""

from __future__ import annotations

from typing import Any

import pytest

import mor_bench
from mor_bench.specs import load_generated_spec

CUBE: dict[str, Any] = {
    "geometry": {"shape": "box", "size_m": [1.0, 1.0, 1.0], "cells": [3, 3, 3]},
    "material": {"law": "neo-hookean", "young_pa": 100.0, "poisson": 0.3},
    "supports": [{"region": "z-min"}],
}
BALL = {"sphere": {"radius_m": 0.5, "centre_m": [0.5, 0.5, 1.6]}}
PLANS: dict[str, dict[str, Any]] = {
    "displacement": {"region": "z-max", "magnitude_m": [0.0, 0.3]},
    "pressure": {"regions": ["z-max"], "magnitude_pa": [0.0, 1.0]},
    "contact": {
        "region": "z-max",
        "instrument": BALL,
        "direction": [0.0, 0.0, -1.0],
        "magnitude_m": [0.0, 0.4],
    },
    "force": {"region": "z-max", "patch_area_m2": 0.1, "magnitude_n": [0.0, 1.0]},
}


@pytest.mark.parametrize("kind", PLANS)
@pytest.mark.parametrize("split", [None, {}, {"test_fraction": 0.3}])
def test_the_default_split_suits_the_loads(kind: str, split: dict[str, Any] | None) -> None:
    table = {} if split is None else {"split": split}
    loads = {"kind": kind, "samples": 4, **PLANS[kind]}
    spec = mor_bench.load_scene({**CUBE, **table, "loads": loads}).generated
    assert spec.split.by == ("region" if kind == "force" else "sample")
    assert spec.split.test_fraction == (0.3 if split else 0.2)
    assert load_generated_spec(spec.model_dump(mode="json")) == spec
    assert spec.model_fields_set == {"name", "title", "loads", *CUBE, *table}
