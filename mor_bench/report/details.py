"""The tables that only the page has room for; one for which there is no data is left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mor_bench.analysis.analyse import share_within
from mor_bench.analysis.frontier import TARGET_ERRORS
from mor_bench.report.console_tables import PAIRWISE_LEGEND, pairwise_cells
from mor_bench.report.paper import Grid, error_measures, same_error, same_time
from mor_bench.report.summary import (
    Entry,
    entries_of,
    metres,
    needs_of,
    number,
    percent,
    size_of,
    span,
)
from mor_bench.report.trained import out_of_range, seeds, training
from mor_bench.results.comparison import Comparison

FACTORS = (1.0, 1.5, 2.0, 5.0, 10.0, 100.0)
"""Columns of the performance profile's table."""

Cell = Callable[[Entry], str]
DASH = "–"


def dataset_details(
    comparison: Comparison, dataset: str, analysis: Mapping[str, Any]
) -> list[Grid]:
    """The further tables of a dataset, in reading order."""
    entries = entries_of(comparison, dataset, analysis)
    grids = [
        *pairwise(comparison, dataset, analysis),
        break_even(dataset, analysis, entries),
        timing(entries),
        resources(entries),
        indicated(entries),
        test_sets(entries),
        out_of_range(entries),
        training(entries),
        seeds(entries),
        hidden(dataset, entries, analysis),
        tuning(dataset, analysis),
        error_measures(dataset, entries),
        same_error(dataset, entries),
        same_time(dataset, entries),
    ]
    return [grid for grid in grids if grid is not None and grid.rows]


def overall(analysis: Mapping[str, Any]) -> list[Grid]:
    """The tables over all datasets."""
    return [
        grid for grid in (profile(analysis), regimes(analysis)) if grid is not None and grid.rows
    ]


def _grid(
    title: str, note: str, entries: Sequence[Entry], columns: Mapping[str, Cell]
) -> Grid | None:
    """A row per configuration that ran; columns, and then rows, without a single figure are left out."""
    shown = {
        heading: [cell(entry) for entry in entries if entry.ran]
        for heading, cell in columns.items()
    }
    shown = {
        heading: cells for heading, cells in shown.items() if any(cell != DASH for cell in cells)
    }
    if not shown:
        return None
    labels = [entry.label for entry in entries if entry.ran]
    rows = [
        [label, *cells]
        for label, *cells in zip(labels, *shown.values(), strict=True)
        if any(cell != DASH for cell in cells)
    ]
    return Grid(title, note, ["configuration", *shown], rows)


def _figure(group: str, key: str, shown: Callable[[float | None], str] = number) -> Cell:
    return lambda entry: shown(entry.figure(group, key))


def _of_a_mesh(key: str) -> Cell:
    """All but those with dense reduced matrices, which cost next to nothing."""

    def cell(entry: Entry) -> str:
        total, reduced = entry.figure("cost", key), entry.figure("cost", f"reduced_{key}")
        return number(total if total is None or reduced is None else total - reduced)

    return cell


def _whole(value: float | None) -> str:
    return DASH if value is None else f"{value:,.0f}"


def _stable(entry: Entry) -> str:
    if entry.unstable:
        return f"no: {'; '.join(entry.unstable)}"
    return "yes" if (entry.row.get("latency_ms") or {}).get("stable") else DASH


def timing(entries: Sequence[Entry]) -> Grid | None:
    """What the timing of each configuration rests on, on more threads and in batches; nothing of plain single-process timings."""
    columns: dict[str, Cell] = {
        "processes": _figure("latency_ms", "n_processes", _whole),
        "queries": _figure("latency_ms", "n_queries", _whole),
        "collector (ms)": _figure("latency_ms", "gc"),
        "all threads (ms)": _figure("all_threads_ms", "median"),
        **{
            f"queries/s by {size}": _figure("throughput", size, _whole)
            for size in ("8", "64", "512")
        },
        "stable": _stable,
    }
    note = (
        "Latency was taken in fresh processes, the configurations in turn. The collector's share is the mean time of garbage collection per query, "
        "which the latencies contain. Throughput: queries per second when they come in batches of 8, 64 and 512."
    )
    return _grid("Timing", note, entries, columns)


def resources(entries: Sequence[Entry]) -> Grid | None:
    """Memory, size of the model, and the cost of a query that no machine changes."""
    columns: dict[str, Cell] = {
        "memory to fit": _figure("memory_bytes", "fit", size_of),
        "memory to predict": _figure("memory_bytes", "predict", size_of),
        "factorisations of a mesh": _of_a_mesh("factorisations"),
        "back-solves of a mesh": _of_a_mesh("back_solves"),
        "reduced factorisations": _figure("cost", "reduced_factorisations"),
        "reduced back-solves": _figure("cost", "reduced_back_solves"),
        "element evaluations": _figure("cost", "element_evaluations", _whole),
        "multiply-adds": _figure("cost", "multiply_adds"),
    }
    if not any(entry.row.get(group) for entry in entries for group in ("memory_bytes", "cost")):
        return None
    columns["model"] = lambda e: size_of(e.row.get("model_bytes"))
    return _grid(
        "Memory and cost",
        "Memory: most of it resident at a time. Counts: means per query; they do not depend on the machine.",
        entries,
        columns,
    )


