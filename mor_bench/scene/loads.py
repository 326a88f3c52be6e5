"""Load patches: a uniform traction on a surface of fixed area, as consistent weights.

A force on a single node is a pressure that grows without bound under mesh refinement and inverts
elements. A patch of fixed area is the same load on every mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, pi, sqrt

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.mesh import corners_of
from mor_bench.scene.triangle_rules import DEGREE_2, quadratic_triangle

POINTS_PER_PATCH = 256
"""Least number of surface quadrature points in a patch."""

POINTS_PER_LINE = 1024
"""Quadrature points of a line. A midpoint rule gives the resultant and its moment exactly."""

FINE_PARTS = 16
"""Parts of an edge of a pressed facet, for meshes whose facets are divided."""
MAX_SURFACE_POINTS = 200_000
"""Largest number of quadrature points. A patch that needs more is tiny compared with its facet."""

MAX_PIECES = 1_000_000
"""Largest number of pieces of long triangles. Thin triangles need many pieces."""


@dataclass(frozen=True)
class Facets:
    """The surface that loads act on: a mesh's boundary, or a smooth surface embedded in a mesh.

    Attributes
    ----------
    points : (n_points, 3) float64
        Positions, m.
    facets : (n_facets, 4, 3 or 6) int64
        Point numbers, oriented outwards. Six are the corners and the middles of a triangle's edges.
    """

    points: NDArray[np.float64]
    facets: NDArray[np.int64]

    def within(self, points: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the facets (n, 4, 3 or 6) with all nodes among some points."""
        inside = np.zeros(len(self.points), dtype=bool)
        inside[points] = True
        return self.facets[inside[self.facets].all(axis=1)]


@dataclass(frozen=True)
class _Quadrature:
    """Points of a quadrature rule on facets.

    Attributes
    ----------
    points : (n_points, 3) float64
        Positions, m.
    vectors : (n_points, 3) float64
        Outward normals whose lengths are the points' areas, m².
    values : (n_points, n_surface_points) sparse float64
        Shape functions of the facets at the points.
    """

    points: NDArray[np.float64]
    vectors: NDArray[np.float64]
    values: sp.csr_array


@dataclass(frozen=True)
class Patches:
    """Load patches on a surface, given by the points of a quadrature rule.

    Attributes
    ----------
    areas : (n_patches, n_points) sparse float64
        Area of each point in a patch, m²; rows sum to the patch's area up to round-off.
    points : (n_points, 3) float64
        Positions, m.
    values : (n_points, n_surface_points) sparse float64
        Shape functions of the facets at the points.
    normals : (n_points, 3) float64
        Outward unit normals.
    """

    areas: sp.csr_array
    points: NDArray[np.float64]
    values: sp.csr_array
    normals: NDArray[np.float64]

    def normal_sums(self) -> NDArray[np.float64]:
        """Return the integral (n_patches, 3) of the normal over each patch, m²."""
        return np.asarray(self.areas @ self.normals)

    def mean_normals(self) -> NDArray[np.float64]:
        """Return outward unit normals (n_patches, 3), each in the direction of the patch's mean."""
        sums = self.normal_sums()
        return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))


