"""Tables that compare methods: time at error, error at time, pairs, whole cost, profile."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

from mor_bench.analysis.frontier import TARGET_ERRORS
from mor_bench.analysis.performance_profile import share_within
from mor_bench.analysis.verdict import needs_of
from mor_bench.report.entries import Analysis, Entry, entries_of, told_by_method
from mor_bench.report.number_format import (
    bytes_text,
    number,
    percent,
    whole,
)
from mor_bench.report.short_names import short_names
from mor_bench.report.text_table import TextTable
from mor_bench.results.comparison import Comparison

NOT_REACHED = "not reached"

PAIRWISE_LEGEND = (
    "+2: the row's method is 2 times faster than the column's. -2: 2 times slower. "
    "?: undecided, because the 95 % interval of the ratio contains 1."
)

TARGETS_NOTE = (
    "Of each method, the configuration that the verdict would choose for the target: its error is "
    "the 95 % upper bound on the validation part. Its figures are those of the test set, with the "
    "95 % interval."
)

FACTORS = (1.0, 1.5, 2.0, 5.0, 10.0, 100.0)
"""Columns of the performance profile's table."""


def target_table(comparison: Comparison, dataset: str, kind: str, analysis: Analysis) -> TextTable:
    """Build the table of time at error or error at time, a row per method.

    A cell has the figure of the configuration that validation selects for the target, its name,
    and the 95 % interval. `kind` is "time_at_error" or "error_at_time".
    """
    told = told_by_method(entries_of(comparison, dataset))
    names = short_names(row for row in comparison.rows if row.dataset == dataset)
    of_time = kind == "time_at_error"
    key, shown, unit = ("latency_ms", number, "ms") if of_time else ("error", percent, "%")
    headings: dict[str, None] = {"method": None}
    rows: dict[str, list[str]] = {}
    for record in analysis[kind]:
        if record["dataset"] != dataset:
            continue
        best, cell = record["best"], NOT_REACHED
        if best is not None:
            lines = [f"{shown(record[key])} {unit}", names[best["label"]].values]
            if of_time and best["error"] > record["target_rel_l2_median"]:
                lines.append(f"test error {percent(best['error'])} %")
            cell = "\n".join(filter(None, [*lines, _target_interval(record, shown)]))
        headings[_target_heading(record)] = None
        rows.setdefault(record["method"], []).append(cell)
    title = (
        "Time at error: median latency at a median relative L2 error"
        if of_time
        else "Error at time: median relative L2 error within a median latency"
    )
    named = ["\n".join(filter(None, (name, told.get(name, "")))) for name in rows]
    cells = [[name, *row] for name, row in zip(named, rows.values(), strict=True)]
    return TextTable(title, TARGETS_NOTE, list(headings), cells)


def _target_heading(record: Mapping[str, Any]) -> str:
    if "target_latency_ms" in record:
        return f"{number(record['target_latency_ms'])} ms"
    return f"{percent(record['target_rel_l2_median'])} %"


def _target_interval(record: Mapping[str, Any], shown: Callable[[float | None], str]) -> str:
    """Format the interval of a target."""
    low, high = record["low"], record["high"]
    return "" if low is None or low == high == 0 else f"{shown(low)}–{shown(high)}"


@dataclass(frozen=True)
class Pairs:
    """Ratios of speed of the pairs of methods at an error.

    Attributes
    ----------
    methods, absent : list of str
        Methods that reach the error, and those that do not.
    cells : list of list of str
        A row for each of `methods`. ``+2.3``: it is 2.3 times faster than the column's method.
        ``-2.3``: it is slower. ``?+1.1`` and ``?-1.1``: undecided.
    intervals : list of list of str
        95 % intervals of these factors.
    """

    methods: list[str]
    absent: list[str]
    cells: list[list[str]]
    intervals: list[list[str]]


def pairs_at(comparison: Comparison, dataset: str, target: float, analysis: Analysis) -> Pairs:
    """Collect the pairs of methods at an error."""
    records = {
        (r["a"], r["b"]): r
        for r in analysis["pairwise"]
        if r["dataset"] == dataset and r["target_rel_l2_median"] == target
    }
    ran = dict.fromkeys(row.method for row in comparison.rows if row.dataset == dataset)
    paired = {a for a, _ in records}
    missing = {name for record in records.values() for name in record["by"]}
    methods = [method for method in ran if method in paired - missing]
    lines = [[_factor(records[a, b]) if a != b else ("·", "") for b in methods] for a in methods]
    return Pairs(
        methods,
        [method for method in ran if method in missing],
        [[cell for cell, _ in line] for line in lines],
        [[interval for _, interval in line] for line in lines],
    )


def _factor(record: Mapping[str, Any]) -> tuple[str, str]:
    ratio, low, high = (record[name] for name in ("ratio", "low", "high"))
    slower = ratio is not None and ratio > 1
    if not slower:  # the record holds a ratio of times, the inverse of a speed-up
        ratio, low, high = (None if x is None else 1 / x for x in (ratio, high, low))
    known = low is not None or high is not None
    interval = f"{'0' if low is None else number(low)}–{'∞' if high is None else number(high)}"
    unsure = "?" if record["verdict"] == "undecided" else ""
    return f"{unsure}{'-' if slower else '+'}{number(ratio)}", interval if known else "no interval"


