"""The full-order model as a contestant."""

from __future__ import annotations

from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.errors import SolverError
from mor_bench.mechanics.model import missing_library, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.observed import forward_model
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import SolverName
from mor_bench.surrogate import Surrogate


class FullFEM(Surrogate):
    """The nonlinear solve on the whole mesh.

    Given displacements of a part of the surface it holds these and leaves all other nodes without a force: exact where
    every loaded node is seen, see `mor_bench.mechanics.observed`.

    Parameters
    ----------
    tolerance : float
        Norm of the residual relative to that of the load at which the solve stops.
    solver : str, optional
        One of `mor_bench.mechanics.model.SOLVERS`; by default as the scene says.
    """

    needs_snapshots = False
    takes_observations = True

    def __init__(
        self,
        tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8,
        solver: SolverName | None = None,
    ) -> None:
        self.tolerance = tolerance
        self.solver = solver

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True) or missing_library(
            self.solver or scene.generated.solver
        )

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        """Assemble and factorise the rest-state stiffness; snapshots are not used."""
        with self._fitting(scene):
            self._restore({})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        out = np.zeros((len(batch), self.scene_.mesh.n_dofs))
        free = self.scene_.free_dofs
        loads = batch.reshape(-1, self.scene_.mesh.n_dofs)[:, free]
        for row, found in zip(
            out, self.model_.solve_many(loads, NewtonOptions(self.tolerance)), strict=True
        ):
            if isinstance(found, SolverError):
                raise found
            row[free] = found.displacement
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        self.model_ = forward_model(self.scene_, self.solver)
