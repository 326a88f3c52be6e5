"""The figure of singular values: decay of the training snapshots, and the tested ranks."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from mor_bench.report.canvas import (
    GREY,
    INK,
    Note,
    Picture,
    Style,
    annotate,
    dress,
    log_ticks,
    new_figure,
    plain,
)
from mor_bench.report.entries import Entry, entries_of
from mor_bench.report.number_format import percent
from mor_bench.results.comparison import Comparison

ROUND_OFF = 1e-12
"""Smaller relative singular values are not shown: they are round-off of the decomposition."""

SIGMA = r"$\sigma_i\,/\,\sigma_1$"
TAIL = r"energy tail $\sqrt{\sum_{i>r}\sigma_i^2\,/\,\sum_i\sigma_i^2}$"

CAPTION = (
    "Grey: singular values of the training snapshots relative to the largest. Black: the "
    "root of the energy that r modes leave out. It is the relative root-mean-square error "
    "of the best linear basis of r modes on the training snapshots. On these snapshots, "
    "no method with a linear basis of r modes can be more accurate. Markers: the ranks "
    "that were tried."
)


def singular_values(
    comparison: Comparison, dataset: str, styles: dict[str, Style]
) -> Picture | None:
    """Draw the decay of the snapshots' singular values; None if they were not recorded."""
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
    title = "Singular values of the training snapshots"
    figure = new_figure(4.6, f"{title} – {dataset}")
    axes = figure.subplots()
    dress(axes)
    decay = {"color": GREY, "linewidth": 1.2, "marker": ".", "markersize": 4}
    axes.loglog(count, sigma / sigma[0], label=SIGMA, **decay)
    axes.loglog(count[:-1], tail[:-1], label=TAIL, color=INK, linewidth=1.6)
    _draw_ranks(axes, _ranks(entries_of(comparison, dataset), len(sigma)), tail, styles)
    axes.set_xlabel("number of modes r (index i)")
    axes.set_ylabel("relative to all snapshots")
    axes.legend(fontsize=9, frameon=False, loc="lower left")
    axes.set_ylim(bottom=max(float(tail[:-1].min(initial=1.0)) / 3, ROUND_OFF))
    log_ticks(axes.xaxis)
    return Picture("singular-values", title, CAPTION, figure)


def _ranks(entries: list[Entry], n_values: int) -> dict[str, list[int]]:
    """Ranks below the number of singular values that each method swept, ascending."""
    used: dict[str, set[int]] = {}
    for entry in entries:
        rank = entry.swept.get("n_modes")
        if isinstance(rank, int) and 1 <= rank < n_values:
            used.setdefault(entry.method, set()).add(rank)
    return {method: sorted(ranks) for method, ranks in used.items()}


def _draw_ranks(
    axes: Axes, used: dict[str, list[int]], tail: NDArray[np.float64], styles: dict[str, Style]
) -> None:
    """Mark ranks on the energy tail: the first method's filled, others as rings around them."""
    for ring, (method, ranks) in enumerate(used.items()):
        style = styles[method]
        (marks,) = axes.plot(ranks, tail[np.subtract(ranks, 1)], style.marker, zorder=4)
        marks.set(ms=7 + 6 * ring, mec=style.colour, mew=1.4, label=plain(method))
        marks.set_markerfacecolor("none" if ring else style.colour)
    notes = [
        Note(rank, float(tail[rank - 1]), f"r={rank}: {percent(float(tail[rank - 1]))} %")
        for rank in sorted({rank for ranks in used.values() for rank in ranks})
    ]
    line = np.column_stack([np.arange(1, len(tail)), tail[:-1]])
    annotate(axes, notes, [line], radius=8.0)