def pairwise(comparison: Comparison, dataset: str, analysis: Analysis) -> list[TextTable]:
    """Build a matrix of pairs for each error that at least two methods reach."""
    tables = []
    records = (r for r in analysis["pairwise"] if r["dataset"] == dataset)
    needed = needs_of(comparison, dataset).error
    for target in sorted({r["target_rel_l2_median"] for r in records}, reverse=True):
        pairs = pairs_at(comparison, dataset, target, analysis)
        if len(pairs.methods) < 2:
            continue
        rows = [
            [
                method,
                *(f"{cell}\n{interval}".strip() for cell, interval in zip(*lines, strict=True)),
            ]
            for method, *lines in zip(pairs.methods, pairs.cells, pairs.intervals, strict=True)
        ]
        of_need = ", the required error" if target == needed else ""
        note = f"{PAIRWISE_LEGEND} Below: the 95 % interval of that factor. Compared are the "
        note += "configurations that the verdict would choose for this error."
        note += f" Not reached by {', '.join(pairs.absent)}." if pairs.absent else ""
        title = f"Who is faster at {percent(target)} %{of_need}"
        tables.append(TextTable(title, note, ["", *pairs.methods], rows))
    return tables


def break_even_table(
    dataset: str, analysis: Analysis, entries: Sequence[Entry]
) -> TextTable | None:
    """Build the table of break-even queries and of the figures behind them."""
    by_label = {entry.label: entry for entry in entries}
    rows, absent = [], dict[float, list[str]]()
    for record in analysis["break_even"]:
        if record["dataset"] != dataset:
            continue
        if record["verdict"] == NOT_REACHED:
            absent.setdefault(record["target_rel_l2_median"], []).append(record["method"])
            continue
        entry = by_label[record["label"]]
        paid = record["queries"] is not None
        queries = whole(record["queries"]) if paid else record["verdict"]
        why = f"\n{record['reason']}" if record["verdict"] == "unknown" else ""
        rows.append(
            [
                record["method"],
                f"{percent(record['target_rel_l2_median'])} %",
                record["label"],
                queries + why,
                whole(record["queries_with_tuning"]),
                number(record["latency_ms"]),
                number(record["fem_latency_ms"]),
                *(number(record["offline_core_s"][part]) for part in ("data", "fit", "all_fits")),
                bytes_text(entry.figure("memory_bytes", "fit")),
                bytes_text(entry.row.model_bytes),
            ]
        )
    headings = ["method", "error", "configuration", "break-even without tuning", "with tuning"]
    headings += ["latency (ms)", "full-order (ms)", "data (core-s)", "fit (core-s)"]
    headings += ["all fits (core-s)", "memory", "model"]
    note = (
        "Each row is the fastest configuration of a method that meets this error by the verdict's "
        "rule: the 95 % upper bound on the validation part. "
        "Break-even, queries: core-seconds of data and fit beyond those of the full-order model, "
        "divided by those that a query saves. "
        "With tuning: all fits of the method count, failed ones too. "
        "The saving is against the fastest full-order configuration that meets the same error "
        "by the same rule. "
        "Never: the full-order model is as fast."
    )
    for target, methods in absent.items():
        note += f" Not reached at {percent(target)} %: {', '.join(methods)}."
    return TextTable("Whole cost", note, headings, rows) if rows else None


def profile_table(analysis: Analysis) -> TextTable | None:
    """Build the performance profile: shares of problems solved within factors of the fastest."""
    found = analysis["profile"]
    if not found["problems"] or len(found["factors"]) < 2:
        return None
    rows = [
        [method, *(f"{100 * share_within(factors, tau):.0f}" for tau in (*FACTORS, inf))]
        for method, factors in found["factors"].items()
    ]
    headings = ["method", *(f"≤ {tau:g}× (%)" for tau in FACTORS), "solved (%)"]
    return TextTable("Performance profile", profile_note(found), headings, rows)


def profile_note(found: Mapping[str, Any]) -> str:
    """Explain the problems of a performance profile, and how to read it."""
    n_datasets = found["n_datasets"]
    over = f"{n_datasets} datasets" if n_datasets > 1 else "one dataset"
    targets = ", ".join(f"{percent(target)} %" for target in TARGET_ERRORS)
    return (
        f"A problem is a dataset at an error: {over} at {targets}. At least one method "
        f"solves {len(found['problems'])} of them. The {found['n_unsolved']} that no "
        "method solves are left out. Shown is the share that a method solves within a "
        "factor of the fastest method's time. It only shows which method is fastest and "
        "which solves the most problems. The order of the others depends on which methods "
        "take part."
    ) + (" With one dataset this says nothing about other scenes." if n_datasets == 1 else "")
