"""Linear elasticity: columns of the inverse of the rest-state stiffness, or a back-solve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.moved_bodies import parametric_response
from mor_bench.mechanics.observed import linear_response
from mor_bench.reduction.subspace import at_wanted, wanted_dofs
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.surrogate import Surrogate


@dataclass(eq=False)
class LinearFEM(Surrogate):
    """u = K₀⁻¹ f, with the stiffness at rest K₀ factorised or inverted once.

    The error grows as the square of the rotations. From observed displacements u_o it returns the
    linear extension, u_h = -K_hh⁻¹ K_ho u_o at the hidden nodes.
    """

    needs_snapshots: ClassVar = False
    takes_parameters: ClassVar = True

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True)

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        if scene.parameter_names:
            self.responses_ = parametric_response(scene)
        else:
            self.compliance_ = linear_response(scene)
            self._wanted, self._respond = None, self.compliance_.respond
            if isinstance(self.compliance_, Compliance):
                self._wanted = wanted_dofs(scene)
                self._respond = self.compliance_.at(self._wanted)

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        loads = forces.reshape(-1, self.scene_.mesh.n_dofs)
        return at_wanted(self._respond(loads), self._wanted, loads.shape[1]).reshape(forces.shape)

    def answer_parametric(
        self, forces: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        loads = forces.reshape(-1, self.scene_.mesh.n_dofs)
        return self.responses_.respond(loads, parameters).reshape(forces.shape)

    def answer_observed(self, observed: ObservedDisplacements) -> NDArray[np.float64]:
        return self.answer(observed.values)
