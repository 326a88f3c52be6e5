"""Console output: a comparison, discretisation errors, and a plan."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from mor_bench.analysis.analyse import analyse
from mor_bench.analysis.selection_text import ERROR
from mor_bench.analysis.told import LEGEND
from mor_bench.analysis.verdict import needs_of
from mor_bench.report.aligned_lines import Line, aligned_lines
from mor_bench.report.caveat_tables import out_of_range
from mor_bench.report.console_columns import NOTE, configuration_lines
from mor_bench.report.entries import (
    Analysis,
    Entry,
    best_per_method,
    dataset_names,
    entries_of,
    verdict_of,
)
from mor_bench.report.line_wrapping import command_lines, wrapped
from mor_bench.report.not_measured import beyond_training
from mor_bench.report.number_format import (
    explain_short_names,
    metres,
    number,
    percent,
    seconds_text,
)
from mor_bench.report.short_names import ShortName, constants, renamed, short_names
from mor_bench.report.speed_tables import (
    NOT_REACHED,
    PAIRWISE_LEGEND,
    TARGETS_NOTE,
    pairs_at,
    target_table,
)
from mor_bench.report.summary import hidden_doubts, interval_basis, notes_of, origins, warnings_of
from mor_bench.report.text_table import TextTable, with_information, with_short_names
from mor_bench.results.comparison import Comparison

if TYPE_CHECKING:
    from mor_bench.runs.plan import Plan, StageName

AGAIN = " Time again: "
"""Words between the sentence on unstable timings and the command that repeats them."""


UNLIMITED = 10_000
"""Width of tables that must not be cut, in characters."""


@dataclass(frozen=True)
class Detail:
    """How much is printed of a comparison.

    Attributes
    ----------
    quiet : bool
        The verdicts only.
    verbose : bool
        Every note.
    wide : bool
        Every column and table, in lines of any length.
    """

    quiet: bool = False
    verbose: bool = False
    wide: bool = False


def _empty_table() -> Table:
    return Table(box=SIMPLE_HEAD, padding=0, show_edge=False)


def _titled(title: str, *parts: RenderableType) -> list[RenderableType]:
    return [Text(""), Text(title, style="bold"), *parts]


def _target_parts(shown: TextTable) -> list[RenderableType]:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), show_edge=False)
    for i, heading in enumerate(shown.headings):
        table.add_column(heading, justify="right" if i else "left", no_wrap=True)
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
    table.add_column("", no_wrap=True)
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
    names = short_names(entry.row for entry in entries)
    found = with_short_names(with_information(found, entries), names)
    table = _empty_table()
    for i, heading in enumerate(found.headings):
        table.add_column(heading, justify="right" if i else "left", no_wrap=True)
    for row in found.rows:
        table.add_row(*map(Text, row))
    title = "Out of range: does the best configuration of each learned method flag large errors?"
    return _titled(title, table, Text(found.note, style="dim"))


def finding_lines(headline: str, names: Mapping[str, ShortName], width: int) -> list[str]:
    """Return the finding of a verdict's headline, with short names."""
    finding = renamed(headline, names).partition(". ")[2]
    return wrapped(finding, width, names=names.values())


def sentence_lines(
    headline: str, sentences: Sequence[str], names: Mapping[str, ShortName], width: int
) -> Iterator[str]:
    """Yield the needs of a verdict's headline and all other sentences, with short names."""
    for sentence in (f"{headline.partition('. ')[0]}.", *sentences):
        text, again, command = renamed(sentence, names).partition(AGAIN)
        text += again.rstrip()
        yield from wrapped(f"- {text}", width, "  ", names=names.values())
        if again:
            yield from command_lines(command, width)


def _verdict_parts(
    verdict: Mapping[str, Any], names: Mapping[str, ShortName], width: int
) -> Iterator[Text]:
    """Yield the verdict; the finding is bold."""
    for line in finding_lines(verdict["headline"], names, width):
        yield Text(line, style="bold", no_wrap=True)
    for line in sentence_lines(verdict["headline"], verdict["beside"], names, width):
        yield Text(line, no_wrap=True)


