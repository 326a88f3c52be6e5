"""Shared parts of projection methods: solves over the free dofs, and saved polynomials."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.tensors import TensorProblem
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]


def answer_each(scene: Scene, forces: Array, solve: Callable[[Array], Array]) -> Array:
    """Return displacements of all nodes, m, from one solve per load over the free dofs.

    Parameters
    ----------
    forces : (n, n_nodes, 3) float64
        Nodal forces, N.
    solve : callable
        Maps a load (n_free,), N, to displacements (n_free,), m.

    Returns
    -------
    (n, n_nodes, 3) float64
    """
    loads = scene.at_free_dofs(forces.reshape(len(forces), scene.mesh.n_dofs))
    found = np.empty(loads.shape)
    for row, load in zip(found, loads, strict=True):
        row[:] = solve(load)
    return scene.at_all_dofs(found).reshape(forces.shape)


def galerkin_or_polynomial(
    scene: Scene, model: FullOrderModel, modes: Array, arrays: Mapping[str, NDArray[Any]]
) -> GalerkinProblem | TensorProblem:
    """Return the saved polynomial of a basis as its reduced problem, or else the projection.

    Raises
    ------
    InvalidInputError
        If the polynomial belongs to another number of modes.
    """
    if "quartic" not in arrays:
        return GalerkinProblem(model.assembler, modes)
    problem = TensorProblem.of_arrays(scene, arrays)
    if problem.n_unknowns != modes.shape[1]:
        raise InvalidInputError(
            f"the polynomial must have {modes.shape[1]} modes; got {problem.n_unknowns}."
        )
    return problem
