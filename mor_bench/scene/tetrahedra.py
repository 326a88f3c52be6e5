"""Tetrahedral meshes of level sets by isosurface stuffing (Labelle & Shewchuk, SIGGRAPH 2007).

The lattice is body-centred cubic: it consists of the corners and centres of cubes. Each
tetrahedron has two neighbouring centres and an edge of the face between them. Long edges join two
corners or two centres. Short edges, √3/2 as long, join a corner and a centre. A lattice point close
to the surface moves onto it. Then tetrahedra that still cross the surface are cut. The authors
prove dihedral angles between 10.7° and 164.8° for their stencils. Some diagonals here may differ.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.mesh import Mesh

Level = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Maps points (n, 3), m, to values (n,): negative inside, 0 on the surface, positive outside."""

CLOSE_LONG, CLOSE_SHORT = 0.24999, 0.41189
"""Fractions of a long and of a short edge within which a lattice point moves onto the surface.

The values give the best smallest angle in the paper's table 1.
"""

BISECTIONS = 60


def _lattice(
    bounds: NDArray[np.float64], spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return points (n, 3), tetrahedra (m, 4) and coordinates (n, 3) of a lattice over bounds.

    The coordinates are integers, in half cubes. The first and last edge of a tetrahedron are long.
    """
    n = np.ceil((bounds[1] - bounds[0]) / spacing).astype(np.int64) + 2
    start = bounds.mean(axis=0) - spacing * n / 2
    shape = tuple(2 * n + 1)
    axes = np.meshgrid(*(np.arange(k) for k in n), indexing="ij")
    centre = 1 + 2 * np.stack(axes, axis=-1).reshape(-1, 3)
    tetrahedra = []
    for axis in range(3):
        along, *across = np.roll(np.eye(3, dtype=np.int64), -axis, axis=0)
        near = centre[centre[:, axis] < 2 * n[axis] - 1]
        signs = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
        ring = [near + along + s * across[0] + t * across[1] for s, t in signs]
        for k in range(4):
            corners = np.stack([near, near + 2 * along, ring[k], ring[(k + 1) % 4]], axis=1)
            tetrahedra.append(np.ravel_multi_index(tuple(np.moveaxis(corners, 2, 0)), shape))
    used, cells = np.unique(np.concatenate(tetrahedra), return_inverse=True)
    places = np.stack(np.unravel_index(used, shape), axis=1)
    return start + spacing / 2 * places, cells.reshape(-1, 4), places


def _crossed_edges(cells: NDArray[np.int64], side: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the distinct edges (n, 2) of tetrahedra (m, 4) from an inner to an outer point.

    A point's side is 1 inside, 0 on the surface, or -1 outside.
    """
    pairs = np.array([*permutations(range(4), 2)])
    edges = cells[(side[cells] < 0).any(axis=1)][:, pairs].reshape(-1, 2)
    first, last = edges[(side[edges[:, 0]] > 0) & (side[edges[:, 1]] < 0)].T
    return np.stack(np.divmod(np.unique(first * len(side) + last), len(side)), axis=1)


def _crossings(
    level: Level, points: NDArray[np.float64], edges: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the position (n,) in [0, 1] of the surface along edges (n, 2), by bisection."""
    low, high = np.zeros(len(edges)), np.ones(len(edges))
    start, step = points[edges[:, 0]], points[edges[:, 1]] - points[edges[:, 0]]
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        is_inside = level(start + middle[:, None] * step) < 0
        low, high = np.where(is_inside, middle, low), np.where(is_inside, high, middle)
    return 0.5 * (low + high)


def _prisms(
    top: NDArray[np.int64], bottom: NDArray[np.int64], rank: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return three tetrahedra (3n, 4) for each prism between triangles (n, 3) and (n, 3).

    Diagonals of its sides start at the top point of higher rank.
    """
    order = np.argsort(-rank, axis=1)
    a, b, c = np.take_along_axis(top, order, axis=1).T
    x, y, z = np.take_along_axis(bottom, order, axis=1).T
    return np.concatenate([np.stack(t, axis=1) for t in [(a, b, c, z), (a, b, y, z), (a, x, y, z)]])


def _snap(
    points: NDArray[np.float64],
    edges: NDArray[np.int64],
    at: NDArray[np.float64],
    close: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Move points onto their nearest crossing if it is close, in place; return the moved points.

    Edges (n, 2) have a crossing at the fraction `at` (n,) of their length. It is close within the
    fraction `close` (n,).
    """
    step = points[edges[:, 1]] - points[edges[:, 0]]
    crossing = points[edges[:, 0]] + at[:, None] * step
    part = np.concatenate([at, 1 - at])
    distance = part * np.tile(np.linalg.norm(step, axis=1), 2)
    chosen = np.flatnonzero(part < np.tile(close, 2))
    chosen = chosen[np.argsort(-distance[chosen], kind="stable")]
    point = edges.T.ravel()[chosen]
    points[point] = np.tile(crossing, (2, 1))[chosen]  # the nearest is written last and remains
    moved = np.zeros(len(points), dtype=bool)
    moved[point] = True
    return moved


def _cut(
    cells: NDArray[np.int64],
    side: NDArray[np.int64],
    places: NDArray[np.int64],
    edges: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return the parts (m, 4), of any orientation, of tetrahedra (n, 4) inside the surface.

    `side` (n_points,) is 1 for points inside, 0 on the surface, -1 outside. `places` (n_points, 3)
    are lattice coordinates. `edges` (n_edges, 2) go from inside to outside, in ascending order. The
    crossing of edge k is point ``n_points + k``.
    """
    cells = np.take_along_axis(cells, np.argsort(-side[cells], axis=1, kind="stable"), axis=1)
    n_in, n_out = (side[cells] > 0).sum(axis=1), (side[cells] < 0).sum(axis=1)
    keys = edges[:, 0] * len(side) + edges[:, 1]

    def end(p: NDArray[np.int64], n: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.where(side[n] < 0, len(side) + np.searchsorted(keys, p * len(side) + n), n)

    def rank(p: NDArray[np.int64], n: NDArray[np.int64]) -> NDArray[np.int64]:
        # A face's trapezium has a diagonal from each of its inner points. The one of higher rank is
        # used. The rank depends on the face only, so both cells agree. If only one of the cut
        # edges is long, the diagonal ends on it.
        is_short = (places[p] - places[n])[..., 0] % 2
        return np.asarray(2 * is_short + (places[p] // 2).sum(axis=-1) % 2)

    whole = cells[(n_in > 0) & (n_out == 0)]
    p, n = np.split(cells[(n_in == 1) & (n_out > 0)], [1], axis=1)
    tips = np.concatenate([p, end(np.broadcast_to(p, n.shape), n)], axis=1)
    # With two points inside and one on the surface, one edge of the prism shrinks to a point.
    p, n = np.split(cells[(n_in > 1) & (n_out == 1)], [3], axis=1)
    n = np.broadcast_to(n, p.shape)
    stumps = _prisms(p, np.where(side[p] > 0, end(p, n), p), rank(p, n))
    p, n = np.split(cells[(n_in == 2) & (n_out == 2)], [2], axis=1)
    p, q = np.broadcast_to(p[:, :1], n.shape), np.broadcast_to(p[:, 1:], n.shape)
    first = np.where(rank(p, n) > rank(q, n), -2, 2) + np.array([0, 1])
    wedges = _prisms(
        np.column_stack([p[:, 0], end(p, n)]),
        np.column_stack([q[:, 0], end(q, n)]),
        np.column_stack([0 * first[:, 0], first]),
    )
    parts = np.concatenate([whole, tips, stumps, wedges])
    return parts[(np.diff(np.sort(parts, axis=1), axis=1) > 0).all(axis=1)]


def tetrahedral_mesh(level: Level, bounds: NDArray[np.float64], spacing_m: float) -> Mesh:
    """Return a T4 mesh of the body where a level set is negative.

    Parameters
    ----------
    level : callable
        Continuous, see `Level`.
    bounds : (2, 3) float64
        Lowest and highest corner of a box that contains the body, m.
    spacing_m : float
        Edge of the lattice's cubes, m. Smaller details of the body may be lost.

    Returns
    -------
    Mesh
        Nodes are numbered along the longest axis of the bounds. Boundary nodes lie on the surface
        to round-off.

    Raises
    ------
    SpecError
        If no lattice point lies in the body, the body exceeds its bounds, or parts of it touch
        along edges only.
    """
    points, cells, places = _lattice(bounds, spacing_m)
    side = -np.sign(level(points)).astype(np.int64)
    if not (side > 0).any():
        raise SpecError(
            f"no point of a lattice of {spacing_m:g} m lies in the body; use a smaller spacing."
        )
    outermost = ((places == 0) | (places == places.max(axis=0))).any(axis=1)
    if (side[outermost] > 0).any():
        low, high = bounds.tolist()
        raise SpecError(f"the body exceeds its bounds, {low} to {high} m.")
    cells = cells[(side[cells] > 0).any(axis=1)]
    edges = _crossed_edges(cells, side)
    at = _crossings(level, points, edges)
    crossings = points[edges[:, 0]] + at[:, None] * (points[edges[:, 1]] - points[edges[:, 0]])
    is_long = (places[edges[:, 0], 0] - places[edges[:, 1], 0]) % 2 == 0
    side[_snap(points, edges, at, np.where(is_long, CLOSE_LONG, CLOSE_SHORT))] = 0
    cut = (side[edges] != 0).all(axis=1)
    parts = _cut(cells, side, places, edges[cut])
    axis = int(np.argmax(np.ptp(bounds, axis=0)))
    mesh = _numbered(np.concatenate([points, crossings[cut]]), parts, axis)
    sides = np.sort(mesh.boundary_facets[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    if n_hinges := int((np.unique(sides, axis=0, return_counts=True)[1] != 2).sum()):
        raise SpecError(
            f"with a spacing of {spacing_m:g} m parts of the body touch along "
            f"{n_hinges} edges only; use a smaller one."
        )
    return mesh


def _numbered(points: NDArray[np.float64], cells: NDArray[np.int64], axis: int) -> Mesh:
    """Return the mesh of tetrahedra (n, 4) of any orientation, without unused points.

    Nodes are ordered by this axis, then by the others.
    """
    used, cells = np.unique(cells, return_inverse=True)
    points = points[used]
    order = np.lexsort(np.roll(points, 2 - axis, axis=1).T)
    cells = np.argsort(order)[cells.reshape(-1, 4)]
    points = points[order]
    a, b, c, d = np.moveaxis(points[cells], 1, 0)
    turned = ((b - a) * np.cross(c - a, d - a)).sum(axis=1) < 0
    cells[turned] = cells[turned][:, [0, 2, 1, 3]]
    return Mesh(points, cells[np.lexsort(np.sort(cells, axis=1).T[::-1])])