def indicated(entries: Sequence[Entry]) -> Grid | None:
    """How well the error of a prediction is told without the right answer."""
    columns: dict[str, Cell] = {
        "indicated / measured, median": _figure("indicator", "ratio_median"),
        "5 %": _figure("indicator", "ratio_p5"),
        "95 %": _figure("indicator", "ratio_p95"),
        "rank correlation": _figure("indicator", "rank_correlation"),
        "that of the residual": _figure("indicator", "residual_rank_correlation"),
    }
    note = (
        "The first correction that the full-order solve would make from a prediction, relative to it, as an estimate of its relative L2 error "
        "(`Surrogate.indicate_error`); it costs about one iteration of that solve. For comparison the plain residual, relative to the load. "
        "Over some samples of the test set; nothing for answers that are exact."
    )
    return _grid("Indicated errors", note, entries, columns)


def test_sets(entries: Sequence[Entry]) -> Grid | None:
    """Errors on the named test sets: a row per configuration, a column per set."""
    names = dict.fromkeys(name for entry in entries for name in entry.row.get("sets") or {})
    rows = []
    for entry in entries:
        if records := entry.row.get("sets"):
            rows.append(
                [
                    entry.label,
                    *(_set_cell(records[name]) if name in records else DASH for name in names),
                ]
            )
    note = "Relative L2 on each set: median, below it 95th percentile and maximum. Flagged: the method itself said that the load is out of its range."
    return Grid("Named test sets", note, ["configuration", *names], rows) if rows else None


def _set_cell(record: Mapping[str, Any]) -> str:
    n, flagged, failed = record.get("n") or 0, record.get("n_flagged"), record.get("n_failed")
    lines = [
        f"{percent(record.get('rel_l2_median'))} %",
        f"p95 {percent(record.get('rel_l2_p95'))}, max {percent(record.get('rel_l2_max'))}",
    ]
    if flagged is not None and n:
        lines.append(f"flagged {percent(flagged / n)} % of {n}")
    if failed:
        lines.append(f"{failed} of {n} without prediction")
    return "\n".join(lines)


def _count(value: object) -> str:
    return DASH if value is None else str(value)


def hidden(dataset: str, entries: Sequence[Entry], analysis: Mapping[str, Any]) -> Grid | None:
    """Errors on the hidden test set beside those on the shipped one."""
    records = {
        record["label"]: record for record in analysis["hidden"] if record["dataset"] == dataset
    }
    rows = []
    for entry in entries:
        if entry.label in records and entry.row.get("hidden"):
            record, found = records[entry.label], entry.row["hidden"]
            ratio = "inf" if record["ratio"] is None else number(record["ratio"])
            figures = [
                percent(found.get(key)) for key in ("rel_l2_median", "rel_l2_p95", "rel_l2_max")
            ]
            verdict = (
                f"worse (more than {number(record['limit'])})" if record["worse"] else "as expected"
            )
            rows.append(
                [
                    entry.label,
                    _count(found.get("n")),
                    *figures,
                    percent(entry.error),
                    ratio,
                    verdict,
                ]
            )
    headings = [
        "configuration",
        "samples",
        "median (%)",
        "p95 (%)",
        "max (%)",
        "shipped: median (%)",
        "ratio",
        "verdict",
    ]
    note = "Fresh loads of the same distribution that no method's author has seen. Worse: beyond what the number of samples explains."
    return Grid("Hidden test set", note, headings, rows) if rows else None


def pairwise(comparison: Comparison, dataset: str, analysis: Mapping[str, Any]) -> list[Grid]:
    """Who is faster than whom: a matrix per error that at least two methods reach."""
    grids = []
    targets = {
        record["target_rel_l2_median"]
        for record in analysis["pairwise"]
        if record["dataset"] == dataset
    }
    records = {
        (r["target_rel_l2_median"], r["a"], r["b"]): r
        for r in analysis["pairwise"]
        if r["dataset"] == dataset
    }
    needed = needs_of(comparison, dataset)["error"]
    for target in sorted(targets, reverse=True):
        reached, cells, absent = pairwise_cells(comparison, dataset, target, analysis)
        if len(reached) < 2:
            continue
        rows = [
            [
                a,
                *(
                    cell if a == b else f"{cell}\n{_factor(records[target, a, b])}"
                    for b, cell in zip(reached, line, strict=True)
                ),
            ]
            for a, line in zip(reached, cells, strict=True)
        ]
        of_need = ", the error that is needed" if target == needed else ""
        note = f"{PAIRWISE_LEGEND} Below: the 95 % interval of that factor."
        note += f" Not reached by {', '.join(absent)}." if absent else ""
        grids.append(
            Grid(f"Who is faster at {percent(target)} %{of_need}", note, ["", *reached], rows)
        )
    return grids


