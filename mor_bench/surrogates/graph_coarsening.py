"""Coarser graphs of a mesh: groups of nodes that share a cell, level by level."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.graph_layers import Indices, mesh_pairs

BIN = 1.0372e-6
"""Positions closer than this fraction of the body count as equal along an axis.

It is an odd number, so that positions of regular meshes do not lie at the ends of bins.
"""


@dataclass(frozen=True)
class GraphLevel:
    """Nodes, edges and cells of one level.

    Attributes
    ----------
    points : (n_nodes, 3) float64
        Positions, m.
    pairs : (n_edges, 2) int64
        Node numbers at the ends of each edge, each edge once.
    cells : (n_cells, most) int64
        Node numbers of each cell, padded with -1.
    """

    points: NDArray[np.float64]
    pairs: Indices
    cells: Indices

    @classmethod
    def of(cls, mesh: Mesh) -> Self:
        """Return the finest level: the mesh itself."""
        return cls(mesh.points, mesh_pairs(mesh), mesh.cells)

    def groups(self) -> Indices:
        """Return the group of each node, (n_nodes,), by greedy search for disjoint cells.

        The nodes of a cell form a group if none has a group yet. Then the cells with fewer nodes
        left follow, down to two. Nodes that are left alone are groups of one. The search goes from
        one end of the body to the other, whatever the numbers of nodes and cells.
        """
        n_nodes = len(self.points)
        ranks = np.append(position_ranks(self.points), n_nodes)  # -1 is the last
        cells = self.cells[np.lexsort(np.sort(ranks[self.cells], axis=1).T[::-1])]
        groups = np.full(n_nodes, -1)
        n_groups = 0
        for size in range(cells.shape[1], 1, -1):
            left = (cells >= 0) & (groups[cells] < 0)
            for cell in cells[left.sum(axis=1) >= size]:
                nodes = cell[cell >= 0]
                nodes = nodes[groups[nodes] < 0]
                if len(nodes) >= size:
                    groups[nodes] = n_groups
                    n_groups += 1
        alone = np.flatnonzero(groups < 0)
        groups[alone] = n_groups + np.arange(len(alone))
        return groups

    def coarser(self, groups: Indices) -> GraphLevel:
        """Return the level whose nodes are groups.

        They lie at the means of their nodes. An edge joins two groups if an edge joins their nodes.
        A cell holds the groups that a cell touches.
        """
        sizes = np.bincount(groups)
        sums = [np.bincount(groups, weights=axis) for axis in self.points.T]
        pairs = np.sort(groups[self.pairs], axis=1)
        pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
        cells = -np.sort(-np.where(self.cells >= 0, groups[self.cells], -1), axis=1)
        cells[:, 1:][cells[:, 1:] == cells[:, :-1]] = -1
        cells = np.unique(-np.sort(-cells, axis=1), axis=0)
        return GraphLevel(np.stack(sums, axis=1) / sizes[:, None], pairs, cells[cells[:, 1] >= 0])


def position_ranks(points: NDArray[np.float64]) -> Indices:
    """Return the rank of each point (n, 3) by x, then y, then z."""
    low = points.min(axis=0)
    bins = np.rint((points - low) / (BIN * max(np.ptp(points, axis=0).max(), 1e-300)))
    ranks = np.empty(len(points), dtype=np.int64)
    ranks[np.lexsort(bins.T[::-1])] = np.arange(len(points))
    return ranks
