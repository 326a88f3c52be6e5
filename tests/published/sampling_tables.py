"""Tables in Markdown about ways to choose training loads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mor_bench.report.number_format import DASH, number
from tests.published.run_tables import markdown
from tests.published.stored import content_of


def learning_curves(source: str, dataset: str, method: str) -> str:
    """Show the errors of a method over its number of snapshots, for each way to choose them.

    The figures are medians over the repetitions. The cost is that of the most snapshots that all
    ways have.
    """
    rows = content_of(source)[dataset]["methods"][method]
    found = {(row["way"], row["n"]): row for row in rows}
    sizes = sorted({row["n"] for row in rows})
    ways = list(dict.fromkeys(row["way"] for row in rows))
    compared = max(n for n in sizes if all((way, n) in found for way in ways))
    base_s = core_seconds(found["random", compared])
    body = []
    for way in ways:
        cells = [_errors(found.get((way, n))) for n in sizes]
        core_s = core_seconds(found[way, compared])
        cost = [number(1e3 * core_s / compared), number(core_s / base_s)]
        body.append([way, *cells, *cost])
    headings = ["median %; p95 %", *(f"n = {n}" for n in sizes)]
    headings += [f"core-ms per snapshot, n = {compared}", "over random"]
    return markdown(headings, body)


def _errors(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return DASH
    errors = [middle(row[name]) for name in ("median", "p95")]
    return "; ".join(number(100 * e) if np.isfinite(e) else "∞" for e in errors)


def middle(values: Sequence[float | None]) -> float:
    """Return the median of errors, where None is an infinite one."""
    return float(np.median([np.inf if value is None else value for value in values]))


def core_seconds(row: Mapping[str, Any]) -> float:
    """Return the core-seconds of all snapshots: solves, fits and choices."""
    parts = np.sum([row[name] for name in ("solve", "fit", "choose")], axis=0)
    return float(np.median(parts))
