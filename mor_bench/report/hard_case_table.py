"""The hard cases: a table of verdicts and their counts on the console, and tables of the page."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mor_bench.hard_cases.catalogue import CASES, CaseResult
from mor_bench.hard_cases.suite import StressResults
from mor_bench.report.number_format import DASH
from mor_bench.report.text_table import TextTable

STYLES = {"pass": "green", "fall short": "bold red", "not applicable": "dim"}


def ordered(found: StressResults) -> list[CaseResult]:
    """Sort the rows by case; within a case they keep the order in which methods were tried."""
    places = {(case.name, case.part): number for number, case in enumerate(CASES)}
    return sorted(found.rows, key=lambda row: places.get((row.case, row.part), len(places)))


def print_stress(found: StressResults, console: Console, quiet: bool = False) -> None:
    """Print all rows unless quiet, the counts, and the names of the methods that fell short."""
    if not quiet:
        console.print(_table(found))
    short = [row for row in ordered(found) if row.verdict == "fall short"]
    counts = (
        f"{len(found.rows)} tried: {found.count('pass')} pass, {len(short)} fall short, "
        f"{found.count('not applicable')} not applicable."
    )
    console.print(counts, highlight=False)
    for told, methods in _by_told(found).items():
        console.print(f"Told ({told}): {', '.join(methods)}.", highlight=False, markup=False)
    if short:
        cases = (f"{_name(row)} of {row.method}" for row in short)
        console.print(f"Fall short: {', '.join(cases)}.", highlight=False, markup=False)


def stress_table(found: StressResults, methods: Sequence[str]) -> TextTable:
    """Build a row per method, or a row per case if there is one method."""
    rows = [row for row in ordered(found) if row.method in methods]
    if len(methods) == 1:
        cells = [[_name(row), row.verdict, row.expected, row.happened] for row in rows]
        headings = ["case", "verdict", "expected", "what happened"]
        told = found.told.get(methods[0])
        note = f"{_NOTE} The method is told: {told}." if told else _NOTE
        return TextTable(f"Hard cases of {methods[0]}", note, headings, cells)
    cells = []
    for method in methods:
        mine = [row for row in rows if row.method == method]
        short = ", ".join(_name(row) for row in mine if row.verdict == "fall short")
        counts = (str(sum(row.verdict == verdict for row in mine)) for verdict in STYLES)
        told = found.told.get(method, DASH)
        cells += [[method, told, *counts, short or "none"]] if mine else []
    headings = ["method", "told", "passed", "fell short", "not applicable", "falls short at"]
    return TextTable("Hard cases of each method", _NOTE, headings, cells)


_NOTE = "Tried on beam-tiny by `mor-bench stress`, with the parameters of the method files."


def _by_told(found: StressResults) -> dict[str, list[str]]:
    """Group the methods by the information that they are given."""
    groups: dict[str, list[str]] = {}
    for method, told in sorted(found.told.items()):
        groups.setdefault(told, []).append(method)
    return groups


def _name(row: CaseResult) -> str:
    return f"{row.case}: {row.part}" if row.part else row.case


def _table(found: StressResults) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    longest = max((len(row.method) for row in found.rows), default=0)
    for heading, width in (
        ("case", 19),
        ("method", max(20, longest)),
        ("expected", 20),
        ("what happened", None),
        ("", 14),
    ):
        table.add_column(heading, width=width, overflow="fold")
    for _, group in groupby(ordered(found), key=lambda row: (row.case, row.part)):
        for number, row in enumerate(group):
            first = (_name(row), row.expected) if number == 0 else ("", "")
            verdict = Text(row.verdict, STYLES[row.verdict])
            table.add_row(
                Text(first[0]), Text(row.method), Text(first[1]), Text(row.happened), verdict
            )
        table.add_section()
    return table
