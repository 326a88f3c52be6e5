"""Contradictions between the tables of a dataset file: a sentence for each of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic_core import PydanticCustomError

from mor_bench.specs.loads_spec import (
    AnyLoads,
    Contact,
    LineLoads,
    Motion,
    PointLoads,
    Pressure,
    Several,
    tables_of,
)
from mor_bench.specs.sampled_parameters import wrong_parameters

FIXED_REGIONS = (Motion, Pressure, Contact, Several)
"""Plans whose samples all act on the same regions."""

Tables = Mapping[str, Any]
"""The tables of a file by key, defaults included. A table that is not valid is missing."""


def contradiction(sentence: str) -> PydanticCustomError:
    """Return an error whose message names all its keys itself."""
    return PydanticCustomError("contradiction", "{sentence}", {"sentence": sentence})


def contradictions(tables: Tables) -> list[str]:
    """Return all contradictions between tables that are valid on their own."""
    return [*_of_fixed_regions(tables), *_of_parameters(tables)]


def _of_fixed_regions(tables: Tables) -> Iterator[str]:
    """Yield what a plan excludes whose samples do not act on one region each."""
    loads, split, tests = tables.get("loads"), tables.get("split"), tables.get("tests")
    if not isinstance(loads, FIXED_REGIONS):
        return
    where = f"where `loads.kind` is {loads.kind!r}"
    why = "all samples act on the same regions"
    if isinstance(loads, Several):
        where, why = "with several tables `[[loads]]`", "they act on several regions at once"
    moves = isinstance(loads, Motion | Contact)
    possible = ("sample", "direction") if moves else ("sample",)
    if split is not None and split.by not in possible:
        yield (
            f"`split.by` must be {' or '.join(map(repr, possible))} {where}, since {why}; "
            f"got {split.by!r}"
        )
    if tables.get("observed") is not None and moves:
        given = "displacements of `loads.region`"
        if isinstance(loads, Contact):
            given = "displacement of `loads.instrument`"
        yield f"`observed` must be absent {where}: the methods get the {given}"
    if _oblique(tables) and isinstance(loads, Contact):
        yield f"`supports.direction` must be absent {where}"
    for name in ("unseen_region", "paper_magnitude_n"):
        if getattr(tests, name, None) is not None:
            yield f"`tests.{name}` must be absent {where}"


def _of_parameters(tables: Tables) -> Iterator[str]:
    """Yield why the scene cannot take its sampled parameters."""
    loads, parameters = tables.get("loads"), tables.get("parameters")
    if parameters is None:
        outside = "unseen_parameters" in getattr(tables.get("tests"), "model_fields_set", ())
        if outside and "parameters" in tables:
            yield "`tests.unseen_parameters` must be absent without the table `parameters`"
        return
    if "material" in tables:
        yield from wrong_parameters(parameters, tables["material"])
    others = {
        "`loads.steps` is above 1": loads is not None and loads.steps > 1,
        "`supports.direction` is given": _oblique(tables),
        "`observed` is given": tables.get("observed") is not None,
        "`needs.stress` is true": getattr(tables.get("needs"), "stress", False),
        "`loads.follower` is true": isinstance(loads, Pressure) and loads.follower,
    }
    for where in (other for other, present in others.items() if present):
        yield f"`parameters` must be absent where {where}"
    fixed_shape = {
        "an instrument presses": isinstance(loads, Contact),
        "the loads are pressures": _has(loads, Pressure),
        "the loads act on points or lines": _has(loads, PointLoads, LineLoads),
        "`springs` are given": bool(tables.get("springs")),
        "`constant_pressures` are given": bool(tables.get("constant_pressures")),
    }
    for where in (other for other, present in fixed_shape.items() if present):
        if parameters.scale is not None:
            yield f"`parameters.scale` must be absent where {where}"


def _has(loads: AnyLoads | None, *kinds: type) -> bool:
    """Return whether one table of loads is of some kinds."""
    return loads is not None and any(isinstance(table, kinds) for table in tables_of(loads))


def _oblique(tables: Tables) -> bool:
    return any(support.direction is not None for support in tables.get("supports", ()))
