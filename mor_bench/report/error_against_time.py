"""The figure of error against time: a point per configuration, and the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from mor_bench.analysis.verdict import Requirements, needs_of
from mor_bench.report.canvas import (
    GREY,
    INK,
    LABEL,
    NOTE,
    Picture,
    dress,
    log_ticks,
    new_figure,
    plain,
    shortened,
)
from mor_bench.report.entries import (
    Analysis,
    Entry,
    by_group,
    entries_of,
    verdict_of,
)
from mor_bench.report.frontier_plane import Plane, Series, plane_of, series_of, timed_and_scored
from mor_bench.report.labels import Note, annotate
from mor_bench.report.method_styles import readable, style_of
from mor_bench.report.number_format import explain_short_names, number, percent
from mor_bench.report.short_names import ShortName, constants, short_names
from mor_bench.results.comparison import Comparison

FRONT_LINE = (0, (4, 2))
"""Dashes of the Pareto front."""

MUST_BE_LABELLED = 4
"""Number of points beyond an axis that get a label even if it covers something."""

USUAL_METHODS = 12
"""Number of methods that the usual height has room for."""

NEEDS_FACE, NEEDS_EDGE, NEEDS_INK = "#e4f2dc", "#5d8c48", "#33591f"
MESH_FACE = "#f0f0f0"


def error_against_time(comparison: Comparison, dataset: str, analysis: Analysis) -> Picture | None:
    """Draw median error over median latency, log-log; None if no configuration has both."""
    entries = entries_of(comparison, dataset, analysis)
    shown = timed_and_scored(entries)
    if not shown:
        return None
    needs = needs_of(comparison, dataset)
    finding = fastest(shown, needs, verdict_of(analysis, dataset))
    subject = f"{dataset}: error against time of each configuration; left and down is better"
    more = len({e.method for e in shown}) - USUAL_METHODS
    figure = new_figure(5.6 + 0.16 * max(0, more), finding, subject)
    draw_frontier(figure.subplots(), entries, needs)
    caption = _caption(entries, shown, needs)
    return Picture("error-against-time", "Error against time", caption, figure, finding)


def fastest(shown: Sequence[Entry], needs: Requirements, verdict: Mapping[str, Any]) -> str:
    """Say which configuration the verdict chose and how fast it is, or that none qualifies."""
    by_label = {e.label: e for e in shown}
    limit = f"{percent(needs.error)} %" if needs.error else ""
    choice = by_label.get(str(verdict.get("choice")))
    if choice is None and verdict and limit:
        within = f" within {number(needs.latency_ms)} ms" if needs.latency_ms else ""
        return f"No configuration is surely below {limit}{within}"
    if choice is None:
        able = [e for e in shown if e.error <= (needs.error or inf)]
        choice = min(able or shown, key=lambda e: e.latency_ms)
        limit = limit if able else ""
    text = f"{shortened(choice.method)} is fastest" + (f" below {limit}" if limit else "")
    text += f": {number(choice.latency_ms)} ms"
    other = by_label.get(str(verdict.get("runner_up")))
    if other is None or other.latency_ms < 1.05 * choice.latency_ms:
        return text
    if other.label in verdict.get("undecided", ()):
        return f"{text}, not surely faster than {shortened(other.method)}"
    times = f"{other.latency_ms / choice.latency_ms:.2g}"
    name = str(short_names(e.row for e in shown)[other.label])
    return f"{text}, {times} times as fast as {shortened(name)}"


def draw_frontier(axes: Axes, entries: Sequence[Entry], needs: Requirements) -> None:
    """Draw the configurations of one dataset, their intervals, the needs and the Pareto front."""
    shown = timed_and_scored(entries)
    dress(axes)
    plane = plane_of(shown, needs)
    axes.set(xscale="log", yscale="log", xlim=plane.x, ylim=plane.y)
    log_ticks(axes.xaxis, plane.x)
    log_ticks(axes.yaxis, plane.y)
    axes.set_xlabel("median latency of one query (ms)", fontsize=LABEL)
    axes.set_ylabel("median relative L2 error (%)", fontsize=LABEL)
    areas = [*_draw_mesh_error(axes, plane), *_draw_needs(axes, plane)]
    series = series_of(shown)
    lines = [_draw_series(axes, one, plane) for one in series]
    lines.append(_draw_front(axes, [e for e in shown if e.on_front], plane))
    names = short_names([e.row for e in shown])
    notes = [*areas, *_cut_notes(shown, names, plane), *_notes(series, shown, names, plane)]
    figure = axes.get_figure(root=True)
    assert figure is not None
    marks = [plane.place(e) for e in shown]
    handles = _key(shown)
    in_legend: set[str] = set()
    while True:  # a legend takes room from the axes, so that further names may not fit
        for text in axes.texts[:]:
            text.remove()
        named = [_handle(one) for one in series if one.name in in_legend]
        legend = _legend(axes, [*named, *handles], 3 if named else 4)
        _draw_arrows(axes, shown, plane)
        left_out = annotate(axes, [n for n in notes if n.text not in in_legend], marks, lines)
        missing = {one.name for one in series} & {note.text for note in left_out}
        if not missing:
            return
        in_legend |= missing
        legend.remove()


def _legend(axes: Axes, handles: Sequence[Line2D], columns: int) -> Legend:
    """Put a legend below a figure, or below the axes if the figure has others or no layout."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    look: dict[str, Any] = {"handles": handles, "fontsize": NOTE, "frameon": False}
    look |= {"columnspacing": 1.2, "handletextpad": 0.5}
    if len(figure.axes) == 1 and isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine):
        return figure.legend(loc="outside lower left", ncols=columns, **look)
    return axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.16), ncols=2, **look)


