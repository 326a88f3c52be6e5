"""The plots of a comparison: error against time, singular values, error against deformation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil, isfinite
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from mor_bench.report.canvas import (
    GREY,
    INK,
    LIGHT,
    Drawn,
    Note,
    Style,
    annotate,
    dress,
    new_figure,
    plain,
    save,
    shortened,
    styles_of,
)
from mor_bench.report.curves import learning_curves, loss_curves, performance_profile
from mor_bench.report.deformed import worst_samples
from mor_bench.report.summary import (
    Entry,
    best_per_method,
    dataset_names,
    entries_of,
    needs_of,
    number,
    percent,
    short_names_used,
    short_swept,
)
from mor_bench.results.comparison import Comparison

FLOOR_PERCENT = 1e-4
"""Errors below stand at this floor: the round-off of the full-order model would squash all else."""

ROUND_OFF = 1e-12
"""Relative singular values below are not shown: there the decomposition's round-off begins."""


def write_figures(comparison: Comparison, analysis: Mapping[str, Any]) -> list[Drawn]:
    """Draw and write every figure for which there is data.

    Parameters
    ----------
    comparison : Comparison
    analysis : dict
        From `mor_bench.analysis.analyse.analyse`.

    Returns
    -------
    list of Drawn
        In reading order, dataset by dataset.
    """
    styles = styles_of(comparison)
    drawn: list[Drawn | None] = []
    for dataset in dataset_names(comparison):
        drawn.append(error_against_time(comparison, dataset, styles, analysis))
        for draw in (
            learning_curves,
            loss_curves,
            error_against_amplitude,
            worst_samples,
            singular_values,
        ):
            drawn.append(draw(comparison, dataset, styles))
    drawn.append(performance_profile(comparison, analysis, styles))
    return [figure for figure in drawn if figure is not None]


def error_against_time(
    comparison: Comparison, dataset: str, styles: dict[str, Style], analysis: Mapping[str, Any]
) -> Drawn | None:
    """Median error over median latency, log-log, a point per configuration; None if no configuration has both."""
    entries = entries_of(comparison, dataset, analysis)
    shown = [e for e in entries if e.ran and isfinite(e.error) and isfinite(e.latency_ms)]
    if not shown:
        return None
    needs = needs_of(comparison, dataset)
    figure = new_figure(6.0)
    axes = figure.subplots()
    dress(axes)
    _log_limits(axes, shown, needs)
    box_label = _draw_needs(axes, needs)
    lines, handles = _draw_series(axes, shown, styles)
    lines.append(_draw_front(axes, [e for e in shown if e.on_front]))
    axes.set_xlabel("latency of one query, median (ms)")
    axes.set_ylabel("relative L2 error, median over the test set (%)")
    axes.set_title(plain(f"Error against time – {dataset}"), loc="left", fontsize=13, color=INK)
    front = Line2D(
        [],
        [],
        color=INK,
        linewidth=1.2,
        linestyle=(0, (4, 2)),
        marker="o",
        markerfacecolor="none",
        markersize=9,
        label="Pareto front",
    )
    figure.legend(handles=[*handles, front], loc="outside right upper", fontsize=9, frameon=False)
    ranked = sorted((e for e in shown if e.swept), key=lambda e: not e.on_front)
    notes = [
        Note(*_place(e), short_swept(e.swept).split(", ")[0], styles[e.method].colour)
        for e in ranked
    ]
    annotate(axes, notes, lines, [box_label] if box_label else [])
    path = save(figure, comparison, dataset, "error-against-time")
    return Drawn(dataset, path, "Error against time", _time_caption(entries, shown))


def _place(entry: Entry) -> tuple[float, float]:
    return entry.latency_ms, max(100 * entry.error, FLOOR_PERCENT)


def _time_caption(entries: Sequence[Entry], shown: Sequence[Entry]) -> str:
    parts = [
        "Each point is one fitted configuration; left and down is better. A thin line joins the swept configurations of a method in order."
    ]
    if any(e.intervals for e in shown):
        parts.append("Bars hold 95 % of what a repeated timing and other load regions would give.")
    parts.append(
        "The dashed steps through the ringed points are the Pareto front: no other configuration is both faster and more accurate. "
        "In the shaded box the scene's needs are met."
    )
    if any(len(e.swept) > 1 for e in shown):
        parts.append(
            "Of a method with two swept parameters, labels give the first one, the legend the second."
        )
    names = short_names_used(shown)
    parts.append(f"Labels: {names}." if names else "")
    if any(100 * e.error < FLOOR_PERCENT for e in shown):
        parts.append(
            f"An arrow marks errors below {FLOOR_PERCENT:g} %, drawn at that floor so that they do not squash the rest."
        )
    if any(e.unstable for e in shown):
        parts.append("A cross marks timings that were not stable.")
    missing = [e.label for e in entries if e.ran and e not in shown]
    if missing:
        parts.append(f"Not shown, since the median error is infinite: {', '.join(missing)}.")
    return " ".join(filter(None, parts))