def _wrapped(
    text: str, width: int, style: str = "", names: Mapping[str, ShortName] | None = None
) -> Iterator[Text]:
    for line in wrapped(text, width, names=(names or {}).values()):
        yield Text(line, style=style, no_wrap=True)


def _failures(
    entries: Sequence[Entry], names: Mapping[str, ShortName], width: int
) -> Iterator[Text]:
    """Yield a line per reason for which configurations have no result or lack predictions."""
    reasons: dict[str, list[str]] = {}
    for entry in entries:
        if entry.trouble:
            reasons.setdefault(entry.trouble, []).append(str(names[entry.label]))
    for reason, labels in reasons.items():
        yield from _wrapped(f"{', '.join(labels)}: {reason}", width, "red", names)


def _notes(
    comparison: Comparison, dataset: str, entries: Sequence[Entry], analysis: Analysis
) -> Iterator[Text]:
    """Yield every doubt and warning, and the number of unused samples."""
    unused = max((entry.row.n_unused for entry in entries), default=0)
    if unused:
        text = f"{unused:,} samples have forces on both sides of the split; they are unused"
        yield Text(text, style="yellow")
    names = short_names(entry.row for entry in entries)
    notes = notes_of(comparison, dataset, analysis)
    notes += [(label, f"warning: {warning}") for label, warning in warnings_of(entries)]
    for label, text in notes:
        yield Text(f"{renamed(label, names)}: {text}", style="yellow")


def _short_notes(
    comparison: Comparison, dataset: str, entries: Sequence[Entry], analysis: Analysis
) -> Iterator[Text]:
    """Yield the doubts that bear on the choice, and the number of the other notes."""
    doubts = [*hidden_doubts(dataset, analysis), *origins(comparison, dataset)]
    names = short_names(entry.row for entry in entries)
    for label, doubt in doubts:
        yield Text(f"{names[label]}: {doubt}", style="yellow")
    n = len(list(_notes(comparison, dataset, entries, analysis))) - len(doubts)
    if n:
        yield Text(
            f"{n} note{'s' * (n > 1)} on methods, timings and samples: --verbose shows them", "dim"
        )


def _dataset_parts(
    comparison: Comparison, dataset: str, analysis: Analysis, console: Console, detail: Detail
) -> Iterator[RenderableType]:
    entries = entries_of(comparison, dataset, analysis)
    names = short_names(entry.row for entry in entries)
    title = str(comparison.datasets.get(dataset, {}).get("title", ""))
    yield Text(f"{dataset} – {title}" if title else dataset, style="bold underline")
    verdict = verdict_of(analysis, dataset)
    if not verdict:
        yield Text("No configuration.\n")
        return
    yield from _verdict_parts(verdict, names, console.width)
    yield Text("")
    yield from configuration_lines(entries, names, None if detail.wide else console.width)
    swept = (entry.swept for entry in entries)
    fixed = constants(entry.row for entry in entries)
    for text in (NOTE, explain_short_names(swept), f"Same in all rows: {fixed}." if fixed else ""):
        if text:
            yield from _wrapped(text, console.width, "dim")
    beyond = beyond_training(comparison, dataset, entries, verdict.get("choice"))
    yield from _wrapped(renamed(beyond, names), console.width, "dim", names)
    yield from _failures(entries, names, console.width)
    notes = _notes if detail.verbose else _short_notes
    for note in notes(comparison, dataset, entries, analysis):
        yield from _wrapped(note.plain, console.width, str(note.style), names)
    if detail.wide:
        yield from _wide_parts(comparison, dataset, entries, analysis)
    yield Text("")


def _wide_parts(
    comparison: Comparison, dataset: str, entries: Sequence[Entry], analysis: Analysis
) -> Iterator[RenderableType]:
    """Yield what the six columns leave out: the winner's figures, further tables."""
    yield Text(LEGEND, style="dim")
    yield from _titled("Figures of the winner, or of the nearest without a winner")
    names = short_names(entry.row for entry in entries)
    for line in verdict_of(analysis, dataset)["evidence"]:
        yield Text(renamed(line, names), no_wrap=True)
    for kind in ("time_at_error", "error_at_time"):
        yield from _target_parts(target_table(comparison, dataset, kind, analysis))
    if basis := interval_basis(dataset, analysis):
        yield Text(basis, style="dim")
    yield from _pairwise_parts(comparison, dataset, analysis)
    yield from _out_of_range_parts(entries)


