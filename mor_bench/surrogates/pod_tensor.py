"""POD-Galerkin for Saint Venant-Kirchhoff by the exact polynomial of its reduced energy."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import MAX_LOAD_N, NewtonOptions, solve_equilibrium
from mor_bench.reduction.basis import pod
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto, size_to_needs
from mor_bench.reduction.subspace import Subspace
from mor_bench.reduction.tensors import MOST_MODES, TensorProblem, has_polynomial
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

N_WATCHED = 300
"""Training samples, spread evenly, that tell where det F is to be watched."""


class TensorPOD(Surrogate):
    """POD-Galerkin without a mesh: Newton's method on the quartic polynomial that the reduced energy is.

    The answers are those of plain POD (Barbič and James 2005); only the wanted outputs are expanded. The polynomial knows no
    det F: it is watched at the few quadrature points where the training samples had their smallest. Where a state goes below
    what they showed there, the whole mesh is looked at; one that is inverted, or unstable, is sought again by plain POD with its
    safeguarded increments, and refused if none is found.

    Parameters
    ----------
    n_modes : int or "auto"
        Size r of the basis; capped at the snapshots' rank with a warning. Memory and time of a query grow as r⁴. "auto", here
        and of the tolerance: as little work as meets the scene's need, see `mor_bench.reduction.sizing`.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load.
    """

    def __init__(
        self,
        n_modes: Annotated[int, Field(ge=1, le=MOST_MODES)] | Auto = 20,
        tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8,
    ) -> None:
        self.n_modes = n_modes
        self.tolerance = tolerance

    def supports(self, scene: Scene) -> str | None:
        if scene.material is not None and not has_polynomial(scene):
            return f"only the energy of saint-venant-kirchhoff is a polynomial of the displacement; this law is {scene.generated.material.law}"
        return unknown_equations(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            known = self._checked_snapshots(snapshots)
            rungs = {"n_modes": [r for r in MODES if r <= MOST_MODES], "tolerance": TOLERANCES}
            displacements, knobs = (
                known.free_displacements,
                size_to_needs(self, scene, known, rungs),
            )
            modes = pod(displacements, knobs["n_modes"]).modes
            chosen = np.unique(np.linspace(0, len(displacements) - 1, N_WATCHED).astype(int))
            problem = TensorProblem.of_modes(
                FullOrderModel(scene), modes, displacements[chosen] @ modes
            )
            self._restore({"modes": modes, **problem.arrays})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        return self._subspace.answer(batch, self._solve).reshape(np.shape(forces))

    def _solve(self, load: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reduced coordinates under a reduced load."""
        q = (
            self.problem_.quick(load, self.tolerance_)
            if 0 < np.abs(load).max() <= MAX_LOAD_N
            else None
        )
        if q is not None and not (self.problem_.unlike(q) and self._plain.force(q).min_det_f <= 0):
            return q
        return solve_equilibrium(
            self._plain, load, options=NewtonOptions(self.tolerance_)
        ).displacement

    @cached_property
    def _plain(self) -> GalerkinProblem:
        """The same equations over the mesh."""
        return GalerkinProblem(FullOrderModel(self.scene_).assembler, self.modes_)

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"modes": self.modes_, **self.problem_.arrays}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        modes, self.problem_ = state["modes"], TensorProblem.of_arrays(self.scene_, state)
        shape = len(self.scene_.free_dofs), self.problem_.n_unknowns
        if modes.shape != shape or not np.isfinite(modes).all():
            raise InvalidInputError(
                f"`modes` must be a finite array of shape {shape}; got shape {modes.shape}."
            )
        self.modes_, self.tolerance_ = modes, self._sized("tolerance")
        vars(self).pop("_plain", None)
        self._subspace = Subspace(self.scene_, modes)
