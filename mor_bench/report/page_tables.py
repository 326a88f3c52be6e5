"""Every figure of a configuration, in groups: tables of the appendix, and details on demand."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from mor_bench.analysis.draws import VALIDATION
from mor_bench.report.entries import Entry
from mor_bench.report.number_format import DASH, bytes_text, metres, number, percent, span
from mor_bench.report.speed_tables import NOT_REACHED
from mor_bench.report.text_table import Cell, TextTable, figure_cell, marked_latency, table_of

INTERVAL = "95 % interval"
"""Name of the intervals in each group."""

EMPTY = {DASH, "", "0", "no", "none", NOT_REACHED}
"""Cells without information."""


def _discretisation(entry: Entry) -> str:
    value = entry.row.discretisation_error_m
    return "not measured" if value is None else metres(value)


GROUPS: dict[str, dict[str, Cell]] = {
    "Relative L2 error (%)": {
        "median": figure_cell("error", "rel_l2_median", percent),
        INTERVAL: lambda e: span(e.intervals.get("rel_l2_median"), percent),
        "p95": figure_cell("error", "rel_l2_p95", percent),
        "max": figure_cell("error", "rel_l2_max", percent),
        "validation median": figure_cell("validation", "rel_l2_median", percent),
        "validation 95 % interval": lambda e: span(e.intervals.get(VALIDATION), percent),
    },
    "Latency of one query (ms)": {
        "median": marked_latency,
        INTERVAL: lambda e: span(e.intervals.get("latency_ms")),
        "p95": figure_cell("latency_ms", "p95"),
        "p99": figure_cell("latency_ms", "p99"),
    },
    "Error per degree of freedom (m)": {
        "ē": figure_cell("error", "mean_dof_m", metres),
        INTERVAL: lambda e: span(e.intervals.get("mean_dof_m"), metres),
        "σ(e)": figure_cell("error", "std_dof_m", metres),
        "max e": figure_cell("error", "max_dof_m", metres),
        "ē, free dofs": figure_cell("error", "mean_free_dof_m", metres),
    },
    "Offline cost": {
        "data (core-s)": figure_cell("offline_s", "data"),
        "fit (core-s)": lambda e: number(e.row.fit_core_s),
    },
    "Nodal error and error over deformation": {
        "largest nodal (m)": figure_cell("error", "max_nodal_m", metres),
        "largest at the tip (m)": figure_cell("error", "tip_max_m", metres),
        "slope": figure_cell("error", "slope", metres),
        "largest u (m)": figure_cell("error", "amplitude_m"),
    },
    "Error at the tip, the node that moves most (%)": {
        "median": figure_cell("error", "tip_rel_median", percent),
        "p95": figure_cell("error", "tip_rel_p95", percent),
        "max": figure_cell("error", "tip_rel_max", percent),
    },
    "Reaction force of the tool (%)": {
        "median": figure_cell("error", "reaction_rel_median", percent),
        "p95": figure_cell("error", "reaction_rel_p95", percent),
        "max": figure_cell("error", "reaction_rel_max", percent),
    },
    "Stress at the cells' centroids (%)": {
        "median": figure_cell("error", "stress_rel_median", percent),
        "p95": figure_cell("error", "stress_rel_p95", percent),
        "max": figure_cell("error", "stress_rel_max", percent),
        "largest von Mises, median": figure_cell("error", "peak_stress_rel_median", percent),
        "largest von Mises, p95": figure_cell("error", "peak_stress_rel_p95", percent),
        "largest von Mises, max": figure_cell("error", "peak_stress_rel_max", percent),
        "largest tension, median": figure_cell("error", "peak_tension_rel_median", percent),
        "largest tension, p95": figure_cell("error", "peak_tension_rel_p95", percent),
        "largest tension, max": figure_cell("error", "peak_tension_rel_max", percent),
    },
    "Size and samples": {
        "model": lambda e: bytes_text(e.row.model_bytes),
        "threads": lambda e: str(e.row.threads),
        "training": lambda e: "none used" if e.row.snapshots is False else str(e.row.n_train),
        "test": lambda e: str(e.row.n_test),
        "without prediction": lambda e: DASH if e.row.n_failed is None else str(e.row.n_failed),
        "discretisation error (m)": _discretisation,
    },
}
"""Groups of figures; `table_of` leaves out those that no configuration has."""

RELATIVE = ("Relative L2 error (%)", "Error at the tip, the node that moves most (%)")
"""Groups of errors that are divided by the reference."""

SMALL = (
    "Each error is divided by its reference: the largest ones often belong to loads that hardly "
    "move the body. The card names the worst loads, with their errors in mm."
)
"""Note of these groups."""


def figure_tables(entries: Sequence[Entry]) -> list[TextTable]:
    """Build one table per group of figures, with a row per configuration."""
    tables = (
        table_of(title, SMALL if title in RELATIVE else "", entries, cells)
        for title, cells in GROUPS.items()
    )
    return [table for table in tables if table is not None]


def details_of(
    entry: Entry, about: Sequence[tuple[str, str]], answer: str
) -> list[tuple[str, list[tuple[str, str]]]]:
    """List all known figures of one configuration, by group.

    `about` is what the method's file says of it, `answer` whether the configuration qualifies.
    """
    given = {key: str(value) for key, value in entry.row.parameters.items()}
    sizes = {f"{key} (chosen)": str(value) for key, value in entry.row.sizes.items()}
    found = [("Hyperparameters", [*given.items(), *sizes.items()])]
    for group, cells in GROUPS.items():
        figures = [(name, cell(entry)) for name, cell in cells.items()]
        found.append((group, [(name, text) for name, text in figures if text != DASH]))
    notes = [("status", entry.trouble or entry.row.status), ("qualifies", answer)]
    notes += [("told", entry.group)] if entry.group else []
    notes += [("run again", run_again(entry))]
    if elsewhere := entry.row.trained_elsewhere:
        text = f"{elsewhere.iterations:,} iterations, {number(elsewhere.core_s)} core-s"
        notes += [("trained elsewhere", text)]
    notes += [("timing not stable", reason) for reason in entry.unstable]
    notes += [("warning", warning) for warning in entry.row.warnings]
    groups = [("Method", list(about)), ("Notes", notes), *found]
    return [
        (group, [(name, text.replace("`", "")) for name, text in figures])
        for group, figures in groups
        if figures
    ]


def run_again(entry: Entry) -> str:
    """Return the command that fits and times this configuration alone."""
    row = entry.row
    length = {"iterations": row.parameters["iterations"]} if "iterations" in row.parameters else {}
    chosen = {**row.swept, **length}
    values = ",".join(f"{key}={value}" for key, value in chosen.items())
    method = f"{row.method}[{values}]" if chosen else row.method
    train = ["--train"] if row.training or row.trained_elsewhere else []
    return shlex.join(["mor-bench", "run", row.dataset, "-m", method, *train])


def in_python(entry: Entry) -> str:
    """Return the lines of Python that fit this configuration and predict with it."""
    row = entry.row
    given = "".join(f", {key}={value!r}" for key, value in row.swept.items())
    return "\n".join(
        [
            f'data = mor_bench.load_dataset("{row.dataset}")',
            f'method = mor_bench.load_method("{row.method}"{given})',
            "method.fit(data.scene, data.train)",
            "u = method.predict(data.test.forces[0])",
        ]
    )


def with_content(tables: Sequence[TextTable]) -> list[TextTable]:
    """Leave out tables in which no cell beside the names holds information."""
    return [
        table
        for table in tables
        if any(cell.split("\n")[0] not in EMPTY for row in table.rows for cell in row[1:])
    ]