def _factor(record: Mapping[str, Any]) -> str:
    """The interval of the factor that stands in the matrix."""
    low, high = record["low"], record["high"]
    if record["verdict"] != "slower":
        low, high = (None if end is None else 1 / end for end in (high, low))
    return f"{'0' if low is None else number(low)}–{'∞' if high is None else number(high)}"


def break_even(dataset: str, analysis: Mapping[str, Any], entries: Sequence[Entry]) -> Grid | None:
    """From how many queries on each method pays off."""
    by_label = {entry.label: entry for entry in entries}
    rows = []
    for record in analysis["break_even"]:
        if record["dataset"] != dataset or record["verdict"] == "not reached":
            continue
        row = by_label[record["label"]]
        queries = f"{record['queries']:,}" if record["queries"] is not None else record["verdict"]
        why = f"\n{record['reason']}" if record["verdict"] == "unknown" else ""
        offline, full = record["offline_s"], record["fem_latency_ms"]
        times = [
            number(record["latency_ms"]),
            number(full),
            *(number(offline[key]) for key in ("data", "fit")),
        ]
        sizes = [size_of(row.figure("memory_bytes", "fit")), size_of(row.row.get("model_bytes"))]
        rows.append(
            [
                record["method"],
                f"{percent(record['target_rel_l2_median'])} %",
                record["label"],
                queries + why,
                *times,
                *sizes,
            ]
        )
    headings = [
        "method",
        "error",
        "configuration",
        "break-even queries",
        "latency (ms)",
        "full-order (ms)",
        "data (s)",
        "fit (s)",
        "memory",
        "model",
    ]
    note = (
        "Break-even: offline time, data included, over what a query saves against the fastest full-order configuration that is at least as accurate; "
        "never, where that one is as fast. "
        "Of each method the fastest configuration with at most the error; errors that it does not reach are left out."
    )
    return Grid("Whole cost", note, headings, rows) if rows else None


def tuning(dataset: str, analysis: Mapping[str, Any]) -> Grid | None:
    """What each method tried, of what it was allowed to."""
    rows = []
    for record in analysis["tuning"]:
        if record["dataset"] == dataset and (
            record["configurations_allowed"] is not None or record["seconds_allowed"] is not None
        ):
            allowed = (
                _of(record[key], record[f"{key}_allowed"], shown)
                for key, shown in (("configurations", str), ("seconds", number))
            )
            rows.append([record["method"], *allowed])
    note = "What each method tried, of what every method was allowed to."
    return (
        Grid("Tuning budget", note, ["method", "configurations", "fitting (s)"], rows)
        if rows
        else None
    )


def _of(value: float, allowed: float | None, shown: Callable[[Any], str]) -> str:
    if allowed is None:
        return shown(value)
    return f"{shown(value)} of {shown(allowed)}{' (over)' if value > allowed else ''}"


def profile(analysis: Mapping[str, Any]) -> Grid | None:
    """Share of problems that each method solves within a factor of the fastest."""
    found = analysis["profile"]
    if not found["problems"] or len(found["factors"]) < 2:
        return None
    rows = [
        [method, *(f"{100 * share_within(factors, tau):.0f}" for tau in FACTORS), _solved(factors)]
        for method, factors in found["factors"].items()
    ]
    return Grid(
        "Performance profile",
        profile_note(found),
        ["method", *(f"≤ {tau:g}× (%)" for tau in FACTORS), "solved (%)"],
        rows,
    )


def _solved(factors: Sequence[float | None]) -> str:
    return f"{100 * share_within(factors, float('inf')):.0f}"


def profile_note(found: Mapping[str, Any]) -> str:
    """What the problems of a performance profile are."""
    over = f"{found['n_datasets']} datasets" if found["n_datasets"] > 1 else "one dataset"
    targets = ", ".join(f"{percent(target)} %" for target in TARGET_ERRORS)
    note = (
        f"Problems: {over} at the errors {targets}; some method solves {len(found['problems'])}, none {found['n_unsolved']}, left out. "
        "Share of them that a method solves within a factor of the fastest one's time. "
        "Only who is first and who solves most can be read from it: the order of the others depends on which methods take part."
    )
    return note + (
        " With one dataset this says nothing of other scenes." if found["n_datasets"] == 1 else ""
    )


def regimes(analysis: Mapping[str, Any]) -> Grid | None:
    """Whether each method was tested where it belongs."""
    rows = [
        [record["method"], record["says"], "yes" if record["in_regime"] else record["verdict"]]
        for record in analysis["regimes"]
    ]
    note = "Where a method's own file says that it belongs, and whether a configuration of this comparison was there."
    return (
        Grid("In its regime", note, ["method", "where it belongs", "tested there"], rows)
        if rows
        else None
    )


def interval_cells(entry: Entry) -> dict[str, str]:
    """The 95 % intervals of the headlines, by the name of the figure; dashes where there are none."""
    return {
        "rel_l2_median": span(entry.intervals.get("rel_l2_median"), 100.0),
        "mean_dof_m": span(entry.intervals.get("mean_dof_m"), of=metres),
        "latency_ms": span(entry.intervals.get("latency_ms")),
    }
