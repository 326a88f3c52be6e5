"""The figure of the performance profile over all problems."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from mor_bench.report.canvas import LABEL, Picture, dress, log_ticks, new_figure, shortened, uncut
from mor_bench.report.entries import Analysis
from mor_bench.report.labels import Note, annotate
from mor_bench.report.method_styles import readable, style_of
from mor_bench.report.number_format import number
from mor_bench.report.speed_tables import profile_note


def performance_profile(analysis: Analysis) -> Picture | None:
    """Draw the share of problems solved within a factor of the fastest, a staircase per method.

    None with a single dataset, where it says nothing about other scenes, and if fewer than two
    methods solve a problem.
    """
    found = analysis["profile"]
    solving = {
        method: sorted(f for f in factors if f is not None)
        for method, factors in found["factors"].items()
    }
    solving = {method: factors for method, factors in solving.items() if factors}
    if len(solving) < 2 or found["n_datasets"] < 2:
        return None
    n = len(found["problems"])
    first = {method: factors.count(1.0) for method, factors in solving.items()}
    quick, able = max(first, key=lambda m: first[m]), max(solving, key=lambda m: len(solving[m]))
    finding = f"{shortened(quick)} is fastest on {first[quick]} of {n} problems"
    also = "it also" if able == quick else shortened(able)
    finding += f"; {also} solves the most, {len(solving[able])}"
    subject = f"Performance profile over {found['n_datasets']} datasets, a staircase per method"
    figure = new_figure(4.4, finding, subject)
    _draw(figure.subplots(), solving, n)
    caption = f"{profile_note(found)} An arrow leads to factors beyond the axis."
    return Picture("performance-profile", "Performance profile", caption, figure, finding)


def _draw(axes: Axes, solving: dict[str, list[float]], n: int) -> None:
    dress(axes)
    end = 1.3 * uncut([f for factors in solving.values() for f in factors])[1]
    notes, lines, marks = [], [], []
    for i, (method, factors) in enumerate(solving.items()):
        style = style_of(method)
        x = np.array([1.0, *factors, end])
        # A shift of about a thousandth separates coincident staircases.
        solved = np.array([0, *range(1, len(factors) + 1), len(factors)]) / n
        y = 100 * (solved + 0.0015 * (i - len(solving) / 2))
        axes.step(x, y, where="post", color=style.colour, linewidth=1.6)
        (points,) = axes.plot(x[1:-1], y[1:-1], style.marker, color=style.colour, markersize=8)
        points.set_markeredgecolor("white")
        beyond = [factor for factor in factors if factor > end]
        colour = readable(style.colour)
        if beyond:
            text = f"{shortened(method)}: {number(max(beyond))}× →"
            notes.append(Note(text, [(end, float(y[-1 - len(beyond)]))], colour, "bold", must=True))
        places = list(zip(x[::-1].tolist(), y[::-1].tolist(), strict=True))
        notes += [] if beyond else [Note(shortened(method), places, colour, "bold", must=True)]
        marks += places[1:-1]
        lines.append(np.column_stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]]))
    axes.set_xscale("log")
    axes.set_xlim(0.95, end)
    axes.set_ylim(-4, 104)
    log_ticks(axes.xaxis, unit="×")
    axes.set_xlabel("at most this factor slower than the fastest method", fontsize=LABEL)
    axes.set_ylabel("problems solved (%)", fontsize=LABEL)
    annotate(axes, notes, marks, lines)
