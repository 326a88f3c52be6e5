"""Galerkin projection of a body that a rigid instrument presses.

The reduced contact is exact: it sums over all points of the surface that may touch, of which few
do. Their choice depends on the place of the instrument, so a cubature of training samples would
miss contacts elsewhere.
"""

from __future__ import annotations

from copy import copy
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.errors import SolverError
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.contact import solve_contact
from mor_bench.mechanics.contact_points import ContactPoints, Touch, motion_of
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.problem import Attempt
from mor_bench.reduction.galerkin import DenseProblem
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]


class PressedModes(DenseProblem):
    """A reduced model with an instrument: Φᵀ f_int(Φq) = Φᵀ f_contact(Φq).

    Parameters
    ----------
    scene : Scene
        A scene with an instrument.
    body : DenseProblem
        The reduced model of the body alone, over all cells or weighted ones.
    modes : (n_free, r) float64
        Φ on the free dofs.
    """

    def __init__(self, scene: Scene, body: DenseProblem, modes: Array) -> None:
        self._scene, self._body, self._points = scene, body, ContactPoints(scene)
        self.n_unknowns, self.extent = modes.shape[1], body.extent
        on_nodes = np.zeros((scene.mesh.n_dofs, modes.shape[1]))
        on_nodes[scene.free_dofs] = modes
        flat = on_nodes.reshape(scene.mesh.n_nodes, -1)
        self._modes = np.asarray(self._points.surface.values @ flat).reshape(-1, modes.shape[1])
        self.motion = np.zeros(3)

    def under(self, motion: Array) -> Self:
        """Return the model with the instrument displaced by (3,), m."""
        found = copy(self)
        found.motion = motion
        return found

    @property
    def rest_tangent(self) -> Array:
        return self._body.rest_tangent

    def _touch(self, q: Array) -> tuple[Touch, Array]:
        """Return the contact, and the modes (n_touching, 3, r) at its points."""
        count(multiply_adds=self._modes.size)
        touch = self._points.touch((self._modes @ q).reshape(-1, 3), self.motion)
        return touch, self._modes.reshape(-1, 3, self.n_unknowns)[touch.points]

    def _force(self, touch: Touch, modes: Array) -> Array:
        count(multiply_adds=modes.size)
        return np.asarray(touch.forces.ravel() @ modes.reshape(-1, self.n_unknowns))

    def contact_size(self, q: Array) -> float:
        """Return the norm of the contact's reduced force."""
        return float(np.linalg.norm(self._force(*self._touch(q))))

    def force(self, q: Array) -> State:
        return self._pressed(self._body.force(q), *self._touch(q))

    def linearise(self, q: Array) -> tuple[State, Array]:
        state, tangent = self._body.linearise(q)
        touch, modes = self._touch(q)
        bent = np.matmul(touch.blocks(curved=True), modes)
        r = self.n_unknowns
        count(multiply_adds=modes.size * (3 + r))
        contact = modes.reshape(-1, r).T @ bent.reshape(-1, r)
        return self._pressed(state, touch, modes), tangent + contact

    def _pressed(self, state: State, touch: Touch, modes: Array) -> State:
        force = state.force - self._force(touch, modes)
        return State(force, state.energy_j + touch.energy_j, state.min_det_f)

    def quickly(self, start: Array, tolerance: float) -> Attempt:
        """Do nothing: a reduced model has no accelerated iteration."""
        return Attempt(start, 1.0, 0, converged=False)

    def solve(self, given: Array, options: NewtonOptions) -> Array:
        """Return coordinates (r,) for a displacement of the instrument at the free dofs, (n_free,).

        Raises
        ------
        InvalidInputError
            If it is not the same at all nodes that the instrument may touch.
        SolverError
            If there is no stable equilibrium.
        """
        motion = motion_of(self._scene, given)
        found = solve_contact(self, motion, self._points.first_step(motion), options)
        if isinstance(found, SolverError):
            raise found
        return found.displacement
