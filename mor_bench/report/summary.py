"""The facts that tables, figures and page share: which configurations there are, which meet the needs, which is best."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, isnan
from typing import Any

from mor_bench.analysis.frontier import Point, non_dominated
from mor_bench.results.comparison import Comparison

SHORT_NAMES = {
    "n_modes": "r",
    "tolerance": "tol",
    "cubature_tolerance": "ctol",
    "n_input_modes": "k",
    "n_output_modes": "r",
}
"""How a swept parameter is called where space is short; others go by the initials of their words."""


OF_THE_MESH = "methods' errors below it are errors against this mesh, not against the body"


@dataclass(frozen=True)
class Entry:
    """A row of the results, with what was concluded about it.

    Attributes
    ----------
    row : dict
        As in `Comparison.rows`.
    meets_needs : bool
        It ran, and its median error and median latency are within what the scene needs.
    on_front : bool
        No other configuration of the dataset is both faster and more accurate.
    intervals : dict
        By `rel_l2_median`, `mean_dof_m`, `latency_ms`: the ends of the 95 % interval, where there is one.
    """

    row: dict[str, Any]
    meets_needs: bool
    on_front: bool
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def label(self) -> str:
        return str(self.row["label"])

    @property
    def method(self) -> str:
        return str(self.row["method"])

    @property
    def ran(self) -> bool:
        return bool(self.row["status"] == "ok")

    @property
    def n_failed(self) -> int:
        return int(self.row.get("n_failed") or 0)

    @property
    def swept(self) -> dict[str, str]:
        """The swept parameters, as the label names them."""
        inside = self.label.removeprefix(self.method).strip().removeprefix("[").removesuffix("]")
        pairs = (part.partition("=") for part in re.split(r", (?=\w+=)", inside))
        return {key: value for key, equals, value in pairs if equals}

    def figure(self, group: str, name: str) -> float | None:
        """A number of the row, such as ``figure("error", "mean_dof_m")``; None if the row does not have it."""
        value = (self.row.get(group) or {}).get(name)
        return None if value is None else float(value)

    @property
    def error(self) -> float:
        """Relative l2, median over the test set; infinite if there is none."""
        return _or_infinite(self.figure("error", "rel_l2_median"))

    @property
    def latency_ms(self) -> float:
        """Median latency, ms; infinite if there is none."""
        return _or_infinite(self.figure("latency_ms", "median"))

    @property
    def unstable(self) -> list[str]:
        """Why the timing is not to be relied on; empty if it is, or if nobody looked."""
        latency = self.row.get("latency_ms") or {}
        if latency.get("stable") is not False:
            return []
        return [str(reason) for reason in latency.get("unstable_because") or ["no reason given"]]

    @property
    def mean_error_m(self) -> float:
        """ē, m; infinite if there is none."""
        return _or_infinite(self.figure("error", "mean_dof_m"))

    @property
    def trouble(self) -> str | None:
        """What went wrong, in one line, or None."""
        if not self.ran:
            return f"{self.row['status']}: {self.row.get('reason') or 'no reason given'}"
        if self.n_failed:
            said = f" ({self.row['reason']})" if self.row.get("reason") else ""
            return f"{self.n_failed} of {self.row.get('n_test')} test samples without a prediction, counted as infinite error{said}"
        return None

    @property
    def warnings(self) -> list[str]:
        """What the method warned of while it was fitted and run."""
        return [str(warning) for warning in self.row.get("warnings") or []]


def _or_infinite(value: float | None) -> float:
    return inf if value is None or isnan(value) else value


def dataset_names(comparison: Comparison) -> list[str]:
    """Datasets that were recorded or have rows."""
    return list(dict.fromkeys([*comparison.datasets, *(row["dataset"] for row in comparison.rows)]))


def needs_of(comparison: Comparison, dataset: str) -> dict[str, float]:
    """The `error` and `latency_ms` that a dataset needs; infinite where it states none."""
    needs = comparison.datasets.get(dataset, {}).get("needs") or {}
    return {key: float(needs.get(key, inf)) for key in ("error", "latency_ms")}


def entries_of(
    comparison: Comparison, dataset: str, analysis: Mapping[str, Any] | None = None
) -> list[Entry]:
    """The configurations of a dataset in the order in which they ran, failed and skipped ones included.

    Parameters
    ----------
    comparison : Comparison
    dataset : str
        Its name.
    analysis : dict, optional
        From `mor_bench.analysis.analyse.analyse`, for the intervals.
    """
    needs = needs_of(comparison, dataset)
    rows = [row for row in comparison.rows if row["dataset"] == dataset]
    plain = [Entry(row, False, False) for row in rows]
    points = [
        Point(e.latency_ms, e.error, str(i))
        for i, e in enumerate(plain)
        if e.ran and isfinite(e.latency_ms)
    ]
    front = {point.label for point in non_dominated(points)}
    intervals = {
        record["label"]: _intervals(record)
        for record in (analysis or {}).get("rows", ())
        if record["dataset"] == dataset
    }
    return [
        Entry(
            e.row,
            e.ran
            and e.error <= needs["error"]
            and e.latency_ms <= needs["latency_ms"]
            and isfinite(e.error),
            str(i) in front,
            intervals.get(e.label, {}),
        )
        for i, e in enumerate(plain)
    ]


def _intervals(record: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Of a record of the analysis, the intervals that have a lower end; an upper one of None is infinite."""
    figures = {name: record[name] for name in ("rel_l2_median", "mean_dof_m", "latency_ms")}
    return {
        name: (f["low"], inf if f["high"] is None else f["high"])
        for name, f in figures.items()
        if f["low"] is not None
    }