def _draw_mesh_error(axes: Axes, plane: Plane) -> list[Note]:
    """Draw the band of errors below the discretisation error; return its label."""
    (x0, x1), (y0, y1) = plane.x, plane.y
    if plane.mesh_percent is None:
        return []
    top = min(max(plane.mesh_percent, y0), y1)
    axes.axhspan(y0, top, facecolor=MESH_FACE, edgecolor="none", zorder=0.3)
    least = "at least " if plane.mesh_at_least else ""
    text = f"discretisation error of the mesh: {least}{number(plane.mesh_percent)} %"
    if not y0 < plane.mesh_percent < y1:
        where = "below" if plane.mesh_percent <= y0 else "above"
        return [Note(f"{text}, {where} this axis", [(x0, y0 if where == "below" else y1)], GREY)]
    axes.axhline(plane.mesh_percent, color=GREY, linewidth=1.2, zorder=1.2)
    ends = [(x1, top), (x0, top)]
    return [Note(text, ends, "#4d4d4d", offsets=((-6, 7), (-6, -7), (6, 7), (6, -7)), must=True)]


def _draw_needs(axes: Axes, plane: Plane) -> list[Note]:
    """Draw the box in which the needs are met, with the error in percent; return its label."""
    if plane.needs.latency_ms is None or plane.needs.error is None:
        return []
    x1, y1 = plane.needs.latency_ms, 100 * plane.needs.error
    (x0, right), (y0, _) = plane.x, plane.y
    box = Rectangle((x0, y0), x1 - x0, y1 - y0, zorder=0.6, facecolor=NEEDS_FACE)
    box.set(edgecolor=NEEDS_EDGE, linewidth=1.0)
    axes.add_patch(box)
    text, end = f"needed: ≤ {number(x1)} ms, ≤ {number(y1)} %", min(x1, right)
    corners = {(x0, y0): (6, 7), (end, y0): (-6, 7), (end, y1): (-6, -7), (x0, y1): (6, -7)}
    return [Note(text, [*corners], NEEDS_INK, offsets=[*corners.values()], must=True)]


def _draw_series(axes: Axes, series: Series, plane: Plane) -> NDArray[np.float64]:
    """Draw joined points with their bars; open points are unstable. Return the points (n, 2)."""
    style = style_of(series.members[0].method)
    colour = style.colour
    xy = np.array([plane.place(e) for e in series.members])
    bars = np.array([plane.bars(e) for e in series.members])
    axes.plot(*xy.T, color=colour, linewidth=1.1, alpha=0.7, linestyle=series.line, zorder=2)
    axes.hlines(xy[:, 1], *bars[:, 0].T, color=colour, linewidth=2.4, alpha=0.35, zorder=2)
    axes.vlines(xy[:, 0], *bars[:, 1].T, color=colour, linewidth=2.4, alpha=0.35, zorder=2)
    unstable = np.array([bool(e.unstable) for e in series.members])
    for mine, face, edge in ((~unstable, colour, "white"), (unstable, "white", colour)):
        (points,) = axes.plot(*xy[mine].T, style.marker, markersize=8, zorder=4)
        points.set(mfc=face, mec=edge, mew=0.6 if edge == "white" else 1.6)
    return xy


def _draw_front(axes: Axes, front: Sequence[Entry], plane: Plane) -> NDArray[np.float64]:
    """Draw the Pareto front as steps, and rings around contestants; return the steps (n, 2)."""
    xy = np.array(sorted(plane.place(e) for e in front)).reshape(-1, 2)
    steps = np.stack([np.repeat(xy[:, 0], 2)[1:], np.repeat(xy[:, 1], 2)[:-1]], axis=1)
    axes.plot(*steps.T, color=INK, linewidth=1.1, linestyle=FRONT_LINE, zorder=3)
    contestants = np.array([plane.place(e) for e in front if e.pareto_mark == "*"]).reshape(-1, 2)
    (rings,) = axes.plot(*contestants.T, "o", markersize=13, markerfacecolor="none", zorder=5)
    rings.set(mec=INK, mew=1.2)
    return steps


