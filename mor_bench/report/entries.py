"""Rows with conclusions about each: whether it meets the needs, is on the front, and intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any

from mor_bench.analysis.frontier import (
    Point,
    median_error,
    median_latency_ms,
    non_dominated,
    number_or_inf,
)
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row

Analysis = Mapping[str, Any]
"""Content of comparison.json, from `mor_bench.analysis.analyse.analyse`."""

Interval = tuple[float, float]


@dataclass(frozen=True)
class Needs:
    """Accuracy and speed that a dataset requires; infinite where it requires none.

    Attributes
    ----------
    error : float
        Median relative L2 error, as a fraction.
    latency_ms : float
        Median latency, ms.
    """

    error: float = inf
    latency_ms: float = inf


@dataclass(frozen=True)
class Entry:
    """A row of the results with conclusions about it.

    Attributes
    ----------
    row : Row
    meets_needs : bool
        It ran, and its median error and median latency are within the dataset's needs.
    on_front : bool
        No other configuration of the dataset is both faster and more accurate.
    intervals : dict
        95 % intervals, as far as known, of `rel_l2_median`, `mean_dof_m` and `latency_ms`.
    """

    row: Row
    meets_needs: bool = False
    on_front: bool = False
    intervals: Mapping[str, Interval] = field(default_factory=dict)

    @property
    def label(self) -> str:
        return self.row.label

    @property
    def method(self) -> str:
        return self.row.method

    @property
    def swept(self) -> Mapping[str, Any]:
        return self.row.swept

    @property
    def ran(self) -> bool:
        return self.row.ok

    @property
    def n_failed(self) -> int:
        """Number of test samples without a prediction."""
        return self.row.n_failed or 0

    def figure(self, part: str, name: str) -> float | None:
        """Look up a number such as ``figure("error", "mean_dof_m")``; None if not measured."""
        found = getattr(self.row, part)
        if found is None:
            return None
        if isinstance(found, dict):
            value = found.get(name)
        else:
            value = getattr(found, name) if name in found.model_fields_set else None
        return None if value is None else float(value)

    @property
    def error(self) -> float:
        """Median relative L2 error over the test set, as a fraction; infinite if there is none."""
        return median_error(self.row)

    @property
    def latency_ms(self) -> float:
        """Median latency, ms; infinite if there is none."""
        return median_latency_ms(self.row)

    @property
    def mean_error_m(self) -> float:
        """Mean error per degree of freedom, ē, m; infinite if there is none."""
        return number_or_inf(self.figure("error", "mean_dof_m"))

    @property
    def unstable(self) -> Sequence[str]:
        """Reasons why the timing is not reliable; empty if it is reliable or was not checked."""
        latency = self.row.latency_ms
        if latency is None or latency.stable is not False:
            return []
        return latency.unstable_because or ["no reason given"]

    @property
    def trouble(self) -> str | None:
        """Reason for a failure, a skip or missing predictions in one line, or None."""
        row = self.row
        if not self.ran:
            return f"{row.status}: {row.reason or 'no reason given'}"
        if self.n_failed:
            reason = f" ({row.reason})" if row.reason else ""
            return (
                f"{self.n_failed} of {row.n_test} test samples without a prediction, "
                f"counted as infinite error{reason}"
            )
        return None


def dataset_names(comparison: Comparison) -> list[str]:
    """List the datasets that were recorded or have rows."""
    return list(dict.fromkeys([*comparison.datasets, *(row.dataset for row in comparison.rows)]))


def needs_of(comparison: Comparison, dataset: str) -> Needs:
    """Return the needs of a dataset."""
    stated = comparison.datasets.get(dataset, {}).get("needs") or {}
    return Needs(float(stated.get("error", inf)), float(stated.get("latency_ms", inf)))


def entries_of(
    comparison: Comparison, dataset: str, analysis: Analysis | None = None
) -> list[Entry]:
    """List all configurations of a dataset in the order in which they ran.

    The intervals come from the analysis and are missing without it.
    """
    needs = needs_of(comparison, dataset)
    rows = [row for row in comparison.rows if row.dataset == dataset]
    points = [
        Point(median_latency_ms(row), median_error(row), row.label)
        for row in rows
        if row.ok and isfinite(median_latency_ms(row))
    ]
    front = {point.label for point in non_dominated(points)}
    records = (analysis or {}).get("rows", ())
    intervals = {r["label"]: _intervals(r) for r in records if r["dataset"] == dataset}
    return [
        Entry(
            row,
            row.ok
            and isfinite(median_error(row))
            and median_error(row) <= needs.error
            and median_latency_ms(row) <= needs.latency_ms,
            row.label in front,
            intervals.get(row.label, {}),
        )
        for row in rows
    ]


def _intervals(record: Mapping[str, Any]) -> dict[str, Interval]:
    """Intervals of an analysis record that have a lower end; a missing upper end is infinite."""
    figures = {name: record[name] for name in ("rel_l2_median", "mean_dof_m", "latency_ms")}
    return {
        name: (f["low"], inf if f["high"] is None else f["high"])
        for name, f in figures.items()
        if f["low"] is not None
    }


def best_per_method(entries: Sequence[Entry]) -> list[Entry]:
    """Return the configuration with the smallest ē of each method that ran."""
    ran = [entry for entry in entries if entry.ran]
    methods = dict.fromkeys(entry.method for entry in ran)
    return [
        min((e for e in ran if e.method == method), key=lambda e: (e.mean_error_m, e.error))
        for method in methods
    ]
