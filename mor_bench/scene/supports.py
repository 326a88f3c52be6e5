"""Supports: nodes and components that do not move, and frames of nodes with oblique supports.

A node with an oblique support has a frame of its own. Its first axes span the directions in which
it cannot move, so these components are no unknowns. The elimination is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.problems import Problems
from mor_bench.scene.regions import Cloud, region_points
from mor_bench.specs import AXES, Support

Array = NDArray[np.float64]

ROUND_OFF = 1e-12
"""Component of a unit vector that counts as zero."""
PARALLEL = 1e-9
"""Sine of the angle below which a direction lies in the span of others."""


@dataclass(frozen=True)
class Frames:
    """Orthonormal axes of nodes with oblique supports.

    Attributes
    ----------
    nodes : (n,) int64
        Sorted.
    axes : (n, 3, 3) float64
        The unit vectors of each node's frame, as rows.
    n_held : (n,) int64
        The first axes, one or two, along which the node does not move.
    """

    nodes: NDArray[np.int64]
    axes: Array
    n_held: NDArray[np.int64]

    @property
    def held_dofs(self) -> NDArray[np.int64]:
        """Dofs, 3 * node + axis of the frame, along which nodes do not move; sorted."""
        held = np.arange(3) < self.n_held[:, None]
        return dofs_of_nodes(self.nodes)[held.ravel()]

    def to_local(self, fields: Array) -> Array:
        """Return nodal vectors (..., n_dofs) in the frames, from components along x, y and z."""
        return self._turned(fields, self.axes)

    def to_global(self, fields: Array) -> Array:
        """Return nodal vectors (..., n_dofs) along x, y and z, from components in the frames."""
        return self._turned(fields, self.axes.swapaxes(1, 2))

    def _turned(self, fields: Array, matrices: Array) -> Array:
        out = np.array(fields, dtype=np.float64)
        vectors = out.reshape(*out.shape[:-1], -1, 3)
        turned = np.einsum("nij,...nj->...ni", matrices, vectors[..., self.nodes, :])
        vectors[..., self.nodes, :] = turned
        return out

    def matrix(self, n_nodes: int) -> sp.csr_array:
        """Return the orthogonal matrix (n_dofs, n_dofs) of `to_local`."""
        blocks = np.tile(np.eye(3), (n_nodes, 1, 1))
        blocks[self.nodes] = self.axes
        numbers = np.arange(n_nodes + 1)
        return sp.csr_array(sp.bsr_array((blocks, numbers[:-1], numbers)).tocsr())


@dataclass(frozen=True)
class Held:
    """What supports hold: whole nodes, components of other nodes along x, y, z, and frames."""

    fixed_nodes: NDArray[np.int64]
    held_dofs: NDArray[np.int64]
    frames: Frames | None


NOTHING_HELD = Held(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), None)


def held_by(supports: Sequence[Support], cloud: Cloud) -> Held:
    """Return what the supports of a dataset file hold.

    Raises
    ------
    SpecError
        If regions are empty, or every node is fixed.
    """
    still = np.zeros((len(cloud.points), 3), dtype=bool)
    oblique: dict[int, list[Array]] = {}
    regions = []
    with Problems() as problems:
        for number, support in enumerate(supports):
            with problems.keep():
                regions.append(region_points(cloud, support.region, f"supports[{number}].region"))
    for support, nodes in zip(supports, regions, strict=True):
        if support.direction is None:
            still[nodes[:, None], [AXES.index(axis) for axis in support.components]] = True
            continue
        direction = np.array(support.direction) / np.abs(support.direction).max()
        direction /= np.linalg.norm(direction)
        if np.count_nonzero(np.abs(direction) > ROUND_OFF) == 1:
            still[nodes, np.abs(direction).argmax()] = True
            continue
        for node in nodes.tolist():
            oblique.setdefault(node, []).append(direction)
    return with_directions(still, oblique)


def with_directions(still: NDArray[np.bool_], oblique: dict[int, list[Array]]) -> Held:
    """Return what is held by components (n_nodes, 3) and directions of some nodes."""
    nodes, axes, n_held = [], [], []
    for node in sorted(oblique):
        held = _orthonormal([*np.eye(3)[still[node]], *oblique[node]])
        if len(held) == 3:
            still[node] = True
        elif len(held) > np.count_nonzero(still[node]):
            still[node] = False
            nodes.append(node)
            axes.append(_completed(held))
            n_held.append(len(held))
    if still.all():
        raise SpecError("the supports fix every node of the mesh: nothing can move.")
    fixed, held_dofs = by_node(still)
    frames = Frames(np.array(nodes), np.array(axes), np.array(n_held)) if nodes else None
    return Held(fixed, held_dofs, frames)


def _orthonormal(vectors: Sequence[Array]) -> list[Array]:
    """Return an orthonormal basis of the span of unit vectors, by Gram and Schmidt."""
    basis: list[Array] = []
    for vector in vectors:
        rest = vector
        for _ in range(2):  # twice is enough
            for axis in basis:
                rest = rest - (rest @ axis) * axis
        if (size := float(np.linalg.norm(rest))) > PARALLEL:
            basis.append(rest / size)
    return basis


def _completed(held: Sequence[Array]) -> Array:
    """Return three orthonormal axes (3, 3), the first of which are one or two given ones."""
    first = held[0]
    if len(held) == 2:
        return np.stack([*held, np.cross(first, held[1])])
    second = np.cross(np.eye(3)[np.abs(first).argmin()], first)
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def by_node(still: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return nodes without a free component, and held dofs of the others, from (n_nodes, 3)."""
    fixed = np.all(still, axis=1, keepdims=True)
    return np.flatnonzero(fixed), np.flatnonzero(still & ~fixed)


def held_by_parents(n_nodes: int, held: Held, parents: NDArray[np.int64]) -> Held:
    """Return what is held on a finer mesh: the directions that all parents of a node hold.

    Parameters
    ----------
    n_nodes : int
        Nodes of the mesh with the given supports.
    held : Held
    parents : (n_finer, n_parents) int
        The nodes between which each node of the finer mesh lies.
    """
    still = np.zeros(3 * n_nodes, dtype=bool)
    still[dofs_of_nodes(held.fixed_nodes)] = True
    still[held.held_dofs] = True
    by_component = still.reshape(-1, 3)
    finer = np.asarray(np.all(by_component[parents], axis=1))
    oblique: dict[int, list[Array]] = {}
    if held.frames is not None:
        projectors = by_component[:, :, None] * np.eye(3)
        for node, axes, n in zip(
            held.frames.nodes, held.frames.axes, held.frames.n_held, strict=True
        ):
            projectors[node] = axes[:n].T @ axes[:n]
        touched = np.isin(parents, held.frames.nodes).any(axis=1)
        for node in np.flatnonzero(touched).tolist():
            # A direction that every parent holds is an eigenvector of the mean with eigenvalue 1.
            values, vectors = np.linalg.eigh(projectors[parents[node]].mean(axis=0))
            oblique[node] = list(vectors.T[values >= 1.0 - PARALLEL])
    return with_directions(finer, oblique)
