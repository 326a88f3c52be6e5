"""The map of the error over the load's position: load patches on the body, coloured by error."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, isfinite

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mor_bench.analysis.told import classes_of, given_by, told_text
from mor_bench.report.canvas import (
    GREY,
    INK,
    LABEL,
    NOTE,
    TICK,
    WIDTH_IN,
    Picture,
    folded,
    log_ticks,
    new_figure,
    plain,
    shortened,
    uncut,
)
from mor_bench.report.entries import Analysis, Entry, entries_of
from mor_bench.report.number_format import percent
from mor_bench.report.projection import View
from mor_bench.report.short_names import short_names
from mor_bench.results.comparison import Comparison
from mor_bench.scene.mesh import Mesh

BODY, BODY_EDGE = "#d9d9d9", "#b9b9b9"
COLOUR_MAP = "viridis_r"
AZIMUTH, ELEVATION = -68.0, 52.0
"""Direction of view, in degrees; from below if most loads act there."""

PANEL_IN = 2.8
"""Largest height of a panel, in inches."""

READING = (
    "Each dot is a load patch. Its colour is the median relative L2 error of the test samples with "
    "a load there. A cross marks an infinite median. Small grey dots are patches without a test "
    "sample. Each panel shows the most accurate configuration among the methods that are told the "
    "same, by the error that the verdict uses."
)


@dataclass(frozen=True)
class PatchErrors:
    """A configuration, what it is told, its errors at the patches, and its short name.

    An error is the median relative L2 error; it is NaN at a patch without a sample.
    """

    entry: Entry
    told: str
    errors: NDArray[np.float64]
    name: str

    @property
    def finite(self) -> NDArray[np.float64]:
        """Errors that a logarithmic scale can show."""
        return self.errors[np.isfinite(self.errors) & (self.errors > 0)]

    def sentence(self, centres: NDArray[np.float64]) -> str:
        """State the range of the error, and where it is largest."""
        if not len(self.finite):
            return ""
        low, high = self.finite.min(), self.finite.max()
        place = centres[np.flatnonzero(self.errors == high)[0]]
        where = ", ".join(f"{x:.3g}" for x in place)
        return (
            f"{self.entry.method}: {percent(low)} to {percent(high)} %, a factor of "
            f"{high / low:.2g}; most where the load acts around ({where}) m."
        )


def median_per_patch(
    errors: NDArray[np.float64], regions: NDArray[np.int64], n_patches: int
) -> NDArray[np.float64]:
    """Return the median error of the samples with a load on each patch; NaN without a sample.

    Parameters
    ----------
    errors : (n,) float64
    regions : (n, k) int64
        The loaded patches of each sample.
    n_patches : int
    """
    out = np.full(n_patches, np.nan)
    for patch in np.unique(regions):
        out[patch] = np.median(errors[(regions == patch).any(axis=1)])
    return out


def error_over_position(
    comparison: Comparison, dataset: str, analysis: Analysis | None = None
) -> Picture | None:
    """Draw the median error at each load patch, a panel for the best of each class of methods.

    None without the patches' centres or raw samples.
    """
    try:
        arrays = comparison.dataset_arrays(dataset)
        mesh = Mesh(np.asarray(arrays["points"]), np.asarray(arrays["cells"]))
        centres, regions = np.asarray(arrays["patch_centres"]), np.asarray(arrays["test_regions"])
    except (OSError, KeyError):
        return None
    maps, given = [], given_by(comparison, dataset)
    entries = entries_of(comparison, dataset, analysis)
    names = short_names([e.row for e in entries])
    for entry in _best_of_each_class(entries):
        try:
            relative = np.asarray(comparison.samples(entry.row)["relative_l2"])
        except (OSError, KeyError):
            continue
        errors = median_per_patch(relative, regions, len(centres))
        told = told_text(entry.row.told, given)
        maps.append(PatchErrors(entry, told, errors, str(names[entry.label])))
    finite = np.concatenate([np.zeros(0), *(found.finite for found in maps)])
    if not len(finite):
        return None
    low, high = uncut(finite)
    scale = LogNorm(100 * low, 100 * high * (1 + 1e-9))
    finding = _finding(maps)
    subject = f"{dataset}: error over the position of the load; a dot is a load patch"
    figure = _draw(mesh, centres, maps, scale, (finding, subject))
    details = " ".join(filter(None, (found.sentence(centres) for found in maps)))
    if float(finite.max()) > high * (1 + 1e-9):
        details += f" The colours end at {percent(high)} %; the largest error is "
        details += f"{percent(float(finite.max()))} %."
    title = "Error over the position of the load"
    return Picture("error-over-position", title, f"{details} {READING}", figure, finding)


def _finding(maps: list[PatchErrors]) -> str:
    """Say which method depends most on the position of the load."""
    spread = {
        found.name: float(found.finite.max() / found.finite.min())
        for found in maps
        if len(found.finite)
    }
    most = max(spread, key=lambda method: spread[method])
    least = min(spread, key=lambda method: spread[method])
    if spread[most] < 1.05 * spread[least]:
        return f"The error of {shortened(most)} varies {spread[most]:.2g}-fold with the position"
    least = min(spread, key=lambda method: spread[method])
    return (
        f"The position of the load changes the error of {shortened(most)} "
        f"{spread[most]:.2g}-fold, of {shortened(least)} {spread[least]:.2g}-fold"
    )


def _best_of_each_class(entries: list[Entry]) -> list[Entry]:
    """Return the most accurate configuration of each class; references are left out."""
    ran = [e for e in entries if e.ran and not e.row.reference and isfinite(e.error_bound)]
    return [
        min((e for e in ran if e.row.told == told), key=lambda e: e.error_bound)
        for told in classes_of(e.row for e in ran)
    ]


def _draw(
    mesh: Mesh,
    centres: NDArray[np.float64],
    maps: list[PatchErrors],
    scale: LogNorm,
    heading: tuple[str, str],
) -> Figure:
    """Draw a panel per map; `heading` is the finding and the subject."""
    columns = min(3, len(maps))
    rows = ceil(len(maps) / columns)
    above = centres[:, 2].mean() >= mesh.bounds[:, 2].mean()
    view = View(AZIMUTH, ELEVATION if above else -ELEVATION)
    screen = np.concatenate([view.project(mesh.points)[0], view.project(centres)[0]])
    margin = 0.04 * float(np.ptp(screen, axis=0).max())
    low, high = screen.min(axis=0) - margin, screen.max(axis=0) + margin
    wide, tall = high - low
    points_per_m = 72 * min(0.96 * WIDTH_IN / columns / wide, PANEL_IN / tall)
    figure = new_figure(0.75 + rows * (0.42 + points_per_m / 72 * tall), *heading)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for axes, found in zip(grid.ravel(), maps, strict=False):
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        view.draw_surface(axes, mesh.points, mesh.drawn_facets, (BODY, BODY_EDGE))
        _draw_patches(axes, view.project(centres)[0], found, scale, points_per_m)
    mappable = ScalarMappable(scale, COLOUR_MAP)
    most = max(float(found.finite.max(initial=0.0)) for found in maps)
    extend = "max" if 100 * most > (scale.vmax or np.inf) else "neither"
    bar = figure.colorbar(
        mappable, ax=grid, orientation="horizontal", aspect=50, pad=0.02, extend=extend
    )
    bar.ax.tick_params(labelsize=TICK)
    bar.set_label("median relative L2 error of the loads on a patch (%)", fontsize=LABEL, color=INK)
    log_ticks(bar.ax.xaxis, (scale.vmin or 1.0, scale.vmax or 1.0))
    return figure


def _draw_patches(
    axes: Axes,
    screen: NDArray[np.float64],
    found: PatchErrors,
    scale: LogNorm,
    points_per_m: float,
) -> None:
    """Draw the patches as dots that hardly overlap; errors without a finite value are crosses."""
    nearest = (
        np.asarray(cKDTree(screen).query(screen, k=2)[0])[:, 1] if len(screen) > 1 else np.ones(1)
    )
    size = float(np.clip(0.9 * np.median(nearest) * points_per_m, 4.0, 16.0))
    known = ~np.isnan(found.errors)
    axes.plot(*screen[~known].T, ".", color=GREY, ms=2.5, zorder=5)
    shown = known & np.isfinite(found.errors)
    axes.scatter(
        screen[shown, 0],
        screen[shown, 1],
        s=size**2,
        c=100 * found.errors[shown],
        norm=scale,
        cmap=COLOUR_MAP,
        linewidths=0.6,
        edgecolors="white",
        zorder=6,
    )
    axes.plot(*screen[known & ~shown].T, "x", color=INK, ms=size, zorder=6)
    title = plain(f"{folded(found.name, 30)}\ntold: {found.told}")
    axes.set_title(title, fontsize=NOTE, loc="left", color=INK)
