"""Load patches: a uniform traction over a part of the surface that has a fixed area, as consistent nodal weights.

A force on a single node means a pressure that grows without bound as the mesh is refined, and inverts elements; a patch
of fixed area means the same load on every mesh.
"""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.mesh import Mesh

POINTS_PER_PATCH = 256
"""Surface quadrature points that a patch holds at least."""

MAX_SURFACE_POINTS = 200_000
"""More than these are a patch that is lost on its facet."""


def _midpoints(n_corners: int, m: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shape functions (n, n_corners) at the midpoints of the parts of a facet, and their derivatives (n, n_corners, 2).

    A quadrilateral is cut into m², a triangle into m² equal parts.
    """
    if n_corners == 4:
        s = (np.arange(m) + 0.5) / m
        x, y = (a.ravel() for a in np.meshgrid(s, s, indexing="ij"))
        shape = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=1)
        return shape, np.stack([np.stack([y - 1, 1 - y, y, -y], axis=1), np.stack([x - 1, -x, x, 1 - x], axis=1)], axis=2)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(m), np.arange(m), indexing="ij"))
    up = [(i + 1 / 3)[i + j < m] / m, (j + 1 / 3)[i + j < m] / m]
    down = [(i + 2 / 3)[i + j < m - 1] / m, (j + 2 / 3)[i + j < m - 1] / m]
    x, y = np.append(up[0], down[0]), np.append(up[1], down[1])
    return np.stack([1 - x - y, x, y], axis=1), np.tile(np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]]), (len(x), 1, 1))


def _surface_points(mesh: Mesh, facets: NDArray[np.int64], spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64], sp.csr_array]:
    """Positions (n, 3), areas (n,) and shape-function values (n, n_nodes) of midpoint-rule points on the facets."""
    corners, n_corners = mesh.points[facets], facets.shape[1]
    longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    m = max(2, ceil(longest / spacing))
    shape, derivatives = _midpoints(n_corners, m)
    positions = np.einsum("pa,fai->fpi", shape, corners)
    tangents = np.einsum("pad,fai->fpdi", derivatives, corners)
    areas = np.linalg.norm(np.cross(tangents[:, :, 0], tangents[:, :, 1]), axis=2) / m**2
    areas = areas if n_corners == 4 else 0.5 * areas
    rows = np.repeat(np.arange(areas.size), n_corners)
    columns = np.repeat(facets, len(shape), axis=0).ravel()
    values = sp.csr_array((np.tile(shape, (len(facets), 1)).ravel(), (rows, columns)), shape=(areas.size, mesh.n_nodes))
    return positions.reshape(-1, 3), areas.ravel(), values


def patch_shares(
    mesh: Mesh, centres: NDArray[np.int64], facets: NDArray[np.int64], area_m2: float
) -> tuple[sp.csr_array, NDArray[np.float64], sp.csr_array]:  # fmt: skip
    """Points on the surface, and the area of each that belongs to the patches around some nodes; see `patch_weights`.

    Returns
    -------
    areas : (n_patches, n_points) sparse float64
        m²; rows sum to the patch's area up to round-off.
    points : (n_points, 3) float64
        Positions, m.
    values : (n_points, n_nodes) sparse float64
        Shape functions of the mesh at the points.

    Raises
    ------
    SpecError
        If there is no facet, the facets are smaller than one patch, or so large that a patch is lost on one.
    """
    if len(facets) == 0:
        raise SpecError("the load region holds nodes but no facet of the surface, so no traction can act on it.")
    corners = mesh.points[facets]
    longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    least = POINTS_PER_PATCH * len(facets) * longest**2 / MAX_SURFACE_POINTS
    if area_m2 < least:
        raise SpecError(f"`patch_area_m2` must be at least {least:.3g}, for facets with edges of up to {longest:.3g} m; got {area_m2}.")
    positions, areas, values = _surface_points(mesh, facets, sqrt(area_m2 / POINTS_PER_PATCH))
    if area_m2 > areas.sum() * (1 + 1e-12):
        raise SpecError(f"`patch_area_m2` must be in (0, {areas.sum():.6g}], the area of the load region; got {area_m2}.")
    nearness = sqrt(area_m2) * 1e-9
    shares = sp.lil_array((len(centres), len(areas)))
    for row, node in enumerate(centres):
        distance = np.round(np.linalg.norm(positions - mesh.points[node], axis=1) / nearness)
        order = np.argsort(distance, kind="stable")
        # Points at the same distance enter together, each with the same fraction, so that a symmetric patch stays so.
        ends = np.flatnonzero(np.append(np.diff(distance[order]) > 0, True))
        filled = np.cumsum(areas[order])[ends]
        last = min(int(np.searchsorted(filled, area_m2)), len(ends) - 1)
        first_of_last = ends[last - 1] + 1 if last else 0
        before = filled[last - 1] if last else 0.0
        whole, partial = order[:first_of_last], order[first_of_last : ends[last] + 1]
        shares[row, whole] = areas[whole]
        shares[row, partial] = areas[partial] * (area_m2 - before) / (filled[last] - before)
    return shares.tocsr(), positions, values


def patch_weights(mesh: Mesh, centres: NDArray[np.int64], facets: NDArray[np.int64], area_m2: float) -> sp.csr_array:
    """Nodal weights of the patches around some nodes.

    The patch around a node is the part of the facets that lies nearest to it and has the given area, so that a patch
    at an edge is as large as one inside. A force F on the patch is the nodal forces ``weight * F`` (the consistent
    load of a uniform traction F / area).

    Parameters
    ----------
    mesh : Mesh
    centres : (n_patches,) int
        Node numbers.
    facets : (n_facets, 4 or 3) int
        The surface on which patches may lie.
    area_m2 : float
        Area of each patch, m².

    Returns
    -------
    (n_patches, n_nodes) sparse float64
        Each row sums to 1.

    Raises
    ------
    SpecError
        If there is no facet, the facets are smaller than one patch, or so large that a patch is lost on one.
    """
    areas, _, values = patch_shares(mesh, centres, facets, area_m2)
    weights = sp.csr_array(areas @ values)
    return sp.csr_array(weights.multiply(1.0 / weights.sum(axis=1)[:, None]))
