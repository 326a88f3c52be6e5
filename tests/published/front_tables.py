"""The table of methods of an earlier commit beside those of today."""

from __future__ import annotations

from typing import Any

from mor_bench.report.number_format import DASH, number
from tests.published.run_tables import markdown
from tests.published.stored import content_of

TARGETS = (0.1, 0.03, 0.01, 0.003)
"""Errors to reach: 95th percentiles of the relative L2 error."""

LIMITS_MS = (0.3, 1.0, 3.0)
"""Times to stay within."""

HEADINGS = [
    "scene",
    *(f"ms for {100 * error:g} %" for error in TARGETS),
    *(f"% in {ms:g} ms" for ms in LIMITS_MS),
]

Rows = list[dict[str, Any]]


def fronts(source: str) -> str:
    """Show the fastest time for each error and the least error in each time, before and now."""
    content = content_of(source)
    body = []
    for dataset in dict.fromkeys(row["dataset"] for row in content["now"]):
        before, now = (
            [row for row in content[code] if row["dataset"] == dataset]
            for code in ("before", "now")
        )
        cells = [_change(_fastest(before, e), _fastest(now, e), "ms", 1.0) for e in TARGETS]
        cells += [
            _change(_best(before, ms), _best(now, ms), "rel_l2_p95", 100.0) for ms in LIMITS_MS
        ]
        body.append([dataset, *cells])
    return markdown(HEADINGS, body)


def fronts_of_all(source: str) -> str:
    """Show the fastest time for each error and the least error in each time, of today's methods."""
    content = content_of(source)
    rows = content["now"] + content["more"]
    body = []
    for dataset in dict.fromkeys(row["dataset"] for row in rows):
        mine = [row for row in rows if row["dataset"] == dataset]
        cells = [_value(_fastest(mine, error), "ms", 1.0) for error in TARGETS]
        cells += [_value(_best(mine, ms), "rel_l2_p95", 100.0) for ms in LIMITS_MS]
        body.append([dataset, *cells])
    return markdown(HEADINGS, body)


def _fastest(rows: Rows, error: float) -> dict[str, Any] | None:
    able = [row for row in rows if row["rel_l2_p95"] <= error]
    return min(able, key=lambda row: float(row["ms"]), default=None)


def _best(rows: Rows, ms: float) -> dict[str, Any] | None:
    able = [row for row in rows if row["ms"] <= ms]
    return min(able, key=lambda row: float(row["rel_l2_p95"]), default=None)


def _change(
    before: dict[str, Any] | None, now: dict[str, Any] | None, name: str, scale: float
) -> str:
    """Return both values, and the method of today's."""
    return _value(before, name, scale).partition(" ")[0] + " → " + _value(now, name, scale)


def _value(row: dict[str, Any] | None, name: str, scale: float) -> str:
    """Return the value and its method."""
    return DASH if row is None else f"{number(scale * row[name])} `{row['method']}`"


FIGURES = {
    "import_s": ("import, s", 1.0),
    "fit_and_first_solve_s": ("fit and first solve, s", 1.0),
    "solve_s": ("solve, ms", 1e3),
    "memory_bytes": ("memory, MB", 1e-6),
}


def nothing_slower(source: str) -> str:
    """Show start, memory and solves of the full-order model before and now, and their ratios."""
    rows = content_of(source)["rows"]
    body = []
    for name in dict.fromkeys(row["dataset"] for row in rows):
        of = {row["version"]: row for row in rows if row["dataset"] == name}
        cells = [f"`{name}`"]
        for figure, (_, unit) in FIGURES.items():
            before, now = (unit * of[version][figure] for version in ("before", "now"))
            cells.append(f"{number(before)} → {number(now)} ({now / before:.2f})")
        body.append(cells)
    return markdown(["scene", *(text for text, _ in FIGURES.values())], body)
