"""Linear elasticity of a body that an instrument presses: contact is its only nonlinearity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count, uncounted
from mor_bench.errors import NoEquilibriumError, UnsupportedSceneError
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.contact_balance import Balance, DenseFlexibility
from mor_bench.mechanics.contact_points import ContactMap, ContactPoints, motion_of
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.dofs import dofs_of_nodes
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]

LEAST_STEP = 1e-3
"""Smallest step of the instrument, as a fraction of its motion, before the solve gives up."""
CHUNK = 256
"""Columns of the compliance that are computed together."""


class LinearContact:
    """K₀ u = f(u), with the stiffness at rest K₀ and the contact's forces f.

    With the compliance C = K₀⁻¹ at the dofs that the instrument may touch, u = C f; see `Balance`.

    Parameters
    ----------
    scene : Scene
        A scene with an instrument.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, model = scene, FullOrderModel(scene)
        self._compliance = Compliance(model)
        assert scene.observed_nodes is not None
        dofs = np.intersect1d(dofs_of_nodes(scene.observed_nodes), scene.free_dofs)
        self._dofs, self._places = dofs, np.searchsorted(scene.free_dofs, dofs)
        n = len(dofs)
        self._flexibility = np.empty((n, n))
        with uncounted():
            for start in range(0, n, CHUNK):
                columns = np.arange(start, min(start + CHUNK, n))
                units = np.zeros((model.n_unknowns, len(columns)))
                units[self._places[columns], np.arange(len(columns))] = 1.0
                self._flexibility[:, columns] = self._compliance.solve(units)[self._places]
        number = np.full(scene.mesh.n_dofs, n, dtype=np.int64)
        number[dofs] = np.arange(n)
        self._contact = ContactMap(ContactPoints(scene), number.reshape(-1, 3), n)
        self._balance = Balance(self._contact, DenseFlexibility(self._flexibility))

    def respond(self, loads: Array, /) -> Array:
        """Return the responses (n, n_dofs), m, to displacements of the instrument of that shape.

        Raises
        ------
        NoEquilibriumError
            If the iteration does not converge.
        """
        forces = np.zeros(loads.shape)
        for row, given in zip(forces, loads, strict=True):
            motion = motion_of(self.scene, given[self.scene.free_dofs])
            if motion.any():
                row[self._dofs] = self._solved(motion)
        return self._compliance.respond(forces)

    def to_coordinates(self, axes: Array) -> Array:
        """Raise an error, since the response is not a linear function of the displacement."""
        raise UnsupportedSceneError(
            f"{self.scene.name}: the response to an instrument is not a linear function."
        )

    def _solved(self, motion: Array) -> Array:
        """Return the contact's forces (n_touched_dofs,), N."""
        step = 1.0 / np.ceil(1.0 / self._contact.points.first_step(motion))
        reached, forces = 0.0, np.zeros(len(self._dofs))
        while reached < 1.0:
            place = 1.0 if reached + 1.001 * step > 1.0 else reached + step
            u = self._flexibility @ forces
            count(multiply_adds=self._flexibility.size)
            before = self._contact.normals(u, reached * motion)
            found = self._balance.settle(u, forces, place * motion)
            if found is not None and not self._passed(found, place * motion, before):
                reached, forces = place, found
            elif (step := 0.5 * step) < LEAST_STEP:
                raise NoEquilibriumError(
                    f"{self.scene.name}: linear elasticity with contact has no solution on this "
                    f"side of the instrument, beyond {reached:.0%} of the motion."
                )
        return forces

    def _passed(self, forces: Array, motion: Array, before: Array) -> bool:
        """Return whether the surface got past the instrument's centre since these normals (n, 3).

        The potential has a second minimum there, with the surface on the other side.
        """
        u = self._flexibility @ forces
        count(multiply_adds=self._flexibility.size)
        touch = self._contact.touch(u, motion)
        return bool(((touch.normals * before[touch.points]).sum(axis=1) < 0).any())
