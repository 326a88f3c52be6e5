"""Penalty contact of a body with a rigid instrument, without friction: forces and stiffness.

The contact adds Π = ½ ∫ k ⟨-g⟩² dA over the undeformed surface to the potential, see
`mor_bench.scene.contact_surface`. Its derivatives are the forces ∫ k ⟨-g⟩ n N dA on the body, with
the instrument's normal n = ∇g, and the tangent ∫ k (n⊗n - ⟨-g⟩ ∇²g) N N dA where g < 0. So the
tangent is symmetric, and the energy balances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError, SpecError
from mor_bench.mechanics.model import rest_displacement
from mor_bench.mechanics.pattern import Pattern
from mor_bench.scene.contact_surface import ROUND_OFF, ContactSurface
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]

ONE_MOTION = 1e-9
"""Difference of the displacements given at several nodes, relative to the largest: round-off."""

GAP_MULTIPLY_ADDS = 12
"""Multiply-adds of a gap and its normal."""


@dataclass(frozen=True)
class Touch:
    """The contact at the points that touch.

    Attributes
    ----------
    points : (n,) int64
        Their numbers.
    forces : (n, 3) float64
        Forces on the body, N.
    energy_j : float
        Energy of the penalty, J.
    penetration : (n,) float64
        Depths, m.
    normals : (n, 3) float64
    curvatures : (n,) float64
        As in `Instrument.gaps`.
    stiffness : (n,) float64
        Penalty stiffness times area, N/m.
    """

    points: NDArray[np.int64]
    forces: Array
    energy_j: float
    penetration: Array
    normals: Array
    curvatures: Array
    stiffness: Array

    def blocks(self, curved: bool) -> Array:
        """Return the stiffness (n, 3, 3) of the contact at each point, N/m.

        Without the curvature of the instrument, it has no negative eigenvalue.
        """
        outer = self.normals[:, :, None] * self.normals[:, None, :]
        if not curved:
            return np.asarray(self.stiffness[:, None, None] * outer)
        bent = (self.penetration * self.curvatures)[:, None, None] * (np.eye(3) - outer)
        return np.asarray(self.stiffness[:, None, None] * (outer - bent))


class ContactPoints:
    """Forces of an instrument on the points of a surface.

    Parameters
    ----------
    scene : Scene
        A scene with an instrument.

    Raises
    ------
    UnsupportedSceneError
        If no instrument presses the scene.
    SpecError
        If the instrument penetrates the body at rest under its pre-load.
    """

    def __init__(self, scene: Scene) -> None:
        self.surface: ContactSurface = scene.contact_surface
        surface, self._instrument = self.surface, self.surface.instrument
        self._points, rest = surface.points, rest_displacement(scene)
        self._nodes = scene.mesh.points if rest is None else scene.mesh.points + rest
        self._outside = self._instrument.gaps(self._nodes)[0] >= 0
        if rest is not None:
            self._points = surface.points + surface.values @ rest
            deepest = -float(self._instrument.gaps(self._points)[0].min())
            if deepest > ROUND_OFF * float(np.ptp(self._points, axis=0).max()):
                raise SpecError(
                    f"{scene.name}: `loads.instrument` must not penetrate the body at rest under "
                    f"its pre-load; it does, by {deepest:.6g} m."
                )

    def first_step(self, motion: Array) -> float:
        """Return the part of a motion (3,), m, that may be made in one step."""
        length = float(np.linalg.norm(motion))
        return min(1.0, self._instrument.longest_step_m / length) if length else 1.0

    def touch(self, moved: Array, motion: Array) -> Touch:
        """Return the contact of points that moved by (n, 3), m, and an instrument by (3,), m."""
        gaps, normals, curvatures = self._instrument.gaps(self._relative(moved, motion))
        count(multiply_adds=GAP_MULTIPLY_ADDS * len(gaps))
        points = np.flatnonzero(gaps < 0)
        depth, normals, stiffness = -gaps[points], normals[points], self.surface.stiffness[points]
        forces = (stiffness * depth)[:, None] * normals
        energy = 0.5 * float(stiffness @ depth**2)
        return Touch(points, forces, energy, depth, normals, curvatures[points], stiffness)

    def depth_of_nodes(self, displacements: Array, motion: Array) -> float:
        """Return how deep a node is in the instrument that is outside at rest, m; 0 if none is.

        All nodes count, not only those that it may touch. Arguments as in `touch`, for all nodes.
        """
        gaps = self._instrument.gaps(self._nodes + (displacements - motion))[0]
        return float(np.maximum(-gaps[self._outside], 0.0).max(initial=0.0))

    def normals(self, moved: Array, motion: Array) -> Array:
        """Return the instrument's normals (n, 3) at points that moved by (n, 3), m."""
        count(multiply_adds=GAP_MULTIPLY_ADDS * len(moved))
        return self._instrument.gaps(self._relative(moved, motion))[1]

    def _relative(self, moved: Array, motion: Array) -> Array:
        """Return the points (n, 3), m, as seen by the instrument."""
        return self._points + (moved - motion)