def _log_limits(axes: Axes, shown: Sequence[Entry], needs: dict[str, float]) -> None:
    """Logarithmic axes with plain numbers, wide enough for the points, their bars and the corner of the needs."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    bars = np.array([_bars(e) for e in shown])
    x = [*bars[:, 0].ravel().tolist(), needs["latency_ms"]]
    y = [*bars[:, 1].ravel().tolist(), 100 * needs["error"]]
    x, y = [v for v in x if isfinite(v) and v > 0], [v for v in y if isfinite(v)]
    axes.set_xlim(min(x) / 1.6, max(x) * 1.6)
    axes.set_ylim(min(y) / 2.0, max(y) * 2.0)
    for axis, values in ((axes.xaxis, x), (axes.yaxis, y)):
        subs = (1.0, 2.0, 5.0) if max(values) / min(values) < 300 else (1.0,)
        axis.set_major_locator(LogLocator(subs=subs, numticks=20))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _bars(entry: Entry) -> NDArray[np.float64]:
    """(2, 2) ends of the intervals of latency in ms and of the error in percent, never above or below the point itself."""
    x, y = _place(entry)
    ends = np.array(
        [
            entry.intervals.get("latency_ms", (x, x)),
            np.multiply(100, entry.intervals.get("rel_l2_median", (y / 100, y / 100))),
        ]
    )
    ends[1] = np.maximum(ends[1], FLOOR_PERCENT)
    ends = np.where(np.isfinite(ends), ends, np.array([[x], [y]]))
    return np.stack([np.minimum(ends[:, 0], [x, y]), np.maximum(ends[:, 1], [x, y])], axis=1)


def _draw_needs(axes: Axes, needs: dict[str, float]) -> Artist | None:
    """The box in which the needs are met, and its label."""
    if not all(map(isfinite, needs.values())):
        return None
    (x0, _), (y0, _) = axes.get_xlim(), axes.get_ylim()
    x1, y1 = needs["latency_ms"], 100 * needs["error"]
    axes.add_patch(
        Rectangle(
            (x0, y0),
            x1 - x0,
            y1 - y0,
            facecolor="#eef6ea",
            edgecolor="#6a9a55",
            linewidth=1,
            zorder=1.5,
            alpha=0.8,
        )
    )
    text = f"meets the needs: ≤ {number(x1)} ms, ≤ {number(y1)} %"
    return axes.annotate(
        text,
        (x0, y0),
        xytext=(6, 6),
        textcoords="offset points",
        fontsize=9,
        color="#3f6b2c",
        va="bottom",
    )


def _draw_series(
    axes: Axes, shown: Sequence[Entry], styles: dict[str, Style]
) -> tuple[list[NDArray[np.float64]], list[Line2D]]:
    """Points, whiskers and joining lines; returns the lines, and handles for the legend."""
    lines, handles = [], []
    for method in dict.fromkeys(e.method for e in shown):
        style = styles[method]
        series: dict[str, list[Entry]] = {}
        for entry in (e for e in shown if e.method == method):
            series.setdefault(short_swept(dict(list(entry.swept.items())[1:])), []).append(entry)
        for rank, (others, members) in enumerate(series.items()):
            xy = np.array([_place(e) for e in members])
            lines.append(xy)
            bars = np.array([_bars(e) for e in members])
            axes.plot(xy[:, 0], xy[:, 1], color=style.colour, linewidth=0.9, alpha=0.6, zorder=2)
            axes.hlines(
                xy[:, 1], *bars[:, 0].T, color=style.colour, linewidth=2.2, alpha=0.4, zorder=2
            )
            axes.vlines(
                xy[:, 0], *bars[:, 1].T, color=style.colour, linewidth=2.2, alpha=0.4, zorder=2
            )
            unsteady = np.array([bool(e.unstable) for e in members])
            axes.plot(*xy[unsteady].T, "x", color=INK, markersize=10, markeredgewidth=1.4, zorder=6)
            low = np.array([100 * e.error < FLOOR_PERCENT for e in members])
            hollow = rank % 2 == 1
            face, edge = ("white", style.colour) if hollow else (style.colour, "white")
            axes.plot(
                *xy[~low].T,
                style.marker,
                markerfacecolor=face,
                markeredgecolor=edge,
                markeredgewidth=1 if hollow else 0.5,
                markersize=7,
                zorder=4,
            )
            axes.plot(
                *xy[low].T, "v", markerfacecolor=face, markeredgecolor=INK, markersize=8, zorder=4
            )
            for x, y in xy[low]:
                axes.annotate(
                    "",
                    (x, y / 1.75),
                    (x, y),
                    arrowprops={"arrowstyle": "->", "color": style.colour, "linewidth": 1.4},
                    zorder=3,
                )
            name = plain(shortened(f"{method}, {others}" if others else method, 28))
            handles.append(
                Line2D(
                    [],
                    [],
                    color=style.colour,
                    linewidth=1,
                    marker=style.marker,
                    markerfacecolor=face,
                    markeredgecolor=style.colour,
                    label=name,
                )
            )
    return lines, handles


def _draw_front(axes: Axes, front: Sequence[Entry]) -> NDArray[np.float64]:
    """The Pareto front as steps, with rings around its points; returns the steps."""
    xy = np.array(sorted(_place(e) for e in front))
    steps = np.stack([np.repeat(xy[:, 0], 2)[1:], np.repeat(xy[:, 1], 2)[:-1]], axis=1)
    axes.plot(*steps.T, color=INK, linewidth=1.2, linestyle=(0, (4, 2)), zorder=3)
    axes.plot(
        *xy.T,
        "o",
        markersize=11,
        markerfacecolor="none",
        markeredgecolor=INK,
        markeredgewidth=1.2,
        zorder=5,
    )
    return steps


def singular_values(comparison: Comparison, dataset: str, styles: dict[str, Style]) -> Drawn | None:
    """Decay of the training snapshots' singular values; None if they were not recorded."""
    try:
        sigma = np.asarray(comparison.dataset_arrays(dataset)["singular_values"], dtype=float)
    except (OSError, KeyError):
        return None
    sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    if not len(sigma):
        return None
    energy = np.cumsum((sigma**2)[::-1])[::-1]
    tail = np.sqrt(np.append(energy[1:], 0.0) / energy[0])
    count = np.arange(1, len(sigma) + 1)
    figure = new_figure(4.6)
    axes = figure.subplots()
    dress(axes)
    axes.loglog(
        count,
        sigma / sigma[0],
        color=GREY,
        linewidth=1.2,
        marker=".",
        markersize=4,
        label=r"$\sigma_i\,/\,\sigma_1$",
    )
    axes.loglog(
        count[:-1],
        tail[:-1],
        color=INK,
        linewidth=1.6,
        label=r"energy tail $\sqrt{\sum_{i>r}\sigma_i^2\,/\,\sum_i\sigma_i^2}$",
    )
    used: dict[int, list[str]] = {}
    for entry in entries_of(comparison, dataset):
        rank = (entry.row.get("parameters") or {}).get("n_modes")
        if (
            isinstance(rank, int)
            and "n_modes" in entry.swept
            and 1 <= rank < len(sigma)
            and entry.method not in used.setdefault(rank, [])
        ):
            used[rank].append(entry.method)
    _draw_ranks(axes, used, tail, styles)
    axes.set_xlabel("number of modes r (index i)")
    axes.set_ylabel("relative to all snapshots")
    axes.set_title(
        plain(f"Singular values of the training snapshots – {dataset}"),
        loc="left",
        fontsize=13,
        color=INK,
    )
    axes.legend(fontsize=9, frameon=False, loc="lower left")
    axes.set_ylim(bottom=max(float(tail[:-1].min(initial=1.0)) / 3, ROUND_OFF))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    path = save(figure, comparison, dataset, "singular-values")
    caption = (
        "Grey: singular values of the training snapshots over the largest. Black: the root of the energy that r modes leave out, which is the "
        "relative root-mean-square error of the best linear basis of r modes on the training snapshots: on those, no method that predicts within "
        "a basis of r modes can be better. Markers: the ranks that were tried."
    )
    return Drawn(dataset, path, "Singular values of the training snapshots", caption)


