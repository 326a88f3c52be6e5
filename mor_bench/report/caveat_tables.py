"""Tables that qualify the ranking: other test sets, range flags, regimes, tuning budgets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import Any

from mor_bench.report.entries import Analysis, Entry
from mor_bench.report.number_format import DASH, number, percent
from mor_bench.report.text_table import TextTable
from mor_bench.results.row import FlagCounts, SetErrors


def named_sets(entries: Sequence[Entry]) -> TextTable | None:
    """Build the table of errors on the named test sets, a column per set."""
    names = dict.fromkeys(name for entry in entries for name in entry.row.sets)
    rows = [
        [
            entry.label,
            *(
                _set_cell(entry.row.sets[name]) if name in entry.row.sets else DASH
                for name in names
            ),
        ]
        for entry in entries
        if entry.row.sets
    ]
    note = (
        "Relative L2 error on each set: median; below it 95th percentile and maximum. "
        "Flagged: the method itself reported that the load is outside its range."
    )
    headings = ["configuration", *names]
    return TextTable("Named test sets", note, headings, rows) if rows else None


def _set_cell(found: SetErrors) -> str:
    lines = [
        f"{percent(found.rel_l2_median)} %",
        f"p95 {percent(found.rel_l2_p95)}, max {percent(found.rel_l2_max)}",
    ]
    if found.n_flagged is not None and found.n:
        lines.append(f"flagged {percent(found.n_flagged / found.n)} % of {found.n}")
    if found.n_failed:
        lines.append(f"{found.n_failed} of {found.n} without prediction")
    return "\n".join(lines)


def out_of_range(entries: Sequence[Entry]) -> TextTable | None:
    """Build the table of range flags of trained methods for loads with large errors."""
    flagged = [entry for entry in entries if entry.row.range]
    if not any(entry.row.sets for entry in flagged):
        return None  # without a set out of range there is nothing to recall
    names = dict.fromkeys(name for entry in flagged for name in entry.row.sets)
    rows = []
    for entry in flagged:
        found, sets = entry.row.range, entry.row.sets
        assert found is not None
        rows.append(
            [
                entry.label,
                percent(found.usual_rel_l2),
                f"{percent(found.false_alarms)} % of {found.n}\n{found.in_range}",
                _recall_cell(found.test, entry.error),
                *(
                    _recall_cell(sets[n], sets[n].rel_l2_median) if n in sets else DASH
                    for n in names
                ),
            ]
        )
    headings = ["configuration", "usual error (%)", "false alarms", "test", *names]
    note = (
        "Usual error: the configuration's 95th percentile of the relative L2 error in "
        "range (on the set named under the false alarms). False alarms: flagged loads of "
        "that set. Each test set shows the median error, the share of flagged loads, and "
        "the recall. Recall: the flagged share of the loads with errors larger than "
        "usual."
    )
    return TextTable("Out of range", note, headings, rows) if rows else None


def _recall_cell(found: SetErrors | FlagCounts, median: float) -> str:
    """Error, flagged share and recall on a test set, one per line."""
    recall = "no unusual errors"
    if found.recall is not None:
        recall = f"recall {percent(found.recall)} % of {found.n_unusual}"
    flagged = percent((found.n_flagged or 0) / found.n)
    return f"{percent(median)} %\nflagged {flagged} %\n{recall}"


def error_bounds(entries: Sequence[Entry]) -> TextTable | None:
    """Build the table of calibrated error bounds and their coverage of each test set.

    Infinite bounds are left out: `not_measured.unmeasured` mentions them.
    """
    bounded = [e for e in entries if e.row.bound and isfinite(e.row.bound.relative_l2)]
    if not bounded:
        return None
    names = dict.fromkeys(name for e in bounded if e.row.bound for name in e.row.bound.coverage)
    rows = []
    for entry in bounded:
        found = entry.row.bound
        assert found is not None
        samples = f"{found.n} in {found.n_groups}"
        shares = (found.coverage.get(name) for name in names)
        shown = (DASH if share is None else percent(share) for share in shares)
        rows.append([entry.label, percent(found.relative_l2), samples, *shown])
        if (scaled := found.scaled) and scaled.widths:
            shown = (
                f"{percent(scaled.coverage[name])} ({percent(scaled.widths[name])})"
                if name in scaled.widths
                else DASH
                for name in names
            )
            rows.append([f"{entry.label} × spread", "of each load", samples, *shown])
    level = percent(bounded[0].row.bound.level if bounded[0].row.bound else None)
    note = (
        f"Bound: {level} % of new loads have at most this relative L2 error, if they are like the "
        "validation loads. It is calibrated on them by split-conformal prediction, with load "
        "regions as groups. Other columns: the share of each "
        "test set within the bound (%)."
    )
    scales = [e.row.bound.scaled for e in bounded if e.row.bound]
    if any(scaled and scaled.widths for scaled in scales):
        note += (
            " × spread: every load has a bound of its own, proportional to how uncertain the "
            "method is: the disagreement of an ensemble, or the standard deviation of a Gaussian "
            "process. Its median over the test set stands in parentheses (%)."
        )
    headings = ["configuration", "bound (%)", "samples in groups", *names]
    return TextTable("Error bounds", note, headings, rows)


def hidden_table(dataset: str, entries: Sequence[Entry], analysis: Analysis) -> TextTable | None:
    """Build the table of errors on the fresh test set and on the shipped one."""
    by_label = {entry.label: entry for entry in entries}
    rows = []
    seeds: dict[int, None] = {}
    for record in analysis["hidden"]:
        entry = by_label.get(record["label"]) if record["dataset"] == dataset else None
        if entry is None or entry.row.hidden is None:
            continue
        found, limit = entry.row.hidden, number(record["limit"])
        if found.seed is not None:
            seeds[found.seed] = None
        rows.append(
            [
                entry.label,
                str(found.n),
                percent(found.rel_l2_median),
                percent(found.rel_l2_p95),
                percent(found.rel_l2_max),
                percent(entry.error),
                "inf" if record["ratio"] is None else number(record["ratio"]),
                f"worse (more than {limit})" if record["worse"] else "as expected",
            ]
        )
    headings = ["configuration", "samples", "median (%)", "p95 (%)", "max (%)"]
    headings += ["main test set: median (%)", "ratio", "verdict"]
    note = (
        "Loads of the same distribution, drawn after all fits: no author of a method has seen "
        "them. Worse: the errors differ by more than the numbers of samples explain."
    )
    if seeds:
        note += f" To draw them again: --test-seed {', '.join(map(str, seeds))}."
    return TextTable("Fresh test set", note, headings, rows) if rows else None


def tuning_table(dataset: str, analysis: Analysis) -> TextTable | None:
    """Build the table of tuning budgets and their use by each method."""
    rows = []
    for record in analysis["tuning"]:
        allowed = record["configurations_allowed"], record["seconds_allowed"]
        if record["dataset"] == dataset and allowed != (None, None):
            configurations = _of(record["configurations"], allowed[0], str)
            rows.append([record["method"], configurations, _of(record["seconds"], allowed[1])])
    note = (
        "Configurations and fitting time of each method, out of the common tuning budget. "
        "Trainings elsewhere have no time here."
    )
    headings = ["method", "configurations", "fitting, wall time (s)"]
    return TextTable("Tuning budget", note, headings, rows) if rows else None


def _of(value: float, allowed: float | None, shown: Callable[[Any], str] = number) -> str:
    if allowed is None:
        return shown(value)
    return f"{shown(value)} of {shown(allowed)}{' (over)' if value > allowed else ''}"


def regimes_table(analysis: Analysis) -> TextTable | None:
    """Build the table of tests in the regime that each method's file names."""
    rows = [
        [record["method"], record["says"], "yes" if record["in_regime"] else record["verdict"]]
        for record in analysis["regimes"]
    ]
    note = "The regime that a method's own file names, and whether this comparison tested it there."
    headings = ["method", "regime", "tested there"]
    return TextTable("In its regime", note, headings, rows) if rows else None
