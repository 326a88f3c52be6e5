"""Total Lagrangian explicit dynamics as a method, relaxed to the static equilibrium."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.relaxation import DynamicRelaxation
from mor_bench.scene.scene import Scene
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.free_dofs import answer_each


@dataclass(eq=False)
class ExplicitDynamics(Surrogate):
    """The whole mesh moves under the load until it rests; see `mor_bench.mechanics.relaxation`.

    Parameters
    ----------
    tolerance : float
        Norm of the residual at rest relative to that of the load, in (0, 1].
    start : {"rest", "linear-response"}
        Initial displacement. Codes of this family start at rest, because they hold no stiffness;
        "linear-response" costs a back-solve with the factor of the stiffness at rest.
    max_steps : int
        Steps after which the solve fails. A second attempt, after divergence, has the same limit.
    """

    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-4
    start: Literal["rest", "linear-response"] = "rest"
    max_steps: Annotated[int, Field(ge=1)] = 50_000

    needs_snapshots: ClassVar = False

    def supports(self, scene: Scene) -> str | None:
        if scene.frames is not None:
            return "it moves nodes along x, y and z only, and some supports are oblique"
        return unknown_equations(scene)

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        self.relaxation_ = DynamicRelaxation(FullOrderModel(scene))

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        return answer_each(self.scene_, forces, self._solve)

    def _solve(self, load: NDArray[np.float64]) -> NDArray[np.float64]:
        start = (
            self.relaxation_.model.rest_factor.solve(load)
            if self.start == "linear-response"
            else None
        )
        return self.relaxation_.solve(load, self.tolerance, self.max_steps, start).displacement
