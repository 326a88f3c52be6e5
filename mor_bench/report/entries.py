"""Rows with conclusions about each: whether it qualifies, is on the front, and intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any

from mor_bench.analysis.draws import VALIDATION, Interval
from mor_bench.analysis.frontier import (
    Point,
    is_point,
    median_error,
    median_latency_ms,
    non_dominated,
    number_or_inf,
    selecting_error,
)
from mor_bench.analysis.told import CLASSES, class_text, given_by
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row

Analysis = Mapping[str, Any]
"""Content of comparison.json, from `mor_bench.analysis.analyse.analyse`."""


@dataclass(frozen=True)
class Entry:
    """A row of the results with conclusions about it.

    Attributes
    ----------
    row : Row
    qualified : bool
        The verdict's rule qualifies it.
    on_front : bool
        No other configuration of the dataset is both faster and more accurate, and it is more
        accurate than answering zero.
    group : str
        What it is told at query time, and whether it learned from snapshots, in words.
    intervals : dict
        95 % intervals, as far as known, of `rel_l2_median`, `mean_dof_m`, `latency_ms` and
        `validation_rel_l2_median`.
    bound : float or None
        The error that selects it, see `mor_bench.analysis.draws.error_bound`; None without an
        analysis.
    """

    row: Row
    qualified: bool = False
    on_front: bool = False
    group: str = ""
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    bound: float | None = None

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
    def pareto_mark(self) -> str:
        """A star on the Pareto front; "ref" for a reference, which gets no star."""
        return "ref" if self.row.reference else "*" if self.on_front else ""

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
    def error_bound(self) -> float:
        """The error that selects; without an analysis, that on the validation part or the test."""
        return selecting_error(self.row) if self.bound is None else self.bound

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


def entries_of(
    comparison: Comparison, dataset: str, analysis: Analysis | None = None
) -> list[Entry]:
    """List all configurations of a dataset in the order in which they ran.

    The intervals and the qualified ones come from the analysis and are missing without it.
    """
    rows = [row for row in comparison.rows if row.dataset == dataset]
    points = [
        Point(median_latency_ms(row), median_error(row), row.label) for row in rows if is_point(row)
    ]
    front = {point.label for point in non_dominated(points)}
    qualified = verdict_of(analysis or {}, dataset).get("qualified", ())
    groups = _groups(rows, given_by(comparison, dataset))
    records = (analysis or {}).get("rows", ())
    mine = {r["label"]: r for r in records if r["dataset"] == dataset}
    intervals = {label: _intervals(record) for label, record in mine.items()}
    bounds = {
        label: number_or_inf(record["error_bound"])
        for label, record in mine.items()
        if "error_bound" in record
    }
    return [
        Entry(
            row,
            row.label in qualified,
            row.label in front,
            groups[row.label],
            intervals.get(row.label, {}),
            bounds.get(row.label),
        )
        for row in rows
    ]


def verdict_of(analysis: Analysis, dataset: str) -> Mapping[str, Any]:
    """Return the summary of a dataset's verdict; empty if there is none."""
    found = (record for record in analysis.get("verdicts", ()) if record["dataset"] == dataset)
    return next(found, {})


def _groups(rows: Sequence[Row], given: str) -> dict[str, str]:
    """Describe each row's information; a row without a fit has the snapshots of its method."""
    known = {row.method: row.snapshots for row in rows if row.snapshots is not None}
    return {
        row.label: class_text(row.with_parts(snapshots=known.get(row.method, row.snapshots)), given)
        for row in rows
    }


def by_group(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    """Group entries by what they are told, the least information first, unknown classes last."""

    def rank(entry: Entry) -> tuple[int, bool, str]:
        told = entry.row.told
        return (CLASSES.index(told) if told else len(CLASSES)), entry.row.reference, entry.group

    groups: dict[str, list[Entry]] = {}
    for entry in sorted(entries, key=rank):
        groups.setdefault(entry.group, []).append(entry)
    return groups


def told_by_method(entries: Sequence[Entry]) -> dict[str, str]:
    """Describe the information of each method whose file states it."""
    found: dict[str, dict[str, None]] = {}
    for entry in entries:
        if entry.row.told:
            found.setdefault(entry.method, {})[entry.group] = None
    return {method: "; ".join(groups) for method, groups in found.items()}


def _intervals(record: Mapping[str, Any]) -> dict[str, Interval]:
    """Intervals of an analysis record that have a lower end; a missing upper end is infinite."""
    names = ("rel_l2_median", "mean_dof_m", "latency_ms", VALIDATION)
    figures = {name: record[name] for name in names if record.get(name)}
    return {
        name: (f["low"], inf if f["high"] is None else f["high"])
        for name, f in figures.items()
        if f["low"] is not None
    }


def best_per_method(entries: Sequence[Entry]) -> list[Entry]:
    """Return each method's most accurate configuration, by the error that the verdict uses."""
    ran = [entry for entry in entries if entry.ran]
    methods = dict.fromkeys(entry.method for entry in ran)
    return [
        min((e for e in ran if e.method == method), key=lambda e: (e.error_bound, e.error))
        for method in methods
    ]


SELECTED = "its fastest configuration that qualifies, or else its most accurate one"
"""What `selected_per_method` returns of each method, in words."""


def selected_per_method(entries: Sequence[Entry]) -> list[Entry]:
    """Return each method's fastest configuration that qualifies, or else its most accurate one."""
    fastest: dict[str, Entry] = {}
    for entry in sorted(entries, key=lambda e: e.latency_ms):
        if entry.qualified:
            fastest.setdefault(entry.method, entry)
    return [fastest.get(entry.method, entry) for entry in best_per_method(entries)]


def most_accurate(entries: Sequence[Entry]) -> tuple[Entry, str]:
    """Return the most accurate configuration, by the error that the verdict uses, and how.

    Without a validation part, as in old results, the test set selects, and the text says so.
    """
    found = min(entries, key=lambda e: (e.error_bound, e.latency_ms))
    if found.row.validation is None:
        return found, "smallest error, selected on the test set: optimistic"
    return found, "most accurate on the validation part"
