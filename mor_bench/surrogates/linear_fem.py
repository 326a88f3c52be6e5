"""Linear elasticity: columns of the inverse of the rest-state stiffness, or a back-solve with it."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


class LinearFEM(Surrogate):
    """u = K₀⁻¹ f, with K₀ the stiffness at rest, factorised or inverted once. Wrong by the square of the rotations."""

    needs_snapshots = False

    def __init__(self) -> None:
        pass

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        """Factorise the rest-state stiffness and keep columns of its inverse; snapshots are not used."""
        with self._fitting(scene):
            self._restore({})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        return self.compliance_.respond(batch.reshape(-1, self.scene_.mesh.n_dofs)).reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        self.compliance_ = Compliance(FullOrderModel(self.scene_))
