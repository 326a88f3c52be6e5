"""Scenes without some tables, and files with several mistakes, which one message lists."""

from __future__ import annotations

from typing import Any

import pytest

import mor_bench
from mor_bench.errors import SpecError
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


def message_of(**changed: Any) -> str:
    with pytest.raises(SpecError) as found:
        mor_bench.load_scene({**CUBE, **changed})
    assert "\n" not in str(found.value)
    return str(found.value)


PRESSED = {"kind": "pressure", "samples": 4, **PLANS["pressure"]}
AWAY = {"sphere_m": [[9.0, 9.0, 9.0], 0.1]}


def test_all_regions_that_hold_nothing_are_named_at_once() -> None:
    message = message_of(
        supports=[{"region": "z-min"}, {"region": {"point_set": "a"}}, {"region": AWAY}],
        springs=[
            {"region": {"point_set": "b"}, "stiffness_n_m3": 1.0},
            {"region": {"nearest_m": [[0.0, 0.0, 0.0], 1]}, "stiffness_n_m3": 1.0},
        ],
        loads={**PRESSED, "regions": ["z-max", AWAY, {"nearest_m": [[1.0, 1.0, 1.0], 2]}]},
        needs={"outputs": AWAY},
        observed={"region": AWAY},
    )
    for part in (
        "`supports[1].region`: unknown point set 'a'. Known: none",
        "`supports[2].region`: region {'sphere_m': ((9.0, 9.0, 9.0), 0.1)} holds no node",
        "`springs[0].region`: unknown point set 'b'",
        "`springs[1].region` holds no facet of the surface",
        "`loads.regions[1]`: region",
        "`loads.regions[2]` holds nodes but no facet",
        "`needs.outputs`: region",
        "`observed.region`: region",
    ):
        assert message.count(part) == 1, part


def test_regions_of_several_tables_are_named_at_once_and_at_most_eight() -> None:
    force = {"kind": "force", "samples": 4, **PLANS["force"], "region": AWAY}
    supports = [{"region": {"point_set": f"{number}"}} for number in range(7)]
    tables = [force, {**PRESSED, "regions": [AWAY]}]
    message = message_of(loads=tables)
    assert "`loads[0].region`: region" in message
    assert "`loads[1].regions[0]`: region" in message
    message = message_of(loads=tables, supports=supports)
    assert "`supports[6].region`: unknown point set '6'" in message
    assert message.endswith(" And 1 more.")


def test_supports_that_fix_every_node_hide_no_other_mistake() -> None:
    message = message_of(supports=[{"region": AWAY}], needs={"outputs": AWAY})
    assert "`supports[0].region`" in message
    everything = {"region": {"box_m": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]}}
    message = message_of(supports=[everything], loads={**PRESSED, "regions": [AWAY]})
    assert "the supports fix every node" in message
    assert "`loads.regions[0]`: region" in message


def test_contradictions_are_listed_beside_mistakes_of_other_tables() -> None:
    message = message_of(
        sppl=1,
        material={**CUBE["material"], "young_pa": -5.0},
        loads=PRESSED,
        split={"by": "region"},
        tests={"unseen_region": "x-min", "paper_magnitude_n": [0.0, 1.0]},
        parameters={"young_pa": [50.0, 100.0], "scale": {"x": [0.9, 1.1]}},
    )
    for part in (
        "unknown key `sppl`",
        "`material.young_pa` must be greater than 0; got -5.0",
        "`split.by` must be 'sample' where `loads.kind` is 'pressure'",
        "`tests.unseen_region` must be absent",
        "`tests.paper_magnitude_n` must be absent",
        "`parameters.scale` must be absent where the loads are pressures.",
    ):
        assert message.count(part) == 1, part
    message = message_of(loads=PRESSED, split={"by": "region"}, tests={"samples": 0, "n": 1})
    for part in ("`split.by` must be", "unknown key `tests.n`", "`tests.samples` must be greater"):
        assert message.count(part) == 1, part


def test_a_table_that_is_not_valid_contradicts_nothing() -> None:
    message = message_of(
        loads={**PRESSED, "samples": 0},
        split={"by": "region"},
        parameters={"young_pa": [2.0, 1.0]},
        tests={"unseen_parameters": 2.0},
    )
    assert "`loads.samples` must be greater" in message
    assert "`parameters.young_pa`: the lower end" in message
    assert "absent" not in message
    assert "split" not in message


def test_all_wrong_parameters_are_listed() -> None:
    message = message_of(parameters={"c10_pa": [1.0, 2.0], "poisson": [0.3, 0.6], "k2": [1.0, 2.0]})
    for name in ("c10_pa", "k2"):
        assert f"`parameters.{name}` cannot be sampled: the law neo-hookean has no" in message
    assert "`parameters.poisson` must stay in [-0.999999, 0.499999]" in message
