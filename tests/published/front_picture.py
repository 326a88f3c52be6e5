"""The picture of the Pareto fronts of an earlier commit and of today."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from mor_bench.report.canvas import GREY, INK, LABEL, NOTE, Picture, dress, log_ticks, new_figure
from mor_bench.report.method_styles import style_of
from tests.published.stored import content_of

LEAST = 0.01
"""Smallest error that is shown, in %; smaller ones lie on the lower edge."""

CAPTION = (
    "95th percentile of the relative error over the median latency, a panel per scene, with the "
    "fronts of some methods at an earlier commit and today, and of more methods today."
)
N_COLUMNS = 2


def fronts_picture(source: str) -> Picture:
    """Draw error over time of all configurations, and the fronts before and now, per scene."""
    content = content_of(source)
    now = content["now"] + content["more"]
    scenes = list(dict.fromkeys(row["dataset"] for row in now))
    methods = list(dict.fromkeys(row["method"] for row in now))
    lower = [s for s in scenes if not np.array_equal(_front(now, s), _front(content["now"], s))]
    finding = f"More methods lower today's front on {len(lower)} of {len(scenes)} scenes"
    n_old = len({row["method"] for row in content["now"]})
    subject = f"Front of {n_old} methods before (dashed) and now (grey); black: with more methods"
    n_rows = -(-len(scenes) // N_COLUMNS)
    figure = new_figure(2.4 * n_rows + 1.2, finding, subject)
    panels = figure.subplots(n_rows, N_COLUMNS, squeeze=False).ravel()
    for axes, scene in zip(panels, scenes, strict=True):
        _draw(axes, scene, now)
        for rows, colour, line in (
            (content["before"], GREY, "--"),
            (content["now"], GREY, "-"),
            (now, INK, "-"),
        ):
            axes.step(*_front(rows, scene).T, where="post", color=colour, linestyle=line)
    handles = [
        Line2D([], [], color=style_of(m).colour, marker=style_of(m).marker, linestyle="", label=m)
        for m in methods
    ]
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=3,
        fontsize=NOTE,
        frameon=False,
        columnspacing=1.0,
    )
    return Picture("fronts", "Fronts before and now", CAPTION, figure, finding)


def _places(rows: list[dict[str, Any]], scene: str) -> NDArray[np.float64]:
    """Return latency, ms, and error, %, of each configuration on a scene (n, 2)."""
    mine = [row for row in rows if row["dataset"] == scene]
    return np.array([[row["ms"], max(100 * row["rel_l2_p95"], LEAST)] for row in mine])


def _front(rows: list[dict[str, Any]], scene: str) -> NDArray[np.float64]:
    """Return the configurations that no other is both faster and more accurate than, in order."""
    places = _places(rows, scene)
    places = places[np.lexsort((places[:, 1], places[:, 0]))]
    least = np.minimum.accumulate(places[:, 1])
    first = np.append(True, least[1:] < least[:-1])
    return np.asarray(places[first])


def _draw(axes: Axes, scene: str, rows: list[dict[str, Any]]) -> None:
    """Draw a mark for each configuration on a scene."""
    dress(axes)
    mine = [row for row in rows if row["dataset"] == scene]
    for row, (ms, error) in zip(mine, _places(rows, scene), strict=True):
        style = style_of(row["method"])
        axes.plot(ms, error, style.marker, color=style.colour, markersize=5, alpha=0.75)
    axes.set(xscale="log", yscale="log", ylim=(0.8 * LEAST, 100.0))
    log_ticks(axes.xaxis)
    log_ticks(axes.yaxis)
    axes.set_title(scene, fontsize=LABEL, loc="left")
    axes.set_xlabel("ms", fontsize=NOTE)
    axes.set_ylabel("%", fontsize=NOTE)
