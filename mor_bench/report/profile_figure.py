"""The figure of the performance profile over all problems."""

from __future__ import annotations

import numpy as np

from mor_bench.report.canvas import Picture, Style, dress, log_ticks, new_figure, plain
from mor_bench.report.entries import Analysis
from mor_bench.report.speed_tables import profile_note


def performance_profile(analysis: Analysis, styles: dict[str, Style]) -> Picture | None:
    """Draw the share of problems solved within a factor of the fastest, a staircase per method.

    None if fewer than two methods solve a problem.
    """
    found = analysis["profile"]
    solving = {
        method: sorted(f for f in factors if f is not None)
        for method, factors in found["factors"].items()
    }
    solving = {method: factors for method, factors in solving.items() if factors}
    if len(solving) < 2:
        return None
    n, n_datasets = len(found["problems"]), found["n_datasets"]
    over = f"{n_datasets} datasets" if n_datasets > 1 else "the errors of one dataset"
    figure = new_figure(4.4, f"Performance profile over {over}")
    axes = figure.subplots()
    dress(axes)
    end = 1.3 * max(max(factors) for factors in solving.values())
    for i, (method, factors) in enumerate(solving.items()):
        style = styles[method]
        x = np.array([1.0, *factors, end])
        # A shift of about a thousandth separates coincident staircases.
        solved = np.array([0, *range(1, len(factors) + 1), len(factors)]) / n
        y = 100 * (solved + 0.0015 * (i - len(solving) / 2))
        axes.step(x, y, where="post", color=style.colour, linewidth=1.6)
        (marks,) = axes.plot(x[1:-1], y[1:-1], style.marker, color=style.colour, markersize=7)
        marks.set_markeredgecolor("white")
        marks.set_label(plain(method))
    axes.set_xscale("log")
    axes.set_xlim(0.95, end)
    axes.set_ylim(-4, 104)
    log_ticks(axes.xaxis, unit="×")
    axes.set_xlabel("at most this factor slower than the fastest method")
    axes.set_ylabel("problems solved (%)")
    figure.legend(loc="outside right upper", fontsize=9, frameon=False)
    return Picture("performance-profile", "Performance profile", profile_note(found), figure)
