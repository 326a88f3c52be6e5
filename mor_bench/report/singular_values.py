"""The figure of singular values: decay of the training snapshots, and the tested ranks."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray

from mor_bench.analysis.verdict import needs_of
from mor_bench.report.canvas import (
    GREY,
    INK,
    LABEL,
    Picture,
    dress,
    lay_out,
    log_ticks,
    new_figure,
    shortened,
)
from mor_bench.report.entries import Entry, entries_of
from mor_bench.report.labels import Note, annotate
from mor_bench.report.method_styles import readable, style_of
from mor_bench.report.number_format import percent
from mor_bench.results.comparison import Comparison

ROUND_OFF = 1e-12
"""Smaller relative singular values are not shown: they are round-off of the decomposition."""

BELOW_RANKS = 1 / 30
"""Part of the least error at a tested rank that the axis still shows."""

SIGMA = "singular values σᵢ / σ₁"
TAIL = "left out by r modes: √(Σ σᵢ² over i > r / Σ σᵢ²)"

STEP_PT = 14.0
"""Distance between the markers of two methods that tested the same rank."""

CAPTION = (
    "Grey: singular values σᵢ of the training snapshots relative to the largest. Black: the "
    "root of the energy that r modes leave out. It is the relative root-mean-square error "
    "of the best linear basis of r modes on the training snapshots. On these snapshots, "
    "no method with a linear basis of r modes can be more accurate. Markers below the black line: "
    "the methods that tried this rank."
)


def singular_values(comparison: Comparison, dataset: str) -> Picture | None:
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
    finding = _finding(tail, needs_of(comparison, dataset).error or 0.01)
    subject = f"{dataset}: singular values of the training snapshots"
    figure = new_figure(4.4, finding, subject)
    axes = figure.subplots()
    dress(axes)
    used = _ranks(entries_of(comparison, dataset), len(sigma))
    _draw(axes, sigma / sigma[0], tail, used)
    return Picture("singular-values", "Singular values", CAPTION, figure, finding)


def _finding(tail: NDArray[np.float64], error: float) -> str:
    """Say how many modes the training snapshots need for an error."""
    rank = int(np.argmax(tail <= error)) + 1
    prefix, modes = ("", "mode suffices") if rank == 1 else ("At least ", "modes are needed")
    return f"{prefix}{rank} {modes} for {percent(error)} % (training data)"


def _draw(
    axes: Axes, sigma: NDArray[np.float64], tail: NDArray[np.float64], used: dict[str, list[int]]
) -> None:
    """Draw both curves in percent, and the markers and values of the tested ranks."""
    count, tail = np.arange(1, len(sigma) + 1), tail[:-1]
    axes.loglog(count, 100 * sigma, label=SIGMA, color=GREY, linewidth=1.2, marker=".", ms=4)
    axes.loglog(count[:-1], 100 * tail, label=TAIL, color=INK, linewidth=1.8)
    tested = sorted({rank for ranks in used.values() for rank in ranks})
    shown = [float(tail[rank - 1]) for rank in tested] or tail.tolist()
    bottom = max(BELOW_RANKS * min(shown, default=1.0), ROUND_OFF)
    axes.set_ylim(100 * bottom, 250)
    last = int(np.argmax(tail < bottom)) if (tail < bottom).any() else len(sigma)
    axes.set_xlim(0.85, 1.15 * max(last, 2))
    log_ticks(axes.xaxis)
    log_ticks(axes.yaxis)
    axes.set_xlabel("number of modes r, or index i", fontsize=LABEL)
    axes.set_ylabel("relative to all snapshots (%)", fontsize=LABEL)
    marks = _draw_ranks(axes, used, tail)
    points = [(float(rank), 100 * float(tail[rank - 1])) for rank in tested]
    above = ((6, 7), (0, 9), (8, 12), (12, 18), (4, 24))
    notes = [
        Note(f"r{rank}: {percent(y / 100)} %", [(x, y)], offsets=above)
        for rank, (x, y) in zip(tested, points, strict=True)
    ]
    notes += _method_names(used, tail)
    if last < len(sigma):
        text = f"falls to {percent(float(tail.min()))} % at {len(tail):,} →"
        end = (axes.get_xlim()[1], 100 * bottom)
        notes.insert(0, Note(text, [end], offsets=((-6, 8),), must=True))
    for text, curve, colour in (("left out by r modes", tail, INK), ("σᵢ / σ₁", sigma, GREY)):
        places = [(float(i), 100 * float(curve[i - 1])) for i in range(2, min(len(curve), last))]
        notes.append(Note(text, places[:: max(1, len(places) // 30)], colour, "bold"))
    lines = [np.column_stack([count, 100 * sigma]), np.column_stack([count[:-1], 100 * tail])]
    annotate(axes, notes, marks, [np.maximum(line, 1e-12) for line in lines], radius=4.0)


def _ranks(entries: list[Entry], n_values: int) -> dict[str, list[int]]:
    """Ranks below the number of singular values that each method swept, ascending."""
    used: dict[str, set[int]] = {}
    for entry in entries:
        rank = entry.swept.get("n_modes")
        if isinstance(rank, int) and 1 <= rank < n_values:
            used.setdefault(entry.method, set()).add(rank)
    return {method: sorted(ranks) for method, ranks in used.items()}


def _draw_ranks(
    axes: Axes, used: dict[str, list[int]], tail: NDArray[np.float64]
) -> list[tuple[float, float]]:
    """Mark ranks with a dot on the curve, and with each method's marker below it.

    Return the places of all marks in data coordinates.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    markers = []
    for place, (method, ranks) in enumerate(used.items()):
        style = style_of(method)
        y = 100 * tail[np.subtract(ranks, 1)]
        axes.plot(ranks, y, "o", color=INK, ms=5, zorder=4)
        down = ScaledTranslation(0, -STEP_PT * (place + 1) / 72, figure.dpi_scale_trans)
        (marks,) = axes.plot(ranks, y, style.marker, zorder=5, label=method)
        marks.set(ms=8, mec="white", mew=0.5, mfc=style.colour)
        marks.set_transform(axes.transData + down)
        markers.append((marks, np.column_stack([ranks, y])))
    lay_out(figure)  # the layout decides how far down the markers are
    found = [xy for _, xy in markers]
    found += [
        axes.transData.inverted().transform(marks.get_transform().transform(xy))
        for marks, xy in markers
    ]
    return [(float(x), float(y)) for xy in found for x, y in xy]


def _method_names(used: dict[str, list[int]], tail: NDArray[np.float64]) -> list[Note]:
    """Label each method's markers at one of its ranks, the largest first."""
    notes = []
    for place, (method, ranks) in enumerate(used.items()):
        places = [(float(rank), 100 * float(tail[rank - 1])) for rank in ranks[::-1]]
        low = -STEP_PT * (place + 1) + 6
        colour, name = readable(style_of(method).colour), shortened(method, 30)
        beside = ((9.0, low), (-9.0, low))
        notes.append(Note(name, places, colour, "bold", beside, leader=False))
    return notes