def warnings_of(entries: Sequence[Entry]) -> list[tuple[str, str]]:
    """Each different warning, after the label of the configuration that gave it, or how many did."""
    labels: dict[str, list[str]] = {}
    for entry in entries:
        for warning in entry.warnings:
            labels.setdefault(warning, []).append(entry.label)
    return [(_and_more(given), warning) for warning, given in labels.items()]


def notes_of(comparison: Comparison, dataset: str, analysis: Mapping[str, Any]) -> list[str]:
    """What a reader must know before believing the tables: timings that are not stable, test sets that disagree, untested regimes."""
    entries = entries_of(comparison, dataset)
    said: dict[str, list[str]] = {}
    for entry in entries:
        for reason in entry.unstable:
            said.setdefault(reason, []).append(entry.label)
    notes = [f"{_and_more(labels)}: timing not stable: {reason}" for reason, labels in said.items()]
    for record in analysis["hidden"]:
        if record["dataset"] == dataset and record["worse"]:
            ratio = "infinitely" if record["ratio"] is None else f"{number(record['ratio'])} times"
            notes.append(
                f"{record['label']}: on the hidden test set the median error is {ratio} as large as on the shipped one"
            )
    methods = {entry.method for entry in entries}
    notes += [
        f"{record['method']}: {record['verdict']}"
        for record in analysis["regimes"]
        if record["method"] in methods and record["in_regime"] is False
    ]
    return notes


def _and_more(labels: Sequence[str]) -> str:
    return labels[0] if len(labels) == 1 else f"{labels[0]} and {len(labels) - 1} more"


def basis_of(dataset: str, analysis: Mapping[str, Any]) -> str:
    """What the intervals of a dataset rest on, in a sentence; empty if there are none."""
    said = [
        f"Ranges hold 95 %: errors over {c['n']} {c['of']}"
        for c in analysis["clusters"]
        if c["dataset"] == dataset
    ]
    for found in analysis["timing"]:
        if found["dataset"] == dataset:
            spread = (
                "with a spread that is typical"
                if found["specific"] is None
                else f"that differ by {percent(found['specific'])} %"
            )
            drift = (
                f" and drift together by {percent(found['common'])} %" if found["common"] else ""
            )
            n = found["n_processes"]
            said.append(
                f"latencies from one process {spread} of processes"
                if n == 1
                else f"latencies over {n} processes {spread}{drift}"
            )
    return f"{', '.join(said)}." if said else ""


def best_per_method(entries: Sequence[Entry]) -> list[Entry]:
    """Of each method that ran, the configuration with the smallest ē (then the smallest median error)."""
    ran = [entry for entry in entries if entry.ran]
    methods = dict.fromkeys(entry.method for entry in ran)
    return [
        min((e for e in ran if e.method == method), key=lambda e: (e.mean_error_m, e.error))
        for method in methods
    ]


