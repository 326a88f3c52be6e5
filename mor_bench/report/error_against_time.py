"""The figure of error against time: a point per configuration, and the Pareto front."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import inf, isfinite
from textwrap import fill

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from mor_bench.analysis.verdict import Requirements, needs_of
from mor_bench.report.canvas import (
    INK,
    Note,
    Picture,
    Style,
    annotate,
    dress,
    log_ticks,
    new_figure,
    plain,
    shortened,
)
from mor_bench.report.entries import Analysis, Entry, by_group, entries_of
from mor_bench.report.number_format import explain_short_names, number, short_swept
from mor_bench.results.comparison import Comparison

FLOOR_PERCENT = 1e-4
"""Floor of the plotted errors: the full-order model's round-off would compress the scale."""

FRONT_LINE = (0, (4, 2))
"""Dashes of the Pareto front."""


def error_against_time(
    comparison: Comparison, dataset: str, styles: dict[str, Style], analysis: Analysis
) -> Picture | None:
    """Draw median error over median latency, log-log; None if no configuration has both."""
    entries = entries_of(comparison, dataset, analysis)
    shown = [e for e in entries if e.ran and isfinite(e.error) and isfinite(e.latency_ms)]
    if not shown:
        return None
    needs = needs_of(comparison, dataset)
    figure = new_figure(6.0, f"Error against time – {dataset}")
    axes = figure.subplots()
    dress(axes)
    _log_limits(axes, shown, needs)
    box_label = _draw_needs(axes, needs)
    lines, handles = _draw_methods(axes, shown, styles)
    lines.append(_draw_front(axes, [e for e in shown if e.on_front]))
    axes.set_xlabel("latency of one query, median (ms)")
    axes.set_ylabel("relative L2 error, median over the test set (%)")
    ring = {"marker": "o", "markerfacecolor": "none", "markersize": 9}
    front = Line2D([], [], color=INK, linewidth=1.2, linestyle=FRONT_LINE, **ring)  # type: ignore[arg-type]
    front.set_label("Pareto front")
    figure.legend(handles=[*handles, front], loc="outside right upper", fontsize=9, frameon=False)
    notes = [
        Note(*_place(e), short_swept(e.swept).split(", ")[0], styles[e.method].colour)
        for e in sorted(shown, key=lambda e: e.pareto_mark != "*")
        if e.swept
    ]
    annotate(axes, notes, lines, [box_label] if box_label else [])
    return Picture("error-against-time", "Error against time", _caption(entries, shown), figure)


def _place(entry: Entry) -> tuple[float, float]:
    """Latency in ms and error in percent."""
    return entry.latency_ms, max(100 * entry.error, FLOOR_PERCENT)


def _below_floor(entry: Entry) -> bool:
    return 100 * entry.error < FLOOR_PERCENT


def _caption(entries: Sequence[Entry], shown: Sequence[Entry]) -> str:
    names = explain_short_names(e.swept for e in shown)
    missing = [e.label for e in entries if e.ran and e not in shown]
    sentences = {
        "Each point is one fitted configuration; left and down is better. "
        "A thin line joins the swept configurations of a method in order.": True,
        "Bars are 95 % intervals for a repeated timing and other load regions.": any(
            e.intervals for e in shown
        ),
        "The dashed steps through the ringed points are the Pareto front: "
        "no other configuration is both faster and more accurate. Full-order solves on the "
        "dataset's mesh are references and not ringed. "
        "In the shaded box the medians meet the dataset's needs. The shape of a marker shows what "
        "a method is told: round, the force only; square, also its linear response; triangle, the "
        "equations.": True,
        "Where a method has two swept parameters, labels give the first one and the legend "
        "the second.": any(len(e.swept) > 1 for e in shown),
        f"Labels: {names}.": bool(names),
        f"An arrow marks errors below {FLOOR_PERCENT:g} %, which are drawn at that floor.": any(
            map(_below_floor, shown)
        ),
        "A cross marks timings that were not stable.": any(e.unstable for e in shown),
        "Not shown, because the median error is infinite: " + ", ".join(missing) + ".": missing,
    }
    return " ".join(sentence for sentence, applies in sentences.items() if applies)


