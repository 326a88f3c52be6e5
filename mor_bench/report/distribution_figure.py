"""The figure of the distributions of error and latency: a staircase per method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from mor_bench.analysis.verdict import Requirements, needs_of
from mor_bench.report.canvas import (
    GREY,
    LABEL,
    NOTE,
    Picture,
    dress,
    folded,
    log_ticks,
    new_figure,
    plain,
    shortened,
    uncut,
)
from mor_bench.report.entries import SELECTED, Analysis, entries_of, selected_per_method
from mor_bench.report.method_styles import style_of
from mor_bench.report.number_format import number
from mor_bench.report.short_names import short_names
from mor_bench.results.comparison import Comparison

MOST_LINES = 14
"""Most methods; those with the smallest 95th percentile are drawn."""

CAPTION = (
    "Height: the share of test loads (or of queries) with at most this error (or latency). Each "
    f"method has {SELECTED}. Full-order "
    "solves on the dataset's mesh are in the lower panel only, because their error is that of "
    "their tolerance. A line that ends below 100 % has loads without a prediction. An arrow "
    "leads to values beyond the axis. Dotted: the dataset's need."
)


@dataclass(frozen=True)
class Staircase:
    """A method's name, its values in ascending order, and their 95th percentile.

    Infinite values have no prediction. The percentile is the one that the tables show.
    """

    method: str
    name: str
    values: NDArray[np.float64]
    p95: float

    @property
    def finite(self) -> NDArray[np.float64]:
        return self.values[np.isfinite(self.values) & (self.values > 0)]


def staircases(
    comparison: Comparison, dataset: str, key: str, analysis: Analysis | None = None
) -> list[Staircase]:
    """Read the errors in % ("relative_l2") or the latencies in ms ("latency_ms") of all methods."""
    entries = entries_of(comparison, dataset, analysis)
    names, found = short_names(entry.row for entry in entries), []
    for entry in selected_per_method(entries):
        if key == "relative_l2" and entry.row.reference:
            continue
        try:
            raw = np.sort(np.asarray(comparison.samples(entry.row)[key], dtype=float))
        except (OSError, KeyError):
            continue
        if key == "relative_l2":
            raw, p95 = 100 * raw, 100 * (entry.figure("error", "rel_l2_p95") or inf)
        else:
            p95 = entry.figure("latency_ms", "p95") or inf
        found.append(Staircase(entry.method, str(names[entry.label]), raw, p95))
    found = [stairs for stairs in found if len(stairs.finite)]
    return sorted(found, key=lambda stairs: stairs.p95)[:MOST_LINES]


def error_distribution(
    comparison: Comparison, dataset: str, analysis: Analysis | None = None
) -> Picture | None:
    """Draw the distributions of error and latency; None without raw errors."""
    errors = staircases(comparison, dataset, "relative_l2", analysis)
    if not errors:
        return None
    latencies = staircases(comparison, dataset, "latency_ms", analysis)
    needs = needs_of(comparison, dataset)
    finding = f"95 % of the loads: {shortened(errors[0].name)} errs by at most "
    finding += f"{number(errors[0].p95)} %"
    if len(errors) > 1:
        finding += f", {shortened(errors[-1].name)} by {number(errors[-1].p95)} %"
    subject = f"{dataset}: distribution of errors and latencies, a configuration per method"
    figure = new_figure(3.6 * (1 + bool(latencies)), finding, subject)
    panels = figure.subplots(1 + bool(latencies), 1, squeeze=False).ravel()
    draw_distribution(panels[0], errors, needs)
    for axes in panels[1:]:
        _draw(axes, latencies, needs.latency_ms, "ms")
        axes.set_xlabel("latency of a query, at most (ms)", fontsize=LABEL)
        axes.set_ylabel("queries (%)", fontsize=LABEL)
    return Picture(
        "distributions", "Distribution of errors and latencies", CAPTION, figure, finding
    )


def draw_distribution(axes: Axes, errors: Sequence[Staircase], needs: Requirements) -> None:
    """Draw the share of test loads with at most an error, a staircase per method."""
    _draw(axes, errors, None if needs.error is None else 100 * needs.error, "%")
    axes.set_xlabel("relative L2 error of a test load, at most (%)", fontsize=LABEL)
    axes.set_ylabel("test loads (%)", fontsize=LABEL)


def _draw(axes: Axes, found: Sequence[Staircase], need: float | None, unit: str) -> None:
    """Draw the staircases, with their names beside them."""
    dress(axes)
    axes.set_xscale("log")
    low = uncut([float(np.quantile(s.finite, 0.01)) for s in found])[0]
    high = uncut([float(np.quantile(s.finite, 0.99)) for s in found])[1]
    axes.set_xlim(0.7 * low, 2 * max(high, need or 0.0))
    axes.set_ylim(-2, 103)
    if need is not None:
        axes.axvline(need, color=GREY, linestyle=":", linewidth=1.2, zorder=1)
    log_ticks(axes.xaxis, axes.get_xlim())
    for stairs in found:
        style, x = style_of(stairs.method), stairs.finite
        y = 100 * (np.searchsorted(stairs.values, x, side="right") / len(stairs.values))
        axes.step(x, y, where="post", color=style.colour, linewidth=1.6, linestyle=style.line)
    _legend(axes, found, unit)


def _legend(axes: Axes, found: Sequence[Staircase], unit: str) -> None:
    """Name the lines beside the axes, in the order in which they reach half of the height.

    A line that ends beyond the axes is named with its end.
    """
    handles = []
    for stairs in sorted(found, key=lambda stairs: float(np.median(stairs.values))):
        style, last = style_of(stairs.method), float(stairs.finite[-1])
        name, (start, end) = folded(stairs.name, 30), axes.get_xlim()
        if last > end:
            name += f"\nup to {number(last)} {unit} →"
        elif last < start:
            name += f"\n← up to {number(last)} {unit}"
        line = Line2D([], [], color=style.colour, linestyle=style.line, linewidth=1.8)
        line.set_label(plain(name))
        handles.append(line)
    axes.legend(
        handles=handles,
        title="from left to right",
        title_fontsize=NOTE,
        loc="center left",
        bbox_to_anchor=(1.01, 0.5),
        fontsize=NOTE,
        frameon=False,
    )