def motion_of(scene: Scene, given: Array) -> Array:
    """Return the displacement (3,), m, of an instrument from values (n_free,) of free dofs, m.

    Raises
    ------
    InvalidInputError
        If the nodes that it may touch have different values.
    """
    assert scene.observed_nodes is not None
    dofs = dofs_of_nodes(scene.observed_nodes)
    places = np.searchsorted(scene.free_dofs, dofs)
    free = scene.free_dofs[np.minimum(places, len(scene.free_dofs) - 1)] == dofs
    found, allowed = np.zeros(3), ONE_MOTION * float(np.abs(given).max(initial=0.0))
    for axis in range(3):
        values = given[places[axis::3][free[axis::3]]]
        if values.size and float(np.ptp(values)) > allowed:
            raise InvalidInputError(
                f"{scene.name}: the displacement of its instrument must be the same at all nodes "
                f"that it may touch; along {'xyz'[axis]} it differs by {np.ptp(values):.3g} m."
            )
        found[axis] = values[0] if values.size else 0.0
    return found


class ContactMap:
    """The contact over vectors with rows for the degrees of freedom of the touched nodes.

    Parameters
    ----------
    points : ContactPoints
    dof_of_node : (n_nodes, 3) int64
        Row of each displacement component in the vectors; ``n`` at supports.
    n : int
        Length of the vectors.
    """

    def __init__(self, points: ContactPoints, dof_of_node: NDArray[np.int64], n: int) -> None:
        self.points, self._n = points, n
        values = points.surface.values
        counts = np.diff(values.indptr)
        width = int(counts.max())
        column = np.arange(len(values.indices)) - np.repeat(values.indptr[:-1], counts)
        row = np.repeat(np.arange(len(counts)), counts)
        self._values = np.zeros((len(counts), width))
        self._values[row, column] = values.data
        self.dofs = np.full((len(counts), width, 3), n, dtype=np.int64)
        self.dofs[row, column] = dof_of_node[values.indices]
        at = dofs_of_nodes(row), dof_of_node[values.indices].ravel()
        shape = (3 * len(counts), n + 1)
        self._moving = sp.csr_array((np.repeat(values.data, 3), at), shape=shape)[:, :n]

    def touch(self, q: Array, motion: Array) -> Touch:
        """Return the contact at displacements q (n,), m, of the body and (3,), m, of its motion."""
        return self.points.touch(self._moved(q), motion)

    def normals(self, q: Array, motion: Array) -> Array:
        """Return the instrument's normals (n_points, 3); arguments as in `touch`."""
        return self.points.normals(self._moved(q), motion)

    def _moved(self, q: Array) -> Array:
        count(multiply_adds=3 * self._values.size)
        return np.asarray(self._moving @ q).reshape(-1, 3)

    def force(self, touch: Touch) -> Array:
        """Return the forces (n,), N, on the body."""
        shares = self._values[touch.points][:, :, None] * touch.forces[:, None, :]
        count(multiply_adds=shares.size)
        dofs = self.dofs[touch.points].ravel()
        total = np.bincount(dofs, shares.ravel(), minlength=self._n + 1)
        return np.asarray(total[: self._n], dtype=np.float64)

    def blocks(self, touch: Touch, curved: bool = True) -> Array:
        """Return each touching point's stiffness over its dofs, (n_touching, d, d), N/m."""
        values, width = self._values[touch.points], 3 * self._values.shape[1]
        pairs = values[:, :, None, None, None] * values[:, None, None, :, None]
        own = pairs * touch.blocks(curved)[:, None, :, None, :]
        count(multiply_adds=own.size)
        return np.asarray(own.reshape(-1, width, width))

    def dense(self, touch: Touch, curved: bool) -> tuple[NDArray[np.int64], Array]:
        """Return the dofs (m,) that touch, and the stiffness (m, m) over them, N/m."""
        own = self.dofs[touch.points].reshape(-1, 3 * self.dofs.shape[1])
        used = np.unique(own)
        used = used[used < self._n]
        place = np.full(self._n + 1, len(used))
        place[used] = np.arange(len(used))
        local, size = place[own], len(used) + 1
        at = (local[:, :, None] * size + local[:, None, :]).ravel()
        found = np.bincount(at, self.blocks(touch, curved).ravel(), size**2)
        return used, np.asarray(found.reshape(size, size)[:-1, :-1])


class NodalContact(ContactMap):
    """The contact over the degrees of freedom of a mesh; parameters as in `ContactMap`.

    Parameters
    ----------
    pattern : Pattern
        Pattern of the stiffness.
    """

    def __init__(
        self, points: ContactPoints, dof_of_node: NDArray[np.int64], pattern: Pattern
    ) -> None:
        super().__init__(points, dof_of_node, pattern.n)
        dofs = self.dofs.reshape(len(self.dofs), -1)
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        kept = (rows <= columns) & (columns < pattern.n)
        keys = pattern.rows * pattern.n + pattern.indices
        self._n_values = len(keys)
        self._slots = np.full(kept.shape, len(keys), dtype=np.int64)
        self._slots[kept] = np.searchsorted(keys, rows[kept] * pattern.n + columns[kept])

    def stiffness(self, touch: Touch) -> Array:
        """Return the stiffness in the pattern, N/m."""
        slots = self._slots[touch.points].ravel()
        found = np.bincount(slots, self.blocks(touch).ravel(), minlength=self._n_values + 1)
        return np.asarray(found[: self._n_values], dtype=np.float64)
