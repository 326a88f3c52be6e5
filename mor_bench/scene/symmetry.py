"""Mirror planes of a scene: the mirror image of a solution solves the mirrored load."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mor_bench.scene.scene import Scene

SAME_PLACE = 1e-6
"""Largest distance between a mirrored node and its match, as a fraction of the body's diagonal."""


@dataclass(frozen=True)
class Mirror:
    """Reflection in the plane through the middle of the body, normal to `axis`.

    `nodes` (n_nodes,) int64 gives the node at the mirror image of each node; it is its own inverse.
    """

    axis: int
    nodes: NDArray[np.int64]

    @property
    def signs(self) -> NDArray[np.float64]:
        """(3,) factors of a vector's components."""
        return np.where(np.arange(3) == self.axis, -1.0, 1.0)

    def __call__(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the image of nodal vectors (…, n_nodes, 3)."""
        return vectors[..., self.nodes, :] * self.signs


def mirrors(scene: Scene) -> list[Mirror]:
    """Return the mirror planes of mesh, supports and loaded nodes, at most one per axis.

    All materials are isotropic, so the image of a solution solves the image of its load.
    """
    points, cells = scene.mesh.points, scene.mesh.cells
    low, high = points.min(axis=0), points.max(axis=0)
    near = SAME_PLACE * np.linalg.norm(high - low)
    tree = cKDTree(points)
    own_cells = _rows(cells)
    kept = scene.fixed_nodes, np.unique(scene.patch_weights.indices)
    found = []
    for axis in range(3):
        images = points.copy()
        images[:, axis] = low[axis] + high[axis] - points[:, axis]
        distance, nodes = (np.asarray(part) for part in tree.query(images))
        if (
            distance.max() <= near
            and len(np.unique(nodes)) == len(nodes)
            and np.array_equal(_rows(nodes[cells]), own_cells)
            and all(np.array_equal(np.sort(nodes[part]), np.sort(part)) for part in kept)
        ):
            found.append(Mirror(axis, nodes.astype(np.int64)))
    return found


def _rows(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the cells as sorted sets of nodes, in lexical order."""
    cells = np.sort(cells, axis=1)
    return cells[np.lexsort(cells.T)]
