"""POD-Galerkin for Saint Venant-Kirchhoff by the exact polynomial of its reduced energy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import MAX_LOAD_N, NewtonOptions, solve_equilibrium
from mor_bench.mechanics.parametric import ParametricModel
from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import pod
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.parametric_tensors import LameTensors
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto
from mor_bench.reduction.subspace import Subspace
from mor_bench.reduction.tensors import MOST_MODES, TensorProblem, has_polynomial
from mor_bench.scene.materials import SaintVenantKirchhoff
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

N_WATCHED = 300
"""Training samples, spread evenly, that decide where det F is monitored."""


@dataclass(eq=False)
class TensorPOD(Surrogate):
    """POD-Galerkin without a mesh: Newton's method on the quartic polynomial of the reduced energy.

    The answers are those of plain POD (Barbič and James 2005); only the wanted outputs are
    expanded. The polynomial does not contain det F. So det F is monitored at the few quadrature
    points where the training samples had their smallest values. A state below these values is
    checked on the whole mesh. If it is inverted or unstable, plain POD solves again with its
    safeguarded increments.

    Parameters
    ----------
    n_modes : int or "auto"
        Size r of the basis; capped at the snapshots' rank with a warning. Memory and time of a
        query grow as r⁴. "auto": the cheapest value that meets the scene's need, see
        `mor_bench.reduction.sizing`.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load, in (0, 1].
    """

    n_modes: Annotated[int, Field(ge=1, le=MOST_MODES)] | Auto = 20
    tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8

    sized: ClassVar = {
        "n_modes": tuple(r for r in MODES if r <= MOST_MODES),
        "tolerance": TOLERANCES,
    }

    takes_parameters: ClassVar = True

    def supports(self, scene: Scene) -> str | None:
        if others := [n for n in scene.parameter_names if n not in ("young_pa", "poisson")]:
            return f"its polynomial is exact in λ and μ only; the scene samples {', '.join(others)}"
        if scene.parameter_names and scene.generated.is_preloaded:
            return "its polynomial about the rest state is that of one material only"
        if scene.material is not None and not has_polynomial(scene):
            law = scene.generated.material.law
            return (
                "only the energy of saint-venant-kirchhoff is a polynomial of the displacement; "
                f"this law is {law}"
            )
        return unknown_equations(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        displacements = samples.free_displacements
        modes = pod(displacements, self.value("n_modes")).modes
        chosen = np.unique(np.linspace(0, len(displacements) - 1, N_WATCHED).astype(int))
        watched = displacements[chosen] @ modes
        if scene.parameter_names:
            return {"modes": modes, **LameTensors.learned(scene, modes, watched)}
        problem = TensorProblem.of_modes(FullOrderModel(scene), modes, watched)
        return {"modes": modes, **problem.arrays}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        self.tolerance_ = self.value("tolerance")
        if scene.parameter_names:
            r = take_array(model, "shear_quadratic", (None, None)).shape[1]
            self.modes_ = take_array(model, "modes", (len(scene.free_dofs), r))
            self.tensors_ = LameTensors.of_arrays(scene, self.modes_, model)
            self.bodies_ = ParametricModel(scene)
        else:
            self.problem_ = TensorProblem.of_arrays(scene, model)
            shape = len(scene.free_dofs), self.problem_.n_unknowns
            self.modes_ = take_array(model, "modes", shape)
        self.subspace_ = Subspace(scene, self.modes_)

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.subspace_.answer(
            forces, lambda load: self._solve(load, self.problem_, lambda: self._plain)
        )

    def answer_parametric(
        self, forces: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return self.subspace_.answer_each(forces, parameters, self._solve_on)

    def _solve_on(
        self, load: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        values = dict(zip(self.scene_.parameter_names, parameters.tolist(), strict=True))
        material = self.scene_.material
        assert isinstance(material, SaintVenantKirchhoff)
        material = replace(material, **values)
        problem = self.tensors_.at(material.lame_lambda, material.lame_mu)

        def plain() -> GalerkinProblem:
            return GalerkinProblem(self.bodies_.assembler_of(parameters), self.modes_)

        return self._solve(load, problem, plain)

    def _solve(
        self,
        load: NDArray[np.float64],
        problem: TensorProblem,
        plain: Callable[[], GalerkinProblem],
    ) -> NDArray[np.float64]:
        """Solve by the polynomial, or by plain POD where the polynomial may be wrong."""
        q = problem.quick(load, self.tolerance_) if 0 < np.abs(load).max() <= MAX_LOAD_N else None
        if q is not None and not (problem.unlike(q) and plain().force(q).min_det_f <= 0):
            return q
        return solve_equilibrium(plain(), load, options=NewtonOptions(self.tolerance_)).displacement

    @cached_property
    def _plain(self) -> GalerkinProblem:
        """Plain POD: the same equations, integrated over the mesh."""
        return GalerkinProblem(FullOrderModel(self.scene_).assembler, self.modes_)
