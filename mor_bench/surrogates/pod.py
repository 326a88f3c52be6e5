"""POD-Galerkin: the equilibrium sought in the span of the leading modes of the snapshots."""

from __future__ import annotations

from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench import counting
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.reduction.basis import pod
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


def predict_reduced(
    scene: Scene, problem: GalerkinProblem, modes: NDArray[np.float64], batch: NDArray[np.float64], tolerance: float
) -> NDArray[np.float64]:  # fmt: skip
    """Solve the reduced equilibrium for each load (n, n_nodes, 3), N, and expand to all nodes, m."""
    out = np.zeros((len(batch), scene.mesh.n_dofs))
    if counting.running is not None:
        counting.running.add(multiply_adds=2 * modes.size * len(batch))
    for row, load in zip(out, batch.reshape(-1, scene.mesh.n_dofs), strict=True):
        solution = solve_equilibrium(problem, modes.T @ load[scene.free_dofs], options=NewtonOptions(tolerance))
        row[scene.free_dofs] = modes @ solution.displacement
    return out.reshape(batch.shape)


class PODGalerkin(Surrogate):
    """SVD of the snapshots, truncated; Galerkin projection with full assembly.

    Parameters
    ----------
    n_modes : int
        Size r of the basis; capped at the snapshots' rank with a warning.
    tolerance : float
        Norm of the reduced residual relative to that of the reduced load.
    """

    def __init__(self, n_modes: Annotated[int, Field(ge=1)] = 20, tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8) -> None:
        self.n_modes = n_modes
        self.tolerance = tolerance

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            basis = pod(self._checked_snapshots(snapshots).free_displacements, self.n_modes)
            self._restore({"modes": basis.modes})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        return predict_reduced(self.scene_, self.problem_, self.modes_, batch, self.tolerance).reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"modes": self.modes_}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        self.modes_ = state["modes"]
        self.problem_ = GalerkinProblem(FullOrderModel(self.scene_).assembler, self.modes_)
        _ = self.problem_.rest_factor
