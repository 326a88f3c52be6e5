"""Galerkin on the quadratic manifold of the modal derivatives, with static correction: no snapshots."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench import counting
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.manifold import ManifoldProblem, QuadraticManifold
from mor_bench.reduction.modal_derivatives import linear_modes, modal_derivatives
from mor_bench.reduction.static_correction import static_correction
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


class QuadraticManifoldGalerkin(Surrogate):
    """Few linear modes, each bent by its modal derivatives: u = Φq + ½ Σ qᵢqⱼψᵢⱼ.

    DOCSTRING

    Parameters
    ----------
    n_modes : int
        Unknowns q; capped at the rank of the linear responses to the scene's loads with a warning.
    tolerance : float
        Norm of the reduced residual relative to that of the reduced load.
    """

    needs_snapshots: ClassVar[bool] = False

    def __init__(self, n_modes: Annotated[int, Field(ge=1)] = 10, tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8) -> None:
        self.n_modes = n_modes
        self.tolerance = tolerance

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        """Compute the modes and their derivatives; snapshots are not looked at."""
        with self._fitting(scene):
            model = FullOrderModel(scene)
            modes = linear_modes(scene, model, self.n_modes).modes
            self._restore({"modes": modes, "derivatives": modal_derivatives(model, modes)})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        out = np.zeros((len(batch), self.scene_.mesh.n_dofs))
        free = self.scene_.free_dofs
        for row, load in zip(out, batch.reshape(out.shape)[:, free], strict=True):
            problem = ManifoldProblem(self.linear_, self.manifold_, load)
            if counting.running is not None:
                counting.running.add(multiply_adds=self.modes_.size)
            q = solve_equilibrium(problem, self.modes_.T @ load, options=NewtonOptions(self.tolerance)).displacement
            row[free] = self.manifold_.at(q)[0] + static_correction(self.model_.rest_factor, problem.rest_factor, self.modes_, load)
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"modes": self.modes_, "derivatives": self.derivatives_}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        self.modes_, self.derivatives_ = (np.ascontiguousarray(state[name]) for name in ("modes", "derivatives"))
        self.model_ = FullOrderModel(self.scene_)
        self.linear_ = GalerkinProblem(self.model_.assembler, self.modes_)
        self.manifold_ = QuadraticManifold(self.modes_, self.derivatives_)
        _ = self.linear_.rest_factor, self.model_.rest_factor
