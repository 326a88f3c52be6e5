"""Mirror planes of a scene: the mirror image of a solution solves the mirrored load."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.materials import HolzapfelGasserOgden, Material
from mor_bench.scene.nearest import tree_of
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
    """Return the mirror planes of a scene with its loaded nodes, at most one per axis.

    None are looked for where supports are oblique or constant pressures act.

    The image of a solution solves the image of its load, because laws are isotropic or their fibres
    have an image too. A scene with an instrument has no plane: its image is another instrument.
    """
    if scene.frames is not None or scene.contact or scene.constant_pressures:
        return []
    points, cells = scene.mesh.points, scene.mesh.cells
    low, high = points.min(axis=0), points.max(axis=0)
    near = SAME_PLACE * np.linalg.norm(high - low)
    tree = tree_of(points)
    own_cells = _rows(cells)
    held = [scene.fixed_dofs[scene.fixed_dofs % 3 == i] // 3 for i in range(3)]
    kept = *held, np.unique(scene.patch_weights.indices)
    gravity, springs, found = scene.generated.gravity, scene.spring_matrix, []
    for axis in range(3):
        images = points.copy()
        images[:, axis] = low[axis] + high[axis] - points[:, axis]
        distance, nodes = (np.asarray(part) for part in tree.query(images))
        if (
            not (gravity and gravity.acceleration_m_s2[axis])
            and _has_fibres_as_image(scene.material, axis)
            and distance.max() <= near
            and len(np.unique(nodes)) == len(nodes)
            and np.array_equal(_rows(nodes[cells]), own_cells)
            and (springs is None or _is_own_image(springs, nodes, axis))
            and all(np.array_equal(np.sort(nodes[part]), np.sort(part)) for part in kept)
        ):
            found.append(Mirror(axis, nodes.astype(np.int64)))
    return found


def _is_own_image(matrix: sp.csr_array, nodes: NDArray[np.int64], axis: int) -> bool:
    """Return whether a stiffness (n_dofs, n_dofs) is its own mirror image."""
    dofs = dofs_of_nodes(nodes)
    signs = sp.diags_array(np.tile(np.where(np.arange(3) == axis, -1.0, 1.0), len(nodes)))
    image = signs @ matrix[dofs][:, dofs] @ signs
    return bool(abs(image - matrix).max() <= 1e-6 * matrix.max())


def _has_fibres_as_image(material: Material | None, axis: int) -> bool:
    """Return whether the image of every family of fibres is a family of fibres."""
    if not isinstance(material, HolzapfelGasserOgden):
        return True
    fibres = np.array(material.fibres) / np.linalg.norm(material.fibres, axis=1)[:, None]
    images = fibres * np.where(np.arange(3) == axis, -1.0, 1.0)
    parallel: NDArray[np.float64] = np.abs(images @ fibres.T).max(axis=1)
    return bool((parallel >= 1.0 - 1e-9).all())


def _rows(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the cells as sorted sets of nodes, in lexical order."""
    cells = np.sort(cells, axis=1)
    return cells[np.lexsort(cells.T)]