def discretisation_error(entries: Sequence[Entry]) -> str:
    """The scene's own discretisation error, as text, and what it means for the errors beside it."""
    found = next(
        (entry.row for entry in entries if entry.row.get("discretisation_error_m") is not None),
        None,
    )
    if found is None:
        return "not measured"
    relative = found.get("discretisation_rel_l2")
    beside = "" if relative is None else f", relative L2 (median) {percent(float(relative))} %"
    return f"{metres(float(found['discretisation_error_m']))} m{beside}; {OF_THE_MESH}"


def headline(comparison: Comparison, dataset: str) -> str:
    """The answer in one or two sentences: the cheapest configuration that meets the needs, or the nearest to it."""
    entries, needs = entries_of(comparison, dataset), needs_of(comparison, dataset)
    usable = [
        entry
        for entry in entries
        if entry.ran and isfinite(entry.error) and isfinite(entry.latency_ms)
    ]
    wanted = f"median relative L2 error ≤ {percent(needs['error'])} %, median latency ≤ {number(needs['latency_ms'])} ms"
    if not usable:
        return f"No configuration gave a usable result: {len(entries)} tried, none with a finite median error."
    meeting = [entry for entry in usable if entry.meets_needs]
    if meeting:
        best = min(meeting, key=lambda e: (e.latency_ms, e.error))
        count = (
            "the only configuration"
            if len(meeting) == 1
            else f"the fastest of {len(meeting)} configurations"
        )
        return f"{best.label} is {count} that meet{'s' if len(meeting) == 1 else ''} the needs ({wanted}): {_figures(best)}."

    def excess(entry: Entry) -> float:
        return max(entry.error / needs["error"], entry.latency_ms / needs["latency_ms"])

    nearest = min(usable, key=excess)
    over = [
        f"{number(value)} times the {name} allowed"
        for name, value in (
            ("error", nearest.error / needs["error"]),
            ("latency", nearest.latency_ms / needs["latency_ms"]),
        )
        if value > 1
    ]
    return f"No configuration meets the needs ({wanted}). Nearest is {nearest.label}: {_figures(nearest)}, {' and '.join(over)}."


def _figures(entry: Entry) -> str:
    latency = f"{number(entry.latency_ms)} ms (p95 {number(entry.figure('latency_ms', 'p95'))} ms)"
    worst = (
        f"{entry.n_failed} without a prediction"
        if entry.n_failed
        else f"worst sample {percent(entry.figure('error', 'rel_l2_max'))} %"
    )
    return f"{latency} at {percent(entry.error)} % ({worst})"


def number(value: float | None) -> str:
    """A number in at most seven characters; a dash if there is none."""
    if value is None:
        return "–"
    if not isfinite(value):
        return str(value)
    size = abs(value)
    if size == 0 or 1e-3 <= size < 99.95:
        return f"{value:.3g}"
    return f"{value:.0f}" if 1 <= size < 1e5 else f"{value:.1e}"


def span(
    interval: tuple[float, float] | None,
    scale: float = 1.0,
    of: Callable[[float], str] | None = None,
) -> str:
    """An interval such as ``0.51–0.56``; a dash if there is none."""
    if interval is None:
        return "–"
    low, high = ((of or number)(scale * end) for end in interval)
    return f"{low}–{high}"


def metres(value: float | None) -> str:
    """A length such as 6.4e-04; a dash if there is none."""
    if value is None:
        return "–"
    return f"{value:.1e}" if isfinite(value) else str(value)


def percent(value: float | None) -> str:
    """A fraction in percent, without the sign."""
    return number(None if value is None else 100 * value)


def size_of(n_bytes: float | None) -> str:
    """Bytes in the unit that fits."""
    if n_bytes is None:
        return "–"
    for unit in ("B", "kB", "MB"):
        if n_bytes < 999.5:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} GB"


def short_name(key: str) -> str:
    """A swept parameter's name where space is short."""
    return SHORT_NAMES.get(
        key, "".join(word[0] for word in key.split("_") if word) if "_" in key else key
    )


def short_swept(swept: dict[str, str]) -> str:
    """Swept values such as ``r=20, ctol=0.001``."""
    return ", ".join(f"{short_name(key)}={value}" for key, value in swept.items())


def short_names_used(entries: Sequence[Entry]) -> str:
    """What the short names stand for, as one line; empty if there are none."""
    keys = dict.fromkeys(key for entry in entries for key in entry.swept)
    return ", ".join(f"{short_name(key)} = {key}" for key in keys if short_name(key) != key)
