"""Linear elasticity: columns of the inverse of the rest-state stiffness, or a back-solve with it."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.observed import linear_response
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


class LinearFEM(Surrogate):
    """u = K₀⁻¹ f, with K₀ the stiffness at rest, factorised or inverted once. Wrong by the square of the rotations.

    Given displacements of a part of the surface it answers with their linear extension, u_h = -K_hh⁻¹ K_ho u_o.
    """

    needs_snapshots = False
    takes_observations = True

    def __init__(self) -> None:
        pass

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True)

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        """Factorise the rest-state stiffness and keep columns of its inverse; snapshots are not used."""
        with self._fitting(scene):
            self._restore({})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        return self.compliance_.respond(batch.reshape(-1, self.scene_.mesh.n_dofs)).reshape(
            np.shape(forces)
        )

    def _state(self) -> dict[str, NDArray[Any]]:
        return {}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        self.compliance_ = linear_response(self.scene_)
