"""The figures of learning curves and of loss curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from mor_bench.report.canvas import (
    INK,
    LABEL,
    NOTE,
    Picture,
    dress,
    log_ticks,
    new_figure,
    plain,
    shortened,
    uncut,
)
from mor_bench.report.labels import Note, annotate
from mor_bench.report.method_styles import readable, style_of
from mor_bench.report.number_format import number
from mor_bench.report.short_names import ShortName, short_names
from mor_bench.results.comparison import Comparison
from mor_bench.results.row import Row

Lines = dict[tuple[str, str], NDArray[np.float64]]
"""By method and label: training samples and error in percent, ascending (n, 2)."""

LAST = 0.1
"""Last part of a training, over which the fall of the loss is stated."""


def learning_curves(comparison: Comparison, dataset: str) -> Picture | None:
    """Draw error over number of training samples, log-log, a line per configuration.

    None if no line has two points.
    """
    lines, left_out = learning_lines(comparison, dataset)
    if not any(len(points) > 1 for points in lines.values()):
        return None
    names = short_names([row for row in comparison.rows if row.dataset == dataset])
    finding = _most_gained(lines, names)
    subject = f"{dataset}: learning curves, the error of a configuration over its training samples"
    figure = new_figure(4.6, finding, subject)
    draw_learning(figure.subplots(), lines, names)
    caption = (
        "Error on the test set of the same configuration, "
        "fitted to increasing numbers of training samples."
    )
    if left_out:
        fits = "fit" if left_out == 1 else "fits"
        caption += f" {left_out} {fits} without a finite error cannot be shown."
    return Picture("learning-curves", "Learning curves", caption, figure, finding)


def draw_learning(axes: Axes, lines: Lines, names: dict[str, ShortName]) -> None:
    """Draw a line per configuration, with its name beside it."""
    dress(axes)
    end = uncut([error for points in lines.values() for error in points[:, 1]])
    notes, marks = [], []
    for (method, label), points in lines.items():
        style = style_of(method)
        shown = np.column_stack([points[:, 0], np.clip(points[:, 1], end[0], end[1])])
        (line,) = axes.loglog(*shown.T, style.marker, color=style.colour, markersize=8)
        line.set(linestyle="-", linewidth=1.4, markeredgecolor="white")
        name, colour = _name(names, label), readable(style.colour)
        places = [(float(x), float(y)) for x, y in shown[::-1]]
        notes.append(Note(shortened(name), places, colour, "bold", must=True))
        marks += places
        for (x, y), (_, cut) in zip(points, shown, strict=True):
            if y != cut:
                text = f"{number(y)} % {'↑' if y > cut else '↓'}"
                notes.append(Note(text, [(float(x), float(cut))], colour, must=True))
    log_ticks(axes.xaxis)
    sizes = sorted({int(n) for points in lines.values() for n in points[:, 0]})
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axes.set_xticks([], minor=True)
    axes.margins(x=0.12, y=0.1)
    log_ticks(axes.yaxis, end)
    axes.set_xlabel("training samples", fontsize=LABEL)
    axes.set_ylabel("median relative L2 error (%)", fontsize=LABEL)
    annotate(axes, notes, marks, list(lines.values()))


def learning_lines(comparison: Comparison, dataset: str) -> tuple[Lines, int]:
    """Collect the learning curves of a dataset, and count the points without a finite error."""
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    left_out = 0
    for point in comparison.learning:
        if point.dataset != dataset:
            continue
        if point.error is None or not 0 < point.error.rel_l2_median < np.inf:
            left_out += 1
            continue
        line = found.setdefault((point.method, point.label), [])
        line.append((point.n_train, 100 * point.error.rel_l2_median))
    return {key: np.array(sorted(line), dtype=float) for key, line in found.items()}, left_out


def _most_gained(lines: Lines, names: dict[str, ShortName]) -> str:
    """Say which configuration gains most from more samples."""
    gains = {
        label: (points[0], points[-1]) for (_, label), points in lines.items() if len(points) > 1
    }
    label = min(gains, key=lambda key: gains[key][1][1] / gains[key][0][1])
    (few, before), (many, after) = gains[label]
    if after >= before:
        return f"No method gains from more samples, up to {many:,.0f}"
    return (
        f"{shortened(_name(names, label))} gains most from samples: {number(before)} % with "
        f"{few:,.0f}, {number(after)} % with {many:,.0f}"
    )


def _name(names: dict[str, ShortName], label: str) -> str:
    return str(names.get(label, label))


def loss_curves(comparison: Comparison, dataset: str) -> Picture | None:
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
    n_columns = min(2 if len(trained) <= 4 else 3, len(trained))
    n_rows = -(-len(trained) // n_columns)
    curves = {row.label: _curves(comparison, row) for rows in trained.values() for row in rows}
    finding = _still_falling(trained, curves)
    subject = f"{dataset}: loss over the training; each method has its own loss"
    figure = new_figure((3.2 if n_columns < 3 else 2.5) * n_rows, finding, subject)
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes in panels[len(trained) :]:
        axes.set_visible(False)
    notes = [
        _loss_panel(axes, rows, curves)
        for axes, rows in zip(panels, trained.values(), strict=False)
    ]
    for axes, labels in zip(panels, notes, strict=False):
        annotate(axes, labels)
    caption = (
        "Training loss from the beginning to the end of the training. "
        "Each method has its own unit of loss."
    )
    if any(len(held_out) for _, held_out in curves.values()):
        caption += " Dashed: loss on held-out samples."
    return Picture("loss-curves", "Loss curves", caption, figure, finding)


def _curves(comparison: Comparison, row: Row) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Training and held-out loss (n, 2): part of the training in percent, and positive loss."""
    samples, found = comparison.samples(row), []
    for name in ("loss_curve", "validation_curve"):
        losses = np.asarray(samples.get(name, ()), dtype=float)
        part = 100 * np.arange(1, len(losses) + 1) / max(len(losses), 1)
        shown = np.isfinite(losses) & (losses > 0)
        found.append(np.column_stack([part, losses])[shown])
    return found[0], found[1]


