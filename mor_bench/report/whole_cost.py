"""Whole cost of the methods that reach the required error: its data, and its figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, log, log10

import numpy as np
from matplotlib.axes import Axes

from mor_bench.analysis.verdict import needs_of
from mor_bench.report.canvas import (
    INK,
    LABEL,
    NOTE,
    Picture,
    dress,
    folded,
    log_ticks,
    new_figure,
    plain,
    shortened,
)
from mor_bench.report.entries import Analysis, Entry, entries_of
from mor_bench.report.labels import Note, annotate
from mor_bench.report.method_styles import readable, style_of
from mor_bench.report.number_format import number, whole
from mor_bench.report.short_names import short_names
from mor_bench.results.comparison import Comparison

PARTS = {"training data": "#2878b5", "fit": "#d98a29", "queries": "#a6a6a6"}
"""Parts of a bar and their colours."""

CAPTION = (
    "Core-seconds of training data, fit and queries, for the fastest configuration of each method "
    "that is accurate enough. Above: the total over the number of queries; a diamond marks the "
    "break-even with the full-order model. Below: the parts of the total near the first "
    "break-even. "
    "An arrow leads to a value beyond the axis."
)


@dataclass(frozen=True)
class CostLine:
    """Core-seconds of a configuration: training data, fit, and one query; its break-even number."""

    label: str
    method: str
    name: str
    data: float
    fit: float
    query: float
    break_even: int | None

    def total(self, queries: float) -> float:
        """Return the cost with a number of queries, core-s."""
        return self.data + self.fit + queries * self.query


@dataclass(frozen=True)
class Costs:
    """The costs at a target error in %; the full-order model, if known, is the first line.

    `missed` is the required error in % if the methods were compared at it and none reaches it.
    """

    target: float
    full_order: str | None
    lines: list[CostLine]
    missed: float | None = None

    @property
    def finding(self) -> str:
        """Name the first that pays off; digits of the break-even are few, as fit costs vary."""
        paid = [line for line in self.lines if line.break_even is not None]
        target = f"at {number(self.target)} %"
        if self.missed is not None:
            target += f" (none reaches {number(self.missed)} %)"
        if not paid:
            return f"No method is cheaper in the long run than the full-order model {target}"
        best = min(paid, key=lambda line: line.break_even or 0)
        queries = whole(float(f"{best.break_even:.2g}"))
        return (
            f"Of each method's fastest {target}, {best.name} pays off first, "
            f"after about {queries} queries"
        )

    @property
    def most_queries(self) -> int:
        """The end of the axis: a power of ten beyond the break-even points and the bars."""
        most = max((line.break_even or 1 for line in self.lines), default=1)
        return int(10 ** min(ceil(log10(max(most, self.queries, 1))) + 1, 9))

    @property
    def queries(self) -> int:
        """The number of queries of the bars: a power of ten at which all parts can be seen.

        It is the one next to the first break-even, where what a method saves in queries is as much
        as its data and fit cost. Without one, queries of a typical line cost as much as these.
        """
        paid = [float(line.break_even) for line in self.lines if line.break_even]
        offline = [line for line in self.lines if line.data + line.fit > 0 and line.query > 0]
        equal = [(line.data + line.fit) / line.query for line in offline]
        n = min(paid) if paid else float(np.median(equal)) if equal else 1.0
        return int(10 ** min(max(round(log10(max(n, 1.0))), 0), 9))


def costs_of(
    comparison: Comparison, dataset: str, analysis: Analysis, entries: Sequence[Entry]
) -> Costs | None:
    """Return the costs of the methods that reach the required error; None if none does."""
    compared = [r for r in analysis["break_even"] if r["dataset"] == dataset]
    records = [record for record in compared if record["label"]]
    needed = needs_of(comparison, dataset).error
    targets = {record["target_rel_l2_median"] for record in records}
    if not targets:
        return None
    target = min(targets, key=lambda t: abs(log(t / needed)) if needed else -t)
    mine = [r for r in records if r["target_rel_l2_median"] == target]
    full_order = next((r["fem_label"] for r in mine if r["fem_label"]), None)
    queries = {full_order: None, **{r["label"]: r["queries"] for r in mine}}
    by_label = {entry.label: entry for entry in entries}
    names = short_names(row for row in comparison.rows if row.dataset == dataset)
    lines = [
        line
        for label, n in queries.items()
        if label in by_label and (line := _line(by_label[label], str(names[label]), n))
    ]
    known = needed in {record["target_rel_l2_median"] for record in compared}
    missed = 100 * needed if known and needed and needed not in targets else None
    return Costs(100 * target, full_order, lines, missed) if lines else None


def _line(entry: Entry, name: str, queries: int | None) -> CostLine | None:
    offline, latency = entry.row.offline_s, entry.figure("latency_ms", "median")
    fit = entry.row.fit_core_s
    if offline is None or latency is None or fit is None or offline.data is None:
        return None
    query = 1e-3 * latency * entry.row.threads
    return CostLine(entry.label, entry.method, name, offline.data, fit, query, queries)


def whole_cost(comparison: Comparison, dataset: str, analysis: Analysis) -> Picture | None:
    """Draw the total cost over the number of queries, and its parts; None without a known cost."""
    costs = costs_of(comparison, dataset, analysis, entries_of(comparison, dataset, analysis))
    if costs is None:
        return None
    subject = f"{dataset}: whole cost of the methods with an error of at most "
    subject += f"{number(costs.target)} %"
    bars = 0.9 + 0.27 * len(costs.lines)
    figure = new_figure(3.6 + bars, costs.finding, subject)
    above, below = figure.subplots(2, 1, height_ratios=[3.6, bars])
    draw_totals(above, costs)
    draw_parts(below, costs)
    return Picture("whole-cost", "Whole cost and break-even", CAPTION, figure, costs.finding)


def draw_totals(axes: Axes, costs: Costs) -> None:
    """Draw the total over the number of queries, and a diamond at each break-even."""
    dress(axes)
    counts = np.geomspace(1, costs.most_queries, 60)
    notes, curves, marks = [], [], []
    for line in costs.lines:
        style, y = style_of(line.method), np.array([line.total(n) for n in counts])
        is_reference = line.label == costs.full_order
        axes.loglog(counts, y, color=style.colour, linewidth=2.6 if is_reference else 1.5)
        curves.append(np.column_stack([counts, y]))
        if line.break_even:
            where = (float(line.break_even), line.total(line.break_even))
            marks.append(where)
            (mark,) = axes.plot(*where, "D", color=style.colour, markersize=8, zorder=5)
            mark.set_markeredgecolor(INK)
        places = [(float(counts[i]), float(y[i])) for i in range(57, 0, -4)]
        beside = ((-8, 6), (-8, -6), (8, 6), (8, -6), (0, 7), (0, -7))
        name = shortened(line.name)
        notes.append(Note(name, places, readable(style.colour), "bold", beside))
    powers = range(round(log10(costs.most_queries)) + 1)
    axes.set_xticks([10**n for n in powers], [_power(n) for n in powers])
    axes.set_xticks([], minor=True)
    log_ticks(axes.yaxis, axes.get_ylim())
    axes.set_xlabel("number of queries", fontsize=LABEL)
    axes.set_ylabel("core-seconds", fontsize=LABEL)
    annotate(axes, notes, marks, curves)


def _power(n: int) -> str:
    """Format a power of ten in five letters, such as ``100 k``."""
    return f"{10 ** (n % 3)} {('', 'k', 'M', 'G')[n // 3]}".strip()


def draw_parts(axes: Axes, costs: Costs) -> None:
    """Draw a bar per configuration for one number of queries."""
    dress(axes)
    axes.grid(visible=False, axis="y")
    lines, n = costs.lines, costs.queries
    totals = sorted(line.total(n) for line in lines)
    end = 1.2 * min(totals[-1], 4 * totals[(len(totals) - 1) // 2])
    left = np.zeros(len(lines))
    for part, colour in PARTS.items():
        values = {
            "training data": [line.data for line in lines],
            "fit": [line.fit for line in lines],
            "queries": [n * line.query for line in lines],
        }[part]
        axes.barh(range(len(lines)), values, left=left, color=colour, height=0.7, label=part)
        left += values
    for i, line in enumerate(lines):
        total = line.total(n)
        beyond = total > end
        text = f"{number(total)} →" if beyond else f" {number(total)}"
        note = axes.text(min(total, end), i, text, fontsize=NOTE, va="center", color=INK)
        if beyond:
            note.set(ha="right", bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0})
    axes.set_yticks(range(len(lines)), [plain(folded(line.name, 30)) for line in lines])
    for line, tick in zip(lines, axes.get_yticklabels(), strict=True):
        tick.set(color=readable(style_of(line.method).colour), fontweight="bold")
    axes.set_ylim(len(lines) - 0.4, -0.6)
    axes.set_xlim(0, end)
    axes.set_xlabel(f"core-seconds for {n:,} queries", fontsize=LABEL)
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.legend(loc="outside lower left", ncols=3, fontsize=NOTE, frameon=False)
