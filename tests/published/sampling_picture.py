"""The picture of errors over the cost of the training loads, for each way to choose them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from mor_bench.report.canvas import LABEL, NOTE, Picture, dress, log_ticks, new_figure
from mor_bench.report.method_styles import Line
from tests.benchmarks.adaptive_sampling import DESIGNS
from tests.published.sampling_tables import core_seconds, middle
from tests.published.stored import content_of

LOOKS: tuple[tuple[str, str, Line], ...] = (
    ("#222222", "o", "-"),
    ("#6e6e6e", "s", "-"),
    ("#a8a8a8", "^", "-"),
    ("#0072B2", "D", "--"),
    ("#56B4E9", "v", "--"),
    ("#D55E00", "X", ":"),
)
"""Colour, marker and dash of each way, in the order of the tables."""

CAPTION = (
    "95th percentile of the relative error over the core-seconds of all solves, fits and choices, "
    "a panel per method and scene, a line per way to choose the training loads. Each point is the "
    "median of the repetitions. Points above 100 % are cut off."
)


def sampling_cost(source: str) -> Picture:
    """Draw errors over the core-seconds that the snapshots cost, for each way to choose them."""
    panels = list(_panels(content_of(source)))
    dearer, deeper = 0, 0
    for _, curves in panels:
        designs = np.vstack([curves[name] for name in DESIGNS])
        # Their first snapshots are those of the random loads.
        chosen = np.vstack([curve[1:] for way, curve in curves.items() if way not in DESIGNS])
        deeper += bool(chosen[:, 1].min() < designs[:, 1].min())
        dearer += all(_reached_sooner(designs, point) for point in chosen)
    finding = (
        f"No adaptive choice reaches an error sooner than a design in {dearer} of {len(panels)} "
        f"panels; in {deeper} of them, one reaches smaller errors than all designs"
    )
    figure = new_figure(5.6, finding, "95th percentile of the error (%) over core-seconds")
    axes = figure.subplots(-(-len(panels) // 2), 2, squeeze=False).ravel()
    for one, (title, curves) in zip(axes, panels, strict=True):
        dress(one)
        for (colour, marker, line), curve in zip(LOOKS, curves.values(), strict=True):
            one.loglog(*curve.T, marker, color=colour, linestyle=line, markersize=4, linewidth=1.2)
        # Fits with fewer snapshots than coordinates lie far above.
        one.set_ylim(0.8 * min(c[:, 1].min() for c in curves.values()), 100.0)
        log_ticks(one.xaxis, one.get_xlim())
        log_ticks(one.yaxis)
        one.set_title(title, fontsize=LABEL, loc="left")
        one.set_xlabel("core-seconds", fontsize=NOTE)
    handles = [
        Line2D([], [], color=colour, marker=marker, linestyle=line, label=name)
        for (colour, marker, line), name in zip(LOOKS, panels[0][1], strict=True)
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=3, fontsize=NOTE, frameon=False
    )
    return Picture("sampling-cost", "Errors over the cost of snapshots", CAPTION, figure, finding)


def _panels(content: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Yield a title and, for each way, its core-seconds and 95th percentiles, %: (n, 2)."""
    for scene, found in content.items():
        for method, rows in found["methods"].items():
            curves: dict[str, list[tuple[float, float]]] = {}
            for row in rows:
                place = (core_seconds(row), 100 * middle(row["p95"]))
                curves.setdefault(row["way"], []).append(place)
            yield f"{method}, {scene}", {way: np.array(curve) for way, curve in curves.items()}


def _reached_sooner(designs: np.ndarray, point: np.ndarray) -> bool:
    """Return whether a point of designs needs no more core-seconds to err no more, or none can."""
    core_s, error = point
    reached = designs[designs[:, 1] <= error, 0]
    return not len(reached) or bool(reached.min() <= core_s)
