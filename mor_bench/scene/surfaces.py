"""Closed triangulated surfaces: readers of STL and OBJ, checks, and a test for enclosed points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.files import read_triangles
from mor_bench.scene.triangles import winding_numbers

FLAT = 1e-12
"""Volume that counts as round-off, as a fraction of the cubed diagonal of the bounding box."""


@dataclass(frozen=True)
class Surface:
    """A closed surface of triangles.

    Attributes
    ----------
    points : (n, 3) float64
        Positions, m.
    triangles : (m, 3) int64
        Point numbers, counter-clockwise as seen from outside the body.
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]

    @cached_property
    def volume_m3(self) -> float:
        """Volume of the body by the divergence theorem, m³; negative if oriented inwards."""
        a, b, c = np.moveaxis(self.points[self.triangles] - self.bounds.mean(axis=0), 1, 0)
        return float((a * np.cross(b, c)).sum() / 6)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest corner of the bounding box, m."""
        return np.array([self.points.min(axis=0), self.points.max(axis=0)])


def inside(surface: Surface, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each point (n, 3), m, lies in the body, by the surface's winding number.

    For a point on the surface, to round-off, the answer may be either.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    return np.asarray(winding_numbers(surface.points[surface.triangles], points) > 0.5)


def read_surface(path: str | Path, unit_m: float = 1.0) -> Surface:
    """Read a closed surface from an STL or OBJ file.

    Equal vertices are merged, polygons become fans of triangles, and a surface that is oriented
    inwards is reversed. Self-intersections of the surface are not detected.

    Parameters
    ----------
    path : str or Path
        A file name that ends in .stl or .obj.
    unit_m : float, default 1
        The file's unit of length, m; 0.01 for centimetres.

    Raises
    ------
    SpecError
        If the file is missing or unreadable, or has no triangles or a NaN. Also if its surface is
        not closed or not consistently oriented, or encloses nothing.
    """
    corners = read_triangles(Path(path), unit_m)
    # Adding zero turns -0.0 into 0.0, so vertices of neighbouring triangles are equal.
    vertices, number = np.unique(corners.reshape(-1, 3) + 0.0, axis=0, return_inverse=True)
    triangles = number.reshape(-1, 3)
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    if len(triangles) == 0:
        raise SpecError(f"{path}: a surface must hold triangles; got only points and lines.")
    try:
        return _turned_outwards(Surface(vertices, triangles))
    except SpecError as error:
        raise SpecError(f"{path}: {error}") from None


def _turned_outwards(surface: Surface) -> Surface:
    edges = surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    sharing = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    if n_open := int((sharing != 2).sum()):
        raise SpecError(
            f"the surface is not closed: {n_open} of its {len(sharing)} edges "
            "are not shared by exactly two triangles."
        )
    if n_twisted := len(edges) - len(np.unique(edges, axis=0)):
        raise SpecError(
            "the triangles are not consistently oriented: the orientation flips across "
            f"{n_twisted} of {len(sharing)} edges."
        )
    if abs(surface.volume_m3) <= FLAT * np.linalg.norm(np.diff(surface.bounds, axis=0)) ** 3:
        raise SpecError("the surface encloses no volume.")
    if surface.volume_m3 > 0:
        return surface
    return Surface(surface.points, surface.triangles[:, ::-1].copy())
