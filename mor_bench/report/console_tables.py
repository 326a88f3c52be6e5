"""Console output: the tables of a comparison, of discretisation errors and of a plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import hypot
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.selection_text import needs_text
from mor_bench.analysis.told import LEGEND
from mor_bench.analysis.verdict import needs_of
from mor_bench.report.caveat_tables import out_of_range
from mor_bench.report.console_columns import configuration_table
from mor_bench.report.entries import (
    Analysis,
    Entry,
    best_per_method,
    dataset_names,
    entries_of,
    verdict_of,
)
from mor_bench.report.number_format import explain_short_names, metres, number, percent
from mor_bench.report.speed_tables import (
    NOT_REACHED,
    PAIRWISE_LEGEND,
    TARGETS_NOTE,
    pairs_at,
    target_table,
)
from mor_bench.report.summary import (
    discretisation_error,
    interval_basis,
    notes_of,
    warnings_of,
)
from mor_bench.report.text_table import TextTable
from mor_bench.results.comparison import Comparison

if TYPE_CHECKING:
    from mor_bench.runs.plan import Plan


def _empty_table() -> Table:
    return Table(box=SIMPLE_HEAD, padding=0, show_edge=False)


def _titled(title: str, *parts: RenderableType) -> list[RenderableType]:
    return [Text(""), Text(title, style="bold"), *parts]


def _target_parts(shown: TextTable, width: int) -> list[RenderableType]:
    table = _empty_table()
    table.add_column("method", overflow="fold", min_width=8)
    cell_width = len(NOT_REACHED) if width >= 100 else 8
    for heading in shown.headings[1:]:
        table.add_column(heading, justify="right", overflow="fold", min_width=cell_width)
    for method, *cells in shown.rows:
        texts = (Text(cell, style="dim" if cell == NOT_REACHED else "") for cell in cells)
        table.add_row(Text(method), *texts)
    return _titled(shown.title, table, Text(TARGETS_NOTE, style="dim"))


def _pairwise_parts(
    comparison: Comparison, dataset: str, analysis: Analysis
) -> list[RenderableType]:
    """Compare speeds at the error that the dataset requires, if two or more methods reach it."""
    error = needs_of(comparison, dataset).error
    if error is None or len((pairs := pairs_at(comparison, dataset, error, analysis)).methods) < 2:
        return []
    table = _empty_table()
    table.add_column("", overflow="fold")
    for i in range(len(pairs.methods)):
        table.add_column(f"({i + 1})", justify="right", min_width=5)
    for i, (method, line) in enumerate(zip(pairs.methods, pairs.cells, strict=True)):
        texts = (Text(cell, style={"+": "green", "-": "red"}.get(cell[0], "dim")) for cell in line)
        table.add_row(Text(f"({i + 1}) {method}"), *texts)
    absent = f" Not reached by {', '.join(pairs.absent)}." if pairs.absent else ""
    title = f"Who is faster at {percent(error)} %, the required error"
    return _titled(title, table, Text(PAIRWISE_LEGEND + absent, style="dim"))


def _out_of_range_parts(entries: Sequence[Entry]) -> list[RenderableType]:
    """Range flags on the named test sets, for the best configuration of each trained method."""
    best = {entry.label for entry in best_per_method(entries)}
    found = out_of_range([entry for entry in entries if entry.label in best and entry.row.sets])
    if found is None:
        return []
    table = _empty_table()
    for i, heading in enumerate(found.headings):
        table.add_column(heading, justify="right" if i else "left", overflow="fold")
    for row in found.rows:
        table.add_row(*map(Text, row))
    title = "Out of range: does the best configuration of each learned method flag large errors?"
    return _titled(title, table, Text(found.note, style="dim"))


def _notes(
    comparison: Comparison, dataset: str, entries: Sequence[Entry], analysis: Analysis
) -> list[Text]:
    """Failures in red; unused samples, doubts and warnings in yellow."""
    unused = max((entry.row.n_unused for entry in entries), default=0)
    lines = [f"{label}: {doubt}" for label, doubt in notes_of(comparison, dataset, analysis)]
    lines += [f"{label}: warning: {warning}" for label, warning in warnings_of(entries)]
    if unused:
        lines.insert(
            0, f"{unused:,} samples have forces on both sides of the split; they are unused"
        )
    return [
        *(Text(f"{e.label}: {e.trouble}", style="red") for e in entries if e.trouble),
        *(Text(line, style="yellow") for line in lines),
    ]


def _dataset_group(comparison: Comparison, dataset: str, width: int, analysis: Analysis) -> Group:
    entries = entries_of(comparison, dataset, analysis)
    title = str(comparison.datasets.get(dataset, {}).get("title", ""))
    marks = (
        "Pareto *: no other configuration is both faster and more accurate (medians). "
        "ref: a full-order solve on the dataset's mesh; its error is not ranked."
    )
    if any(entry.unstable for entry in entries):
        marks += " Latency ~: not stable, see below."
    parts: list[RenderableType] = [
        Text(f"{dataset} – {title}" if title else dataset, style="bold"),
        Text(f"needs: {needs_text(needs_of(comparison, dataset))}"),
        Text(f"discretisation error of the dataset's mesh: {discretisation_error(entries)}"),
        Text(""),
        configuration_table(entries, width),
        Text(marks, style="dim"),
        Text(LEGEND, style="dim"),
        *_notes(comparison, dataset, entries, analysis),
    ]
    for kind in ("time_at_error", "error_at_time"):
        parts += _target_parts(target_table(comparison, dataset, kind, analysis), width)
    names = explain_short_names(entry.swept for entry in entries)
    basis = [interval_basis(dataset, analysis), names, "Nothing is extrapolated."]
    parts.append(Text("  ".join(filter(None, basis)), style="dim"))
    parts += _pairwise_parts(comparison, dataset, analysis)
    parts += _out_of_range_parts(entries)
    return Group(*parts, *_verdict_parts(verdict_of(analysis, dataset)))


def _verdict_parts(verdict: Mapping[str, Any]) -> list[RenderableType]:
    lines = [*verdict["evidence"], *verdict["beside"]]
    return [Text(""), Text(verdict["headline"], style="bold"), *map(Text, lines), Text("")]


def print_tables(
    comparison: Comparison, console: Console, analysis: Analysis | None = None
) -> None:
    """Print all tables of a comparison; `analyse` makes the analysis if it is not given."""
    analysis = analysis or analyse(comparison)
    with console.capture() as captured:
        for name in dataset_names(comparison):
            group = _dataset_group(comparison, name, console.width, analysis)
            console.print(group, highlight=False)
    # A redirected stream with a legacy code page must not make a long run fail at its end.
    encoding = console.encoding or "utf-8"
    console.file.write(captured.get().encode(encoding, "replace").decode(encoding))
    console.file.flush()


def print_discretisation(record: Mapping[str, Any], console: Console) -> None:
    """Print a record of `mor_bench.measure.discretisation_error.refine`: loads, means, meshes."""
    table = _empty_table()
    for heading in ("sample", "patch", "force\nN", "e\nm", "rel L2\n%", "order", "limit"):
        table.add_column(heading, justify="right")
    for load in record["loads"]:
        table.add_row(
            str(load["sample"]),
            ", ".join(map(str, load["patches"])),
            ", ".join(number(hypot(*vector)) for vector in load["vectors_n"]),
            metres(load["error_m"]),
            percent(load["relative_l2"]),
            number(load["order"]),
            load["limit"],
        )
    console.print(table, highlight=False)
    for load in record["loads"]:
        if load["error_m"] is None:
            excluded = f"sample {load['sample']} is excluded from the means: {load['reason']}"
            console.print(Text(excluded, style="red"))
    for kind, meshes in (
        ("meshes", record["meshes"]),
        ("left out because of their size", record["left_out"]),
    ):
        shown = (f"{mesh['n_cells']:,} cells ({mesh['n_dofs']:,} dofs)" for mesh in meshes)
        if meshes:
            console.print(Text(f"{kind}: {', '.join(shown)}"))
    relative = percent(record["relative_l2"])
    mean = (
        f"mean e {metres(record['error_m'])} m, relative L2 {relative} % "
        f"(median {percent(record['relative_l2_median'])} %)"
    )
    console.print(Text(f"discretisation error of {record['dataset']}: {mean}", style="bold"))


def print_plan(plan: Plan, console: Console) -> None:
    """Print the plan of a run, a row per dataset and configuration, and its estimated time."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), show_edge=False)
    for heading in ("dataset", "step"):
        table.add_column(heading)
    table.add_column("estimate", justify="right")
    for step in plan.steps:
        estimate = "unknown" if step.seconds is None else f"{number(step.seconds)} s"
        table.add_row(step.dataset, Text(step.label), "in the cache" if step.done else estimate)
    console.print(table, highlight=False)
    unknown = f", and {plan.n_unknown} steps of unknown duration" if plan.n_unknown else ""
    stages = {"compilation, once per machine": plan.compilation_s, "scores": plan.scoring_s}
    stages |= {"timing": plan.timing_s, "report": plan.report_s}
    parts = ", ".join(f"{name} {number(seconds)} s" for name, seconds in stages.items() if seconds)
    console.print(Text(f"beside these steps: {parts}"))
    total = f"about {plan.seconds / 60:.1f} min"
    console.print(Text(total + unknown, style="bold"))
