"""The figure of error against deformation: a dot per test sample, a panel per method."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mor_bench.report.canvas import (
    INK,
    LABEL,
    NOTE,
    Picture,
    dress,
    folded,
    length_unit,
    new_figure,
    plain,
    shortened,
)
from mor_bench.report.entries import SELECTED, Analysis, Entry, entries_of, selected_per_method
from mor_bench.report.method_styles import style_of
from mor_bench.report.number_format import number
from mor_bench.report.published_figures import SCENES, scene_of
from mor_bench.report.short_names import ShortName, short_names
from mor_bench.results.comparison import Comparison

MOST_PANELS = 12

FAR = 2.0
"""Samples above this multiple of the 99th percentile lie beyond the axis."""

CAPTION = (
    f"Each dot is a test sample. Each panel shows a method, with {SELECTED}. "
    "Full-order solves on the dataset's mesh are left out. "
    "The line is the least-squares line through the origin. "
    "Its slope (mm of error per m of deformation) compares methods at a glance. "
    "Every panel has its own vertical scale. "
    "Samples without a prediction are not drawn; the panel gives their number."
)


@dataclass(frozen=True)
class Samples:
    """A configuration with the largest displacement and the error e of its samples, m."""

    entry: Entry
    amplitude: NDArray[np.float64]
    e: NDArray[np.float64]

    @property
    def finite(self) -> NDArray[np.bool_]:
        return np.asarray(np.isfinite(self.e) & np.isfinite(self.amplitude))

    @property
    def slope(self) -> float | None:
        """Slope of the least-squares line through the origin; None without an error."""
        x, y = self.amplitude[self.finite], self.e[self.finite]
        return float(x @ y / (x @ x)) if len(x) and x.max() > 0 and y.max() > 0 else None


def error_against_deformation(
    comparison: Comparison, dataset: str, analysis: Analysis | None = None
) -> Picture | None:
    """Draw the error e of every test sample over its largest displacement.

    None if there are no raw samples with an error.
    """
    entries = entries_of(comparison, dataset, analysis)
    best = [e for e in selected_per_method(entries) if not e.row.reference]
    found = [s for e in best if (s := _read(comparison, e)) is not None]
    panels = [samples for samples in found if samples.slope is not None]
    if not panels:
        return None
    caption, left_out = CAPTION, [s.entry.method for s in found if s.slope is None]
    if left_out:
        caption += f" Without errors: {', '.join(left_out)}."
    if len(panels) > MOST_PANELS:
        panels.sort(key=lambda s: s.entry.error_bound)
        more = [s.entry.method for s in panels[MOST_PANELS:]]
        caption += f" Not drawn, because they are less accurate: {', '.join(more)}."
        panels = panels[:MOST_PANELS]
    scene = SCENES.get(scene_of(dataset))
    slope = scene.network.slope if scene else None
    if scene:
        largest = max(float(samples.amplitude.max()) for samples in panels)
        line = f"; the dashed line has its slope, {1e3 * slope:.3g} mm/m" if slope else ""
        line = line or ", without a slope"
        caption += (
            f" The paper's U-Mesh is on this scene with deformations of up to "
            f"{scene.amplitude_m:g} m{line}. The largest here is {number(largest)} m."
        )
    columns = min(3, len(panels))
    rows = ceil(len(panels) / columns)
    finding = _finding(panels)
    subject = f"{dataset}: mean error e over the largest displacement, a dot per test sample"
    if slope:
        subject += f"; dashed: the paper's U-Mesh, {number(1e3 * slope)} mm/m"
    figure = new_figure(0.4 + (2.3 if columns > 1 else 3.6) * rows, finding, subject)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel()[len(panels) :]:
        axes.set_visible(False)
    names = short_names([e.row for e in entries])
    x_unit = length_unit(max(float(s.amplitude[s.finite].max()) for s in panels))
    y_unit = length_unit(max(float(s.e[s.finite].max()) for s in panels))
    for axes, samples in zip(grid.ravel(), panels, strict=False):
        _panel(axes, samples, names[samples.entry.label], slope, (x_unit, y_unit))
    figure.supxlabel(f"largest nodal displacement of the reference ({x_unit[0]})", fontsize=LABEL)
    figure.supylabel(f"mean error per degree of freedom, e ({y_unit[0]})", fontsize=LABEL)
    return Picture(
        "error-against-deformation", "Error against deformation", caption, figure, finding
    )


def _read(comparison: Comparison, entry: Entry) -> Samples | None:
    try:
        arrays = comparison.samples(entry.row)
        return Samples(entry, np.asarray(arrays["amplitude_m"]), np.asarray(arrays["mean_dof_m"]))
    except (OSError, KeyError):
        return None


def _finding(panels: list[Samples]) -> str:
    """Name the methods with the smallest and the largest slope."""
    slopes = {s.entry.method: 1e3 * s.slope for s in panels if s.slope is not None}
    least, most = min(slopes, key=lambda m: slopes[m]), max(slopes, key=lambda m: slopes[m])
    text = f"Per metre of deformation, {shortened(least)} errs by {number(slopes[least])} mm"
    if least == most:
        return text
    return f"{text}, {shortened(most)} by {number(slopes[most])} mm"


def _panel(
    axes: Axes,
    samples: Samples,
    name: ShortName,
    published: float | None,
    units: tuple[tuple[str, float], tuple[str, float]],
) -> None:
    """Draw the samples of one configuration, and the paper's slope."""
    finite, slope = samples.finite, samples.slope or 0.0
    (_, x_unit), (unit, per_m) = units
    x, e = x_unit * samples.amplitude[finite], samples.e[finite]
    usual = FAR * float(np.percentile(e, 99))
    beyond = e > usual if usual > 0 else np.zeros(len(e), dtype=bool)
    top = float(e[~beyond].max())
    dress(axes)
    (dots,) = axes.plot(x[~beyond], per_m * e[~beyond], ".", rasterized=True)
    dots.set(color=style_of(samples.entry.method).colour, alpha=0.5, mew=0)
    dots.set_markersize(5 if len(x) > 300 else 9)
    axes.set_xlim(0, 1.05 * float(x.max()))
    axes.set_ylim(0, 1.12 * per_m * top)
    axes.axline((0, 0), slope=slope * per_m / x_unit, color=INK, linewidth=1.4)
    remarks = [f"slope {number(1e3 * slope)} mm/m"]
    if published is not None:
        dashes = (0, (4, 3))
        line = published * per_m / x_unit
        axes.axline((0, 0), slope=line, color=INK, linewidth=1.4, linestyle=dashes)
    if not finite.all():
        remarks.append(f"{int((~finite).sum())} of {len(finite)} without prediction")
    if beyond.any():
        remarks.append(f"↑ {int(beyond.sum())} up to {number(per_m * float(e.max()))} {unit}")
        height = np.full(int(beyond.sum()), 1.08 * per_m * top)
        axes.plot(x[beyond], height, "^", color=style_of(samples.entry.method).colour, ms=6)
    title = plain("\n".join([folded(str(name), 27), *remarks]))
    axes.set_title(title, fontsize=NOTE, loc="left", color=INK)
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_locator(MaxNLocator(4))
