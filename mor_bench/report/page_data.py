"""The data of the page's charts and tables, as one JSON object per dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import numpy as np

from mor_bench.analysis.verdict import Requirements, needs_of
from mor_bench.report.entries import Analysis, Entry, by_group
from mor_bench.report.frontier_plane import lines_of
from mor_bench.report.method_styles import DARK, LINES, readable, style_of
from mor_bench.report.number_format import number, percent, span
from mor_bench.report.page_bodies import bodies
from mor_bench.report.page_facts import answer_of, method_facts, reason_of
from mor_bench.report.page_samples import (
    dataset_arrays,
    deformations,
    distributions,
    has_error,
    losses,
    mesh_of,
    positions,
    sampled,
    singular_values,
)
from mor_bench.report.page_tables import details_of
from mor_bench.report.page_verdict import Card, offline_text
from mor_bench.report.whole_cost import costs_of
from mor_bench.results.comparison import Comparison


@dataclass(frozen=True)
class Shown:
    """A dataset's entries with their short names and the verdict card.

    `untested` says, by method, why the comparison does not test it where it is built for.
    """

    comparison: Comparison
    dataset: str
    analysis: Analysis
    entries: Sequence[Entry]
    names: Mapping[str, str]
    card: Card
    untested: Mapping[str, str] = field(default_factory=dict)


def payload(shown: Shown, body_bytes: int) -> dict[str, Any]:
    """Return all data of a dataset's charts; a chart without data is None or empty."""
    comparison, dataset, entries = shown.comparison, shown.dataset, shown.entries
    picks = [pick.entry for ranking in shown.card.rankings for pick in ranking.picks]
    found = sampled(comparison, entries, picks)
    compared = [item for item in found if has_error(item.entry)]
    arrays = dataset_arrays(comparison, dataset)
    mesh = mesh_of(arrays)
    needs = needs_of(comparison, dataset)
    mesh_error = (entry.row.discretisation_rel_l2 for entry in entries)
    return {
        "dataset": dataset,
        "needs": {
            "error": None if needs.error is None else 100 * needs.error,
            "latency": needs.latency_ms,
        },
        "mesh_error": next((100 * value for value in mesh_error if value is not None), None),
        "mesh_at_least": any(entry.row.discretisation_at_least for entry in entries),
        "winner": shown.card.rankings[0].picks[0].entry.label if shown.card.rankings else None,
        "styles": {entry.method: _style(entry.method) for entry in entries},
        "dashes": [dash for _, dash in LINES],
        "groups": list(by_group(entries)),
        "rows": [_row(shown, entry, needs) for entry in entries],
        "lines": _lines(entries),
        "order": [entry.label for entry in sorted(entries, key=reading_order)],
        "distributions": distributions(found),
        "deformations": deformations(compared),
        "positions": positions(found, arrays, mesh),
        "singular": singular_values(arrays, needs.error),
        "ranks": _ranks(entries),
        "learning": _learning(comparison, dataset, shown.names),
        "losses": losses(comparison, entries),
        "costs": _costs(shown),
        "bodies": bodies(found, mesh, body_bytes),
    }


def _lines(entries: Sequence[Entry]) -> list[list[str]]:
    """Return the labels of the configurations that a line joins, line by line."""
    methods = dict.fromkeys(entry.method for entry in entries)
    return [
        [entry.label for entry in joined]
        for method in methods
        for joined in lines_of([e for e in entries if e.method == method]).values()
    ]


TEXT_CONTRAST = 5.5
"""Contrast of direct labels on white and on the dark page; in a chart's grey band it is lower."""


def _style(method: str) -> dict[str, Any]:
    style = style_of(method)
    return {
        **vars(style),
        "text": readable(style.colour, least=TEXT_CONTRAST),
        "dark_text": readable(style.dark_colour, DARK, TEXT_CONTRAST),
    }


def reading_order(entry: Entry) -> tuple[bool, bool, float]:
    """Put qualified configurations first and failed ones last, each group by latency."""
    return not entry.qualified, bool(entry.trouble), entry.latency_ms


