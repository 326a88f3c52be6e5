"""The table of configurations on the console: six columns, or every figure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from rich.text import Text

from mor_bench.report.aligned_lines import Line, aligned_lines
from mor_bench.report.entries import Entry, by_group
from mor_bench.report.number_format import (
    DASH,
    bytes_text,
    metres,
    number,
    percent,
    span,
)
from mor_bench.report.short_names import ShortName
from mor_bench.report.text_table import Cell, figure_cell

NOTE = (
    "*: on the Pareto front of the medians, references aside. ~: timing not stable. "
    "offline: core-seconds of data and fit; °: trained elsewhere."
)
"""Explanation of the marks and of the one column that needs it."""


def _latency(entry: Entry) -> str:
    text = number(entry.figure("latency_ms", "median"))
    return f"~{text}" if entry.unstable else text


def _offline(entry: Entry) -> str:
    return number(entry.row.offline_core_s) + "°" * bool(entry.row.trained_elsewhere)


def _qualifies(entry: Entry) -> str:
    if not entry.ran:
        return entry.row.status
    return "yes" if entry.qualified else "no"


MAIN: dict[str, Cell] = {
    "error\nmedian\n(%)": figure_cell("error", "rel_l2_median", percent),
    "error\np95\n(%)": figure_cell("error", "rel_l2_p95", percent),
    "latency\nmedian\n(ms)": _latency,
    "offline\n(core-s)": _offline,
    "qualifies": _qualifies,
}
"""The columns beside the name that are always shown; each has one unit, in its heading."""


def _interval(name: str, shown: Callable[[float | None], str] = number) -> Cell:
    return lambda entry: span(entry.intervals.get(name), shown)


def _seeds(name: str, shown: Callable[[float | None], str]) -> Cell:
    def cell(entry: Entry) -> str:
        spread = getattr(entry.row.seeds, name) if entry.row.seeds else None
        return span(spread.interval, shown) if spread else DASH

    return cell


FURTHER: dict[str, Cell] = {
    "error 95 %\n(%)": _interval("rel_l2_median", percent),
    "error\nmax\n(%)": figure_cell("error", "rel_l2_max", percent),
    "seeds 95 %\n(%)": _seeds("rel_l2_median", percent),
    "ē\n(m)": figure_cell("error", "mean_dof_m", metres),
    "σ(e)\n(m)": figure_cell("error", "std_dof_m", metres),
    "max e\n(m)": figure_cell("error", "max_dof_m", metres),
    "seeds ē\n95 % (m)": _seeds("mean_dof_m", metres),
    "latency 95 %\n(ms)": _interval("latency_ms"),
    "latency\np95\n(ms)": figure_cell("latency_ms", "p95"),
    "latency\np99\n(ms)": figure_cell("latency_ms", "p99"),
    "all\nthreads\n(ms)": figure_cell("all_threads_ms", "median"),
    "queries/s\nby 64": figure_cell("throughput", "64"),
    "data\n(core-s)": figure_cell("offline_s", "data"),
    "fit\n(s)": figure_cell("offline_s", "fit"),
    "memory": figure_cell("memory_bytes", "predict", bytes_text),
    "model": lambda e: bytes_text(e.row.model_bytes),
    "threads": lambda e: str(e.row.threads or DASH),
}
"""The columns of the wide table; those without a figure are left out."""


def configuration_lines(
    entries: Sequence[Entry], names: Mapping[str, ShortName], width: int | None
) -> Iterator[Text]:
    """Yield the table of configurations, grouped by what the methods are told.

    Parameters
    ----------
    entries : sequence of Entry
    names : mapping
        Short name of each configuration, by label.
    width : int or None
        Characters of a line for six columns; None for all columns and lines of any length.
    """
    columns = dict(MAIN)
    if width is None:
        further = {head: cell for head, cell in FURTHER.items() if set(map(cell, entries)) - {DASH}}
        columns = {**MAIN, **further}
    lines = []
    for group, members in by_group(entries).items():
        lines.append(Line([f"– {group} –"], "dim italic"))
        for entry in members:
            name = f"{'*' if entry.pareto_mark == '*' else ' '} {names[entry.label]}"
            if entry.ran and entry.n_failed:
                name += f" ({entry.n_failed} failed)"
            cells = [name, *(cell(entry) for cell in columns.values())]
            lines.append(Line(cells, _style(entry)))
    yield from aligned_lines(["  configuration", *columns], lines, width)


def _style(entry: Entry) -> str:
    colour = "green" if entry.qualified else "" if entry.ran else "red"
    return f"{colour} bold".strip() if entry.pareto_mark == "*" else colour
