"""Mirror planes under which a scene is its own image: what is solved on one side is solved on the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mor_bench.scene.scene import Scene

SAME_PLACE = 1e-6
"""Distance, as a part of the body's diagonal, within which a mirrored node is another one."""


@dataclass(frozen=True)
class Mirror:
    """Reflection in the plane through the middle of the body, normal to an axis.

    Attributes
    ----------
    axis : int
    nodes : (n_nodes,) int64
        The node of which each node is the image; its own inverse.
    """

    axis: int
    nodes: NDArray[np.int64]

    @property
    def signs(self) -> NDArray[np.float64]:
        """(3,): what vectors are multiplied by."""
        return np.where(np.arange(3) == self.axis, -1.0, 1.0)

    def __call__(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image of nodal vectors (…, n_nodes, 3)."""
        return vectors[..., self.nodes, :] * self.signs


def mirrors(scene: Scene) -> list[Mirror]:
    """The planes, at most one per axis, that map mesh, supports and the nodes that loads act on onto themselves.

    The materials are isotropic and have no directions of their own. If u answers f, the image of u answers the image of f.
    """
    points, cells = scene.mesh.points, scene.mesh.cells
    low, high = points.min(axis=0), points.max(axis=0)
    tree = cKDTree(points)
    own_cells = _rows(cells)
    loaded = np.unique(scene.patch_weights.indices)
    found = []
    for axis in range(3):
        images = points.copy()
        images[:, axis] = low[axis] + high[axis] - points[:, axis]
        distance, nodes = (np.asarray(part) for part in tree.query(images))
        if distance.max() > SAME_PLACE * np.linalg.norm(high - low) or len(np.unique(nodes)) < len(
            nodes
        ):
            continue
        same = np.array_equal(_rows(nodes[cells]), own_cells)
        for kept in (scene.fixed_nodes, loaded):
            same = same and np.array_equal(np.sort(nodes[kept]), np.sort(kept))
        if same:
            found.append(Mirror(axis, nodes.astype(np.int64)))
    return found


def _rows(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells as sets of nodes, in an order of their own."""
    cells = np.sort(cells, axis=1)
    return cells[np.lexsort(cells.T)]