def _row(shown: Shown, entry: Entry, needs: Requirements) -> dict[str, Any]:
    """Return the figures of one configuration: errors in %, latencies in ms, cost in core-s."""
    comparison, names = shown.comparison, shown.names
    error, latency = entry.intervals.get("rel_l2_median"), entry.intervals.get("latency_ms")
    untested = shown.untested.get(entry.method)
    return {
        "label": entry.label,
        "name": names[entry.label],
        "untested": bool(untested),
        "method": entry.method,
        "told": entry.row.told or "",
        "group": entry.group,
        "status": entry.row.status,
        "failed": bool(entry.trouble),
        "reference": entry.row.reference,
        "qualified": entry.qualified,
        "answer": answer_of(entry, needs),
        "front": entry.pareto_mark == "*",
        "unstable": bool(entry.unstable),
        "error": {
            "median": _percent(entry, "rel_l2_median"),
            "p95": _percent(entry, "rel_l2_p95"),
            "max": _percent(entry, "rel_l2_max"),
            "span": None if error is None else [100 * end for end in error],
        },
        "latency": {
            "median": entry.figure("latency_ms", "median"),
            "p95": entry.figure("latency_ms", "p95"),
            "max": _slowest(comparison, entry),
            "span": latency,
        },
        "work": entry.figure("cost", "multiply_adds"),
        "offline": entry.row.offline_core_s,
        "cells": cells_of(entry),
        "hover": [*hover_of(entry, names), *([f"† {untested}"] if untested else [])],
        "details": details_of(
            entry,
            [*method_facts(comparison, entry.method), *_tested(untested)],
            reason_of(entry, needs),
        ),
    }


def _tested(untested: str | None) -> list[tuple[str, str]]:
    """Say why the comparison does not test a method where it is built for; nothing if it does."""
    return [("tested there", f"no: {untested}")] if untested else []


def cells_of(entry: Entry) -> dict[str, list[str]]:
    """Return the texts of the table's figures: the value, and its interval if there is one."""
    error, latency = entry.intervals.get("rel_l2_median"), entry.intervals.get("latency_ms")
    return {
        "error": [
            percent(entry.figure("error", "rel_l2_median")),
            span(error, percent) if error else "",
        ],
        "latency": [
            number(entry.figure("latency_ms", "median")) + ("~" if entry.unstable else ""),
            span(latency) if latency else "",
        ],
        "offline": [number(entry.row.offline_core_s), ""],
    }


def hover_of(entry: Entry, names: Mapping[str, str]) -> list[str]:
    """Return the lines that a chart shows for a configuration."""
    cells = cells_of(entry)
    lines = [
        names[entry.label],
        f"error {cells['error'][0]} %" + (f" [{cells['error'][1]}]" if cells["error"][1] else ""),
        f"latency {cells['latency'][0].rstrip('~')} ms"
        + (f" [{cells['latency'][1]}]" if cells["latency"][1] else ""),
        f"offline {offline_text(entry)}",
        f"told: {entry.group}",
        *(f"{key} = {value}" for key, value in entry.row.parameters.items()),
    ]
    return lines + (["timing not stable"] if entry.unstable else [])


def _percent(entry: Entry, name: str) -> float | None:
    value = entry.figure("error", name)
    return None if value is None else 100 * value


def _slowest(comparison: Comparison, entry: Entry) -> float | None:
    """Return the longest latency among the raw samples, ms."""
    if not entry.ran:
        return None
    try:
        raw = comparison.samples(entry.row).get("latency_ms", ())
    except (OSError, KeyError):
        return None
    return float(np.max(raw)) if len(raw) else None


def _ranks(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """List the swept ranks of each method."""
    used: dict[str, set[int]] = {}
    for entry in entries:
        rank = entry.swept.get("n_modes")
        if isinstance(rank, int) and rank >= 1:
            used.setdefault(entry.method, set()).add(rank)
    return [{"method": method, "ranks": sorted(ranks)} for method, ranks in used.items()]


def _learning(
    comparison: Comparison, dataset: str, names: Mapping[str, str]
) -> list[dict[str, Any]]:
    """List learning curves with at least two points: samples against median error in %.

    A curve may belong to a configuration that is not compared; its full label names it.
    """
    lines: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for point in comparison.learning:
        if point.dataset == dataset and point.error and point.error.rel_l2_median > 0:
            value = 100 * point.error.rel_l2_median
            if isfinite(value):
                lines.setdefault((point.method, point.label), []).append((point.n_train, value))
    return [
        {
            "method": method,
            "label": label,
            "name": names.get(label, label),
            "points": sorted(points),
        }
        for (method, label), points in lines.items()
        if len(points) > 1
    ]


def _costs(shown: Shown) -> dict[str, Any] | None:
    """Return offline and online cost of the methods that reach the required error, in core-s."""
    found = costs_of(shown.comparison, shown.dataset, shown.analysis, shown.entries)
    if found is None:
        return None
    lines = [vars(line) for line in found.lines]
    return {**vars(found), "finding": found.finding, "queries": found.queries, "lines": lines}
