"""The table of configurations on the page: every figure, in groups of columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mor_bench.report.entries import Entry
from mor_bench.report.number_format import DASH, bytes_text, metres, percent, span
from mor_bench.report.text_table import Cell, figure_cell, marked_latency

INTERVAL = "95 %"
"""Heading of the columns of intervals; they are left out if there are no intervals."""


def _discretisation(entry: Entry) -> str:
    value = entry.row.discretisation_error_m
    return "not measured" if value is None else metres(value)


GROUPS: dict[str, dict[str, Cell]] = {
    "relative L2 (%)": {
        "median": figure_cell("error", "rel_l2_median", percent),
        INTERVAL: lambda e: span(e.intervals.get("rel_l2_median"), percent),
        "p95": figure_cell("error", "rel_l2_p95", percent),
        "max": figure_cell("error", "rel_l2_max", percent),
    },
    "latency (ms)": {
        "median": marked_latency,
        INTERVAL: lambda e: span(e.intervals.get("latency_ms")),
        "p95": figure_cell("latency_ms", "p95"),
        "p99": figure_cell("latency_ms", "p99"),
    },
    "per degree of freedom (m)": {
        "ē": figure_cell("error", "mean_dof_m", metres),
        INTERVAL: lambda e: span(e.intervals.get("mean_dof_m"), metres),
        "σ(e)": figure_cell("error", "std_dof_m", metres),
        "max e": figure_cell("error", "max_dof_m", metres),
        "ē, free dofs": figure_cell("error", "mean_free_dof_m", metres),
    },
    "offline": {
        "data (core-s)": figure_cell("offline_s", "data"),
        "fit (s)": figure_cell("offline_s", "fit"),
    },
    "nodal (m)": {
        "max": figure_cell("error", "max_nodal_m", metres),
        "max at the tip": figure_cell("error", "tip_max_m", metres),
    },
    "e over u": {
        "slope": figure_cell("error", "slope", metres),
        "largest u (m)": figure_cell("error", "amplitude_m"),
    },
    "tip (%)": {
        "median": figure_cell("error", "tip_rel_median", percent),
        "p95": figure_cell("error", "tip_rel_p95", percent),
        "max": figure_cell("error", "tip_rel_max", percent),
    },
}
"""Groups of columns under a common heading."""

SINGLE: dict[str, Cell] = {
    "size": lambda e: bytes_text(e.row.model_bytes),
    "threads": lambda e: str(e.row.threads),
    "n train": lambda e: str(e.row.n_train),
    "n test": lambda e: str(e.row.n_test),
    "without prediction": lambda e: DASH if e.row.n_failed is None else str(e.row.n_failed),
    "discretisation error (m)": _discretisation,
}
"""Columns without a group."""


@dataclass(frozen=True)
class ConfigurationRow:
    """An entry and its cells, in the order of `ConfigurationTable.groups` and then `single`."""

    entry: Entry
    cells: list[str]


@dataclass(frozen=True)
class ConfigurationTable:
    """The table of configurations: headings of groups, headings of single columns, and rows."""

    groups: dict[str, list[str]]
    single: list[str]
    rows: list[ConfigurationRow]


def configuration_columns(entries: Sequence[Entry]) -> ConfigurationTable:
    """Build the table of configurations of a dataset, one per row."""
    certain = any(entry.intervals for entry in entries)
    groups = {
        group: {name: cell for name, cell in columns.items() if certain or name != INTERVAL}
        for group, columns in GROUPS.items()
    }
    cells = [cell for columns in groups.values() for cell in columns.values()]
    cells += SINGLE.values()
    return ConfigurationTable(
        {group: list(columns) for group, columns in groups.items()},
        list(SINGLE),
        [ConfigurationRow(entry, [cell(entry) for cell in cells]) for entry in entries],
    )
