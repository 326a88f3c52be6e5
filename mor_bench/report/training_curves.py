"""The figures of learning curves and of loss curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from mor_bench.report.canvas import (
    COLOURS,
    INK,
    Picture,
    Style,
    dress,
    log_ticks,
    new_figure,
    plain,
    shortened,
)
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row


def learning_curves(
    comparison: Comparison, dataset: str, styles: dict[str, Style]
) -> Picture | None:
    """Draw error over number of training samples, log-log, a line per configuration.

    None if no line has two points.
    """
    lines: dict[tuple[str, str], list[tuple[float, float]]] = {}
    left_out = 0
    for point in comparison.learning:
        if point.dataset != dataset:
            continue
        if point.error is None or not 0 < point.error.rel_l2_median < np.inf:
            left_out += 1
            continue
        line = lines.setdefault((point.method, point.label), [])
        line.append((point.n_train, 100 * point.error.rel_l2_median))
    if not any(len(points) > 1 for points in lines.values()):
        return None
    figure = new_figure(4.8, f"Learning curves – {dataset}")
    axes = figure.subplots()
    dress(axes)
    for (method, label), points in lines.items():
        style = styles.get(method, Style(INK, "o"))
        look = {"color": style.colour, "marker": style.marker, "markeredgecolor": "white"}
        x, y = np.array(sorted(points), dtype=float).T
        axes.loglog(x, y, markersize=7, linewidth=1.3, label=plain(shortened(label, 40)), **look)
    sizes = sorted({n for points in lines.values() for n, _ in points})
    log_ticks(axes.xaxis)
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    log_ticks(axes.yaxis, [error for points in lines.values() for _, error in points])
    axes.set_xlabel("training samples")
    axes.set_ylabel("relative L2 error, median over the test set (%)")
    figure.legend(loc="outside right upper", fontsize=9, frameon=False)
    caption = (
        "Error on the test set of the same configuration, "
        "fitted to increasing numbers of training samples."
    )
    if left_out:
        fits = "fit" if left_out == 1 else "fits"
        caption += f" {left_out} {fits} without a finite error cannot be shown."
    return Picture("learning-curves", "Learning curves", caption, figure)


def loss_curves(comparison: Comparison, dataset: str, styles: dict[str, Style]) -> Picture | None:
    """Draw losses over the course of the training, a panel per method; None without trainings.

    Validation losses are dashed. Each method has its own axis, because methods minimise different
    losses.
    """
    trained: dict[str, list[Row]] = {}
    for row in comparison.rows:
        mine = row.dataset == dataset and row.ok and row.training
        if mine and len(comparison.samples(row).get("loss_curve", ())):
            trained.setdefault(row.method, []).append(row)
    if not trained:
        return None
    n_columns = min(2, len(trained))
    n_rows = -(-len(trained) // n_columns)
    figure = new_figure(0.6 + 3.4 * n_rows, f"Loss curves – {dataset}")
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes in panels[len(trained) :]:
        axes.set_visible(False)
    validated = [
        _loss_panel(axes, comparison, rows)
        for axes, rows in zip(panels, trained.values(), strict=False)
    ]
    caption = (
        "Training loss from the beginning to the end of the training. "
        "Each method has its own unit of loss."
    )
    if any(validated):
        caption += " Dashed: loss on held-out samples."
    return Picture("loss-curves", "Loss curves", caption, figure)


def _loss_panel(axes: Axes, comparison: Comparison, rows: Sequence[Row]) -> bool:
    """Draw the losses of one method's configurations; return whether any is a validation loss."""
    validated = False
    dress(axes)
    for i, row in enumerate(rows):
        samples, colour = comparison.samples(row), COLOURS[i % len(COLOURS)]
        name = ", ".join(f"{key}={value}" for key, value in row.swept.items()) or row.method
        if row.training and row.training.iterations is not None:
            name += f", {row.training.iterations:,} iterations"
        for curve, line in (("loss_curve", "-"), ("validation_curve", "--")):
            losses = np.asarray(samples.get(curve, ()), dtype=float)
            shown = np.isfinite(losses) & (losses > 0)
            x = 100 * np.arange(1, len(losses) + 1) / max(len(losses), 1)
            (drawn,) = axes.plot(x[shown], losses[shown], line, color=colour, linewidth=1.3)
            drawn.set_marker("o" if shown.sum() == 1 else "")
            if curve == "loss_curve":
                drawn.set_label(plain(shortened(name, 50)))
            else:
                validated |= bool(shown.any())
    axes.set_yscale("log")
    axes.set_xlabel("part of the training (%)")
    axes.set_ylabel("loss")
    axes.set_title(plain(rows[0].method), loc="left", fontsize=11, color=INK)
    axes.legend(fontsize=8, frameon=False)
    return validated
