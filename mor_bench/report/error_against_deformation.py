"""The figure of error against deformation: a dot per test sample, a panel per method."""

from __future__ import annotations

from math import ceil
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from mor_bench.report.canvas import (
    INK,
    LIGHT,
    Picture,
    Style,
    dress,
    new_figure,
    plain,
    shortened,
)
from mor_bench.report.entries import Entry, best_per_method, entries_of
from mor_bench.report.number_format import number, short_swept
from mor_bench.report.published_figures import SCENES, scene_of
from mor_bench.results.comparison import Comparison

CAPTION = (
    "Each dot is a test sample. Each panel shows a method's configuration "
    "with the smallest ē, of the validation part if there is one. "
    "The line is the least-squares line through the origin. "
    "Its slope (m of error per m of deformation) compares methods at a glance. "
    "Every panel has its own vertical scale. "
    "Samples without a prediction are not drawn; the panel gives their number."
)


def error_against_deformation(
    comparison: Comparison, dataset: str, styles: dict[str, Style]
) -> Picture | None:
    """Draw the error e of every test sample over its largest displacement.

    None if there are no raw samples.
    """
    panels = []
    for entry in best_per_method(entries_of(comparison, dataset)):
        try:
            arrays = comparison.samples(entry.row)
            panels.append(
                (entry, np.asarray(arrays["amplitude_m"]), np.asarray(arrays["mean_dof_m"]))
            )
        except (OSError, KeyError):
            continue
    if not panels:
        return None
    title, scene = "Error against deformation", SCENES.get(scene_of(dataset))
    caption, slope = CAPTION, scene.network.slope if scene else None
    if scene:
        largest = max(float(amplitude.max()) for _, amplitude, _ in panels)
        line = f"; the dashed line has its slope, {slope:g}" if slope else ", without a slope"
        caption += (
            f" The paper's U-Mesh is on this scene with deformations of up to "
            f"{scene.amplitude_m:g} m{line}. The largest here is {number(largest)} m."
        )
    columns = min(3, len(panels))
    rows = ceil(len(panels) / columns)
    figure = new_figure(0.6 + 2.7 * rows, f"{title} – {dataset}")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel()[len(panels) :]:
        axes.set_visible(False)
    for axes, (entry, amplitude, e) in zip(grid.ravel(), panels, strict=False):
        _panel(axes, entry, (amplitude, e), styles[entry.method], slope)
    figure.supxlabel("largest nodal displacement of the reference (m)", fontsize=10)
    figure.supylabel("mean error per dof, e (m)", fontsize=10)
    return Picture("error-against-deformation", title, caption, figure)


def _panel(
    axes: Axes,
    entry: Entry,
    samples: tuple[NDArray[np.float64], NDArray[np.float64]],
    style: Style,
    published: float | None,
) -> None:
    """Draw the samples (largest displacement, e) of one configuration, m, and the paper's slope."""
    amplitude, e = samples
    finite = np.isfinite(e) & np.isfinite(amplitude)
    x, y = amplitude[finite], e[finite]
    dress(axes)
    (dots,) = axes.plot(x, y, ".", color=style.colour, alpha=0.5, rasterized=True)
    dots.set(ms=4.5 if len(x) > 300 else 8, mew=0)
    name = f"{entry.method}\n{shortened(short_swept(entry.swept), 40)}".rstrip()
    axes.set_title(plain(name), fontsize=10, loc="left", color=INK)
    remarks = []
    if len(x) and x.max() > 0:
        slope = float(x @ y / (x @ x))
        axes.axline((0, 0), slope=slope, color=INK, linewidth=1.3)
        axes.set_xlim(0, 1.05 * float(x.max()))
        remarks.append(f"slope {slope:.1e}" if y.max() > 0 else "e = 0 on every sample")
        if published is not None and y.max() > 0:
            axes.axline((0, 0), slope=published, color=INK, linewidth=1.3, linestyle=(0, (4, 3)))
            remarks.append(f"paper's U-Mesh {published:.1e}")
    if len(y) and y.max() > 0:
        axes.set_ylim(0, 1.05 * float(y.max()))
    else:
        axes.yaxis.set_visible(False)
        axes.set_ylim(0, 1)
    if not finite.all():
        remarks.append(f"{int((~finite).sum())} of {len(e)} without prediction")
    frame = {"facecolor": "white", "edgecolor": LIGHT, "pad": 2.5}
    place: dict[str, Any] = {"xycoords": "axes fraction", "va": "top", "fontsize": 9, "color": INK}
    axes.annotate("\n".join(remarks), (0.04, 0.95), bbox=frame, **place)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{value:.1e}" if 0 < value < 1e-3 else f"{value:.3g}")
    )
