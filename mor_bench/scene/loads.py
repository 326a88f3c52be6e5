"""Load patches: a uniform traction over a part of the surface that has a fixed area, as consistent nodal weights.

A force on a single node means a pressure that grows without bound as the mesh is refined, and inverts elements; a patch
of fixed area means the same load on every mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi, sqrt

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError

POINTS_PER_PATCH = 256
"""Surface quadrature points that a patch holds at least."""

MAX_SURFACE_POINTS = 200_000
"""More than these are a patch that is lost on its facet."""

MAX_PIECES = 1_000_000
"""Of long triangles, cut up; thin ones need many."""


def _midpoints(n_corners: int, m: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shape functions (n, n_corners) at the midpoints of the parts of a facet, and their derivatives (n, n_corners, 2).

    A quadrilateral is cut into m², a triangle into m² equal parts.
    """
    if n_corners == 4:
        s = (np.arange(m) + 0.5) / m
        x, y = (a.ravel() for a in np.meshgrid(s, s, indexing="ij"))
        shape = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=1)
        return shape, np.stack(
            [np.stack([y - 1, 1 - y, y, -y], axis=1), np.stack([x - 1, -x, x, 1 - x], axis=1)],
            axis=2,
        )
    i, j = (a.ravel() for a in np.meshgrid(np.arange(m), np.arange(m), indexing="ij"))
    up = [(i + 1 / 3)[i + j < m] / m, (j + 1 / 3)[i + j < m] / m]
    down = [(i + 2 / 3)[i + j < m - 1] / m, (j + 2 / 3)[i + j < m - 1] / m]
    x, y = np.append(up[0], down[0]), np.append(up[1], down[1])
    return np.stack([1 - x - y, x, y], axis=1), np.tile(
        np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]]), (len(x), 1, 1)
    )


@dataclass(frozen=True)
class Facets:
    """The surface that loads act on: a mesh's own, or the smooth one that is embedded in a mesh.

    Attributes
    ----------
    points : (n_points, 3) float64
        m.
    facets : (n_facets, 4 or 3) int64
        Numbers of points, turned outwards.
    """

    points: NDArray[np.float64]
    facets: NDArray[np.int64]

    def within(self, points: NDArray[np.int64]) -> NDArray[np.int64]:
        """(n, 4 or 3) the facets all of whose corners are among some points."""
        inside = np.zeros(len(self.points), dtype=bool)
        inside[points] = True
        return self.facets[inside[self.facets].all(axis=1)]


@dataclass(frozen=True)
class Patches:
    """Load patches, cut out of the surface by the points of a midpoint rule.

    Attributes
    ----------
    areas : (n_patches, n_points) sparse float64
        Area of each point that belongs to a patch, m²; rows sum to the patch's area up to round-off.
    points : (n_points, 3) float64
        m.
    values : (n_points, n_surface_points) sparse float64
        The facets' shape functions at the points.
    normals : (n_points, 3) float64
        Outward, of unit length.
    """

    areas: sp.csr_array
    points: NDArray[np.float64]
    values: sp.csr_array
    normals: NDArray[np.float64]

    def mean_normals(self) -> NDArray[np.float64]:
        """(n_patches, 3) outward unit normals, each the mean over its patch."""
        sums = self.areas @ self.normals
        return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))


def _midpoint_rule(
    surface: Facets, facets: NDArray[np.int64], spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], sp.csr_array]:
    """Positions (n, 3), area vectors (n, 3) and shape-function values (n, n_surface_points) of points on the facets."""
    corners, n_corners = surface.points[facets], facets.shape[1]
    longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    m = max(2, ceil(longest / spacing))
    shape, derivatives = _midpoints(n_corners, m)
    positions = np.einsum("pa,fai->fpi", shape, corners)
    tangents = np.einsum("pad,fai->fpdi", derivatives, corners)
    areas = np.cross(tangents[:, :, 0], tangents[:, :, 1]) / m**2
    areas = areas if n_corners == 4 else 0.5 * areas
    n_points = len(facets) * len(shape)
    rows = np.repeat(np.arange(n_points), n_corners)
    columns = np.repeat(facets, len(shape), axis=0).ravel()
    values = sp.csr_array(
        (np.tile(shape, (len(facets), 1)).ravel(), (rows, columns)),
        shape=(n_points, len(surface.points)),
    )
    return positions.reshape(-1, 3), areas.reshape(-1, 3), values


