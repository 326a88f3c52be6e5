"""Tables of methods that learn: their training, its scatter over seeds, and whether they say so where their errors are large."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mor_bench.report.paper import Grid
from mor_bench.report.summary import Entry, metres, number, percent

DASH = "–"


def out_of_range(entries: Sequence[Entry]) -> Grid | None:
    """Whether methods that learn say so where their errors are large: a row per configuration, a column per test set."""
    names = dict.fromkeys(
        name for entry in entries if entry.row.get("range") for name in entry.row.get("sets") or {}
    )
    rows = []
    for entry in entries:
        if found := entry.row.get("range"):
            alarms = f"{percent(found['false_alarms'])} % of {found['n']}\n{found['in_range']}"
            test = _recall_cell(found["test"], entry.error)
            sets = (
                _recall_cell(entry.row["sets"][name]) if name in entry.row["sets"] else DASH
                for name in names
            )
            rows.append([entry.label, percent(found["usual_rel_l2"]), alarms, test, *sets])
    headings = ["configuration", "usual error (%)", "false alarms", "test", *names]
    note = (
        "Usual: the configuration's own 95th percentile of the relative L2 in range (below: on which set). False alarms: loads of that set that are "
        "flagged as out of range. Of each test set: the median error; the loads flagged; and of the loads whose error is beyond the usual one the "
        "share that is flagged, the recall."
    )
    return Grid("Out of range", note, headings, rows) if rows else None


def _recall_cell(record: Mapping[str, Any], median: float | None = None) -> str:
    """Error, flagged and recall on a test set, in lines."""
    n = record["n_unusual"]
    recall = (
        "none beyond"
        if record["recall"] is None
        else f"recall {percent(record['recall'])} % of {n}"
    )
    error = record["rel_l2_median"] if median is None else median
    return f"{percent(error)} %\nflagged {percent(record['n_flagged'] / record['n'])} %\n{recall}"


def training(entries: Sequence[Entry]) -> Grid | None:
    """Where and how long the trained methods were trained."""
    rows = []
    for entry in entries:
        if found := entry.row.get("training"):
            seconds = [number(found["fit_seconds"]), number(entry.figure("offline_s", "fit"))]
            losses = [number(found["loss"]), number(found["validation_loss"])]
            rows.append(
                [
                    entry.label,
                    str(found["device"]),
                    DASH if found["iterations"] is None else f"{found['iterations']:,}",
                    *seconds,
                    *losses,
                ]
            )
    headings = [
        "configuration",
        "device",
        "iterations",
        "asked (s)",
        "fit (s)",
        "last loss",
        "of validation",
    ]
    note = "Asked: the seconds that the number of iterations was chosen to fill; the same number as the knob `iterations` trains the same again."
    return Grid("Training", note, headings, rows) if rows else None


def seeds(entries: Sequence[Entry]) -> Grid | None:
    """How the errors scatter over the seeds of the training."""
    rows = []
    for entry in entries:
        if (found := entry.row.get("seeds")) and "trainings" in found:
            figures = []
            for key, shown in (("rel_l2_median", percent), ("mean_dof_m", metres)):
                spread = found[key]
                figures += [
                    shown(spread["median"]),
                    f"{shown(spread['min'])}–{shown(spread['max'])}",
                    shown(spread["std"]),
                ]
            failed = "\n".join(found["failed"]) or DASH
            rows.append([entry.label, f"{found['n']} of {found['asked']}", *figures, failed])
    named = (
        f"{name}{what}"
        for name in ("rel. L2 (%)", "ē (m)")
        for what in (": median", ", min–max", ", st. dev.")
    )
    note = (
        "The same configuration trained with other seeds; all other tables show the first. Of each training the median of the relative L2 and ē over "
        "the test set; here their median, range and standard deviation over the trainings. One that failed counts with an infinite error."
    )
    return (
        Grid("Training seeds", note, ["configuration", "trained", *named, "failed"], rows)
        if rows
        else None
    )
