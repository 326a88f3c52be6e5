"""One verdict on the configurations of a dataset: which qualify, and which of them is fastest.

Console, report and `pick` use this rule. The validation part selects, so the test error of the
winner is unbiased. Limits on memory and offline cost, if given, qualify in the same way.

If a fresh test set was drawn, its median error must meet the limit, too. It guards against methods
that were tuned to the shipped samples. Of the test set itself, only this counts: a row
must answer all of its loads. Without validation errors the test errors select; the verdict then
says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import Any

import numpy as np

from mor_bench.analysis.bootstrap import central_interval
from mor_bench.analysis.draws import Draws, Interval, answers_all, error_high
from mor_bench.analysis.frontier import median_latency_ms, number_or_inf
from mor_bench.analysis.latency_intervals import verdict_of
from mor_bench.analysis.selection_text import worded
from mor_bench.analysis.told import classes_of, given_by
from mor_bench.analysis.verdict import Figures, Relaxation, Requirements, Verdict, speed_rank
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row


def decide(
    comparison: Comparison, dataset: str, requirements: Requirements, draws: Draws
) -> Verdict:
    """Reach the verdict on one dataset.

    Parameters
    ----------
    comparison : Comparison
    dataset : str
    requirements : Requirements
    draws : Draws
        The dataset's resamples; they give the upper bounds and the paired latencies.
    """
    asked = requirements.asked
    rows = [row for row in comparison.rows if row.dataset == dataset]
    figures = {row.label: bounds_of(row, draws.intervals.get(row.label, {})) for row in rows}
    answering = [row for row in rows if answers_all(row)]
    qualified = [row for row in answering if _meets(figures[row.label], asked)]
    qualified.sort(key=speed_rank)
    verdict = Verdict(
        dataset,
        requirements,
        rows,
        qualified,
        _undecided(qualified, draws),
        n_without_answers=len(rows) - len(answering),
        nearest_told={
            told: _nearest([row for row in answering if row.told == told], figures, asked)
            for told in classes_of(rows)
        },
        figures=figures,
        intervals=draws.intervals,
        given=given_by(comparison, dataset),
        run=comparison.out,
        machine=comparison.machine,
        settings=asked_of(comparison, dataset),
    )
    if qualified:
        return worded(verdict)
    relaxations = [
        found for name in asked if (found := _relaxation(name, asked, answering, figures))
    ]
    unknown = [name for name in asked if all(figures[r.label][name] == inf for r in answering)]
    nearest = _nearest(answering, figures, asked)
    return worded(replace(verdict, relaxations=relaxations, unknown=unknown, nearest=nearest))


def asked_of(comparison: Comparison, dataset: str) -> dict[str, Any]:
    """Return the settings of a run with the datasets and methods that it was asked for."""
    return {
        **comparison.settings,
        "datasets": list(comparison.datasets) or [dataset],
        "methods": [table.get("asked") or name for name, table in comparison.methods.items()],
    }


def bounds_of(row: Row, intervals: Mapping[str, Interval]) -> dict[str, float]:
    """Return the upper bounds of a row by the names of the limits; infinite where unknown."""
    latency = row.latency_ms
    _, latency_high = intervals.get("latency_ms", (0.0, 0.0))
    stored = latency.high if latency and latency.high is not None else latency_high
    memory = row.memory_bytes.predict if row.memory_bytes else None
    return {
        "error": error_high(row, intervals),
        "latency_ms": max(median_latency_ms(row), stored),
        "memory_bytes": number_or_inf(memory),
        "offline_s": number_or_inf(row.offline_core_s),
    }


def _meets(figures: Mapping[str, float], asked: Mapping[str, float]) -> bool:
    return all(figures[name] <= limit for name, limit in asked.items())


def _undecided(qualified: Sequence[Row], draws: Draws) -> list[Row]:
    """Return the rows whose latency ratio to the first one has an interval that contains 1."""
    drawn = {row.label: draws.log_latencies[i] for i, row in enumerate(draws.rows)}
    if not qualified or qualified[0].label not in drawn:
        return []
    first, *others = qualified
    out = []
    for row in others:
        if row.label in drawn:
            low, high = central_interval(drawn[first.label] - drawn[row.label])
            measured = float(np.log(median_latency_ms(first) / median_latency_ms(row)))
            if verdict_of(min(low, measured), max(high, measured)) == "undecided":
                out.append(row)
    return out


def _nearest(rows: Sequence[Row], figures: Figures, asked: Mapping[str, float]) -> Row | None:
    """Return the row that exceeds the limits by the smallest factor."""

    def excess(row: Row) -> float:
        return max((figures[row.label][name] / limit for name, limit in asked.items()), default=0.0)

    known = [row for row in rows if excess(row) < inf]
    return min(known, key=lambda row: (excess(row), speed_rank(row)), default=None)


def _relaxation(
    name: str, asked: Mapping[str, float], rows: Sequence[Row], figures: Figures
) -> Relaxation | None:
    """Return the strictest limit on one figure that lets a row qualify; None if there is none."""
    others = {other: limit for other, limit in asked.items() if other != name}
    able = [
        row for row in rows if _meets(figures[row.label], others) and figures[row.label][name] < inf
    ]
    row = min(able, key=lambda row: (figures[row.label][name], speed_rank(row)), default=None)
    return None if row is None else Relaxation(name, asked[name], figures[row.label][name], row)