def cut_patches(
    surface: Facets, facets: NDArray[np.int64], centres: NDArray[np.int64], area_m2: float
) -> Patches:
    """The patches around some points of a surface.

    The patch around a point is the part of the facets that lies nearest to it and has the given area, so that a patch
    at an edge is as large as one inside. A force F on it is a uniform traction F / area.

    Parameters
    ----------
    surface : Facets
    facets : (n_facets, 4 or 3) int
        The part of the surface on which patches may lie.
    centres : (n_patches,) int
        Numbers of points of the surface.
    area_m2 : float
        Area of each patch, m².

    Raises
    ------
    SpecError
        If there is no facet, the facets are smaller than one patch, or so large that a patch is lost on one.
    """
    if len(facets) == 0:
        raise SpecError(
            "the load region holds nodes but no facet of the surface, so no traction can act on it."
        )
    positions, vectors, values = _points(surface, facets, area_m2)
    areas = np.linalg.norm(vectors, axis=1)
    if area_m2 > areas.sum() * (1 + 1e-12):
        raise SpecError(
            f"`patch_area_m2` must be in (0, {areas.sum():.6g}], the area of the load region; got {area_m2}."
        )
    nearness = sqrt(area_m2) * 1e-9
    rows, columns, shares = [], [], []
    for row, centre in enumerate(surface.points[centres]):
        near, distance = _nearest(positions, areas, centre, area_m2)
        distance = np.round(distance / nearness)
        order = near[np.argsort(distance, kind="stable")]
        distance = np.sort(distance)
        # Points at the same distance enter together, each with the same fraction, so that a symmetric patch stays so.
        ends = np.flatnonzero(np.append(np.diff(distance) > 0, True))
        filled = np.cumsum(areas[order])[ends]
        last = min(int(np.searchsorted(filled, area_m2)), len(ends) - 1)
        first_of_last = ends[last - 1] + 1 if last else 0
        before = filled[last - 1] if last else 0.0
        own = areas[order[: ends[last] + 1]]
        own[first_of_last:] *= (area_m2 - before) / (filled[last] - before)
        rows.append(np.full(len(own), row))
        columns.append(order[: len(own)])
        shares.append(own)
    at = np.concatenate(rows), np.concatenate(columns)
    cut = sp.csr_array((np.concatenate(shares), at), shape=(len(centres), len(areas)))
    return Patches(cut, positions, values, vectors / areas[:, None])


def _nearest(
    positions: NDArray[np.float64],
    areas: NDArray[np.float64],
    centre: NDArray[np.float64],
    area_m2: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rising numbers of points around a centre that have more than the wanted area together, or of all; and their distances, m."""
    distance = np.linalg.norm(positions - centre, axis=1)
    reach = 2 * sqrt(area_m2 / pi)
    while reach < distance.max():
        # Points about as far as the furthest one belong together; none of them may be left out.
        near = np.flatnonzero(distance <= reach)
        if areas[distance <= 0.999 * reach].sum() > area_m2:
            return near, distance[near]
        reach *= 2
    return np.arange(len(distance)), distance


def _points(
    surface: Facets, facets: NDArray[np.int64], area_m2: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], sp.csr_array]:
    """As `_midpoint_rule`, after long triangles have been halved, and again, until there are few enough points."""
    spacing = sqrt(area_m2 / POINTS_PER_PATCH)
    longest = _longest_edge(surface.points[facets])
    if len(facets) * max(2, ceil(longest / spacing)) ** 2 <= MAX_SURFACE_POINTS:
        return _midpoint_rule(surface, facets, spacing)
    if facets.shape[1] == 3:
        pieces, to_corners = _halved(surface, facets, 2 * spacing)
        if len(pieces.facets) <= MAX_PIECES:
            corners = pieces.points[pieces.facets]
            vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            mean = sp.csr_array(sp.kron(sp.eye_array(len(corners)), np.full((1, 3), 1 / 3)))
            return corners.mean(axis=1), vectors, sp.csr_array(mean @ to_corners)
    least = POINTS_PER_PATCH * len(facets) * longest**2 / MAX_SURFACE_POINTS
    raise SpecError(
        f"`patch_area_m2` must be at least about {least:.3g}, for facets with edges of up to {longest:.3g} m; got {area_m2}."
    )


def _longest_edge(corners: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())


def _halved(
    surface: Facets, facets: NDArray[np.int64], length: float
) -> tuple[Facets, sp.csr_array]:
    """Triangles cut across their longest edges until none is longer than a length, m.

    Returns
    -------
    pieces : Facets
        With three points of its own for each triangle.
    to_corners : (3 n_pieces, n_surface_points) sparse float64
        Takes values at the surface's points to those of the pieces.
    """
    owner, shares = np.arange(len(facets)), np.tile(np.eye(3), (len(facets), 1, 1))
    while True:
        corners = np.einsum("pca,pai->pci", shares, surface.points[facets[owner]])
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        first = edges.argmax(axis=1)
        long = edges.max(axis=1) > length
        if not long.any() or len(owner) > MAX_PIECES:
            break
        rows, a = np.arange(long.sum()), first[long]
        one, other = shares[long].copy(), shares[long].copy()
        middle = 0.5 * (one[rows, a] + one[rows, (a + 1) % 3])
        one[rows, (a + 1) % 3], other[rows, a] = middle, middle
        owner, shares = (
            np.concatenate([owner[~long], owner[long], owner[long]]),
            np.concatenate([shares[~long], one, other]),
        )
    n = 3 * len(owner)
    at = np.repeat(np.arange(n), 3), np.repeat(facets[owner], 3, axis=0).ravel()
    return Facets(corners.reshape(-1, 3), np.arange(n).reshape(-1, 3)), sp.csr_array(
        (shares.ravel(), at), shape=(n, len(surface.points))
    )


def spread_out(points: NDArray[np.float64], n: int) -> NDArray[np.int64]:
    """Numbers of n points that lie evenly among all, by farthest-point sampling from the one nearest to their mean; sorted."""
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())]
    distance = np.full(len(points), np.inf)
    while len(chosen) < n:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return np.sort(chosen)
