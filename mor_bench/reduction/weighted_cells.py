"""Weighted cells of a scene, assembled over the degrees of freedom that they touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.model import body_of
from mor_bench.scene.scene import Scene


def weighted_cells(
    scene: Scene, cells: NDArray[np.int64], weights: NDArray[np.float64]
) -> tuple[Assembler, NDArray[np.int64]]:
    """Return an assembler over these cells, and the free dofs that it sees.

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
        If a cell is out of range or repeated, or the weights do not match the cells or are not
        positive and finite.
    """
    n_cells = scene.mesh.n_cells
    if (
        cells.dtype.kind != "i"
        or cells.shape != weights.shape
        or not ((cells >= 0) & (cells < n_cells)).all()
    ):
        raise InvalidInputError(
            f"`cells` must be integers in [0, {n_cells - 1}], one for each weight."
        )
    if len(np.unique(cells)) != len(cells):
        raise InvalidInputError("`cells` must be different integers.")
    if not (np.isfinite(weights).all() and (weights > 0).all()):
        raise InvalidInputError("`weights` must be positive and finite.")
    touched = np.zeros((scene.mesh.n_nodes, 3), dtype=bool)
    touched[scene.mesh.cells[cells]] = True
    rows = np.flatnonzero(touched.reshape(-1)[scene.free_dofs])
    dof_of_node = np.full(scene.mesh.n_dofs, len(rows), dtype=np.int64)
    dof_of_node[scene.free_dofs[rows]] = np.arange(len(rows))
    assembler = Assembler(
        body_of(scene, cells), dof_of_node.reshape(-1, 3), len(rows), weights, scene.frames
    )
    return assembler, rows
