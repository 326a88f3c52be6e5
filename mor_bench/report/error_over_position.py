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

from mor_bench.analysis.told import classes_of, is_observed, told_text
from mor_bench.report.canvas import (
    GREY,
    INK,
    WIDTH_IN,
    Picture,
    log_ticks,
    new_figure,
    plain,
    shortened,
)
from mor_bench.report.entries import Entry, entries_of
from mor_bench.report.number_format import percent, short_swept
from mor_bench.report.projection import View
from mor_bench.results.comparison import Comparison
from mor_bench.scene.mesh import Mesh

BODY, BODY_EDGE = "#d9d9d9", "#b9b9b9"
COLOUR_MAP = "viridis_r"
AZIMUTH, ELEVATION = -68.0, 52.0
"""Direction of view, in degrees; from below if most loads act there."""

PANEL_IN = 3.4
"""Largest height of a panel, in inches."""

READING = (
    "Each dot is a load patch. Its colour is the median relative L2 error of the test samples with "
    "a load there. A cross marks an infinite median. Small grey dots are patches without a test "
    "sample. Each panel shows the configuration with the smallest ē among the methods that are "
    "told the same, selected on validation samples if there are any."
)


@dataclass(frozen=True)
class PatchErrors:
    """A configuration, what it is told, and its median relative L2 error at each patch.

    The error is NaN without a sample.
    """

    entry: Entry
    told: str
    errors: NDArray[np.float64]

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


def error_over_position(comparison: Comparison, dataset: str) -> Picture | None:
    """Draw the median error at each load patch, a panel for the best of each class of methods.

    None without the patches' centres or raw samples.
    """
    try:
        arrays = comparison.dataset_arrays(dataset)
        mesh = Mesh(np.asarray(arrays["points"]), np.asarray(arrays["cells"]))
        centres, regions = np.asarray(arrays["patch_centres"]), np.asarray(arrays["test_regions"])
    except (OSError, KeyError):
        return None
    maps, observed = [], is_observed(comparison, dataset)
    for entry in _best_of_each_class(entries_of(comparison, dataset)):
        try:
            relative = np.asarray(comparison.samples(entry.row)["relative_l2"])
        except (OSError, KeyError):
            continue
        errors = median_per_patch(relative, regions, len(centres))
        maps.append(PatchErrors(entry, told_text(entry.row.told, observed), errors))
    finite = np.concatenate([np.zeros(0), *(found.finite for found in maps)])
    if not len(finite):
        return None
    scale = LogNorm(100 * float(finite.min()), 100 * float(finite.max()) * (1 + 1e-9))
    title = "Error over the position of the load"
    figure = _draw(mesh, centres, maps, scale, f"{title} – {dataset}")
    finding = " ".join(filter(None, (found.sentence(centres) for found in maps)))
    return Picture("error-over-position", title, f"{finding} {READING}", figure, finding)


def _best_of_each_class(entries: list[Entry]) -> list[Entry]:
    """Return the configuration with the smallest ē of each class; references are left out."""
    ran = [e for e in entries if e.ran and not e.row.reference and isfinite(e.selecting_error_m)]
    return [
        min((e for e in ran if e.row.told == told), key=lambda e: e.selecting_error_m)
        for told in classes_of(e.row for e in ran)
    ]


def _draw(
    mesh: Mesh,
    centres: NDArray[np.float64],
    maps: list[PatchErrors],
    scale: LogNorm,
    title: str,
) -> Figure:
    columns = min(3, len(maps))
    rows = ceil(len(maps) / columns)
    above = centres[:, 2].mean() >= mesh.bounds[:, 2].mean()
    view = View(AZIMUTH, ELEVATION if above else -ELEVATION)
    screen = np.concatenate([view.project(mesh.points)[0], view.project(centres)[0]])
    margin = 0.04 * float(np.ptp(screen, axis=0).max())
    low, high = screen.min(axis=0) - margin, screen.max(axis=0) + margin
    wide, tall = high - low
    points_per_m = 72 * min(0.96 * WIDTH_IN / columns / wide, PANEL_IN / tall)
    figure = new_figure(1.2 + rows * (0.5 + points_per_m / 72 * tall), title)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for axes, found in zip(grid.ravel(), maps, strict=False):
        axes.set_aspect("equal")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        view.draw_surface(axes, mesh.points, mesh.boundary_facets, (BODY, BODY_EDGE))
        _draw_patches(axes, view.project(centres)[0], found, scale, points_per_m)
    mappable = ScalarMappable(scale, COLOUR_MAP)
    bar = figure.colorbar(mappable, ax=grid, orientation="horizontal", aspect=45, pad=0.02)
    bar.set_label("median relative L2 error of the loads on a patch (%)", fontsize=10, color=INK)
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
    name = shortened(f"{found.entry.method}  {short_swept(found.entry.swept)}".rstrip(), 44)
    axes.set_title(plain(f"{name}\ntold: {found.told}"), fontsize=9.5, loc="left", color=INK)
