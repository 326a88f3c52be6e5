"""The datasets and methods of a suite by family, with what each needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mor_bench.report.method_styles import families, style_of
from mor_bench.report.number_format import milliseconds_text, percent
from mor_bench.specs import (
    AnyDatasetSpec,
    DatasetSpec,
    MethodSpec,
    list_suite,
    load_dataset_spec,
    load_method_spec,
)

SHAPES = {
    "box": "boxes of hexahedra",
    "l-shape": "L-shapes of hexahedra",
    "chambered-box": "boxes of hexahedra with chambers",
    "tube": "tubes of hexahedra",
    "voxels": "bodies of voxels",
    "tetrahedra": "bodies of tetrahedra",
    "file": "meshes from files",
}
"""Families of datasets, by the shape of their geometry."""

TOLD = {
    "input": "force",
    "linear-response": "response",
    "equations": "equations",
    None: "not stated",
}
"""Names of what a query uses."""

LEGEND = (
    "What a method needs: its queries use the force alone, the linear response to it, or the "
    "equations; most methods learn from snapshots; some need an extra, which "
    "pip install 'mor-bench[learn]' or [mkl] adds. "
    "What a dataset needs: at most this median error and latency."
)


@dataclass(frozen=True)
class Item:
    """A dataset or a method of the suite: its name, title, family and needs."""

    name: str
    title: str
    family: str
    needs: str


def overview(suite: Path | None = None) -> dict[str, list[Item]]:
    """Return the items of a suite by kind, "datasets" and "methods"."""
    datasets = (load_dataset_spec(path) for path in list_suite("datasets", suite).values())
    methods = (load_method_spec(path) for path in list_suite("methods", suite).values())
    return {
        "datasets": [Item(s.name, s.title, dataset_family(s), dataset_needs(s)) for s in datasets],
        "methods": [Item(s.name, s.title, method_family(s), method_needs(s)) for s in methods],
    }


def by_family(items: Iterable[Item]) -> Mapping[str, list[Item]]:
    """Group items by family, in the order of the families of methods or of the first items."""
    order = list(families())
    groups: dict[str, list[Item]] = {}
    for item in sorted(items, key=lambda i: order.index(i.family) if i.family in order else 99):
        groups.setdefault(item.family, []).append(item)
    return groups


def dataset_family(spec: AnyDatasetSpec) -> str:
    """Name the family of a dataset, such as "boxes of hexahedra"."""
    if not isinstance(spec, DatasetSpec):
        return "imported snapshots"
    family = SHAPES[spec.geometry.shape]
    if spec.motion:
        return f"{family}, displacements prescribed"
    if spec.loads and spec.loads.kind == "pressure":
        return f"{family}, under pressure"
    if spec.loads and spec.loads.kind == "contact":
        return f"{family}, pressed by an instrument"
    return f"{family}, displacements observed" if spec.observed else family


def dataset_needs(spec: AnyDatasetSpec) -> str:
    """State the largest error and latency that a dataset's user accepts."""
    return f"≤ {percent(spec.needs.error)} %, ≤ {milliseconds_text(spec.needs.latency_ms)}"


def method_family(spec: MethodSpec) -> str:
    """Name the family of a method, such as "hyper-reduction"."""
    return style_of(spec.name).family


def method_needs(spec: MethodSpec) -> str:
    """State what a method needs, such as "equations, snapshots"."""
    told = "observed displacements" if spec.observed else TOLD[spec.told]
    parts: list[Any] = [told, "snapshots" if spec.snapshots else ""]
    parts.append(f"[{spec.extra}]" if spec.extra else "")
    return ", ".join(filter(None, parts))
