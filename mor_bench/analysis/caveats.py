"""Caveats of a ranking: the fresh test set, untested regimes, tuning budgets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import inf, isfinite, sqrt
from typing import Any

from mor_bench.analysis.draws import Interval, finite_or_none
from mor_bench.analysis.frontier import EXACT, median_error, number_or_inf
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row

QUERIES_ON_CPU = "trained on a graphics processor, but queried on the CPU"
"""Unmet condition of every row in a GPU regime.

Such a regime needs queries on the GPU, timed after the device is synchronised. Queries are timed on
the CPU only.
"""

HIDDEN_WORSE = 1.2
"""Largest ratio of hidden to shipped test error that is never called worse."""


def hidden(
    rows: Iterable[Row], dataset: str, intervals: Mapping[str, Mapping[str, Interval]]
) -> list[dict[str, Any]]:
    """Compare the errors of each configuration on the hidden and on the shipped test set.

    A configuration is `worse` if the ratio of the medians exceeds `limit`. On the log scale, the
    limit is the half-width of the shipped set's interval times sqrt(1 + n shipped / n hidden), but
    at least log `HIDDEN_WORSE`.
    """
    out = []
    for row in rows:
        if row.dataset != dataset or row.status != "ok" or not row.hidden or not row.error:
            continue
        shipped, fresh = median_error(row), number_or_inf(row.hidden.rel_l2_median)
        measurable = EXACT < shipped < inf
        exact = 1.0 if fresh <= max(shipped, EXACT) else inf
        ratio = fresh / shipped if measurable else exact
        high = intervals.get(row.label, {}).get("rel_l2_median", (inf, inf))[1]
        room = max(high / shipped, 1.0) if isfinite(high) and measurable else 1.0
        limit = max(HIDDEN_WORSE, room ** sqrt(1 + row.n_test / max(row.hidden.n or 1, 1)))
        out.append(
            {
                "dataset": dataset,
                "label": row.label,
                "ratio": finite_or_none(ratio),
                "limit": float(limit),
                "worse": bool(ratio > limit),
            }
        )
    return out


def regimes(comparison: Comparison) -> list[dict[str, Any]]:
    """Compare each method's tests with the regime that its file names; list unmet conditions.

    The list is empty if no file names a regime.
    """
    out: list[dict[str, Any]] = []
    if not any((method or {}).get("regime") for method in comparison.methods.values()):
        return out
    device = str(comparison.settings.get("device") or "cpu")
    for method in dict.fromkeys(row.method for row in comparison.rows):
        regime = (comparison.methods.get(method) or {}).get("regime")
        if not regime:
            verdict = "its file names no regime"
            out.append({"method": method, "says": "", "in_regime": None, "verdict": verdict})
            continue
        missing = [
            _missing(row, regime, device)
            for row in comparison.rows
            if row.method == method and row.status == "ok"
        ]
        least = min(missing, key=len, default=["no configuration ran"])
        says = str(regime.get("says") or "")
        verdict = "in its regime"
        if least:
            verdict = f"not tested in its regime ({', '.join(least)}). It is for: {says}"
        out.append({"method": method, "says": says, "in_regime": not least, "verdict": verdict})
    return out


def _missing(row: Row, regime: Mapping[str, Any], device: str) -> list[str]:
    """List in words the conditions of a regime that a row does not meet."""
    trained = row.training.iterations if row.training else None
    has = {
        "min_dofs": (row.n_dofs, "degrees of freedom"),
        "min_train": (row.n_train, "training samples"),
        "min_iterations": (trained or _number(row.parameters.get("iterations")), "iterations"),
    }
    missing = [
        f"{n or 0:,} {what}; it needs {regime[name]:,}"
        for name, (n, what) in has.items()
        if regime.get(name) and (n or 0) < regime[name]
    ]
    if regime.get("split") and row.split != regime["split"]:
        missing.append(f"split by {row.split}")
    if regime.get("gpu"):
        trained_on = row.training.device if row.training else device
        missing.append("no graphics processor" if trained_on == "cpu" else QUERIES_ON_CPU)
    return missing


def _number(value: Any) -> int | None:
    return value if isinstance(value, int) else None


def tuning(comparison: Comparison) -> list[dict[str, Any]]:
    """Compare the tuning of each method on each dataset with its tuning budget.

    The seconds are those of fitting, including failed fits, but no trainings elsewhere.
    """
    budget = comparison.settings.get("budget") or {}
    out = []
    for dataset, method in dict.fromkeys((row.dataset, row.method) for row in comparison.rows):
        tried = [
            row
            for row in comparison.rows
            if (row.dataset, row.method) == (dataset, method) and row.status != "skipped"
        ]
        out.append(
            {
                "dataset": dataset,
                "method": method,
                "configurations": len(tried),
                "seconds": sum(map(_tuning_seconds, tried)),
                "configurations_allowed": budget.get("configurations"),
                "seconds_allowed": budget.get("seconds"),
            }
        )
    return out


def _tuning_seconds(row: Row) -> float:
    if row.trained_elsewhere:
        return 0.0
    return row.tuning_s or (row.offline_s.fit if row.offline_s else None) or 0.0