def _draw_ranks(
    axes: Axes, used: dict[int, list[str]], tail: NDArray[np.float64], styles: dict[str, Style]
) -> None:
    """The ranks that methods used, as markers on the energy tail: the first method's filled, those of others as rings around it."""
    for ring, method in enumerate(
        dict.fromkeys(method for methods in used.values() for method in methods)
    ):
        ranks = np.array(sorted(rank for rank, methods in used.items() if method in methods))
        style = styles[method]
        face = "none" if ring else style.colour
        axes.plot(
            ranks,
            tail[ranks - 1],
            style.marker,
            markersize=7 + 6 * ring,
            markerfacecolor=face,
            markeredgecolor=style.colour,
            markeredgewidth=1.4,
            zorder=4,
            label=plain(method),
        )
    xy = np.column_stack([np.arange(1, len(tail)), tail[:-1]])
    notes = [
        Note(rank, float(tail[rank - 1]), f"r={rank}: {percent(float(tail[rank - 1]))} %")
        for rank in sorted(used)
    ]
    annotate(axes, notes, [xy], radius=8.0)


def error_against_amplitude(
    comparison: Comparison, dataset: str, styles: dict[str, Style]
) -> Drawn | None:
    """Error e of every test sample over its largest displacement, a panel per method; None if no samples are left."""
    panels = []
    for entry in best_per_method(entries_of(comparison, dataset)):
        try:
            arrays = comparison.samples(entry.row)
            panels.append(
                (entry, np.asarray(arrays["amplitude_m"]), np.asarray(arrays["mean_dof_m"]))
            )
        except (OSError, KeyError):
            continue
    if not panels:
        return None
    columns = min(3, len(panels))
    rows = ceil(len(panels) / columns)
    figure = new_figure(0.6 + 2.7 * rows)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel()[len(panels) :]:
        axes.set_visible(False)
    for axes, (entry, amplitude, e) in zip(grid.ravel(), panels, strict=False):
        _amplitude_panel(axes, entry, amplitude, e, styles[entry.method])
    figure.supxlabel("largest nodal displacement of the reference (m)", fontsize=10)
    figure.supylabel("mean error per dof, e (m)", fontsize=10)
    figure.suptitle(
        plain(f"Error against deformation – {dataset}"), x=0.01, ha="left", fontsize=13, color=INK
    )
    path = save(figure, comparison, dataset, "error-against-deformation")
    caption = (
        "Each dot is a test sample, of the configuration of each method with the smallest ē. The line is the least-squares line through the origin; "
        "its slope (m of error per m of deformation) compares methods at one glance. Every panel has its own vertical scale. "
        "Samples without a prediction have no place here; the panel gives their number."
    )
    return Drawn(dataset, path, "Error against deformation", caption)


