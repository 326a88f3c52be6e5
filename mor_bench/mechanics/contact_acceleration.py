"""An accelerated iteration for a body that an instrument presses.

With the approximate inverse P⁻¹ = R K₀⁻¹ Rᵀ of the body's tangents, an iteration would need many
steps, since the contact is much stiffer than the body. So each correction contains an exact balance
of the contact with a body of flexibility P⁻¹, see `Balance`. It takes two solves with the factor.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.accelerated import ACCELERATED_ITERATIONS, DIVERGED, TURNING
from mor_bench.mechanics.anderson import Anderson
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.contact_balance import Balance
from mor_bench.mechanics.contact_points import ContactMap, ContactPoints, Touch
from mor_bench.mechanics.problem import Attempt, is_round_off
from mor_bench.mechanics.rotated import RotatedRest, Turned
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]

STEPS = 50
"""Most steps of a balance; an easy one needs some five."""

FORCING = 1e-4
"""Allowed last step of a balance, relative to the change of the contact's forces in it."""


class _Body(Protocol):
    """A full-order model without a contact, as far as it is needed here."""

    scene: Scene
    n_unknowns: int

    @property
    def turned_rest(self) -> RotatedRest: ...
    @property
    def moving_nodes(self) -> NDArray[np.int64]: ...


class _PressedBody(_Body, Protocol):
    """A model of a body and an instrument at a place."""

    extent: float
    motion: Array

    def force(self, q: Array) -> State: ...
    def touch(self, q: Array) -> Touch: ...
    def contact_force(self, touch: Touch) -> Array: ...


class TouchedDofs:
    """The dofs of the nodes that an instrument may touch, with columns of K₀⁻¹.

    Each node has three local dofs; those that supports hold are unused. Columns are computed when a
    node first touches.

    Parameters
    ----------
    body : FullOrderModel
    points : ContactPoints
    """

    def __init__(self, body: _Body, points: ContactPoints) -> None:
        scene = body.scene
        assert scene.observed_nodes is not None
        nodes = scene.observed_nodes
        self.n, self._n_unknowns = 3 * len(nodes), body.n_unknowns
        number = np.full(scene.mesh.n_dofs, body.n_unknowns, dtype=np.int64)
        number[scene.free_dofs] = np.arange(body.n_unknowns)
        self._unknowns = number.reshape(-1, 3)[nodes].ravel()
        free = self._unknowns < body.n_unknowns
        local = np.full((scene.mesh.n_nodes, 3), self.n, dtype=np.int64)
        local[nodes] = np.where(free, np.arange(self.n), self.n).reshape(-1, 3)
        self.contact = ContactMap(points, local, self.n)
        self._moving = np.searchsorted(body.moving_nodes, nodes)
        self._inverse = body.turned_rest
        self._columns: dict[int, Array] = {}

    def at(self, q: Array) -> Array:
        """Return the local entries (n,) of a vector of the unknowns."""
        return np.asarray(np.append(q, 0.0)[self._unknowns])

    def spread(self, local: Array) -> Array:
        """Return a vector of the unknowns with these local entries, and zeros elsewhere."""
        out = np.zeros(self._n_unknowns + 1)
        out[self._unknowns] = local
        return out[:-1]

    def rotations(self, all_of_them: Array) -> Array:
        """Return the rotations (n_nodes, 3, 3) of the nodes, from those of all moving nodes."""
        return np.asarray(all_of_them[self._moving])

    def columns(self, nodes: NDArray[np.int64]) -> Array:
        """Return the columns of K₀⁻¹ at the dofs of some nodes as rows, (3 n_nodes, n), m/N."""
        lacking = [node for node in nodes.tolist() if node not in self._columns]
        if lacking:
            units = np.zeros((3 * len(lacking), self.n))
            dofs = dofs_of_nodes(np.array(lacking))
            units[np.arange(len(dofs)), dofs] = 1.0
            loads, none = [self.spread(unit) for unit in units], self._inverse.turned(None)
            found = self._inverse.solve_many(loads, [none] * len(loads))
            own = np.array([self.at(row) for row in found]).reshape(len(lacking), 3, self.n)
            self._columns.update(zip(lacking, own, strict=True))
        return np.concatenate([self._columns[node] for node in nodes.tolist()])


