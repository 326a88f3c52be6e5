"""The hard cases on the console: a table of verdicts, and their counts."""

from __future__ import annotations

from itertools import groupby

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mor_bench.hard_cases.catalogue import CASES, CaseResult
from mor_bench.hard_cases.suite import StressResults

STYLES = {"pass": "green", "fall short": "bold red", "not applicable": "dim"}


def ordered(found: StressResults) -> list[CaseResult]:
    """Sort the rows by case; within a case they keep the order in which methods were tried."""
    places = {(case.name, case.part): number for number, case in enumerate(CASES)}
    return sorted(found.rows, key=lambda row: places[row.case, row.part])


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
    if short:
        names = (f"{row.case} ({row.part})" if row.part else row.case for row in short)
        cases = (f"{name} of {row.method}" for name, row in zip(names, short, strict=True))
        console.print(f"Fall short: {', '.join(cases)}.", highlight=False, markup=False)


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
            name = f"{row.case}: {row.part}" if row.part else row.case
            first = (name, row.expected) if number == 0 else ("", "")
            verdict = Text(row.verdict, STYLES[row.verdict])
            table.add_row(
                Text(first[0]), Text(row.method), Text(first[1]), Text(row.happened), verdict
            )
        table.add_section()
    return table
