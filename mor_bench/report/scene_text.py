"""A scene in a sentence: body, material, supports and loads."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mor_bench.errors import MorBenchError
from mor_bench.report.number_format import number
from mor_bench.specs import (
    AnyLoads,
    ChamberedGeometry,
    Contact,
    DatasetSpec,
    LineLoads,
    Motion,
    PointLoads,
    PointSetRegion,
    Pressure,
    Region,
    Several,
    SphereInstrument,
    TubeGeometry,
    load_recorded_spec,
)
from mor_bench.specs.support_spec import AXES

LAWS = {
    "saint-venant-kirchhoff": "Saint Venant-Kirchhoff",
    "neo-hookean": "neo-Hooke",
    "mooney-rivlin": "Mooney-Rivlin",
    "yeoh": "Yeoh",
    "ogden": "Ogden",
    "holzapfel-gasser-ogden": "Holzapfel-Gasser-Ogden",
}
"""Names of laws that are names of people."""

SYMBOLS = {"young_pa": "E", "poisson": "ν"}
"""Symbols of material constants."""

DIRECTIONS = {
    "force": "in any direction",
    "point": "in any direction",
    "line": "in any direction",
    "normal": "along the normal",
    "tangential": "along the surface",
}
"""Directions of forces, by the kind of load."""


def recorded_scene(content: Mapping[str, Any]) -> DatasetSpec | None:
    """Return the description of a generated dataset in a run; None for others and damaged ones."""
    try:
        found = load_recorded_spec({"name": "scene", "title": "", **content}, "a run")
    except MorBenchError:
        return None
    return found if isinstance(found, DatasetSpec) else None


def scene_text(content: Mapping[str, Any]) -> str:
    """Describe a scene of a run in a sentence; empty if it has no loads or is not known."""
    spec = recorded_scene(content)
    if spec is None or spec.loads is None:
        return ""
    parts = [
        f"{_body(spec)}, {_material(spec)}",
        _supports(spec),
        "under gravity" if spec.gravity else "",
        "on springs" if spec.springs else "",
        "under constant pressures" if spec.constant_pressures else "",
        f"with {_loads(spec.loads)}{_parameters(spec)}.",
    ]
    text = " ".join(filter(None, parts))
    return text[0].upper() + text[1:]


def _body(spec: DatasetSpec) -> str:
    """Name the shape and its size."""
    body = spec.geometry
    if isinstance(body, TubeGeometry):
        return f"tube with radii of {body.radii_m[0]:g} and {body.radii_m[1]:g} m"
    if isinstance(body, ChamberedGeometry):
        n = len(body.chambers)
        sides = " × ".join(f"{side:g}" for side in body.size_m)
        return f"box of {sides} m with {n} chamber{'s' if n > 1 else ''}"
    size = getattr(body, "size_m", None)
    if size:
        return f"{body.shape} of {' × '.join(f'{side:g}' for side in size)} m"
    return "liver" if getattr(body, "surface", None) == "liver" else f"body ({body.shape})"


def _material(spec: DatasetSpec) -> str:
    """Name the law and its constants."""
    material = spec.material
    constants = (
        f"{SYMBOLS.get(name, name)} {number(value)}{' Pa' if name.endswith('_pa') else ''}"
        for name, value in material.model_dump().items()
        if isinstance(value, float)
    )
    return f"{LAWS.get(material.law, material.law)} ({', '.join(constants)}),"


def _parameters(spec: DatasetSpec) -> str:
    """State the ranges of sampled parameters; empty without any."""
    if spec.parameters is None:
        return ""
    ranges = (
        f"{SYMBOLS.get(name, name)} from {number(low)} to {number(high)}"
        f"{' Pa' if name.endswith('_pa') else ''}"
        for name, (low, high) in spec.parameters.ranges.items()
    )
    return f"; sampled per body: {', '.join(ranges)}"


def _supports(spec: DatasetSpec) -> str:
    """Name the regions that are clamped, and those that are held in some directions only."""
    whole = [s.direction is None and set(s.components) == set(AXES) for s in spec.supports]
    clamped = [s.region for s, all_of_it in zip(spec.supports, whole, strict=True) if all_of_it]
    others = [s.region for s, all_of_it in zip(spec.supports, whole, strict=True) if not all_of_it]
    parts = [("clamped at", clamped), ("held in some directions at", others)]
    return " and ".join(f"{how} {_regions(regions)}" for how, regions in parts if regions)


def _regions(regions: Iterable[Region]) -> str:
    """Name regions that have a name, or are sets of nodes."""
    names = (
        region
        if isinstance(region, str)
        else region.point_set
        if isinstance(region, PointSetRegion)
        else "a part of its surface"
        for region in regions
    )
    return " and ".join(dict.fromkeys(names))


def _loads(loads: AnyLoads) -> str:
    """State number, size, direction and place of the loads."""
    if isinstance(loads, Several):
        return ", and ".join(map(_loads, loads.tables))
    low, high = loads.magnitude
    ends = f"{low:g} to {high:g} {loads.unit}"
    if isinstance(loads, Motion):
        return f"a tool on {_regions([loads.region])} that moves by {ends}"
    if isinstance(loads, Contact):
        shape = "sphere" if isinstance(loads.instrument, SphereInstrument) else "plane"
        return (
            f"a rigid {shape} that touches {_regions([loads.region])} without friction and moves "
            f"by {ends}"
        )
    if isinstance(loads, Pressure):
        kind = "following" if loads.follower else "dead"
        return f"{kind} pressures of {ends} on {_regions(loads.regions)}"
    n, how = loads.simultaneous, DIRECTIONS[loads.kind]
    count = "one dead force" if n == 1 else f"{n} dead forces"
    forces = f"{count} of {ends} {how}"
    if isinstance(loads, LineLoads):
        return f"{forces} along lines"
    where = f"{forces} on {_regions([loads.region])}"
    if isinstance(loads, PointLoads):
        return f"{where}, each at a point"
    return f"{where}, as a uniform traction on a patch of {loads.patch_area_m2:g} m² each"
