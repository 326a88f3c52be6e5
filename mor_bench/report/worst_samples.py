"""The figure of worst test samples: meshes coloured by their error, in parallel projection."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from mor_bench.analysis.selection_text import ERROR
from mor_bench.report.canvas import (
    DPI,
    GREY,
    INK,
    LABEL,
    NOTE,
    TICK,
    WIDTH_IN,
    Picture,
    folded,
    length_unit,
    log_ticks,
    new_figure,
    plain,
    shortened,
    uncut,
)
from mor_bench.report.entries import SELECTED, Analysis, Entry, entries_of, selected_per_method
from mor_bench.report.number_format import number, percent
from mor_bench.report.projection import View, normals
from mor_bench.report.rendering import WIRE, Look, Shot, show_shots
from mor_bench.report.short_names import short_names
from mor_bench.results.comparison import Comparison
from mor_bench.scene.mesh import Mesh

FORCE = "#B00020"
COLOUR_MAP = "viridis_r"

DECADES = 2.5
"""Decades of the colour scale below the largest error."""

MOST_PANELS = 12

VIEW = View(azimuth=-68.0, elevation=20.0)
"""x points right, z points up; the faces y-min and z-max are visible."""

CAPTION = (
    f"Each panel shows a method, with {SELECTED}, on its test sample "
    "with the largest e. A mean hides such samples. Full-order solves on the dataset's mesh are "
    "left out. Samples without a prediction cannot "
    "be drawn; the title gives their number. Colours: distance of each node of the prediction "
    "from the reference. Dark lines: the reference. Grey lines: the body at rest. Deformations "
    "are not magnified, and all panels have the same scale. The red arrow shows the direction and "
    "place of the force, not its size."
)


@dataclass(frozen=True)
class WorstSample:
    """The test sample with the largest e of a configuration; arrays are (n_nodes, 3).

    Attributes
    ----------
    entry : Entry
    prediction, reference : array
        Displacements, m; the prediction is NaN if there is none.
    forces : array
        Nodal forces, N.
    error_m, relative_l2 : float
        Errors of this sample.
    """

    entry: Entry
    prediction: NDArray[np.float64]
    reference: NDArray[np.float64]
    forces: NDArray[np.float64]
    error_m: float
    relative_l2: float

    @property
    def nodal_m(self) -> NDArray[np.float64]:
        """Distance of each node from the reference (n_nodes,), m; NaN without a prediction."""
        return np.asarray(np.linalg.norm(self.prediction - self.reference, axis=1))

    @property
    def largest_m(self) -> float:
        """Largest distance of a node, m; zero without a prediction."""
        found = self.nodal_m[np.isfinite(self.nodal_m)]
        return float(found.max(initial=0.0))


def worst_samples(
    comparison: Comparison, dataset: str, analysis: Analysis | None = None
) -> Picture | None:
    """Draw the worst sample of each method's best configuration; None if there are none."""
    try:
        arrays = comparison.dataset_arrays(dataset)
        mesh = Mesh(np.asarray(arrays["points"]), np.asarray(arrays["cells"]))
    except (OSError, KeyError):
        return None
    entries = entries_of(comparison, dataset, analysis)
    best = [e for e in selected_per_method(entries) if not e.row.reference]
    found = [s for e in best if (s := _read(comparison, e)) is not None]
    samples = [s for s in found if s.largest_m > 0 or not np.isfinite(s.error_m)]
    samples = sorted(samples, key=lambda s: s.largest_m)[:MOST_PANELS]
    if not samples:
        return None
    caption, drawn = CAPTION, {s.entry.method for s in samples}
    if left_out := [s.entry.method for s in found if s.entry.method not in drawn]:
        caption += (
            f" Not drawn, because without an error or with a larger one: {', '.join(left_out)}."
        )
    names = short_names([e.row for e in entries])
    titles = [str(names[s.entry.label]) for s in samples]
    figure, how = _draw(mesh, samples, titles, dataset)
    return Picture(
        "worst-samples",
        "Worst test sample of each method",
        f"{caption} {how}",
        figure,
        _finding(samples),
    )


