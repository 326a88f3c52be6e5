"""A few weighted cells of a scene, assembled over the degrees of freedom that they touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.mechanics.assembly import Assembler
from mor_bench.scene.scene import Scene
from mor_bench.specs import NO_EQUATIONS


def weighted_cells(
    scene: Scene, cells: NDArray[np.int64], weights: NDArray[np.float64]
) -> tuple[Assembler, NDArray[np.int64]]:
    """An assembler over these cells only, and which free dofs it sees.

    Parameters
    ----------
    scene : Scene
    cells : (n,) int
        Numbers of cells.
    weights : (n,) float64
        Cubature weights.

    Raises
    ------
    InvalidInputError
        If a number is out of range, or there are not as many weights, or they are not finite: the kernels check no bounds.
    """
    if scene.material is None:
        raise UnsupportedSceneError(NO_EQUATIONS)
    n_cells = scene.mesh.n_cells
    if (
        cells.dtype.kind != "i"
        or cells.shape != weights.shape
        or not ((cells >= 0) & (cells < n_cells)).all()
    ):
        raise InvalidInputError(
            f"`cells` must be integers in [0, {n_cells - 1}], as many as there are weights."
        )
    if len(np.unique(cells)) != len(cells):
        raise InvalidInputError("`cells` must be different integers.")
    if not (np.isfinite(weights).all() and (weights > 0).all()):
        raise InvalidInputError("`weights` must be positive and finite.")
    nodes = scene.mesh.cells[cells]
    touched = np.zeros((scene.mesh.n_nodes, 3), dtype=bool)
    touched[nodes] = True
    rows = np.flatnonzero(touched.reshape(-1)[scene.free_dofs])
    dof_of_node = np.full(scene.mesh.n_dofs, len(rows), dtype=np.int64)
    dof_of_node[scene.free_dofs[rows]] = np.arange(len(rows))
    return Assembler(
        scene.mesh.points,
        nodes,
        dof_of_node.reshape(-1, 3),
        len(rows),
        scene.material,
        weights,
        scene.selective,
    ), rows
