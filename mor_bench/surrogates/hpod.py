"""Hyper-reduced POD by energy-conserving sampling and weighting (ECSW)."""

from __future__ import annotations

from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.reduction.basis import pod
from mor_bench.reduction.cubature import ecsw_system, sparse_nnls
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.sizing import MODES, TOLERANCES, Auto, size_to_needs
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import NO_EQUATIONS
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.pod import predict_reduced

CUBATURE_TOLERANCES = (3e-2, 1e-2, 3e-3, 1e-3)
"""To choose from."""


class HyperReducedPOD(Surrogate):
    """POD-Galerkin that integrates over a few weighted cells only.

    The weights are trained so that the reduced force of the projected snapshots is kept to a relative residual
    (Farhat et al. 2014). The sum of the weights is not the number of cells, and volume is not preserved.

    Parameters
    ----------
    n_modes : int or "auto"
        Size r of the basis; capped at the snapshots' rank with a warning. "auto", here and of the tolerances: as little work as
        meets the scene's need, see `mor_bench.reduction.sizing`.
    cubature_tolerance : float or "auto"
        Relative residual of the reduced forces. Smaller keeps more cells: slower and closer to plain POD.
    n_cubature_snapshots : int
        Training snapshots whose reduced forces are matched, spread evenly over the training set.
    tolerance : float or "auto"
        Norm of the reduced residual relative to that of the reduced load.
    """

    def __init__(
        self,
        n_modes: Annotated[int, Field(ge=1)] | Auto = 20,
        cubature_tolerance: Annotated[float, Field(ge=0, lt=1)] | Auto = 1e-3,
        n_cubature_snapshots: Annotated[int, Field(ge=1)] = 300,
        tolerance: Annotated[float, Field(gt=0, le=1)] | Auto = 1e-8,
    ) -> None:
        self.n_modes = n_modes
        self.cubature_tolerance = cubature_tolerance
        self.n_cubature_snapshots = n_cubature_snapshots
        self.tolerance = tolerance

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            known = self._checked_snapshots(snapshots)
            rungs = {"n_modes": MODES, "cubature_tolerance": CUBATURE_TOLERANCES, "tolerance": TOLERANCES}
            knobs = size_to_needs(self, scene, known, rungs)
            displacements = known.free_displacements
            modes = pod(displacements, knobs["n_modes"]).modes
            model = FullOrderModel(scene)
            if knobs["cubature_tolerance"] == 0:
                weights = np.ones(scene.mesh.n_cells)
            else:
                chosen = np.unique(np.linspace(0, len(displacements) - 1, self.n_cubature_snapshots).astype(int))
                system = ecsw_system(model.assembler, model.cell_dofs, modes, displacements[chosen] @ modes)
                weights = sparse_nnls(system, system.sum(axis=1), knobs["cubature_tolerance"]).weights
            cells = np.flatnonzero(weights)
            self._restore({"modes": modes, "cells": cells, "weights": weights[cells]})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        return predict_reduced(self.scene_, self.problem_, self.modes_, batch, self.tolerance_).reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {"modes": self.modes_, "cells": self.cells_, "weights": self.weights_}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        self.modes_, self.cells_, self.weights_ = state["modes"], state["cells"], state["weights"]
        self.tolerance_ = self._sized("tolerance")
        scene = self.scene_
        if scene.material is None:
            raise UnsupportedSceneError(NO_EQUATIONS)
        numbers, n_cells = self.cells_, scene.mesh.n_cells
        if numbers.dtype.kind != "i" or numbers.shape != self.weights_.shape or not ((numbers >= 0) & (numbers < n_cells)).all():
            raise InvalidInputError(f"`cells` must be integers in [0, {n_cells - 1}], as many as there are weights.")
        if self.modes_.shape[0] != len(scene.free_dofs):
            raise InvalidInputError(f"`modes` must have {len(scene.free_dofs)} rows; got {self.modes_.shape[0]}.")
        cells = scene.mesh.cells[self.cells_]
        touched = np.zeros((scene.mesh.n_nodes, 3), dtype=bool)
        touched[cells] = True
        rows = np.flatnonzero(touched.reshape(-1)[scene.free_dofs])
        dof_of_node = np.full(scene.mesh.n_dofs, len(rows), dtype=np.int64)
        dof_of_node[scene.free_dofs[rows]] = np.arange(len(rows))
        assembler = Assembler(scene.mesh.points, cells, dof_of_node.reshape(-1, 3), len(rows), scene.material, self.weights_, scene.selective)
        self.problem_ = GalerkinProblem(assembler, self.modes_[rows])
        _ = self.problem_.rest_factor
