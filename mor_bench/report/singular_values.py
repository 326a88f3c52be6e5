"""The figure of singular values: decay of the training snapshots, and the tested ranks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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
"""Smaller relative values are round-off of the decomposition."""

LEADING = 400
"""Number of singular values that a run records of a dataset with many samples."""

BELOW_RANKS = 1 / 30
"""Part of the least error at a tested rank that the axis still shows."""

SIGMA = "singular values σᵢ / σ₁"
TAIL = "left out by r modes: √(Σ σᵢ² over i > r / Σ σᵢ²)"

ROOM_PT = 270.0
"""Height of the axes, about."""

STEP_PT = 14.0
"""Distance between the rows of markers of two methods, above the axis."""

CAPTION = (
    "Grey: singular values σᵢ of the training snapshots relative to the largest. Black: the "
    "root of the energy that r modes leave out. It is the relative root-mean-square error "
    "of the best linear basis of r modes on the training snapshots. On these snapshots, "
    "no method with a linear basis of r modes can be more accurate. Markers at the bottom: "
    "the methods that tried this rank; their height has no meaning."
)


@dataclass(frozen=True)
class Spectrum:
    """Singular values of the training snapshots, relative to the largest.

    Attributes
    ----------
    sigma : (n,) float64
    tail : (n or n - 1,) float64
        For r = 1, 2, …: the relative root-mean-square error of the best r modes. All are positive.
    is_whole : bool
        All singular values were recorded, so one mode more than `tail` has makes no error.
    """

    sigma: NDArray[np.float64]
    tail: NDArray[np.float64]
    is_whole: bool

    def finding(self, error: float) -> str:
        """Say how many modes the training snapshots need for an error."""
        enough = np.flatnonzero(self.tail <= error)
        rank = int(enough[0]) + 1 if len(enough) else len(self.tail) + self.is_whole
        words = "At least {} modes are needed"
        if not len(enough) and not self.is_whole:
            words = "More than {} modes are needed"
        elif rank == 1:
            words = "{} mode suffices"
        return f"{words.format(rank)} for {percent(error)} % on the training samples themselves"


def spectrum_of(arrays: Mapping[str, NDArray[Any]]) -> Spectrum | None:
    """Return the spectrum among a dataset's arrays; None if it is not known.

    Of many samples, a run records the leading singular values only. The norm of all snapshots gives
    the energy of the others. Runs of earlier versions did not record it.
    """
    sigma = np.asarray(arrays.get("singular_values", ()), dtype=float)
    sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    if not len(sigma) or (len(sigma) == LEADING and "snapshots_norm" not in arrays):
        return None
    energy = np.cumsum((sigma**2)[::-1])[::-1]
    others = float(arrays.get("snapshots_norm", 0.0)) ** 2 - energy[0]
    others = others if others > ROUND_OFF * energy[0] else 0.0
    tail = np.sqrt((np.append(energy[1:], 0.0) + others) / (energy[0] + others))
    return Spectrum(sigma / sigma[0], tail[tail > 0], others == 0.0)


def singular_values(comparison: Comparison, dataset: str) -> Picture | None:
    """Draw the decay of the snapshots' singular values; None if they were not recorded."""
    try:
        spectrum = spectrum_of(comparison.dataset_arrays(dataset))
    except (OSError, KeyError):
        return None
    if spectrum is None:
        return None
    finding = spectrum.finding(needs_of(comparison, dataset).error or 0.01)
    subject = f"{dataset}: singular values of the training snapshots"
    figure = new_figure(4.4, finding, subject)
    draw_singular_values(figure.subplots(), spectrum, entries_of(comparison, dataset))
    return Picture("singular-values", "Singular values", CAPTION, figure, finding)


