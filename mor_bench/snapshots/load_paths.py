"""Equilibria along load paths: each step begins at an extrapolation of the steps before it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SolverError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import Solution

Array = NDArray[np.float64]


def solve_paths(
    model: FullOrderModel, loads: Array, first: int, steps: int
) -> list[Solution | SolverError]:
    """Solve for consecutive samples of paths, all paths together, step by step.

    Parameters
    ----------
    model : FullOrderModel
    loads : (m, n_free) float64
        Forces, N. Sample i is step i modulo ``steps`` of its path.
    first : int
        Number of the first sample. If it is in the middle of a path, the solve begins there from
        rest.
    steps : int
        Samples of each path.

    Returns
    -------
    list
        A solution or an error for each sample. The step after an error begins from rest.
    """
    step = (first + np.arange(len(loads))) % steps + 1
    found: dict[int, Solution | SolverError] = {}
    for number in range(1, steps + 1):
        rows = np.flatnonzero(step == number).tolist()
        starts = [_extrapolated(found, row, number) for row in rows]
        solved = model.solve_many(loads[rows], starts=starts)
        found.update(zip(rows, solved, strict=True))
    return [found[row] for row in range(len(loads))]


def _extrapolated(found: dict[int, Solution | SolverError], row: int, number: int) -> Array | None:
    """Extrapolate up to three steps before a step; the state at rest is the one before the first.

    Returns None if the step before has no solution.
    """
    states: list[Array] = []
    for back in range(1, min(number, 4)):
        state = found.get(row - back)
        if not isinstance(state, Solution):
            break
        states.append(state.displacement)
    if not states:
        return None
    if len(states) == number - 1 < 3:
        states.append(np.zeros_like(states[0]))
    if len(states) == 1:
        return states[0]
    if len(states) == 2:
        return 2.0 * states[0] - states[1]
    return 3.0 * states[0] - 3.0 * states[1] + states[2]
