"""Bodies in parallel projection: their surfaces and edges as seen from one direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import NDArray

from mor_bench.report.method_styles import channels

Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """A direction of view; angles in degrees."""

    azimuth: float
    elevation: float

    def project(self, points: Array) -> tuple[Array, Array]:
        """Rotate points into screen coordinates (n, 2), m, and nearness to the viewer (n,), m."""
        towards, right, up = self.axes()
        return points @ np.stack([right, up]).T, points @ towards

    def axes(self) -> tuple[Array, Array, Array]:
        """Unit vectors towards the viewer, to the right and upwards on the screen."""
        azimuth, elevation = np.deg2rad([self.azimuth, self.elevation])
        ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
        towards = np.array([ce * ca, ce * sa, se])
        right = np.array([-sa, ca, 0.0])
        return towards, right, np.asarray(np.cross(towards, right))

    def facing(self, points: Array, facets: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mark the facets with a visible outer side."""
        return np.asarray(self.project(normals(points, facets))[1] > 0)

    def draw_edges(
        self, axes: Axes, points: Array, facets: NDArray[np.int64], look: dict[str, Any]
    ) -> None:
        """Draw every edge of some facets once."""
        pairs = np.stack([facets, np.roll(facets, -1, axis=1)], axis=-1).reshape(-1, 2)
        edges = np.unique(np.sort(pairs, axis=1), axis=0)
        axes.add_collection(LineCollection(list(self.project(points)[0][edges]), **look))

    def draw_surface(
        self, axes: Axes, points: Array, facets: NDArray[np.int64], colours: tuple[str | Array, str]
    ) -> None:
        """Draw visible facets from far to near; facets that face upwards are brighter.

        ``colours`` are those of the facets, such as ``#7fb2d6`` or one (n_facets, 3) each, and of
        their edges.
        """
        facing = self.facing(points, facets)
        seen = facets[facing]
        screen, nearness = self.project(points)
        order = np.argsort(nearness[seen].mean(axis=1))
        normal = normals(points, seen)
        up = normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)
        if isinstance(colours[0], str):
            base = np.array(channels(colours[0]))
            shade = 1.0 - 0.75 * (0.35 + 0.3 * np.clip(up, -1, 1))[:, None]
            faces = 1.0 - (1.0 - base) * np.clip(shade, 0.3, 1.0)
        else:  # colours that mean values stay near the colour scale
            faces = colours[0][facing] * (0.93 + 0.07 * np.clip(up, -1, 1))[:, None]
        axes.add_collection(
            PolyCollection(
                list(screen[seen[order]]),
                facecolors=faces[order],
                edgecolors=colours[1],
                linewidths=0.4,
                zorder=3,
            )
        )


def normals(points: Array, facets: NDArray[np.int64]) -> Array:
    """Outward normals (n_facets, 3); their length is twice the facet's area."""
    corners = points[facets]
    return np.asarray(np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1]))
