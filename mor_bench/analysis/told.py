"""Classes of methods by what they are told at query time, in words, and a filter by class."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import get_args

from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row
from mor_bench.specs.method_spec import MethodSpec, Told

CLASSES: tuple[Told, ...] = get_args(Told)
"""All classes, the one with the least information first."""

FORCE = "force"
"""Input of most datasets' queries."""

LEGEND = (
    "What a method is told at query time: the force (or the displacements of some nodes) only; "
    "also its linear response, which needs the equations once; or the equations. Snapshots: "
    "whether it learned from samples."
)


def told_text(told: Told | None, given: str = FORCE) -> str:
    """Name a class, such as "force and linear response", for the input that `given_by` names."""
    names = {"input": f"{given} only", "linear-response": f"{given} and linear response"}
    return names.get(told or "", told or "not stated")


def class_text(row: Row, given: str) -> str:
    """Describe a row's information, such as "equations, snapshots, reference"."""
    return class_words(told_text(row.told, given), row.snapshots, row.reference)


def class_words(told: str, snapshots: bool | None, reference: bool) -> str:
    """Join the words of a class of information."""
    learned = {True: "snapshots", False: "no snapshots", None: ""}[snapshots]
    return ", ".join(filter(None, (told, learned, "reference" if reference else "")))


def class_of_method(spec: MethodSpec, profile: str) -> str:
    """Describe the information of a method of forces with the parameters of its file."""
    told = spec.told_with(spec.parameters_of(profile))
    return class_words(told_text(told), spec.snapshots, spec.reference)


def given_by(comparison: Comparison, dataset: str) -> str:
    """Name the input that a dataset's queries give: the force, or displacements of some nodes."""
    spec = comparison.datasets.get(dataset, {})
    if spec.get("observed"):
        return "observed displacements"
    kind = (spec.get("loads") or {}).get("kind", "")
    return {
        "displacement": "prescribed displacements",
        "contact": "displacement of the instrument",
    }.get(kind, FORCE)


def classes_of(rows: Iterable[Row]) -> list[Told | None]:
    """List the classes of rows, the least information first and unknown ones last."""
    found = {row.told for row in rows}
    return [told for told in (*CLASSES, None) if told in found]


def told_at_most(comparison: Comparison, told: Told | None) -> Comparison:
    """Keep the rows that are told no more than a class; None keeps all."""
    if told is None:
        return comparison
    allowed = CLASSES[: CLASSES.index(told) + 1]
    return replace(comparison, rows=[row for row in comparison.rows if row.told in allowed])
