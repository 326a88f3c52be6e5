"""Equilibria of one test sample under a growing load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import (
    InvalidInputError,
    SolverError,
    UnsupportedSceneError,
    check_count,
    is_integer,
)
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.load_paths import solve_paths

Array = NDArray[np.float64]


def load_steps(data: Dataset, sample: int, n_steps: int) -> tuple[Array, Array]:
    """Return fractions of the load of a test sample from 0 to 1, and the displacements there.

    The full-order model solves each step from an extrapolation of the steps before.

    Returns
    -------
    fractions : (n_steps + 1,) float64
    displacements : (n_steps + 1, n_nodes, 3) float64
        In m; the first are zero.

    Raises
    ------
    InvalidInputError
        If the sample does not exist, or `n_steps` is less than 1.
    UnsupportedSceneError
        If the full-order model cannot solve the scene for given forces.
    SolverError
        If a step has no solution.
    """
    scene = data.scene
    check_count("n_steps", n_steps)
    if not (is_integer(sample) and 0 <= sample < len(data.test)):
        raise InvalidInputError(
            f"`sample` must be an integer in [0, {len(data.test) - 1}]; got {sample!r}."
        )
    reason = "its body varies between samples" if scene.parameter_names else None
    if reason := reason or unknown_equations(scene):
        raise UnsupportedSceneError(f"{scene.name} has no load path: {reason}.")
    fractions = np.arange(n_steps + 1) / n_steps
    loads = fractions[1:, None] * data.test.free_forces[sample]
    steps = np.zeros((n_steps + 1, len(scene.free_dofs)))
    solved = solve_paths(FullOrderModel(scene), loads, 0, n_steps)
    for row, found in zip(steps[1:], solved, strict=True):
        if isinstance(found, SolverError):
            raise found
        row[:] = found.displacement
    return fractions, scene.at_all_dofs(steps).reshape(n_steps + 1, -1, 3)