def _still_falling(
    trained: dict[str, list[Row]],
    curves: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> str:
    """Say whose held-out loss, or else training loss, falls most in the last part of training."""
    shown = []
    for method, rows in trained.items():
        for row in rows:
            training, held_out = curves[row.label]
            curve = held_out if len(held_out) > 1 else training
            shown.append((method, curve[:, 1]))
    return still_falling(shown)


def still_falling(shown: Sequence[tuple[str, NDArray[np.float64]]]) -> str:
    """Say which of some named loss curves falls most in the last part of the training."""
    falls: dict[str, float] = {}
    for method, losses in shown:
        if len(losses) > 1:
            n = max(1, round(LAST * len(losses)))
            before, after = np.median(losses[-2 * n : -n]), np.median(losses[-n:])
            falls[method] = max(falls.get(method, -np.inf), 1 - float(after / before))
    if not falls:
        return "Losses over the training"
    method = max(falls, key=lambda key: falls[key])
    if falls[method] < 0.05:
        return "No loss falls by more than 5 % in the last tenth of its training"
    return f"The loss of {shortened(method)} still falls by {100 * falls[method]:.0f} % at the end"


def _loss_panel(
    axes: Axes,
    rows: Sequence[Row],
    curves: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> list[Note]:
    """Draw the losses of one method's configurations; return the labels of the curves."""
    names, notes = short_names(rows), []
    colour = style_of(rows[0].method).colour
    dress(axes)
    for i, row in enumerate(rows):
        look = {"color": colour, "linewidth": 1.5, "alpha": 1 - 0.6 * i / max(len(rows), 1)}
        training, held_out = curves[row.label]
        for curve, line in ((training, "-"), (held_out, "--")):
            (drawn,) = axes.plot(*curve.T, linestyle=line, **look)  # type: ignore[arg-type]
            drawn.set_marker("o" if len(curve) == 1 else "")
        if len(training) and names[row.label].values:
            end = (float(training[-1, 0]), float(training[-1, 1]))
            text = shortened(names[row.label].values)
            notes.append(Note(text, [end], readable(colour), offsets=((-7, 9), (-7, -9), (-7, 20))))
        if len(held_out) and i == 0:
            end = (float(held_out[-1, 0]), float(held_out[-1, 1]))
            beside = ((-7, 10), (-7, -10), (-7, 22))
            notes.append(Note("held out", [end], readable(colour), offsets=beside))
    axes.set_yscale("log")
    axes.set_xlabel("part of the training (%)", fontsize=LABEL)
    axes.set_ylabel("loss", fontsize=LABEL)
    iterations = {row.training.iterations for row in rows if row.training}
    count = next(iter(iterations)) if len(iterations) == 1 else None
    title = shortened(rows[0].method) + (f", {count:,} iterations" if count else "")
    axes.set_title(plain(title), loc="left", fontsize=NOTE + 1, color=INK)
    return notes