def _draw(
    mesh: Mesh, samples: list[WorstSample], titles: list[str], dataset: str
) -> tuple[Figure, str]:
    """Draw a panel per sample; return also how the meshes were drawn, in a sentence."""
    columns = min(3 if len(samples) > 4 else 2, len(samples))
    rows = ceil(len(samples) / columns)
    arrows = [_arrow(mesh, sample) for sample in samples]
    limits = _limits(mesh, samples, arrows)
    tall = float(np.divide(*np.diff(limits, axis=0)[0, ::-1]))
    subject = f"{dataset}: of each method the test load with its largest mean error e, "
    subject += "coloured by the error of each node"
    height = 0.95 + rows * (0.66 + WIDTH_IN / columns * min(tall, 1.0))
    figure = new_figure(height, _finding(samples), subject)
    grid = figure.subplots(rows, columns, squeeze=False)
    high = uncut([s.largest_m for s in samples])[1]
    width = round(1.5 * DPI * WIDTH_IN / columns)
    colours = (high / 10**DECADES, high)
    look = Look(mesh.drawn_facets, VIEW, limits, colours, COLOUR_MAP, width)
    shots = [
        Shot(mesh.points + s.prediction, s.nodal_m, mesh.points + s.reference, mesh.points)
        for s in samples
    ]
    for axes in grid.ravel():
        axes.set_axis_off()
    panels = grid.ravel()[: len(samples)]
    how = show_shots(list(panels), shots, look)
    for axes, sample, arrow, title in zip(panels, samples, arrows, titles, strict=True):
        _write_panel(axes, sample, arrow, title)
    _draw_keys(figure, grid, look, max(s.largest_m for s in samples))
    return figure, how


def _draw_keys(figure: Figure, grid: NDArray[Any], look: Look, largest_m: float) -> None:
    """Draw the scale of the colours and the legend of the lines."""
    low, high = look.values
    unit, per_m = length_unit(high)
    bar = figure.colorbar(
        ScalarMappable(LogNorm(per_m * low, per_m * high), COLOUR_MAP),
        ax=grid,
        orientation="horizontal",
        aspect=50,
        pad=0.02,
        extend="both" if largest_m > 1.001 * high else "min",
    )
    bar.ax.tick_params(labelsize=TICK)
    log_ticks(bar.ax.xaxis, (per_m * low, per_m * high))
    bar.set_label(f"distance of each node from the reference ({unit})", fontsize=LABEL, color=INK)
    handles = [
        Line2D([], [], color=WIRE, linewidth=1.0, label="reference"),
        Line2D([], [], color=GREY, linewidth=0.8, label="at rest"),
        Line2D([], [], color=FORCE, linewidth=1.6, marker=">", label="total force"),
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=3, fontsize=NOTE, frameon=False
    )


def _finding(samples: list[WorstSample]) -> str:
    """Name the methods with the smallest and the largest error of a node on their worst sample."""
    answered = [s for s in samples if s.largest_m > 0]
    if not answered:
        return "No method predicts its worst sample"
    least, most = answered[0], answered[-1]
    unit, per_m = length_unit(most.largest_m)
    text = f"Where its mean error e is largest, {shortened(least.entry.method)} errs by up to "
    text += f"{number(per_m * least.largest_m)} {unit}"
    if least is most:
        return text
    return f"{text}, {shortened(most.entry.method)} by {number(per_m * most.largest_m)} {unit}"


def _read(comparison: Comparison, entry: Entry) -> WorstSample | None:
    try:
        arrays = comparison.samples(entry.row)
        e = np.asarray(arrays["mean_dof_m"])
        # A sample without a prediction cannot be drawn.
        worst = int(np.argmax(np.where(np.isfinite(e), e, -1.0)))
        prediction, reference, forces = (
            np.asarray(arrays[f"worst_{name}"], dtype=float)
            for name in ("prediction", "reference", "forces")
        )
        figures = float(e[worst]), float(arrays["relative_l2"][worst])
    except (OSError, KeyError, ValueError):
        return None
    return WorstSample(entry, prediction, reference, forces, *figures)


