"""A table of texts; console and page draw it in different ways."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from mor_bench.report.entries import Entry, told_by_method
from mor_bench.report.number_format import DASH, number
from mor_bench.report.short_names import ShortName, renamed

Cell = Callable[[Entry], str]


@dataclass(frozen=True)
class TextTable:
    """A table of texts.

    Attributes
    ----------
    title, note : str
        The table's content, and how to read it.
    headings : sequence of str
    rows : sequence of sequence of str
        The first cell names the row. A cell may have several lines; the first is the main one.
    """

    title: str
    note: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


def table_of(
    title: str, note: str, entries: Sequence[Entry], columns: Mapping[str, Cell]
) -> TextTable | None:
    """Build a row per configuration that ran; columns and rows without a figure are left out.

    `columns` maps a heading to a function from an entry to its cell. None if no figure is left.
    """
    ran = [entry for entry in entries if entry.ran]
    cells = {heading: [cell(entry) for entry in ran] for heading, cell in columns.items()}
    shown = {heading: texts for heading, texts in cells.items() if set(texts) - {DASH}}
    rows = [
        [entry.label, *texts]
        for entry, *texts in zip(ran, *shown.values(), strict=True)
        if set(texts) - {DASH}
    ]
    return TextTable(title, note, ["configuration", *shown], rows) if rows else None


def with_short_names(table: TextTable, names: Mapping[str, ShortName]) -> TextTable:
    """Replace the labels of configurations by their short names."""
    return replace(table, rows=[[renamed(cell, names) for cell in row] for row in table.rows])


def with_information(table: TextTable, entries: Sequence[Entry]) -> TextTable:
    """Add what each row's method is told, if the rows are configurations or methods."""
    known = {
        "configuration": {entry.label: entry.group for entry in entries},
        "method": told_by_method(entries),
    }.get(table.headings[0] if table.headings else "", {})
    if not any(row[0] in known for row in table.rows):
        return table
    first, *others = table.headings
    rows = [[row[0], known.get(row[0], DASH), *row[1:]] for row in table.rows]
    return replace(table, headings=[first, "told", *others], rows=rows)


def figure_cell(part: str, name: str, shown: Callable[[float | None], str] = number) -> Cell:
    """Make the cell of one figure, such as ``figure_cell("latency_ms", "median")``."""
    return lambda entry: shown(entry.figure(part, name))


def marked_latency(entry: Entry) -> str:
    """Format the median latency in ms; a tilde marks a timing that is not stable."""
    return number(entry.figure("latency_ms", "median")) + ("~" if entry.unstable else "")
