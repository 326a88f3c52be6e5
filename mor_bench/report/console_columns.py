"""The table of configurations on the console, fitted to the width of the terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from mor_bench.report.entries import Entry, by_group
from mor_bench.report.number_format import DASH, metres, number, percent, span
from mor_bench.report.text_table import Cell, figure_cell, marked_latency

LABEL_WIDTH = 25
"""Least width of the label, in characters; columns are left out to make room for it."""

REQUIRED = 9
"""Least weight of the columns that are shown even without figures."""


@dataclass(frozen=True)
class Column:
    """A column of the configuration table.

    `heading` has at most two lines. `cell` maps an `Entry` to its text. On a narrow terminal,
    columns of small `weight` are left out first.
    """

    heading: str
    cell: Cell
    weight: int


def _bounded(value: float | None) -> str:
    """Percent, or "<0.01"; the CSV file and the page have all digits."""
    return "<0.01" if value is not None and 0 < value < 1e-4 else percent(value)


def _scaled(factor: float) -> Callable[[float | None], str]:
    return lambda value: number(None if value is None else value / factor)


def _qualified_mark(entry: Entry) -> str:
    if not entry.ran:
        return entry.row.status
    return "yes" if entry.qualified else "no"


def _seeds_error(entry: Entry) -> str:
    spread = entry.row.seeds and entry.row.seeds.rel_l2_median
    return span(spread.interval, percent) if spread else DASH


def _seeds_mean(entry: Entry) -> str:
    spread = entry.row.seeds and entry.row.seeds.mean_dof_m
    return span(spread.interval, metres) if spread else DASH


COLUMNS = (
    Column("ē\nm", figure_cell("error", "mean_dof_m", metres), REQUIRED),
    Column("σ(e)\nm", figure_cell("error", "std_dof_m", metres), 3),
    Column("max e\nm", figure_cell("error", "max_dof_m", metres), 6),
    Column("rel L2\nmed %", figure_cell("error", "rel_l2_median", percent), REQUIRED),
    Column("\np95 %", figure_cell("error", "rel_l2_p95", _bounded), 8),
    Column("\nmax %", figure_cell("error", "rel_l2_max", _bounded), 8),
    Column("latency\nmed ms", marked_latency, REQUIRED),
    Column("\n95 %", lambda e: span(e.intervals.get("latency_ms")), 7),
    Column("\np95", figure_cell("latency_ms", "p95"), 8),
    Column("\np99", figure_cell("latency_ms", "p99"), 5),
    Column("all\nthr", figure_cell("all_threads_ms", "median"), 3),
    Column("seeds\nmed %", _seeds_error, 7),
    Column("seeds\nē m", _seeds_mean, 5),
    Column("q/s\nby 64", figure_cell("throughput", "64"), 4),
    Column("fit\ns", figure_cell("offline_s", "fit"), 6),
    Column("mem\nMB", figure_cell("memory_bytes", "predict", _scaled(1e6)), 3),
    Column("size\nkB", lambda e: _scaled(1000)(e.row.model_bytes), 4),
    Column("\nthr", lambda e: str(e.row.threads or DASH), 4),
    Column("Pa-\nreto", lambda e: e.pareto_mark, REQUIRED),
    Column("quali-\nfies", _qualified_mark, REQUIRED),
)


def _columns_for(entries: Sequence[Entry], width: int) -> tuple[list[Column], int]:
    """Choose columns that leave enough room for the label; return them and that room."""

    def needed(column: Column) -> int:
        return 1 + max(map(len, [*column.heading.split("\n"), *map(column.cell, entries)]))

    chosen = [
        column
        for column in COLUMNS
        if column.weight == REQUIRED or set(map(column.cell, entries)) - {"", DASH}
    ]
    while len(chosen) > 5 and LABEL_WIDTH + sum(map(needed, chosen)) > width:
        chosen.remove(min(chosen, key=lambda column: column.weight))
    return chosen, max(width - sum(map(needed, chosen)), 8)


def configuration_table(entries: Sequence[Entry], width: int) -> Table:
    """Build the table of configurations, one per row, within a width in characters.

    The rows are grouped by what the methods are told.
    """
    columns, room = _columns_for(entries, width)
    table = Table(box=SIMPLE_HEAD, padding=0, show_edge=False)
    table.add_column("configuration", overflow="fold", max_width=room)
    for column in columns:
        table.add_column(column.heading, justify="right", no_wrap=True)
    for group, members in by_group(entries).items():
        table.add_row(Text(f"– {group} –", style="dim italic"))
        for entry in members:
            style = "green" if entry.qualified else "" if entry.ran else "red"
            failed = f" ({entry.n_failed} failed)" if entry.ran and entry.n_failed else ""
            look = "bold" if entry.pareto_mark == "*" else ""
            origin = " (trained elsewhere)" if entry.row.trained_elsewhere else ""
            label = Text.assemble((entry.label, look), (origin, "dim"), (failed, "red"))
            table.add_row(label, *(Text(column.cell(entry)) for column in columns), style=style)
    return table