def _log_limits(axes: Axes, shown: Sequence[Entry], needs: Requirements) -> None:
    """Set logarithmic axes that hold the points, their bars and the corner of the needs."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    bars = np.array([_bars(e) for e in shown])
    corner = needs.latency_ms or inf, 100 * (needs.error or inf)
    x = [v for v in (*bars[:, 0].ravel().tolist(), corner[0]) if isfinite(v) and v > 0]
    y = [v for v in (*bars[:, 1].ravel().tolist(), corner[1]) if isfinite(v)]
    axes.set_xlim(min(x) / 1.6, max(x) * 1.6)
    axes.set_ylim(min(y) / 2.0, max(y) * 2.0)
    log_ticks(axes.xaxis, x)
    log_ticks(axes.yaxis, y)


def _bars(entry: Entry) -> NDArray[np.float64]:
    """Ends (2, 2) of the intervals of latency in ms and of the error in percent.

    They contain the point itself; an unknown or infinite end is at the point.
    """
    x, y = _place(entry)
    latency = entry.intervals.get("latency_ms", (x, x))
    error = np.multiply(100, entry.intervals.get("rel_l2_median", (y / 100, y / 100)))
    ends = np.array([latency, np.maximum(error, FLOOR_PERCENT)])
    ends = np.where(np.isfinite(ends), ends, np.array([[x], [y]]))
    return np.stack([np.minimum(ends[:, 0], [x, y]), np.maximum(ends[:, 1], [x, y])], axis=1)


def _draw_needs(axes: Axes, needs: Requirements) -> Artist | None:
    """Draw the box in which the needs are met, with the error in percent; return its label."""
    if needs.error is None or needs.latency_ms is None:
        return None
    (x0, _), (y0, _) = axes.get_xlim(), axes.get_ylim()
    x1, y1 = needs.latency_ms, 100 * needs.error
    look = {"facecolor": "#eef6ea", "edgecolor": "#6a9a55", "linewidth": 1, "alpha": 0.8}
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, zorder=1.5, **look))  # type: ignore[arg-type]
    return axes.annotate(
        f"the needs: ≤ {number(x1)} ms, ≤ {number(y1)} %",
        (x0, y0),
        xytext=(6, 6),
        textcoords="offset points",
        fontsize=9,
        color="#3f6b2c",
        va="bottom",
    )


def _draw_methods(
    axes: Axes, shown: Sequence[Entry], styles: dict[str, Style]
) -> tuple[list[NDArray[np.float64]], list[Line2D]]:
    """Draw all points; return the joining lines, and handles for the legend, grouped by class.

    The configurations of a method that differ in their first swept parameter are joined.
    """
    lines, handles = [], []
    for group, mine in by_group(shown).items():
        handles.append(Line2D([], [], linestyle="none", label=fill(plain(f"{group}:"), 28)))
        series: dict[tuple[str, str], list[Entry]] = {}
        for entry in mine:
            others = short_swept(dict(list(entry.swept.items())[1:]))
            series.setdefault((entry.method, others), []).append(entry)
        ranks = Counter[str]()
        for (method, others), members in series.items():
            style, hollow = styles[method], ranks[method] % 2 == 1
            ranks[method] += 1
            lines.append(_draw_series(axes, members, style, hollow))
            handle = Line2D([], [], color=style.colour, linewidth=1, marker=style.marker)
            handle.set_markerfacecolor("white" if hollow else style.colour)
            handle.set_markeredgecolor(style.colour)
            handle.set_label(plain(shortened(f"{method}, {others}" if others else method, 28)))
            handles.append(handle)
    return lines, handles


def _draw_series(
    axes: Axes, members: Sequence[Entry], style: Style, hollow: bool
) -> NDArray[np.float64]:
    """Draw joined points with their bars and marks; return the points (n, 2)."""
    colour = style.colour
    xy = np.array([_place(e) for e in members])
    bars = np.array([_bars(e) for e in members])
    axes.plot(*xy.T, color=colour, linewidth=0.9, alpha=0.6, zorder=2)
    axes.hlines(xy[:, 1], *bars[:, 0].T, color=colour, linewidth=2.2, alpha=0.4, zorder=2)
    axes.vlines(xy[:, 0], *bars[:, 1].T, color=colour, linewidth=2.2, alpha=0.4, zorder=2)
    unstable = np.array([bool(e.unstable) for e in members])
    axes.plot(*xy[unstable].T, "x", color=INK, markersize=10, markeredgewidth=1.4, zorder=6)
    low = np.array([_below_floor(e) for e in members])
    face, edge = ("white", colour) if hollow else (colour, "white")
    (points,) = axes.plot(*xy[~low].T, style.marker, markersize=7, zorder=4)
    points.set(mfc=face, mec=edge, mew=1 if hollow else 0.5)
    axes.plot(*xy[low].T, "v", markerfacecolor=face, markeredgecolor=INK, markersize=8, zorder=4)
    arrow = {"arrowstyle": "->", "color": colour, "linewidth": 1.4}
    for x, y in xy[low]:
        axes.annotate("", (x, y / 1.75), (x, y), arrowprops=arrow, zorder=3)
    return xy


def _draw_front(axes: Axes, front: Sequence[Entry]) -> NDArray[np.float64]:
    """Draw the Pareto front as steps, and rings around contestants; return the steps (n, 2)."""
    xy = np.array(sorted(_place(e) for e in front)).reshape(-1, 2)
    steps = np.stack([np.repeat(xy[:, 0], 2)[1:], np.repeat(xy[:, 1], 2)[:-1]], axis=1)
    axes.plot(*steps.T, color=INK, linewidth=1.2, linestyle=FRONT_LINE, zorder=3)
    contestants = np.array([_place(e) for e in front if e.pareto_mark == "*"]).reshape(-1, 2)
    (rings,) = axes.plot(*contestants.T, "o", markersize=11, markerfacecolor="none", zorder=5)
    rings.set(mec=INK, mew=1.2)
    return steps
