"""The table of methods of an earlier commit beside those of today."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mor_bench.analysis.frontier import Point, fastest_within, most_accurate_within
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


def points_on(scene: str, rows: Sequence[Mapping[str, Any]]) -> list[Point]:
    """Return latency and 95th percentile of the error on a scene, with the method as label."""
    mine = (row for row in rows if row["dataset"] == scene)
    return [Point(row["ms"], row["rel_l2_p95"], row["method"]) for row in mine]


def scenes_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the scenes of rows, in their order."""
    return list(dict.fromkeys(row["dataset"] for row in rows))


def rows_of_today(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of all of today's methods."""
    return [row for run in ("now", "more", "further") for row in content[run]]


def fronts(source: str) -> str:
    """Show the fastest time for each error and the least error in each time, before and now."""
    content = content_of(source)
    return _both(content["before"], content["now"])


def fronts_of_all(source: str) -> str:
    """Show the fastest time for each error and the least error in each time, of today's methods."""
    rows = rows_of_today(content_of(source))
    body = [
        [scene, *map(_with_method, _figures(points_on(scene, rows)))] for scene in scenes_of(rows)
    ]
    return markdown(HEADINGS, body)


def fronts_of_newest(source: str) -> str:
    """Show the same figures of the full-order model alone, and with the newest methods."""
    rows = content_of(source)["newest"]
    return _both([row for row in rows if row["method"] == "fem"], rows)


def _both(old: Sequence[Mapping[str, Any]], new: Sequence[Mapping[str, Any]]) -> str:
    body = []
    for scene in scenes_of(new):
        pairs = zip(*(_figures(points_on(scene, rows)) for rows in (old, new)), strict=True)
        body.append([scene, *(f"{left} → {_with_method(right)}" for (left, _), right in pairs)])
    return markdown(HEADINGS, body)


def _figures(points: Sequence[Point]) -> list[tuple[str, str]]:
    """Return the figure of each heading but the first, and its method."""
    fastest = [fastest_within(points, error) for error in TARGETS]
    best = [most_accurate_within(points, ms) for ms in LIMITS_MS]
    return [
        *((DASH, "") if p is None else (number(p.latency_ms), p.label) for p in fastest),
        *((DASH, "") if p is None else (number(100.0 * p.error), p.label) for p in best),
    ]


def _with_method(figure: tuple[str, str]) -> str:
    value, method = figure
    return f"{value} `{method}`" if method else value


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
