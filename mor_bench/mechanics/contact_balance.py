"""The balance of a contact with a body that is linear in the contact's forces."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.contact_points import ContactMap, Touch

Array = NDArray[np.float64]

TOLERANCE = 1e-10
"""Change of the contact's forces in a step, relative to them, at which the iteration ends."""

MAX_ITERATIONS = 100
MAX_HALVINGS = 20


class Flexibility(Protocol):
    """A symmetric matrix C (n, n), m/N, of displacements under forces on the touched dofs."""

    def apply(self, forces: Array) -> Array:
        """Return the displacements (n,), m, under forces (n,), N."""
        ...

    def among(self, dofs: NDArray[np.int64]) -> Array:
        """Return the entries (m, m) of some dofs."""
        ...


class DenseFlexibility:
    """A flexibility whose entries are all known."""

    def __init__(self, matrix: Array) -> None:
        self._matrix = matrix

    def apply(self, forces: Array) -> Array:
        acting = np.flatnonzero(forces)  # few dofs touch
        count(multiply_adds=len(acting) * len(forces))
        return np.asarray(forces[acting] @ self._matrix[acting])

    def among(self, dofs: NDArray[np.int64]) -> Array:
        return np.asarray(self._matrix[np.ix_(dofs, dofs)])


class Balance:
    """Contact forces f with f = f_contact(u) and u = u₀ + C (f - f₀).

    Newton's steps solve (1 + C K) δ = C (f_contact - f), where K is the contact's stiffness at the
    few dofs that touch. K leaves out the curvature of the instrument where a step would not descend
    on the potential.

    Parameters
    ----------
    contact : ContactMap
        Over the touched dofs.
    flexibility : Flexibility
    most_steps : int
    """

    def __init__(
        self, contact: ContactMap, flexibility: Flexibility, most_steps: int = MAX_ITERATIONS
    ) -> None:
        self._contact, self._flexibility, self._most_steps = contact, flexibility, most_steps

    def settle(self, u: Array, forces: Array, motion: Array, forcing: float = 0.0) -> Array | None:
        """Iterate from forces (n,), N, with displacements (n,), m; None without convergence.

        The instrument is displaced by ``motion`` (3,), m. The last step may be ``forcing`` times
        the change of the forces since the begin.
        """
        touch, first = self._contact.touch(u, motion), forces
        begin = u - self._flexibility.apply(forces)
        for _ in range(self._most_steps):
            wanted = self._contact.force(touch)
            excess = wanted - forces
            if float(np.linalg.norm(excess)) <= TOLERANCE * float(np.linalg.norm(wanted)):
                return wanted
            moved = self._flexibility.apply(excess)
            for curved in (True, False):
                change = self._newton(touch, wanted, moved, curved) - forces
                step = self._flexibility.apply(change)
                if (slope := float(excess @ step)) > 0:
                    break
            before = 0.5 * float(forces @ (u - begin)) + touch.energy_j
            for halving in range(MAX_HALVINGS):
                length = 0.5**halving
                other, there = forces + length * change, u + length * step
                touch = self._contact.touch(there, motion)
                left = float((self._contact.force(touch) - other) @ step)
                energy = 0.5 * float(other @ (there - begin)) + touch.energy_j
                if energy <= before or abs(left) <= slope:
                    break
            forces, u = other, there
            whole = float(np.linalg.norm(forces - first))
            if not halving and float(np.linalg.norm(change)) <= forcing * whole:
                return forces
        return None

    def _newton(self, touch: Touch, wanted: Array, moved: Array, curved: bool) -> Array:
        """Return the forces of the equilibrium with the contact linearised."""
        used, stiffness = self._contact.dense(touch, curved)
        if not len(used):
            return wanted
        system = np.eye(len(used)) + self._flexibility.among(used) @ stiffness
        count(factorisations=1, multiply_adds=len(used) ** 2 * (len(used) // 3 + len(used)))
        found = wanted.copy()
        found[used] -= stiffness @ np.linalg.solve(system, moved[used])
        return found
