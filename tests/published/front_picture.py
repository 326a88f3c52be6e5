"""The picture of the Pareto fronts of an earlier commit and of today."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from mor_bench.analysis.frontier import Point, non_dominated
from mor_bench.report.canvas import GREY, INK, LABEL, NOTE, Picture, dress, log_ticks, new_figure
from mor_bench.report.method_styles import style_of
from tests.published.front_tables import points_on, rows_of_today, scenes_of
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
    now = rows_of_today(content)
    scenes, methods = scenes_of(now), list(dict.fromkeys(row["method"] for row in now))
    lower = [s for s in scenes if _front(s, now) != _front(s, content["now"])]
    finding = f"More methods lower today's front on {len(lower)} of {len(scenes)} scenes"
    n_old = len({row["method"] for row in content["now"]})
    subject = f"Front of {n_old} methods before (dashed) and now (grey); black: with more methods"
    n_rows = -(-len(scenes) // N_COLUMNS)
    figure = new_figure(2.4 * n_rows + 1.2, finding, subject)
    panels = figure.subplots(n_rows, N_COLUMNS, squeeze=False).ravel()
    for axes, scene in zip(panels, scenes, strict=True):
        _draw(axes, scene, points_on(scene, now))
        for rows, colour, line in (
            (content["before"], GREY, "--"),
            (content["now"], GREY, "-"),
            (now, INK, "-"),
        ):
            axes.step(*_places(_front(scene, rows)), where="post", color=colour, linestyle=line)
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


def _front(scene: str, rows: list[dict[str, Any]]) -> list[Point]:
    return non_dominated(points_on(scene, rows))


def _places(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    """Return latencies, ms, and errors, %."""
    return [p.latency_ms for p in points], [max(100 * p.error, LEAST) for p in points]


def _draw(axes: Axes, scene: str, points: Sequence[Point]) -> None:
    """Draw a mark for each configuration on a scene."""
    dress(axes)
    for point in points:
        style = style_of(point.label)
        (mark,) = axes.plot(*_places([point]), style.marker, color=style.colour)
        mark.set(markersize=5, alpha=0.75)
    axes.set(xscale="log", yscale="log", ylim=(0.8 * LEAST, 100.0))
    log_ticks(axes.xaxis)
    log_ticks(axes.yaxis)
    axes.set_title(scene, fontsize=LABEL, loc="left")
    axes.set_xlabel("ms", fontsize=NOTE)
    axes.set_ylabel("%", fontsize=NOTE)
