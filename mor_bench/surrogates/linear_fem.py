"""Linear elasticity: one back-solve with the rest-state stiffness."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.observed import forward_model
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


class LinearFEM(Surrogate):
    """u = K₀⁻¹ f, with K₀ the stiffness at rest, factorised once. Wrong by the square of the rotations.

    Given displacements of a part of the surface it answers with their linear extension, u_h = -K_hh⁻¹ K_ho u_o.
    """

    needs_snapshots = False
    takes_observations = True

    def __init__(self) -> None:
        pass

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True)

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        """Factorise the rest-state stiffness; snapshots are not used."""
        with self._fitting(scene):
            self._restore({})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        out = np.zeros((len(batch), self.scene_.mesh.n_dofs))
        free = self.scene_.free_dofs
        out[:, free] = self.model_.linear_response(batch.reshape(-1, self.scene_.mesh.n_dofs)[:, free])
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        self.model_ = forward_model(self.scene_)
