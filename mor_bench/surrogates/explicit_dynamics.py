"""Total Lagrangian explicit dynamics, relaxed to the static equilibrium, as a contestant."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.relaxation import DynamicRelaxation
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


class ExplicitDynamics(Surrogate):
    """The whole mesh, let go under the load and relaxed until it rests; see `mor_bench.mechanics.relaxation`.

    Parameters
    ----------
    tolerance : float
        Norm of the residual relative to that of the load at which the body rests.
    start : {"rest", "linear-response"}
        Where the body is let go. `rest` is what codes of this family do, which hold no stiffness; `linear-response` costs a
        back-solve with the factor of the stiffness at rest.
    max_steps : int
        Steps after which there is no answer; a second attempt, after divergence, may take as many.
    """

    needs_snapshots = False

    def __init__(
        self,
        tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-4,
        start: Literal["rest", "linear-response"] = "rest",
        max_steps: Annotated[int, Field(ge=1)] = 50_000,
    ) -> None:
        self.tolerance = tolerance
        self.start = start
        self.max_steps = max_steps

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        """Find mass and extreme frequencies at rest; snapshots are not used."""
        with self._fitting(scene):
            self._restore({})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        out = np.zeros((len(batch), self.scene_.mesh.n_dofs))
        free = self.scene_.free_dofs
        for row, load in zip(out, batch.reshape(-1, self.scene_.mesh.n_dofs)[:, free], strict=True):
            start = (
                self.relaxation_.model.rest_factor.solve(load)
                if self.start == "linear-response"
                else None
            )
            row[free] = self.relaxation_.solve(
                load, self.tolerance, self.max_steps, start
            ).displacement
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        self.relaxation_ = DynamicRelaxation(FullOrderModel(self.scene_))