def print_tables(
    comparison: Comparison,
    console: Console,
    analysis: Analysis | None = None,
    detail: Detail = Detail(),
) -> None:
    """Print verdicts and tables; `analyse` makes the analysis if it is not given."""
    analysis = analysis or analyse(comparison)
    with console.capture() as captured:
        for name in dataset_names(comparison):
            if detail.quiet:
                names = short_names(row for row in comparison.rows if row.dataset == name)
                headline = verdict_of(analysis, name).get("headline", f"{name}: no configuration.")
                for line in _wrapped(renamed(headline, names), console.width, names=names):
                    _print(line, console)
                continue
            for part in _dataset_parts(comparison, name, analysis, console, detail):
                _print(part, console)
    # A redirected stream with a legacy code page must not make a long run fail at its end.
    encoding = console.encoding or "utf-8"
    console.file.write(captured.get().encode(encoding, "replace").decode(encoding))
    console.file.flush()


def _print(part: RenderableType, console: Console) -> None:
    """Print a part; tables and lines that must not be broken may be wider than the console."""
    width = console.width
    if isinstance(part, Table):
        console.width = UNLIMITED
    if isinstance(part, Text) and part.no_wrap:
        console.print(part, crop=False, overflow="ignore")
    else:
        console.print(part, highlight=False)
    console.width = width


def print_discretisation(record: Mapping[str, Any], console: Console) -> None:
    """Print a record of `mor_bench.measure.discretisation_error.refine`: loads, means, meshes."""
    table = _empty_table()
    headings = ("sample", "patch", "force\nN", "e\nm", "relative\nL2 error\n%", "order", "limit")
    for heading in headings:
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
        f"mean e {metres(record['error_m'])} m, {ERROR} {relative} % "
        f"(median {percent(record['relative_l2_median'])} %)"
    )
    console.print(Text(f"discretisation error of {record['dataset']}: {mean}", style="bold"))


_NOT_FITTED = re.compile(r"(.*) \((left out|trained elsewhere)(?:: (.*))?\)", re.DOTALL)
"""Label of a step that takes no time: the configuration, what happens to it, and the reason."""


def _plan_lines(plan: Plan, width: int) -> Iterator[Line]:
    """Yield a line per step, below the name of its dataset, with its estimated seconds."""
    for dataset in dict.fromkeys(step.dataset for step in plan.steps):
        yield Line([f"– {dataset} –"], "dim italic")
        for step in (step for step in plan.steps if step.dataset == dataset):
            shown = "unknown" if step.seconds is None else number(step.seconds)
            shown = "in the cache" if step.done else shown
            found = _NOT_FITTED.fullmatch(step.label)
            name, why = step.label, ""
            if found:
                name, shown, why = found[1], found[2], found[3] or ""
            yield Line([f"  {name}", shown])
            for part in wrapped(why, width, "    ", first="    "):
                yield Line([part], "dim")


def print_plan(plan: Plan, console: Console) -> None:
    """Print the plan of a run, a row per step, and its estimated time; no name is broken."""
    lines = list(_plan_lines(plan, console.width))
    for text in aligned_lines(["  step", "estimate (s)"], lines, console.width):
        _print(text, console)
    unknown = f", and {plan.n_unknown} steps of unknown duration" if plan.n_unknown else ""
    stages: dict[str, StageName] = {
        "compilation, once per machine": "compilation",
        "scores": "scores",
        "timing": "timing",
        "report": "report",
    }
    known = {name: plan.stage_seconds(stage) for name, stage in stages.items()}
    parts = ", ".join(
        f"{name} {seconds_text(seconds)}" for name, seconds in known.items() if seconds
    )
    for line in wrapped(f"beside these steps: {parts}", console.width):
        console.print(Text(line))
    total = f"about {seconds_text(plan.seconds)}"
    console.print(Text(total + unknown, style="bold"))
