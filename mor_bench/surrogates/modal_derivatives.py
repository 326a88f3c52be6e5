"""Galerkin on linear modes and their modal derivatives, with static correction: no snapshots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.model_arrays import take_array
from mor_bench.reduction.derivative_modes import derivative_basis, patch_responses
from mor_bench.reduction.static_correction import model_of, softened
from mor_bench.reduction.tensors import TensorProblem, polynomial_pays
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs.load_ranges import largest_of
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.corrected import Correction
from mor_bench.surrogates.free_dofs import galerkin_or_polynomial

N_WATCHED = 300
"""Linear responses to the largest loads that decide where det F is monitored."""


@dataclass(eq=False)
class ModalDerivatives(Surrogate):
    """Galerkin on principal linear responses to the scene's loads and their modal derivatives.

    The basis is computed from the equations alone. Static correction adds the part of the linear
    response outside the basis (`mor_bench.reduction.static_correction`). The basis covers only the
    loads of the scene. For other loads, the added part is linear.

    Parameters
    ----------
    n_linear : int
        Linear modes n, whose n (n + 1) / 2 modal derivatives are computed; at most the rank of the
        linear responses.
    n_modes : int
        Size of the kept basis; capped at the rank with a warning.
    tolerance : float
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    """

    n_linear: Annotated[int, Field(ge=1)] = 10
    n_modes: Annotated[int, Field(ge=1)] = 40
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8

    needs_snapshots: ClassVar[bool] = False

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        full = FullOrderModel(scene)
        modes = derivative_basis(scene, full, self.n_linear, self.n_modes)
        reduced = model_of(softened(scene), full)
        if not polynomial_pays(reduced, modes.shape[1]):
            return {"modes": modes}
        largest = (
            largest_of(scene.generated.load_plan.magnitude) * patch_responses(scene, full) @ modes
        )
        chosen = np.unique(np.linspace(0, len(largest) - 1, N_WATCHED // 2).astype(int))
        watched = np.vstack([largest[chosen], -largest[chosen]])
        return {"modes": modes, **TensorProblem.of_modes(reduced, modes, watched).arrays}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        self.modes_ = take_array(model, "modes", (len(scene.free_dofs), None))
        self.correction_ = Correction(scene)
        reduced = model_of(softened(scene), self.correction_.model)
        self.problem_ = galerkin_or_polynomial(scene, reduced, self.modes_, model)
        self.problem_.prepare()

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.correction_.answer(self.problem_, self.modes_, forces, self.tolerance)
