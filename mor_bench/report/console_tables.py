"""Console tables of a comparison: a row per configuration, time at error, error at time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.frontier import compare
from mor_bench.report.summary import (
    Entry,
    basis_of,
    best_per_method,
    dataset_names,
    discretisation_error,
    entries_of,
    headline,
    metres,
    needs_of,
    notes_of,
    number,
    percent,
    short_names_used,
    short_swept,
    span,
    warnings_of,
)
from mor_bench.report.trained import out_of_range
from mor_bench.results.comparison import Comparison

if TYPE_CHECKING:
    from mor_bench.runs.plan import Plan

Analysis = Mapping[str, Any]
"""The content of comparison.json, from `mor_bench.analysis.analyse.analyse`."""

NOT_REACHED = "not reached"

LABEL_WIDTH = 25
"""Characters that the label keeps before columns of less weight are left out."""


@dataclass(frozen=True)
class Column:
    """A column of the configuration table.

    Attributes
    ----------
    heading : str
        At most two lines.
    cell : callable
        An `Entry` to its text.
    weight : int
        Where the terminal is narrow, columns of small weight are left out first.
    """

    heading: str
    cell: Callable[[Entry], str]
    weight: int


def _bounded(value: float | None) -> str:
    """Percent; below 0.01 % as a bound, since the CSV file and the page have the digits."""
    return "<0.01" if value is not None and 0 < value < 1e-4 else percent(value)


def _kilobytes(value: float | None) -> str:
    return number(None if value is None else value / 1000)


def _mark(entry: Entry) -> str:
    return "yes" if entry.meets_needs else "no" if entry.ran else entry.row["status"]


def _latency(entry: Entry) -> str:
    return number(entry.figure("latency_ms", "median")) + ("~" if entry.unstable else "")


def _over_seeds(entry: Entry, name: str, shown: Callable[[float | None], str]) -> str:
    """Range over the seeds of the training; one that failed is infinite."""
    spread = (entry.row.get("seeds") or {}).get(name)
    return f"{shown(spread['min'])}–{shown(spread['max'])}" if spread else "–"


def _megabytes(value: float | None) -> str:
    return number(None if value is None else value / 1e6)


COLUMNS = (
    Column("ē\nm", lambda e: metres(e.figure("error", "mean_dof_m")), 9),
    Column("σ(e)\nm", lambda e: metres(e.figure("error", "std_dof_m")), 3),
    Column("max e\nm", lambda e: metres(e.figure("error", "max_dof_m")), 6),
    Column("rel L2\nmed %", lambda e: percent(e.figure("error", "rel_l2_median")), 9),
    Column("\np95 %", lambda e: _bounded(e.figure("error", "rel_l2_p95")), 8),
    Column("\nmax %", lambda e: _bounded(e.figure("error", "rel_l2_max")), 8),
    Column("latency\nmed ms", _latency, 9),
    Column("\n95 %", lambda e: span(e.intervals.get("latency_ms")), 7),
    Column("\np95", lambda e: number(e.figure("latency_ms", "p95")), 8),
    Column("\np99", lambda e: number(e.figure("latency_ms", "p99")), 5),
    Column("all\nthr", lambda e: number(e.figure("all_threads_ms", "median")), 3),
    Column("seeds\nmed %", lambda e: _over_seeds(e, "rel_l2_median", percent), 7),
    Column("seeds\nē m", lambda e: _over_seeds(e, "mean_dof_m", metres), 5),
    Column("q/s\nby 64", lambda e: number(e.figure("throughput", "64")), 4),
    Column("fit\ns", lambda e: number(e.figure("offline_s", "fit")), 6),
    Column("mem\nMB", lambda e: _megabytes(e.figure("memory_bytes", "predict")), 3),
    Column("size\nkB", lambda e: _kilobytes(e.row.get("model_bytes")), 4),
    Column("\nthr", lambda e: str(e.row.get("threads") or "–"), 4),
    Column("Pa-\nreto", lambda e: "*" if e.on_front else "", 9),
    Column("meets\nneeds", _mark, 9),
)


def _columns_for(entries: Sequence[Entry], width: int) -> tuple[list[Column], int]:
    """The columns that leave the label its room, in their order, and the characters left for the label."""

    def needed(column: Column) -> int:
        return 1 + max(
            len(line) for line in [*column.heading.split("\n"), *map(column.cell, entries)]
        )

    chosen = [
        column
        for column in COLUMNS
        if column.weight == 9 or any(column.cell(entry) not in ("", "–") for entry in entries)
    ]
    while len(chosen) > 5 and LABEL_WIDTH + sum(map(needed, chosen)) > width:
        chosen.remove(min(chosen, key=lambda column: column.weight))
    return chosen, max(width - sum(map(needed, chosen)), 8)


def configuration_table(
    comparison: Comparison, dataset: str, width: int = 120, analysis: Analysis | None = None
) -> Table:
    """A row per configuration of a dataset.

    Parameters
    ----------
    comparison : Comparison
    dataset : str
        Its name.
    analysis : dict, optional
        From `mor_bench.analysis.analyse.analyse`, for the intervals.
    width : int
        Characters of a line; columns of little weight are left out where it is small.
    """
    entries = entries_of(comparison, dataset, analysis)
    columns, room = _columns_for(entries, width)
    table = Table(box=SIMPLE_HEAD, padding=0, show_edge=False)
    table.add_column("configuration", overflow="fold", max_width=room)
    for column in columns:
        table.add_column(column.heading, justify="right", no_wrap=True)
    for entry in entries:
        style = "green" if entry.meets_needs else "" if entry.ran else "red"
        said = f" ({entry.n_failed} failed)" if entry.ran and entry.n_failed else ""
        label = Text.assemble((entry.label, "bold" if entry.on_front else ""), (said, "red"))
        table.add_row(label, *(Text(column.cell(entry)) for column in columns), style=style)
    return table


def _target_table(headings: Sequence[str], rows: dict[str, list[str]], width: int) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=0, show_edge=False)
    table.add_column("method", overflow="fold", min_width=8)
    for heading in headings:
        table.add_column(
            heading,
            justify="right",
            overflow="fold",
            min_width=len(NOT_REACHED) if width >= 100 else 8,
        )
    for method, cells in rows.items():
        table.add_row(
            Text(method),
            *(Text(cell, style="dim" if cell == NOT_REACHED else "") for cell in cells),
        )
    return table


def target_cells(
    comparison: Comparison, dataset: str, kind: str, analysis: Analysis | None = None
) -> tuple[list[str], dict[str, list[str]]]:
    """Headings and, for each method, a cell per target: the interpolated value, the best real configuration and the 95 % interval.

    Parameters
    ----------
    comparison : Comparison
    dataset : str
        Its name.
    kind : {"time_at_error", "error_at_time"}
        Which table.
    analysis : dict, optional
        From `mor_bench.analysis.analyse.analyse`, for the intervals.
    """
    wanted: list[dict[str, Any]] = [
        record
        for record in (analysis or compare(comparison.rows))[kind]
        if record["dataset"] == dataset
    ]
    swept = {entry.label: short_swept(entry.swept) for entry in entries_of(comparison, dataset)}
    of_time = kind == "time_at_error"
    headings: dict[str, None] = {}
    rows: dict[str, list[str]] = {}
    for record in wanted:
        heading = (
            f"{percent(record['target_rel_l2_median'])} %"
            if of_time
            else f"{number(record['target_latency_ms'])} ms"
        )
        value, best = record["latency_ms" if of_time else "error"], record["best"]
        shown, unit = (number, "ms") if of_time else (percent, "%")
        cell = NOT_REACHED
        if best is not None:
            lines = [
                f"{shown(value)} {unit} ({shown(best['latency_ms' if of_time else 'error'])})",
                swept[best["label"]],
                _sure(record, shown),
            ]
            cell = "\n".join(filter(None, lines))
        headings[heading] = None
        rows.setdefault(record["method"], []).append(cell)
    return list(headings), rows


def _sure(record: Mapping[str, Any], shown: Callable[[float | None], str]) -> str:
    """The interval of a target; where an end is beyond what was reached in enough resamples, it says so."""
    low, high = record.get("low"), record.get("high")
    if low == high == 0:
        return ""
    if low is None:
        return (
            f"{NOT_REACHED} in {percent(record['not_reached'])} %"
            if record.get("not_reached")
            else ""
        )
    return f"{shown(low)}–{NOT_REACHED if high is None else shown(high)}"


def tables(
    comparison: Comparison, width: int = 120, analysis: Analysis | None = None
) -> list[RenderableType]:
    """All console tables, a group for each dataset.

    Parameters
    ----------
    comparison : Comparison
    width : int
        Characters of a line.
    analysis : dict, optional
        From `mor_bench.analysis.analyse.analyse`, which is called if it is not given.
    """
    analysis = analysis or analyse(comparison)
    return [_dataset_group(comparison, name, width, analysis) for name in dataset_names(comparison)]


def pairwise_cells(
    comparison: Comparison, dataset: str, target: float, analysis: Analysis
) -> tuple[list[str], list[list[str]], list[str]]:
    """Who is faster than whom at an error: the methods that reach it, a row of cells for each, and those that do not.

    ``+2.3``: the row's method is 2.3 times faster than the column's, ``-2.3``: slower; ``?1.1``: undecided.
    """
    records = [
        r
        for r in analysis["pairwise"]
        if r["dataset"] == dataset and r["target_rel_l2_median"] == target
    ]
    verdicts = {(record["a"], record["b"]): record for record in records}
    methods = list(
        dict.fromkeys(row["method"] for row in comparison.rows if row["dataset"] == dataset)
    )
    absent = {name for record in records for name in record["by"]}
    reached = [method for method in methods if method not in absent]
    cells = (
        [["·" if a == b else _verdict(verdicts[a, b]) for b in reached] for a in reached]
        if records
        else []
    )
    return reached, cells, [method for method in methods if method in absent]


def _verdict(record: Mapping[str, Any]) -> str:
    ratio = float(record["ratio"])
    if record["verdict"] == "undecided":
        return f"?{number(1 / ratio)}"
    return f"+{number(1 / ratio)}" if record["verdict"] == "faster" else f"-{number(ratio)}"


PAIRWISE_LEGEND = "+2: the row's method is 2 times faster than the column's; -2: slower; ?1.1: 1.1 times faster, but the 95 % interval of the ratio holds 1."


def _pairwise_parts(
    comparison: Comparison, dataset: str, analysis: Analysis
) -> list[RenderableType]:
    """Who is faster at the error that the dataset needs; nothing where less than two methods reach it."""
    error = needs_of(comparison, dataset)["error"]
    reached, cells, absent = pairwise_cells(comparison, dataset, error, analysis)
    if len(reached) < 2:
        return []
    table = Table(box=SIMPLE_HEAD, padding=0, show_edge=False)
    table.add_column("", overflow="fold")
    for i in range(len(reached)):
        table.add_column(f"({i + 1})", justify="right", min_width=5)
    for i, (method, line) in enumerate(zip(reached, cells, strict=True)):
        texts = (Text(cell, style={"+": "green", "-": "red"}.get(cell[0], "dim")) for cell in line)
        table.add_row(Text(f"({i + 1}) {method}"), *texts)
    legend = PAIRWISE_LEGEND + (f" Not reached by {', '.join(absent)}." if absent else "")
    return [
        Text(""),
        Text(f"Who is faster at {percent(error)} %, the error that is needed", style="bold"),
        table,
        Text(legend, style="dim"),
    ]


def _out_of_range_parts(entries: Sequence[Entry]) -> list[RenderableType]:
    """Errors, flags and their recall on the named test sets, of the best configuration of each method that learns."""
    best = {entry.label for entry in best_per_method(entries)}
    grid = out_of_range(
        [entry for entry in entries if entry.label in best and entry.row.get("sets")]
    )
    if grid is None:
        return []
    table = Table(box=SIMPLE_HEAD, padding=0, show_edge=False)
    for i, heading in enumerate(grid.headings):
        table.add_column(heading, justify="right" if i else "left", overflow="fold")
    for row in grid.rows:
        table.add_row(*map(Text, row))
    title = "Out of range: does the best configuration of each method that learns say so where its error is large?"
    return [Text(""), Text(title, style="bold"), table, Text(grid.note, style="dim")]


def _dataset_group(comparison: Comparison, dataset: str, width: int, analysis: Analysis) -> Group:
    entries, needs = entries_of(comparison, dataset, analysis), needs_of(comparison, dataset)
    title = str(comparison.datasets.get(dataset, {}).get("title", ""))
    notes = [
        Text(f"{entry.label}: {entry.trouble}", style="red") for entry in entries if entry.trouble
    ]
    unused = max((entry.row.get("n_unused") or 0 for entry in entries), default=0)
    if unused:
        notes.append(
            Text(
                f"{unused:,} samples with forces on both sides of the split are in neither part",
                style="yellow",
            )
        )
    notes += [Text(note, style="yellow") for note in notes_of(comparison, dataset, analysis)]
    notes += [
        Text(f"{label}: warning: {warning}", style="yellow")
        for label, warning in warnings_of(entries)
    ]
    marks = "Pareto *: no other configuration is both faster and more accurate (medians)."
    marks += (
        " Latency ~: not stable, see below." if any(entry.unstable for entry in entries) else ""
    )
    parts: list[RenderableType] = [
        Text(f"{dataset}{f' – {title}' if title else ''}", style="bold"),
        Text(
            f"needs: relative L2 (median) ≤ {percent(needs['error'])} %, latency (median) ≤ {number(needs['latency_ms'])} ms"
        ),
        Text(f"discretisation error of the scene itself: {discretisation_error(entries)}"),
        Text(""),
        configuration_table(comparison, dataset, width, analysis),
        Text(marks, style="dim"),
        *notes,
    ]
    for kind, heading in (
        (
            "time_at_error",
            "Time at error: median latency at a median relative L2 error (in brackets: the fastest real configuration)",
        ),
        (
            "error_at_time",
            "Error at time: median relative L2 error within a median latency (in brackets: the best real configuration)",
        ),
    ):
        headings, rows = target_cells(comparison, dataset, kind, analysis)
        parts += [Text(""), Text(heading, style="bold"), _target_table(headings, rows, width)]
    said = [basis_of(dataset, analysis), short_names_used(entries), "Nothing is extrapolated."]
    parts.append(Text("  ".join(filter(None, said)), style="dim"))
    parts += _pairwise_parts(comparison, dataset, analysis)
    parts += _out_of_range_parts(entries)
    parts += [Text(""), Text(headline(comparison, dataset), style="bold"), Text("")]
    return Group(*parts)


def print_tables(
    comparison: Comparison, console: Console | None = None, analysis: Analysis | None = None
) -> None:
    """Print all tables.

    Parameters
    ----------
    comparison : Comparison
    console : rich.console.Console, optional
        Standard output by default, 120 characters wide where that is no terminal.
    analysis : dict, optional
        From `mor_bench.analysis.analyse.analyse`, which is called if it is not given.
    """
    console = console or Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    with console.capture() as captured:
        for part in tables(comparison, console.width, analysis):
            console.print(part, highlight=False)
    encoding = (
        console.encoding or "utf-8"
    )  # a redirected stream of a legacy code page must not end a long run with an error
    console.file.write(captured.get().encode(encoding, "replace").decode(encoding))
    console.file.flush()


def print_discretisation(record: dict[str, Any], console: Console | None = None) -> None:
    """Print the record of `mor_bench.measure.discretisation_error.refine`: a row per load, the means, the meshes.

    Parameters
    ----------
    record : dict
    console : rich.console.Console, optional
        Standard output by default.
    """
    console = console or Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    table = Table(box=SIMPLE_HEAD, padding=0, show_edge=False)
    for heading in ("sample", "patch", "force\nN", "e\nm", "rel L2\n%", "order", "limit"):
        table.add_column(heading, justify="right")
    for load in record["loads"]:
        force = ", ".join(number(hypot(*vector)) for vector in load["vectors_n"])
        figures = (
            metres(load["error_m"]),
            percent(load["relative_l2"]),
            number(load["order"]),
            load["limit"],
        )
        table.add_row(str(load["sample"]), ", ".join(map(str, load["patches"])), force, *figures)
    console.print(table, highlight=False)
    for load in record["loads"]:
        if load["error_m"] is None:
            console.print(
                Text(f"sample {load['sample']} is in no mean: {load['reason']}", style="red")
            )
    for kind, meshes in (
        ("meshes", record["meshes"]),
        ("left out for their size", record["left_out"]),
    ):
        if meshes:
            shown = ", ".join(
                f"{mesh['n_cells']:,} cells ({mesh['n_dofs']:,} dofs)" for mesh in meshes
            )
            console.print(Text(f"{kind}: {shown}"))
    mean = f"mean e {metres(record['error_m'])} m, relative L2 {percent(record['relative_l2'])} % (median {percent(record['relative_l2_median'])} %)"
    console.print(Text(f"discretisation error of {record['dataset']}: {mean}", style="bold"))


def print_plan(plan: Plan, console: Console | None = None) -> None:
    """Print what a run would do: a row per dataset and configuration, and the time that all of it would take."""
    console = console or Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), show_edge=False)
    for heading in ("dataset", "step"):
        table.add_column(heading)
    table.add_column("estimate", justify="right")
    for step in plan.steps:
        estimate = "unknown" if step.seconds is None else f"{number(step.seconds)} s"
        table.add_row(step.dataset, Text(step.label), "in the cache" if step.done else estimate)
    console.print(table, highlight=False)
    unknown = f", and {plan.n_unknown} steps of which nothing is known" if plan.n_unknown else ""
    console.print(
        Text(
            f"about {plan.seconds / 60:.1f} min, {plan.timing_s / 60:.1f} of them timing{unknown}",
            style="bold",
        )
    )