def cut_patches(
    surface: Facets, facets: NDArray[np.int64], centres: NDArray[np.int64], area_m2: float
) -> Patches:
    """Return the patches around some points of a surface.

    A patch is the nearest part of the facets with the given area. So a patch at an edge is as large
    as any other. A force F on it is a uniform traction F / area.

    Parameters
    ----------
    surface : Facets
    facets : (n_facets, 4, 3 or 6) int
        The part of the surface on which patches may lie.
    centres : (n_patches,) int
        Numbers of points of the surface.
    area_m2 : float
        Area of each patch, m².

    Raises
    ------
    SpecError
        If there is no facet, or the facets are smaller than one patch, or too large for one.
    """
    if len(facets) == 0:
        raise SpecError(
            "the load region holds nodes but no facet of the surface, so no traction can act on it."
        )
    rule = _quadrature(surface, facets, area_m2)
    areas = np.linalg.norm(rule.vectors, axis=1)
    if area_m2 > areas.sum() * (1 + 1e-12):
        raise SpecError(
            f"`patch_area_m2` must be in (0, {areas.sum():.6g}], the area of the load region; "
            f"got {area_m2}."
        )
    cut = [_shares(rule.points, areas, centre, area_m2) for centre in surface.points[centres]]
    rows = np.repeat(np.arange(len(cut)), [len(own) for _, own in cut])
    at = rows, np.concatenate([columns for columns, _ in cut])
    own = np.concatenate([own for _, own in cut])
    shares = sp.csr_array((own, at), shape=(len(centres), len(areas)))
    return Patches(shares, rule.points, rule.values, rule.vectors / areas[:, None])


def pressed_patches(
    surface: Facets, regions: Sequence[NDArray[np.int64]], *, fine: bool = False
) -> Patches:
    """Return three patches for each region of facets: the parts of a pressure along x, y and z.

    The "areas" of patch 3 k + i are the components i of the area vectors of region k. Their sum is
    that of the closed surface's normal, so it may be zero or negative. A pressure p on the region
    is the traction -p e_i on each of its patches.

    Parameters
    ----------
    surface : Facets
    regions : sequence of (n_facets, n_corners) int64
        Facets of each region.
    fine : bool
        Whether the points serve meshes with divided facets too. Few points per facet give the
        consistent load of its own mesh, and forces at single nodes of a fine one.
    """
    if fine:
        rules = [
            _divided_rule(surface, facets, _fine_spacing(surface, facets)) for facets in regions
        ]
    else:
        rules = [_quadrature(surface, facets, _area(surface, facets)) for facets in regions]
    vectors = [rule.vectors for rule in rules]
    areas = np.concatenate([np.linalg.norm(v, axis=1) for v in vectors])
    return Patches(
        sp.csr_array(sp.block_diag([v.T for v in vectors])),
        np.concatenate([rule.points for rule in rules]),
        sp.csr_array(sp.vstack([rule.values for rule in rules])),
        np.concatenate(vectors) / areas[:, None],
    )


def point_patches(surface: Facets, nodes: NDArray[np.int64]) -> Patches:
    """Return patches that are single points of a surface; their "areas" are 1."""
    shape = len(nodes), len(surface.points)
    values = sp.csr_array((np.ones(len(nodes)), (np.arange(len(nodes)), nodes)), shape=shape)
    return Patches(
        sp.csr_array(sp.eye_array(len(nodes))),
        surface.points[nodes],
        values,
        np.zeros((len(nodes), 3)),
    )


def line_patches(lines: Sequence[Sequence[Sequence[float]]]) -> Patches:
    """Return patches that are straight lines between two points; their "areas" are lengths, m.

    They have no shape functions on the surface: a mesh interpolates to their points.
    """
    ends = np.array(lines)
    along = (np.arange(POINTS_PER_LINE) + 0.5) / POINTS_PER_LINE
    points = ends[:, None, 0] + along[:, None] * (ends[:, 1] - ends[:, 0])[:, None]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / POINTS_PER_LINE
    areas = sp.block_diag([np.full((1, POINTS_PER_LINE), length) for length in lengths])
    n = len(ends) * POINTS_PER_LINE
    return Patches(
        sp.csr_array(areas), points.reshape(-1, 3), sp.csr_array((n, 0)), np.zeros((n, 3))
    )


def _area(surface: Facets, facets: NDArray[np.int64]) -> float:
    """Return the area of facets, m²; of a warped quadrilateral, that of two triangles."""
    corners = surface.points[corners_of(facets)]
    halves = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
    crosses = [np.cross(h[:, 1] - h[:, 0], h[:, 2] - h[:, 0]) for h in halves]
    return float(sum(0.5 * np.linalg.norm(cross, axis=1).sum() for cross in crosses))


