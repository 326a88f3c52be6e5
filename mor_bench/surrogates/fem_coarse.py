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
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.rigid_motions import check_supports
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.other_meshes import with_cells
from mor_bench.scene.scene import Scene
from mor_bench.surrogate import Surrogate

Array = NDArray[np.float64]


@dataclass(eq=False)
class CoarseFEM(Surrogate):
    """Full-order FEM with fewer cells, u = P u_c(Pᵀf), or its nonlinear part.

    P holds the coarse shape functions at the scene's nodes; Pᵀ preserves the sum of the forces and
    their moments. The supports of the coarse mesh come from the same regions. With static
    correction, u = K₀⁻¹f + P (u_c(s Pᵀf) - s l) with l the linear response of the coarse mesh. The
    scale s gives s P l the size of K₀⁻¹f in the least-squares sense, because coarse cells are too
    stiff.

    Parameters
    ----------
    coarsening : int
        Divisor of the scene's cells per axis, at least 2; the results are rounded up.
    tolerance : float
        Largest norm of the final residual relative to that of the load, in (0, 1].
    static_correction : bool
        Whether the linear response is that of the scene's mesh.
    """

    coarsening: Annotated[int, Field(ge=2)] = 2
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-4
    static_correction: bool = True

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
        if self.static_correction:
            self.compliance_ = Compliance(FullOrderModel(scene))
            self.coarse_compliance_ = Compliance(self.model_)

    def answer(self, forces: Array) -> Array:
        coarse, options = self.model_.scene, NewtonOptions(self.tolerance)
        out = np.zeros_like(forces)
        count(multiply_adds=6 * self.interpolation_.nnz * len(forces))
        for row, force in zip(out, forces, strict=True):
            load = (self.restriction_ @ force).reshape(1, -1)
            if self.static_correction:
                row[:], scale = self._corrected(force, load)
                load = scale * load
            found = self.model_.solve(coarse.at_free_dofs(load)[0], options=options).displacement
            row += self._on_nodes(coarse.at_all_dofs(found[None]))
        self.scene_.hold(out.reshape(len(out), self.scene_.mesh.n_dofs))
        return out

    def _corrected(self, force: Array, load: Array) -> tuple[Array, float]:
        """Return K₀⁻¹f - s P l at the nodes, (n_nodes, 3), m, and s."""
        linear = self.compliance_.respond(force.reshape(1, -1)).reshape(-1, 3)
        coarse = self._on_nodes(self.coarse_compliance_.respond(load))
        size = float(np.vdot(coarse, coarse))
        scale = float(np.vdot(linear, coarse)) / size if size > 0 else 1.0
        count(multiply_adds=3 * coarse.size + 3 * self.interpolation_.nnz)
        return linear - scale * coarse, scale

    def _on_nodes(self, displacement: Array) -> Array:
        """Interpolate a displacement of the coarse mesh (1, n_dofs), (n_nodes, 3)."""
        return np.asarray(self.interpolation_ @ displacement.reshape(-1, 3))

    def _coarse(self, scene: Scene) -> Scene:
        cells = getattr(scene.generated.geometry, "cells", (1, 1, 1))
        nx, ny, nz = (ceil(n / self.coarsening) for n in cells)
        coarse = with_cells(scene, (nx, ny, nz))
        if coarse.mesh.n_cells == scene.mesh.n_cells:
            raise UnsupportedSceneError(f"{scene.name}: a mesh of one cell cannot be made coarser.")
        return coarse