def _limits(
    mesh: Mesh, samples: list[WorstSample], arrows: list[NDArray[np.float64] | None]
) -> NDArray[np.float64]:
    """Screen box (2, 2) of all shapes and arrows.

    Displacements of wild predictions are clipped at half a diagonal of the body.
    """
    span = _diagonal(mesh)
    shapes = [mesh.points, *(arrow for arrow in arrows if arrow is not None)]
    for sample in samples:
        shapes.append(mesh.points + sample.reference)
        predicted = np.isfinite(sample.prediction).all(axis=1)
        shapes.append(
            (mesh.points + np.clip(sample.prediction, -0.5 * span, 0.5 * span))[predicted]
        )
    screen = np.concatenate([VIEW.project(shape)[0] for shape in shapes])
    margin = 0.06 * float(np.ptp(screen[:, 0]))
    return np.array([screen.min(axis=0) - margin, screen.max(axis=0) + margin])


def _diagonal(mesh: Mesh) -> float:
    return float(np.linalg.norm(np.diff(mesh.bounds, axis=0)))


def _arrow(mesh: Mesh, sample: WorstSample) -> NDArray[np.float64] | None:
    """Start and end (2, 3) of the total force: a push ends on the surface, a pull starts there."""
    size, total = np.linalg.norm(sample.forces, axis=1), sample.forces.sum(axis=0)
    if not size.sum() > 0 or not np.linalg.norm(total) > 0:
        return None
    points = mesh.points + sample.reference
    place = size @ points / size.sum()
    arrow = 0.16 * _diagonal(mesh) * total / np.linalg.norm(total)
    loaded = mesh.drawn_facets[np.isin(mesh.drawn_facets, np.flatnonzero(size > 0)).any(axis=1)]
    pushes = normals(points, loaded).sum(axis=0) @ total < 0
    return np.stack([place - arrow, place] if pushes else [place, place + arrow])


def _write_panel(
    axes: Axes, sample: WorstSample, arrow: NDArray[np.float64] | None, name: str
) -> None:
    """Write a panel's title, and draw the arrow of the force."""
    figures = "no prediction: the method failed on it"
    if np.isfinite(sample.prediction).all(axis=1).any():
        unit, per_m = length_unit(sample.largest_m)
        figures = f"up to {number(per_m * sample.largest_m)} {unit}"
        figures += f"\n{ERROR} {percent(sample.relative_l2)} %"
        if sample.entry.n_failed:
            figures += f"; {sample.entry.n_failed} failed"
    if arrow is not None:
        start, end = VIEW.project(arrow)[0]
        _draw_force(axes, start, end, float(np.linalg.norm(sample.forces.sum(axis=0))))
    title = plain(f"{folded(name, 30)}\n{figures}")
    axes.set_title(title, fontsize=NOTE, loc="left", color=INK)


def _draw_force(
    axes: Axes, start: NDArray[np.float64], end: NDArray[np.float64], newton: float
) -> None:
    """Draw the arrow of the force with its size in N beside the upper end."""
    shape = {"arrowstyle": "-|>", "color": FORCE, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (end[0], end[1]), (start[0], start[1]), arrowprops=shape, zorder=6)
    frame = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8}
    beside, other = (end, start) if end[1] > start[1] else (start, end)
    right = beside[0] >= other[0]
    place: dict[str, Any] = {
        "xytext": (4 if right else -4, 4),
        "textcoords": "offset points",
        "ha": "left" if right else "right",
        "va": "center",
    }
    axes.annotate(
        f"{newton:.2g} N",
        (beside[0], beside[1]),
        **place,
        fontsize=NOTE,
        color=FORCE,
        bbox=frame,
        zorder=6,
    )
