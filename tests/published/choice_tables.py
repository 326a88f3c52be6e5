"""Tables in Markdown about the fixed choices of methods, on validation and on test samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mor_bench.report.number_format import number
from tests.published.run_tables import markdown
from tests.published.stored import content_of


def choices(source: str, group: str = "open") -> str:
    """Show errors of variants of methods: medians of the trainings, and the range of e."""
    body = []
    for row in content_of(source)["rows"]:
        if row["group"] != group:
            continue
        cells = [f"{row['choice']} {row['value']}".strip()]
        for part in ("validation", "test"):
            errors = [training[part] for training in row["trainings"]]
            sizes = [error["mean_dof_m"] for error in errors]
            e = f"{float(np.median(sizes)):.2e}"
            if len(sizes) > 1:
                e += f" ({min(sizes):.2e} to {max(sizes):.2e})"
            median, p95 = (
                100 * float(np.median([error[name] for error in errors]))
                for name in ("rel_l2_median", "rel_l2_p95")
            )
            cells.append(f"{e}; {number(median)}; {number(p95)}".replace("e-0", "e-"))
        core_s = float(np.median([training["core_s"] for training in row["trainings"]]))
        body.append([*cells, number(core_s)])
    headings = [
        "",
        "validation: e, m; median %; p95 %",
        "test: e, m; median %; p95 %",
        "core-s of a fit",
    ]
    return markdown(headings, body)


def choices_decided(source: str) -> str:
    """Show which value each part would choose, and what choosing by the test would have gained.

    The figure of a value is the median of e over its trainings. The gain is the difference of the
    test errors of both values, relative to that of the value with the least validation error.
    """
    found: dict[str, dict[str, Mapping[str, Any]]] = {}
    for row in content_of(source)["rows"]:
        if row["group"] in ("open", "others"):
            found.setdefault(row["choice"], {})[str(row["value"])] = row
    body = []
    for choice, rows in found.items():
        best = [_least(rows, part) for part in ("validation", "test")]
        chosen, tempting = (_median_e(rows[value], "test") for value in best)
        body.append([choice, next(iter(rows)), *best, number(100 * (1 - tempting / chosen))])
    headings = ["choice", "in the file then", "least on validation", "least on test"]
    return markdown([*headings, "gain by the test, %"], body)


def _least(rows: Mapping[str, Mapping[str, Any]], part: str) -> str:
    return min(rows, key=lambda value: _median_e(rows[value], part))


def _median_e(row: Mapping[str, Any], part: str) -> float:
    return float(np.median([training[part]["mean_dof_m"] for training in row["trainings"]]))