def _draw_arrows(axes: Axes, shown: Sequence[Entry], plane: Plane) -> None:
    """Draw an arrow outwards at each point that lies beyond an axis."""
    for entry in shown:
        if direction := plane.direction(entry):
            look = {"arrowstyle": "<|-", "color": style_of(entry.method).colour, "linewidth": 1.5}
            end = 17 * direction[0], 17 * direction[1]
            where = {"xytext": end, "textcoords": "offset points", "arrowprops": look}
            axes.annotate("", plane.place(entry), zorder=3.5, **where)  # type: ignore[arg-type]


def _cut_notes(shown: Sequence[Entry], names: Mapping[str, ShortName], plane: Plane) -> list[Note]:
    """Label the points beyond an axis with their values."""
    notes: list[Note] = []
    for entry in shown:
        if direction := plane.direction(entry):
            value = f"{percent(entry.error)} %" if direction[1] else ""
            time = f"{number(entry.latency_ms)} ms" if direction[0] else ""
            name, colour = str(names[entry.label]), readable(style_of(entry.method).colour)
            text = f"{shortened(name)}: {', '.join(filter(None, (value, time)))}"
            must = len(notes) < MUST_BE_LABELLED
            notes.append(Note(text, [plane.place(entry)], colour, must=must))
    return notes


def _notes(
    series: Sequence[Series],
    shown: Sequence[Entry],
    names: Mapping[str, ShortName],
    plane: Plane,
) -> list[Note]:
    """Label each series with its name, then the front's points with their values, then all."""
    notes = []
    for one in series:
        ends = [one.members[0], one.members[-1], *one.members[1:-1]]
        places = [plane.place(e) for e in ends]
        colour = readable(style_of(one.members[0].method).colour)
        notes.append(Note(one.name, places, colour, "bold"))
    for entry in sorted(shown, key=lambda e: e.pareto_mark != "*"):
        text = names[entry.label].values.split(", ")[0]
        if text and not plane.direction(entry):
            colour = readable(style_of(entry.method).colour)
            notes.append(Note(shortened(text), [plane.place(entry)], colour))
    return notes


def _key(shown: Sequence[Entry]) -> list[Line2D]:
    """Explain rings, open markers and bars in a legend of one line."""
    ring = Line2D([], [], color=INK, linewidth=1.1, linestyle=FRONT_LINE, marker="o")
    ring.set(markerfacecolor="none", markersize=11, label="Pareto front")
    handles = [ring]
    if any(e.unstable for e in shown):
        opened = Line2D([], [], color=INK, linestyle="none", marker="o", markersize=8)
        opened.set(markerfacecolor="white", markeredgewidth=1.6, label="open: timing not stable")
        handles.append(opened)
    if any(e.intervals for e in shown):
        handles.append(Line2D([], [], color=GREY, linewidth=2.4, label="95 % interval"))
    return handles


def _handle(series: Series) -> Line2D:
    """Return the entry of a series in the legend, where its name has no room beside its points."""
    style = style_of(series.members[0].method)
    handle = Line2D([], [], color=style.colour, marker=style.marker, linestyle="none")
    handle.set(markersize=8, markeredgecolor="white", label=plain(series.name))
    return handle


def _caption(entries: Sequence[Entry], shown: Sequence[Entry], needs: Requirements) -> str:
    names = explain_short_names(e.swept for e in shown)
    fixed = constants(e.row for e in shown)
    missing = [e.label for e in entries if e.ran and e not in shown]
    plane = plane_of(shown, needs)
    told = "; ".join(
        f"{group}: {', '.join(dict.fromkeys(e.method for e in mine))}"
        for group, mine in by_group(shown).items()
    )
    sentences = {
        "Each point is one fitted configuration; left and down is better. "
        "A thin line joins the swept configurations of a method in order.": True,
        "The relative L2 error is |u - u_ref| / |u_ref|; u are all nodal displacements.": True,
        "Bars are 95 % intervals for a repeated timing and other load regions.": any(
            e.intervals for e in shown
        ),
        "The dashed steps through the ringed points are the Pareto front: "
        "no other configuration is both faster and more accurate. Full-order solves on the "
        "dataset's mesh are references and not ringed. "
        "In the green box the medians meet the dataset's needs.": True,
        "In the grey band, errors are smaller than the discretisation error of the mesh. "
        "Differences there are not evidence about the real body.": plane.mesh_percent is not None,
        f"What the methods are told: {told}.": bool(told),
        f"Labels: {names}.": bool(names),
        f"Not in the names: {fixed}.": bool(fixed),
        "An arrow marks a point beyond an axis; its label gives the value.": any(
            map(plane.direction, shown)
        ),
        "Open markers have timings that were not stable.": any(e.unstable for e in shown),
        "Not shown, because the median error is infinite: " + ", ".join(missing) + ".": missing,
    }
    return " ".join(sentence for sentence, applies in sentences.items() if applies)
