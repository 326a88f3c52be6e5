"""The full-order model on a coarser mesh of the same body."""

from __future__ import annotations

from math import ceil
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import UnconstrainedBodyError, UnsupportedSceneError
from mor_bench.mechanics.model import FullOrderModel, check_supports, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.scene import Scene, with_cells
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate


class CoarseFEM(Surrogate):
    """Full-order FEM with fewer cells, u = P u_c(Pᵀ f), with P the coarse shape functions at the scene's nodes.

    Pᵀ keeps the sum of the forces and their moments. The supports of the coarse mesh come from the same regions.

    Parameters
    ----------
    coarsening : int
        The scene's cells per axis are divided by it and rounded up.
    tolerance : float
        Norm of the residual relative to that of the load at which the solve stops.
    """

    needs_snapshots = False

    def __init__(
        self,
        coarsening: Annotated[int, Field(ge=2)] = 2,
        tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-4,
    ) -> None:
        self.coarsening = coarsening
        self.tolerance = tolerance

    def fit(self, scene: Scene, snapshots: Snapshots | None = None) -> Self:
        """Build the coarse mesh and factorise its rest-state stiffness; snapshots are not used."""
        with self._fitting(scene):
            self._restore({})
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        coarse = self.model_.scene
        out = np.zeros_like(batch)
        count(multiply_adds=6 * self.interpolation_.nnz * len(batch))
        for row, load in zip(out, batch, strict=True):
            displacement = np.zeros(coarse.mesh.n_dofs)
            displacement[coarse.free_dofs] = self.model_.solve(
                (self._restriction @ load).ravel()[coarse.free_dofs], options=self._options
            ).displacement
            row[:] = self.interpolation_ @ displacement.reshape(-1, 3)
        out[:, self.scene_.fixed_nodes] = 0
        return out.reshape(np.shape(forces))

    def supports(self, scene: Scene) -> str | None:
        """The reason why there is no coarser mesh of a scene, or why it would not be held."""
        if reason := unknown_equations(scene):
            return reason
        try:
            check_supports(self._coarse(scene))
        except (UnsupportedSceneError, UnconstrainedBodyError) as error:
            return str(error)
        return None

    def _coarse(self, scene: Scene) -> Scene:
        nx, ny, nz = (
            ceil(n / self.coarsening) for n in getattr(scene.generated.geometry, "cells", (1, 1, 1))
        )
        coarse = with_cells(scene, (nx, ny, nz))
        if coarse.mesh.n_cells == scene.mesh.n_cells:
            raise UnsupportedSceneError(f"{scene.name}: a mesh of one cell cannot be made coarser.")
        return coarse

    def _state(self) -> dict[str, NDArray[Any]]:
        return {}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        coarse = self._coarse(self.scene_)
        self.model_ = FullOrderModel(coarse)
        _ = self.model_.rest_factor
        self.interpolation_ = interpolation_matrix(coarse.mesh, self.scene_.mesh.points)
        self._restriction = self.interpolation_.T.tocsr()
        self._options = NewtonOptions(self.tolerance)