def _shares(
    points: NDArray[np.float64],
    areas: NDArray[np.float64],
    centre: NDArray[np.float64],
    area_m2: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the points of one patch by their numbers, and their areas in it, m²."""
    near, distance = _nearest(points, areas, centre, area_m2)
    distance = np.round(distance / (sqrt(area_m2) * 1e-9))
    order = near[np.argsort(distance, kind="stable")]
    distance = np.sort(distance)
    # Points at the same distance get the same fraction, so a symmetric patch stays symmetric.
    ends = np.flatnonzero(np.append(np.diff(distance) > 0, True))
    filled = np.cumsum(areas[order])[ends]
    last = min(int(np.searchsorted(filled, area_m2)), len(ends) - 1)
    first_of_last = ends[last - 1] + 1 if last else 0
    before = filled[last - 1] if last else 0.0
    order = order[: ends[last] + 1]
    own = areas[order]
    own[first_of_last:] *= (area_m2 - before) / (filled[last] - before)
    return order, own


def _nearest(
    points: NDArray[np.float64],
    areas: NDArray[np.float64],
    centre: NDArray[np.float64],
    area_m2: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return points around a centre with enough area, or all points; and their distances, m."""
    distance = np.linalg.norm(points - centre, axis=1)
    reach = 2 * sqrt(area_m2 / pi)
    while reach < distance.max():
        # A margin of 0.1 % keeps points at about the same distance together.
        near = np.flatnonzero(distance <= reach)
        if areas[distance <= 0.999 * reach].sum() > area_m2:
            return near, distance[near]
        reach *= 2
    return np.arange(len(distance)), distance


def _quadrature(surface: Facets, facets: NDArray[np.int64], area_m2: float) -> _Quadrature:
    """Return a rule for each part of equally divided facets.

    If it has too many points, long triangles are halved instead.
    """
    spacing = sqrt(area_m2 / POINTS_PER_PATCH)
    if facets.shape[1] == 6:
        spacing *= sqrt(len(DEGREE_2))  # each part has more points
    longest = _longest_edge(surface.points[corners_of(facets)])
    per_part = len(DEGREE_2) if facets.shape[1] == 6 else 1
    if len(facets) * per_part * max(2, ceil(longest / spacing)) ** 2 <= MAX_SURFACE_POINTS:
        return _divided_rule(surface, facets, spacing)
    if facets.shape[1] == 3:
        corners, to_corners = _halved(surface, facets, 2 * spacing)
        if len(corners) <= MAX_PIECES:
            vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            mean = sp.csr_array(sp.kron(sp.eye_array(len(corners)), np.full((1, 3), 1 / 3)))
            return _Quadrature(corners.mean(axis=1), vectors, sp.csr_array(mean @ to_corners))
    least = POINTS_PER_PATCH * len(facets) * longest**2 / MAX_SURFACE_POINTS
    raise SpecError(
        f"`patch_area_m2` must be at least about {least:.3g} m², because facets have edges "
        f"of up to {longest:.3g} m; got {area_m2}."
    )


def _fine_spacing(surface: Facets, facets: NDArray[np.int64]) -> float:
    """Return the distance of points, m, that divides edges into `FINE_PARTS`, or fewer parts."""
    per_part = len(DEGREE_2) if facets.shape[1] == 6 else 1
    most = int(sqrt(MAX_SURFACE_POINTS / (len(facets) * per_part)))
    return _longest_edge(surface.points[corners_of(facets)]) / max(1, min(FINE_PARTS, most))


def _longest_edge(corners: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())


def _divided_rule(surface: Facets, facets: NDArray[np.int64], spacing: float) -> _Quadrature:
    corners, n_corners = surface.points[facets], facets.shape[1]
    m = max(2, ceil(_longest_edge(surface.points[corners_of(facets)]) / spacing))
    shape, derivatives = _points_of(n_corners, m)
    positions = np.einsum("pa,fai->fpi", shape, corners)
    tangents = np.einsum("pad,fai->fpdi", derivatives, corners)
    areas = np.cross(tangents[:, :, 0], tangents[:, :, 1]) / m**2
    areas = areas * {4: 1.0, 3: 0.5, 6: 0.5 / len(DEGREE_2)}[n_corners]
    n_points = len(facets) * len(shape)
    rows = np.repeat(np.arange(n_points), n_corners)
    columns = np.repeat(facets, len(shape), axis=0).ravel()
    values = np.tile(shape, (len(facets), 1)).ravel()
    matrix = sp.csr_array((values, (rows, columns)), shape=(n_points, len(surface.points)))
    return _Quadrature(positions.reshape(-1, 3), areas.reshape(-1, 3), matrix)


def _points_of(n_corners: int, m: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return shape functions (n, n_corners) and derivatives (n, n_corners, 2) at points.

    They are the midpoints of the m² equal parts of a quadrilateral or triangle. On a facet of six
    nodes each part has three points, so that its consistent load is exact.
    """
    i, j = (a.ravel() for a in np.meshgrid(np.arange(m), np.arange(m), indexing="ij"))
    if n_corners == 4:
        x, y = (i + 0.5) / m, (j + 0.5) / m
        shape = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=1)
        along_x = np.stack([y - 1, 1 - y, y, -y], axis=1)
        along_y = np.stack([x - 1, -x, x, 1 - x], axis=1)
        return shape, np.stack([along_x, along_y], axis=2)
    up, down = i + j < m, i + j < m - 1
    x = np.append((i + 1 / 3)[up] / m, (i + 2 / 3)[down] / m)
    y = np.append((j + 1 / 3)[up] / m, (j + 2 / 3)[down] / m)
    if n_corners == 6:
        # Parts that point down have the same second moments, so the same points serve them.
        away = (DEGREE_2 - 1 / 3) / m
        at = np.stack([x, y], axis=1)[:, None] + away
        return quadratic_triangle(at.reshape(-1, 2))
    gradients = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    return np.stack([1 - x - y, x, y], axis=1), np.tile(gradients, (len(x), 1, 1))


def _halved(
    surface: Facets, facets: NDArray[np.int64], length: float
) -> tuple[NDArray[np.float64], sp.csr_array]:
    """Cut triangles across their longest edges until no edge is longer than a length, m.

    Returns the corners (n_pieces, 3, 3) float64, m, and a sparse map (3 n_pieces, n_surface_points)
    from values at the surface's points to values at the corners.
    """
    owner, shares = np.arange(len(facets)), np.tile(np.eye(3), (len(facets), 1, 1))
    while True:
        corners = np.einsum("pca,pai->pci", shares, surface.points[facets[owner]])
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        long = edges.max(axis=1) > length
        if not long.any() or len(owner) > MAX_PIECES:
            break
        rows, a = np.arange(long.sum()), edges.argmax(axis=1)[long]
        one, other = shares[long].copy(), shares[long].copy()
        middle = 0.5 * (one[rows, a] + one[rows, (a + 1) % 3])
        one[rows, (a + 1) % 3], other[rows, a] = middle, middle
        owner = np.concatenate([owner[~long], owner[long], owner[long]])
        shares = np.concatenate([shares[~long], one, other])
    n = 3 * len(owner)
    at = np.repeat(np.arange(n), 3), np.repeat(facets[owner], 3, axis=0).ravel()
    return corners, sp.csr_array((shares.ravel(), at), shape=(n, len(surface.points)))


def spread_out(points: NDArray[np.float64], n: int) -> NDArray[np.int64]:
    """Return the sorted numbers of n evenly distributed points, by farthest-point sampling.

    The first is the point nearest to the mean of all points.
    """
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())]
    distance = np.full(len(points), np.inf)
    while len(chosen) < n:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return np.sort(chosen)
