"""What a method's page shows of a comparison: its own rows, the references and the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from mor_bench.report.entries import Analysis, entries_of, verdict_of
from mor_bench.results.comparison import Comparison


def method_view(
    comparison: Comparison, analysis: Analysis, method: str
) -> tuple[Comparison, Analysis]:
    """Keep the datasets on which a method was tried, and the rows to compare it with.

    Beside its own rows these are the references, the Pareto front, and each winner. Conclusions
    about methods that lose a row are left out.
    """
    rows = []
    for dataset in dict.fromkeys(row.dataset for row in comparison.rows if row.method == method):
        choice = verdict_of(analysis, dataset).get("choice")
        rows += [
            entry.row
            for entry in entries_of(comparison, dataset)
            if entry.method == method or entry.pareto_mark or entry.label == choice
        ]
    kept = {(row.dataset, row.label) for row in rows}
    names = {row.dataset for row in rows}
    view = replace(
        comparison,
        rows=rows,
        datasets={name: spec for name, spec in comparison.datasets.items() if name in names},
        learning=[point for point in comparison.learning if point.method == method],
    )
    incomplete = {
        row.method
        for row in comparison.rows
        if row.dataset in names and (row.dataset, row.label) not in kept
    }

    def holds(record: Mapping[str, Any]) -> bool:
        if record.get("dataset", next(iter(names), None)) not in names:
            return False
        if incomplete & {record.get(key) for key in ("method", "a", "b")}:
            return False
        label = record.get("label")
        return label is None or (record["dataset"], label) in kept

    return view, {
        name: [record for record in found if holds(record)] if isinstance(found, list) else found
        for name, found in analysis.items()
    }