def _amplitude_panel(
    axes: Axes, entry: Entry, amplitude: NDArray[np.float64], e: NDArray[np.float64], style: Style
) -> None:
    dress(axes)
    finite = np.isfinite(e) & np.isfinite(amplitude)
    x, y = amplitude[finite], e[finite]
    axes.plot(
        x,
        y,
        ".",
        color=style.colour,
        markersize=4.5 if len(x) > 300 else 8,
        alpha=0.5,
        markeredgewidth=0,
        rasterized=True,
    )
    axes.set_title(
        plain(f"{entry.method}\n{shortened(short_swept(entry.swept), 40)}".rstrip()),
        fontsize=10,
        loc="left",
        color=INK,
    )
    said = []
    if len(x) and x.max() > 0:
        slope = float(x @ y / (x @ x))
        axes.axline((0, 0), slope=slope, color=INK, linewidth=1.3)
        axes.set_xlim(0, 1.05 * float(x.max()))
        said.append(f"slope {slope:.1e}" if y.max() > 0 else "e = 0 on every sample")
    if len(y) and y.max() > 0:
        axes.set_ylim(0, 1.05 * float(y.max()))
    else:
        axes.yaxis.set_visible(False)
        axes.set_ylim(0, 1)
    if not finite.all():
        said.append(f"{int((~finite).sum())} of {len(e)} without prediction")
    frame = {"facecolor": "white", "edgecolor": LIGHT, "pad": 2.5}
    axes.annotate(
        "\n".join(said),
        (0.04, 0.95),
        xycoords="axes fraction",
        va="top",
        fontsize=9,
        color=INK,
        bbox=frame,
    )
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{value:.1e}" if 0 < value < 1e-3 else f"{value:.3g}")
    )
