"""POD-Galerkin: the equilibrium in the span of the leading modes of the snapshots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.mechanics.parametric import ParametricModel
from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import pod
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto
from mor_bench.reduction.subspace import Subspace
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.surrogate import Surrogate


def stiffness_at_rest(model: FullOrderModel) -> sp.csr_array:
    """Return the stiffness at rest K₀ over the free dofs, (n_free, n_free), N/m."""
    return model.assembler.pattern.symmetric(model.rest_tangent)


@dataclass(eq=False)
class PODGalerkin(Surrogate):
    """Galerkin projection onto the leading singular vectors of the snapshots, fully assembled.

    Parameters
    ----------
    n_modes : int, "auto" or "energy"
        Size r of the basis; capped at the snapshots' rank with a warning. "auto": the smallest that
        meets the scene's need, see `mor_bench.reduction.sizing`. "energy": chosen by
        `energy_tolerance`, which only this value requires and allows.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    energy_tolerance : float, optional
        Keep the fewest modes n with √(Σ_{j>n} sⱼ² / Σ sⱼ²) at or below this; s are the singular
        values.
    inner_product : {"euclidean", "stiffness"}
        Inner product in which the modes are orthonormal: of the free displacements, or uᵀK₀v
        with the stiffness at rest. Keep the default; the other one brings no benefit.
    """

    n_modes: Annotated[int, Field(ge=1)] | Literal["auto", "energy"] = 20
    tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8
    energy_tolerance: Annotated[float, Field(gt=0, lt=1)] | None = None
    inner_product: Literal["euclidean", "stiffness"] = "euclidean"

    sized: ClassVar = {"n_modes": MODES, "tolerance": TOLERANCES}
    takes_parameters: ClassVar = True

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, contact=True)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        n_modes = self.value("n_modes")
        if (n_modes == "energy") != (self.energy_tolerance is not None):
            raise InvalidInputError(
                '`energy_tolerance` of PODGalerkin must be given with `n_modes` = "energy", '
                f"and not otherwise; got {self.energy_tolerance} with {self.n_modes!r}."
            )
        product = (
            stiffness_at_rest(FullOrderModel(scene)) if self.inner_product == "stiffness" else None
        )
        basis = pod(
            samples.free_displacements,
            None if n_modes == "energy" else n_modes,
            energy_tolerance=self.energy_tolerance,
            inner_product=product,
        )
        return {"modes": basis.modes}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        self.modes_ = take_array(model, "modes", (len(scene.free_dofs), None))
        self.options_ = NewtonOptions(self.value("tolerance"))
        self.subspace_ = Subspace(scene, self.modes_)
        if scene.parameter_names:
            self.bodies_ = ParametricModel(scene)
            return
        self.problem_ = GalerkinProblem(FullOrderModel(scene).assembler, self.modes_)
        self.problem_.prepare()
        if scene.contact:
            from mor_bench.reduction.pressed_modes import PressedModes  # only such scenes need it

            self.pressed_ = PressedModes(scene, self.problem_, self.modes_)

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.subspace_.answer(
            forces,
            lambda load: solve_equilibrium(self.problem_, load, options=self.options_).displacement,
        )

    def answer_observed(self, observed: ObservedDisplacements) -> NDArray[np.float64]:
        return self.subspace_.answer_given(
            observed.values, lambda given: self.pressed_.solve(given, self.options_)
        )

    def answer_parametric(
        self, forces: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return self.subspace_.answer_each(forces, parameters, self._solve_on)

    def _solve_on(
        self, load: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        body, factor = self.bodies_.bodies.shared(parameters)
        problem = GalerkinProblem(self.bodies_.assembler_of(body), self.modes_)
        return solve_equilibrium(problem, factor * load, options=self.options_).displacement
