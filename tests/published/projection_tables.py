"""Tables in Markdown about projection methods at equal sizes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mor_bench.report.number_format import DASH, number
from tests.published.run_tables import markdown
from tests.published.stored import content_of


def projections(source: str, dataset: str) -> str:
    """Show errors, cells, points and counted work of hyper-reduced models on one scene."""
    headings = ["r", "method", "median %", "p95 %", "max %", "without answer"]
    body = []
    for row in content_of(source)[dataset]["rows"]:
        head = [str(row["size"]), row["name"]]
        if "reason" in row:
            body.append([*head, *[DASH] * 7])
            continue
        points = row["n_points"]
        counts = [
            str(row["n_failed"]),
            str(row["n_cells"]),
            DASH if points is None else str(points),
        ]
        body.append([*head, *_percents(row["error"]), *counts, _millions(row)])
    return markdown([*headings, "cells", "points", "10⁶ multiply-adds per query"], body)


def reconstructions(source: str, dataset: str) -> str:
    """Show errors beside reconstruction errors of POD and curved manifolds on one scene."""
    headings = ["r", "method", "median %", "p95 %", "max %", "without answer"]
    headings += ["reconstruction: median %", "p95 %", "cells", "10⁶ multiply-adds per query"]
    body = []
    for row in content_of(source)[dataset]["rows"]:
        head = [str(row["size"]), row["name"]]
        if "reason" in row:
            body.append([*head, *[DASH] * 8])
            continue
        apart = _percents(row["reconstruction"])[:2] if "reconstruction" in row else [DASH] * 2
        counts = [str(row["n_failed"]), *apart, str(row["n_cells"]), _millions(row)]
        body.append([*head, *_percents(row["error"]), *counts])
    return markdown(headings, body)


def softened_volume(source: str, size: str) -> str:
    """Show errors by Poisson's ratio of bodies and of their reduced problems, of one size."""
    rows = [row for row in content_of(source)["rows"] if row["size"] == int(size)]
    least = sorted({row["reduced"] for row in rows if row["reduced"] < row["poisson"]})
    headings = ["scene", "ν of the body", "the same, %", *(f"{r:g}, %" for r in reversed(least))]
    of = {(row["dataset"], row["poisson"], row["reduced"]): row["error"] for row in rows}
    body = []
    for scene, poisson in dict.fromkeys((row["dataset"], row["poisson"]) for row in rows):
        spreads = (of.get((scene, poisson, r)) for r in reversed(least) if r < poisson)
        cells = [" / ".join(_percents(s)) for s in (of[scene, poisson, poisson], *spreads) if s]
        missing = [DASH] * (1 + len(least) - len(cells))
        body.append([f"`{scene}`", f"{poisson:g}", cells[0], *missing, *cells[1:]])
    return markdown(headings, body)


def response_inputs(source: str, dataset: str) -> str:
    """Show errors of regressions by what they start from, and the time of the start."""
    rows = [row for row in content_of(source)["rows"] if row["dataset"] == dataset]
    learned = [name for name in rows[0] if name.startswith("pca-")]
    headings = ["start", "ms of the start", "alone: median / p95 / max, %"]
    headings += [f"with `{name}`: median / p95 / max, %" for name in learned]
    body = []
    for row in rows:
        spreads = (" / ".join(_percents(row[name])) for name in ("alone", *learned))
        body.append([row["start"], number(row["start_ms"]), *spreads])
    return markdown(headings, body)


def _percents(spread: Mapping[str, float | None]) -> list[str]:
    found = (spread[name] for name in ("median", "p95", "max"))
    return ["∞" if value is None else number(100 * value) for value in found]


def _millions(row: Mapping[str, Any]) -> str:
    return number(row["multiply_adds"] / 1e6)
