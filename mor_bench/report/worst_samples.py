"""The figure of worst test samples: predicted mesh over reference, in parallel projection."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from mor_bench.report.canvas import (
    GREY,
    INK,
    WIDTH_IN,
    Picture,
    Style,
    new_figure,
    plain,
    shortened,
)
from mor_bench.report.entries import Entry, best_per_method, entries_of
from mor_bench.report.number_format import metres, percent, short_swept
from mor_bench.report.projection import View, normals
from mor_bench.results.comparison import Comparison
from mor_bench.scene.mesh import Mesh

REFERENCE, REFERENCE_EDGE = "#7fb2d6", "#33607f"
REST, PREDICTION, FORCE = "#c4c4c4", "#D55E00", "#222222"

VIEW = View(azimuth=-68.0, elevation=20.0)
"""x points right, z points up; the faces y-min and z-max are visible."""

CAPTION = (
    "Each panel shows a method's configuration with the smallest ē (of the "
    "validation part if there is one), on its test sample "
    "with the largest e. A mean hides such samples. Samples without a prediction cannot "
    "be drawn; the title gives their number. Filled: the reference. Lines: the "
    "prediction. Grey: the body at rest. Deformations are not magnified, and all panels "
    "have the same scale. The arrow shows the direction and place of the force, not its "
    "size."
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


def worst_samples(comparison: Comparison, dataset: str, styles: dict[str, Style]) -> Picture | None:
    """Draw the worst sample of each method's best configuration; None if there are none."""
    try:
        arrays = comparison.dataset_arrays(dataset)
        mesh = Mesh(np.asarray(arrays["points"]), np.asarray(arrays["cells"]))
    except (OSError, KeyError):
        return None
    best = best_per_method(entries_of(comparison, dataset))
    samples = [sample for entry in best if (sample := _read(comparison, entry)) is not None]
    if not samples:
        return None
    columns = min(3 if len(samples) > 4 else 2, len(samples))
    rows = ceil(len(samples) / columns)
    arrows = [_arrow(mesh, sample) for sample in samples]
    limits = _limits(mesh, samples, arrows)
    tall = float(np.divide(*np.diff(limits, axis=0)[0, ::-1]))
    title = "Worst test sample of each method"
    height = 0.9 + rows * (0.45 + WIDTH_IN / columns * min(tall, 1.0))
    figure = new_figure(height, f"{title} – {dataset}")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for axes, sample, arrow in zip(grid.ravel(), samples, arrows, strict=False):
        axes.set_aspect("equal")
        axes.set_xlim(limits[0, 0], limits[1, 0])
        axes.set_ylim(limits[0, 1], limits[1, 1])
        _draw_sample(axes, mesh, sample, arrow)
    handles = [
        Line2D([], [], color=GREY, linewidth=0.8, label="at rest"),
        Patch(facecolor=REFERENCE, edgecolor=REFERENCE_EDGE, label="reference (full-order)"),
        Line2D([], [], color=PREDICTION, linewidth=1.5, label="prediction"),
        Line2D([], [], color=FORCE, linewidth=1.5, marker=">", label="total force"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return Picture("worst-samples", title, CAPTION, figure)


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
    loaded = mesh.boundary_facets[
        np.isin(mesh.boundary_facets, np.flatnonzero(size > 0)).any(axis=1)
    ]
    pushes = normals(points, loaded).sum(axis=0) @ total < 0
    return np.stack([place - arrow, place] if pushes else [place, place + arrow])


def _draw_sample(
    axes: Axes, mesh: Mesh, sample: WorstSample, arrow: NDArray[np.float64] | None
) -> None:
    facets = mesh.boundary_facets
    VIEW.draw_edges(axes, mesh.points, facets, {"colors": REST, "linewidths": 0.5, "zorder": 1})
    VIEW.draw_surface(axes, mesh.points + sample.reference, facets, (REFERENCE, REFERENCE_EDGE))
    predicted = np.asarray(np.isfinite(sample.prediction).all(axis=1))
    figures = "no prediction: the method failed on it"
    if predicted.any():
        points = mesh.points + sample.prediction
        whole = facets[predicted[facets].all(axis=1)]
        look = {"colors": PREDICTION, "linewidths": 0.9, "zorder": 4}
        VIEW.draw_edges(axes, points, whole[VIEW.facing(points, whole)], look)
        figures = f"e = {metres(sample.error_m)} m, relative L2 = {percent(sample.relative_l2)} %"
        if sample.entry.n_failed:
            figures += f"; {sample.entry.n_failed} failed"
    if arrow is not None:
        start, end = VIEW.project(arrow)[0]
        _draw_force(axes, start, end, float(np.linalg.norm(sample.forces.sum(axis=0))))
    name = shortened(f"{sample.entry.method}  {short_swept(sample.entry.swept)}".rstrip(), 44)
    axes.set_title(plain(f"{name}\n{figures}"), fontsize=9.5, loc="left", color=INK)


def _draw_force(
    axes: Axes, start: NDArray[np.float64], end: NDArray[np.float64], newton: float
) -> None:
    """Draw the arrow of the force with its size in N beside the upper end."""
    shape = {"arrowstyle": "-|>", "color": FORCE, "linewidth": 1.6, "shrinkA": 0, "shrinkB": 0}
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
        fontsize=8.5,
        color=FORCE,
        bbox=frame,
        zorder=6,
    )