class _TurnedFlexibility:
    """The entries of R K₀⁻¹ Rᵀ at the touched dofs, as a `Flexibility`."""

    def __init__(self, touched: TouchedDofs, rotations: Array) -> None:
        self._touched, self._rotations = touched, touched.rotations(rotations)
        self._nodes, self._columns = np.zeros(0, dtype=np.int64), np.zeros((0, touched.n))

    def _know(self, nodes: NDArray[np.int64]) -> None:
        """Keep the columns at the dofs of some nodes."""
        if not np.isin(nodes, self._nodes).all():
            self._nodes = np.union1d(self._nodes, nodes)
            self._columns = self._touched.columns(self._nodes)

    def apply(self, forces: Array) -> Array:
        by_node = forces.reshape(-1, 3)
        self._know(np.flatnonzero(by_node.any(axis=1)))
        back = np.einsum("aji,aj->ai", self._rotations[self._nodes], by_node[self._nodes])
        count(multiply_adds=self._columns.size + 9 * len(back) + 3 * len(forces))
        found = (back.ravel() @ self._columns).reshape(-1, 3)
        return np.asarray(np.einsum("bij,bj->bi", self._rotations, found).ravel())

    def among(self, dofs: NDArray[np.int64]) -> Array:
        nodes = np.unique(dofs // 3)
        self._know(nodes)
        rows, columns = dofs_of_nodes(np.searchsorted(self._nodes, nodes)), dofs_of_nodes(nodes)
        blocks, turn = self._columns[np.ix_(rows, columns)], self._rotations[nodes]
        count(multiply_adds=6 * blocks.size)
        blocks = np.matmul(turn, blocks.reshape(len(nodes), 3, -1)).reshape(len(rows), -1)
        blocks = np.matmul(turn, blocks.T.reshape(len(nodes), 3, -1)).reshape(len(rows), -1)
        chosen = 3 * np.searchsorted(nodes, dofs // 3) + dofs % 3
        return np.asarray(blocks[np.ix_(chosen, chosen)].T)


class PressedInverse:
    """R K₀⁻¹ Rᵀ with the push of a contact along its normals, as a preconditioner.

    With the contact's stiffness K and the flexibility C of the touched dofs, the correction of a
    response u is that of the forces -K (1 + C K)⁻¹ u there (Woodbury's formula).

    Parameters
    ----------
    inverse : Turned
    touched : TouchedDofs
    touch : Touch
    """

    def __init__(self, inverse: Turned, touched: TouchedDofs, touch: Touch) -> None:
        self._inverse, self._touched = inverse, touched
        self._dofs, stiffness = touched.contact.dense(touch, curved=False)
        flexibility = _TurnedFlexibility(touched, inverse.rotations).among(self._dofs)
        n = len(self._dofs)
        count(factorisations=1, multiply_adds=n**2 * (2 * n + n // 3))
        self._push = stiffness @ np.linalg.inv(np.eye(n) + flexibility @ stiffness)

    def solve(self, residual: Array) -> Array:
        """Return the approximate response (n_free,), m, to a force (n_free,), N."""
        found, forces = self._inverse.solve(residual), np.zeros(self._touched.n)
        forces[self._dofs] = -self._push @ self._touched.at(found)[self._dofs]
        count(multiply_adds=self._push.size)
        return found + self._inverse.solve(self._touched.spread(forces))


def accelerated_contact(
    model: _PressedBody, touched: TouchedDofs, start: Array, tolerance: float
) -> Attempt:
    """Iterate from a state (n_free,), m, with Anderson acceleration; stability is not checked.

    It fails if the surface gets past the instrument's centre, where the potential has a second
    minimum.
    """
    inverse, memory = model.turned_rest, Anderson(model.n_unknowns)
    q, turning, before, min_det = start, True, np.inf, 1.0
    rotations, first = inverse.turned(None), 0.0
    for iteration in range(1, ACCELERATED_ITERATIONS + 1):
        state, touch = model.force(q), model.touch(q)
        residual, min_det, pushing = -state.force, state.min_det_f, model.contact_force(touch)
        size, allowed = float(np.linalg.norm(residual)), float(np.linalg.norm(pushing))
        if size <= tolerance * allowed:
            break
        first = first or size
        if not size <= DIVERGED * max(allowed, first):
            return Attempt(q, min_det, iteration, converged=False)
        if turning:
            rotations = inverse.turned(q)
        correction = inverse.solve_many([residual], [rotations])[0]
        flexible = Balance(touched.contact, _TurnedFlexibility(touched, rotations), STEPS)
        forces = touched.at(pushing)
        settled = flexible.settle(touched.at(q + correction), forces, model.motion, FORCING)
        if settled is None:
            return Attempt(q, min_det, iteration, converged=False)
        if (change := settled - forces).any():
            correction = correction + inverse.solve_many([touched.spread(change)], [rotations])[0]
        if size > 0.5 * before and is_round_off(correction, q, model.extent):
            break
        before = size
        turning = float(np.abs(correction).max()) > TURNING * float(np.abs(q).max())
        q = q + memory.advance(q, correction)
    else:
        return Attempt(q, min_det, ACCELERATED_ITERATIONS, converged=False)
    ends = (touched.contact.normals(touched.at(u), model.motion) for u in (start, q))
    passed = np.prod(list(ends), axis=0).sum(axis=1) < 0  # also where it does not touch any more
    return Attempt(q, min_det, iteration, converged=not passed.any())
