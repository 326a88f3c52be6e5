"""The full-order model on a coarser mesh of the same body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import UnconstrainedBodyError, UnsupportedSceneError
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.rigid_motions import check_supports
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.other_meshes import with_cells
from mor_bench.scene.scene import Scene
from mor_bench.surrogate import Surrogate


@dataclass(eq=False)
class CoarseFEM(Surrogate):
    """Full-order FEM with fewer cells: u = P u_c(Pᵀ f).

    P holds the coarse shape functions at the scene's nodes; Pᵀ preserves the sum of the forces and
    their moments. The supports of the coarse mesh come from the same regions.

    Parameters
    ----------
    coarsening : int
        Divisor of the scene's cells per axis, at least 2; the results are rounded up.
    tolerance : float
        Largest norm of the final residual relative to that of the load, in (0, 1].
    """

    coarsening: Annotated[int, Field(ge=2)] = 2
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-4

    needs_snapshots: ClassVar = False

    def supports(self, scene: Scene) -> str | None:
        """Return the reason why there is no coarser mesh, or why it has no supports."""
        if reason := unknown_equations(scene):
            return reason
        try:
            check_supports(self._coarse(scene))
        except (UnsupportedSceneError, UnconstrainedBodyError) as error:
            return str(error)
        return None

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        coarse = self._coarse(scene)
        self.model_ = FullOrderModel(coarse)
        self.model_.prepare()
        self.interpolation_ = interpolation_matrix(coarse.mesh, scene.mesh.points)
        self.restriction_ = self.interpolation_.T.tocsr()

    def answer(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        coarse, options = self.model_.scene, NewtonOptions(self.tolerance)
        out = np.zeros_like(forces)
        count(multiply_adds=6 * self.interpolation_.nnz * len(forces))
        for row, load in zip(out, forces, strict=True):
            on_coarse = coarse.at_free_dofs((self.restriction_ @ load).reshape(1, -1))[0]
            found = self.model_.solve(on_coarse, options=options).displacement
            row[:] = self.interpolation_ @ coarse.at_all_dofs(found[None]).reshape(-1, 3)
        self.scene_.hold(out.reshape(len(out), self.scene_.mesh.n_dofs))
        return out

    def _coarse(self, scene: Scene) -> Scene:
        cells = getattr(scene.generated.geometry, "cells", (1, 1, 1))
        nx, ny, nz = (ceil(n / self.coarsening) for n in cells)
        coarse = with_cells(scene, (nx, ny, nz))
        if coarse.mesh.n_cells == scene.mesh.n_cells:
            raise UnsupportedSceneError(f"{scene.name}: a mesh of one cell cannot be made coarser.")
        return coarse