def draw_singular_values(axes: Axes, spectrum: Spectrum, entries: Sequence[Entry]) -> None:
    """Draw both curves in percent, and the markers and values of the tested ranks."""
    dress(axes)
    sigma, tail = spectrum.sigma, spectrum.tail
    used = _ranks(entries, len(tail))
    count = np.arange(1, len(sigma) + 1)
    axes.loglog(count, 100 * sigma, label=SIGMA, color=GREY, linewidth=1.2, marker=".", ms=4)
    axes.loglog(count[: len(tail)], 100 * tail, label=TAIL, color=INK, linewidth=1.8)
    tested = sorted({rank for ranks in used.values() for rank in ranks})
    shown = [float(tail[rank - 1]) for rank in tested] or tail.tolist()
    bottom = max(BELOW_RANKS * min(shown, default=1.0), ROUND_OFF)
    part = min(0.6, (len(used) + 0.5) * STEP_PT / ROOM_PT)
    strip = (2.5 / bottom) ** (-part / (1 - part))  # free room below the curves, for the markers
    bottom *= strip
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
    notes += _method_names(used, 100 * bottom)
    if last < len(sigma):
        text = f"left out by {len(tail):,} modes: {percent(float(tail.min()))} %"
        corner = (axes.get_xlim()[1], axes.get_ylim()[1])  # free, since both curves fall
        notes.insert(0, Note(text, [corner], offsets=((-6, -9),), must=True, leader=False))
    for text, curve, colour in (("left out by r modes", tail, INK), ("σᵢ / σ₁", sigma, GREY)):
        places = [(float(i), 100 * float(curve[i - 1])) for i in range(2, min(len(curve), last))]
        notes.append(Note(text, places[:: max(1, len(places) // 30)], colour, "bold"))
    lines = [np.column_stack([count[: len(y)], 100 * y]) for y in (sigma, tail)]
    annotate(axes, notes, marks, [np.maximum(line, 1e-12) for line in lines], radius=4.0)


def _ranks(entries: Sequence[Entry], most: int) -> dict[str, list[int]]:
    """Ranks up to `most` that each method swept, ascending."""
    used: dict[str, set[int]] = {}
    for entry in entries:
        rank = entry.swept.get("n_modes")
        if isinstance(rank, int) and 1 <= rank <= most:
            used.setdefault(entry.method, set()).add(rank)
    return {method: sorted(ranks) for method, ranks in used.items()}


def _draw_ranks(
    axes: Axes, used: dict[str, list[int]], tail: NDArray[np.float64]
) -> list[tuple[float, float]]:
    """Mark ranks with a dot on the curve, and with each method's marker in a row above the axis.

    Return the places of all marks in data coordinates.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    markers, curve = [], list[tuple[float, float]]()
    for place, (method, ranks) in enumerate(used.items()):
        style = style_of(method)
        y = 100 * tail[np.subtract(ranks, 1)]
        axes.plot(ranks, y, "o", color=INK, ms=5, zorder=4)
        up = ScaledTranslation(0, STEP_PT * (place + 0.95) / 72, figure.dpi_scale_trans)
        low = np.full(len(ranks), axes.get_ylim()[0])
        (marks,) = axes.plot(ranks, low, style.marker, zorder=5, label=method)
        marks.set(ms=8, mec="white", mew=0.5, mfc=style.colour)
        marks.set_transform(axes.transData + up)
        curve += [(float(rank), float(height)) for rank, height in zip(ranks, y, strict=True)]
        markers.append((marks, np.column_stack([ranks, low])))
    lay_out(figure)  # the layout decides how high the markers are
    found = [np.array(curve).reshape(-1, 2)]
    found += [
        axes.transData.inverted().transform(marks.get_transform().transform(xy))
        for marks, xy in markers
    ]
    return [(float(x), float(y)) for xy in found for x, y in xy]


def _method_names(used: dict[str, list[int]], bottom: float) -> list[Note]:
    """Label each method's markers at one of its ranks, the largest first."""
    notes = []
    for place, (method, ranks) in enumerate(used.items()):
        places = [(float(rank), bottom) for rank in ranks[::-1]]
        low = STEP_PT * (place + 0.95) - 5.5
        colour, name = readable(style_of(method).colour), shortened(method)
        beside = ((9.0, low), (-9.0, low))
        notes.append(Note(name, places, colour, "bold", beside, leader=False))
    return notes
