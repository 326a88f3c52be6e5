"""The full-order model as a method."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.errors import SolverError
from mor_bench.mechanics.model import missing_library, unknown_equations
from mor_bench.mechanics.moved_bodies import parametric_model
from mor_bench.mechanics.newton import NewtonOptions, Solution
from mor_bench.mechanics.observed import forward_model
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.specs import SolverName
from mor_bench.surrogate import Surrogate


@dataclass(eq=False)
class FullFEM(Surrogate):
    """The nonlinear solve on the whole mesh.

    Observed nodes are held at their displacements, and all other nodes carry no force. This is
    exact if every loaded node is observed, see `mor_bench.mechanics.observed`.

    Parameters
    ----------
    tolerance : float
        Largest norm of the final residual relative to that of the load, in (0, 1].
    solver : str, optional
        One of `mor_bench.mechanics.model.SOLVERS`. Default: the scene's solver.
    """

    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8
    solver: SolverName | None = None

    needs_snapshots: ClassVar = False
    takes_parameters: ClassVar = True

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True) or missing_library(
            self.solver or scene.generated.solver
        )

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        if scene.parameter_names:
            self.bodies_ = parametric_model(scene, self.solver)
            self.bodies_.prepare()
        else:
            self.model_ = forward_model(scene, self.solver)

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._displacements(
            forces, lambda loads: self.model_.solve_many(loads, NewtonOptions(self.tolerance))
        )

    def answer_parametric(
        self, forces: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        options = NewtonOptions(self.tolerance)
        return self._displacements(
            forces, lambda loads: self.bodies_.solve_many(loads, parameters, options)
        )

    def _displacements(
        self,
        forces: NDArray[np.float64],
        solve: Callable[[NDArray[np.float64]], list[Solution | SolverError]],
    ) -> NDArray[np.float64]:
        scene = self.scene_
        loads = scene.at_free_dofs(forces.reshape(len(forces), scene.mesh.n_dofs))
        out = loads.copy()
        for row, found in zip(out, solve(loads), strict=True):
            if isinstance(found, SolverError):
                raise found
            row[:] = found.displacement
        return scene.at_all_dofs(out).reshape(forces.shape)

    def answer_observed(self, observed: ObservedDisplacements) -> NDArray[np.float64]:
        return self.answer(observed.values)
