"""Tables of secondary measurements: timing, memory, work, trainings."""

from __future__ import annotations

from collections.abc import Sequence

from mor_bench.report.entries import Entry
from mor_bench.report.number_format import DASH, bytes_text, metres, number, percent, span, whole
from mor_bench.report.text_table import Cell, TextTable, figure_cell, table_of


def timing(entries: Sequence[Entry]) -> TextTable | None:
    """Build the table of timing conditions, and of latencies with more threads and in batches."""
    columns: dict[str, Cell] = {
        "processes": figure_cell("latency_ms", "n_processes", whole),
        "queries": figure_cell("latency_ms", "n_queries", whole),
        "collector (ms)": figure_cell("latency_ms", "gc"),
        "all threads (ms)": figure_cell("all_threads_ms", "median"),
    }
    for size in ("8", "64", "512"):
        columns[f"queries/s by {size}"] = figure_cell("throughput", size, whole)
    columns["stable"] = _stable
    note = (
        "Latencies were measured in fresh processes, the configurations in turn. "
        "Collector: mean time of garbage collection per query, included in the latencies. "
        "Queries/s: throughput in batches of 8, 64 and 512."
    )
    return table_of("Timing", note, entries, columns)


def _stable(entry: Entry) -> str:
    if entry.unstable:
        return f"no: {'; '.join(entry.unstable)}"
    return "yes" if entry.row.latency_ms and entry.row.latency_ms.stable else DASH


def resources(entries: Sequence[Entry]) -> TextTable | None:
    """Build the table of memory, model size and the counted work of a query."""
    if not any(entry.row.memory_bytes or entry.row.cost for entry in entries):
        return None
    columns: dict[str, Cell] = {
        "memory to fit": figure_cell("memory_bytes", "fit", bytes_text),
        "memory to predict": figure_cell("memory_bytes", "predict", bytes_text),
        "factorisations of a mesh": _on_mesh("factorisations"),
        "back-solves of a mesh": _on_mesh("back_solves"),
        "reduced factorisations": figure_cell("cost", "reduced_factorisations"),
        "reduced back-solves": figure_cell("cost", "reduced_back_solves"),
        "element evaluations": figure_cell("cost", "element_evaluations", whole),
        "multiply-adds": figure_cell("cost", "multiply_adds"),
        "model": lambda e: bytes_text(e.row.model_bytes),
    }
    note = (
        "Memory: peak resident memory. Counts: means per query, which do not depend on the "
        "machine. A linear response is part of the query; on a small mesh it is a product "
        "with the stored inverse, which counts as multiply-adds."
    )
    return table_of("Memory and cost", note, entries, columns)


def _on_mesh(key: str) -> Cell:
    """Count for a mesh's sparse matrices, without the cheap dense reduced ones."""

    def cell(entry: Entry) -> str:
        total, reduced = entry.figure("cost", key), entry.figure("cost", f"reduced_{key}")
        return number(total if total is None or reduced is None else total - reduced)

    return cell


def indicated(entries: Sequence[Entry]) -> TextTable | None:
    """Build the table of error indicators: estimated against measured errors."""
    columns: dict[str, Cell] = {
        "indicated / measured, median": figure_cell("indicator", "ratio_median"),
        "5 %": figure_cell("indicator", "ratio_p5"),
        "95 %": figure_cell("indicator", "ratio_p95"),
        "rank correlation": figure_cell("indicator", "rank_correlation"),
        "rank correlation of the residual": figure_cell("indicator", "residual_rank_correlation"),
    }
    note = (
        "Indicated: an estimate of the relative L2 error (`Surrogate.indicate_error`). It "
        "is the first correction that the full-order solve would make, relative to the "
        "prediction. It costs about one iteration of that solve. For comparison, the "
        "rank correlation of the error with the residual, relative to the load, is shown; the "
        "residual itself is not. Measured on a part of the test set; "
        "exact answers are left out."
    )
    return table_of("Indicated errors", note, entries, columns)


def training(entries: Sequence[Entry]) -> TextTable | None:
    """Build the table of trainings: device, length and losses."""
    rows = []
    for entry in entries:
        if found := entry.row.training:
            rows.append(
                [
                    entry.label,
                    found.device,
                    whole(found.iterations),
                    number(found.fit_seconds),
                    number(entry.row.fit_core_s),
                    number(found.loss),
                    number(found.validation_loss),
                ]
            )
    headings = ["configuration", "device", "iterations", "requested (s)", "fit (core-s)"]
    headings += ["last loss", "validation loss"]
    note = (
        "Requested: the seconds for which the number of iterations was chosen. The "
        "parameter `iterations` with this number repeats the training."
    )
    return TextTable("Training", note, headings, rows) if rows else None


def seeds(entries: Sequence[Entry]) -> TextTable | None:
    """Build the table of the spread of errors over training seeds."""
    rows = []
    for entry in entries:
        found = entry.row.seeds
        if not found or not found.trainings:
            continue
        figures = []
        for spread, shown in ((found.rel_l2_median, percent), (found.mean_dof_m, metres)):
            if spread is None:
                figures += [DASH] * 3
                continue
            ends = f"{shown(spread.min)}–{shown(spread.max)}"
            figures += [shown(spread.median), ends, span(spread.interval, shown)]
        failed = "\n".join(found.failed) or DASH
        rows.append([entry.label, f"{found.n} of {found.asked}", *figures, failed])
    statistics = ("median", "min–max", "another training")
    measures = ("relative L2 error (%)", "ē (m)")
    named = [f"{name}: {what}" for name in measures for what in statistics]
    note = (
        "The same configuration trained with other seeds; all other tables show the first "
        "seed. The figures describe the median relative L2 error and ē of these "
        "trainings. A failed training has an infinite error. Another training: its 95 % "
        "prediction interval on the same test set, from Student's t on the logarithms."
    )
    headings = ["configuration", "trained", *named, "failed"]
    return TextTable("Training seeds", note, headings, rows) if rows else None
