"""The accelerated pass: Anderson's iteration with an approximate inverse, for many loads."""

from __future__ import annotations

from collections.abc import Generator, Iterator

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.anderson import Anderson
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.curvature import search_of
from mor_bench.mechanics.problem import Attempt, Problem, Turning, is_linear, is_round_off

Array = NDArray[np.float64]

ACCELERATED_ITERATIONS = 40
DIVERGED = 1e4
"""Residual, as a multiple of the load, that ends the pass; the iteration would not recover."""
STRETCHED = 32.0
"""Residual of the linear response, as a multiple of the load, above which it is bent.

The loads of the shipped datasets seldom leave more.
"""
SHORTER = 0.97
"""Factor of the bent response below which it is bent once more; the potential energy sets it."""
TURNING = 1e-2
"""Correction, relative to the displacement, above which nodal rotations are updated."""
PROBE_FROM = 0.1
"""Residual, relative to the load, at which probing begins; the tangent hardly changes later."""
TOGETHER = 16
"""Loads solved together; a back-solve on beam-fine takes 2.4 ms alone, 0.7 ms in a group of 16."""

Asked = list[tuple[Array, Array]]
Correcting = Generator[Asked, list[Array], Attempt]
"""A pass as a generator, which yields residuals with rotations and receives the corrections."""


def _bent(
    problem: Problem, inverse: Turning, load: Array, q: Array, state: State
) -> tuple[Array, State]:
    """Return a start with true rotations, if its residual is smaller than that of q.

    Along the bent responses α ↦ bent(α q), the potential energy falls by f·q at first. A parabola
    through its value at α = 1 gives the best α.
    """
    bent = inverse.bent(q)
    if bent is None:
        return q, state
    found, work = problem.force(bent), float(load @ q)
    rise = found.energy_j - float(load @ bent) + work
    if 0.5 * work < SHORTER * rise:
        shorter = inverse.bent(0.5 * work / rise * q)
        if shorter is not None:
            bent, found = shorter, problem.force(shorter)
    smaller = np.linalg.norm(load - found.force) < np.linalg.norm(load - state.force)
    return (bent, found) if smaller else (q, state)


def accelerated(
    problem: Problem,
    inverse: Turning,
    load: Array,
    start: Array | None,
    tolerance: float,
    symmetric: bool = True,
) -> Correcting:
    """Iterate with Anderson acceleration; reject a solution if negative curvature was seen.

    The tangent is not ``symmetric`` if the load follows the surface.
    """
    load_norm, memory = float(np.linalg.norm(load)), Anderson(problem.n_unknowns)
    search = search_of(problem, inverse, load, tolerance, symmetric)
    rotations = inverse.turned(start)
    q = (yield [(load, rotations)])[0] if start is None else start.copy()
    if start is None and is_linear(problem, q):
        return Attempt(problem.rest_factor.solve(load), 1.0, 1, converged=True)
    turning, min_det, before = True, -np.inf, np.inf
    for iteration in range(1, ACCELERATED_ITERATIONS + 1):
        state = problem.force(q)
        residual, min_det = load - state.force, state.min_det_f
        size = float(np.linalg.norm(residual))
        if iteration == 1 and start is None and size > STRETCHED * load_norm:
            q, state = _bent(problem, inverse, load, q, state)
            residual, min_det = load - state.force, state.min_det_f
            size = float(np.linalg.norm(residual))
        search.arrive(q, residual)
        ended = size <= tolerance * load_norm
        if ended and search.over:
            break
        if not size <= DIVERGED * load_norm:
            return Attempt(q, min_det, iteration, converged=False)
        if turning:
            rotations = inverse.turned(q)
        asked = search.asked(rotations) if size <= PROBE_FROM * load_norm else []
        correction, *answers = yield [(one, rotations) for one in (residual, *asked)]
        search.take(answers)
        ended = ended or (size > 0.5 * before and is_round_off(correction, q, problem.extent))
        if ended and search.over:
            break
        before = size
        turning = float(np.abs(correction).max()) > TURNING * float(np.abs(q).max())
        q = q + memory.advance(q, correction)
        disturbance = search.disturb(correction, rotations, ended)
        if disturbance is not None:
            memory.leap(keep=disturbance[1])
            q = q + disturbance[0]
    else:
        return Attempt(q, min_det, ACCELERATED_ITERATIONS, converged=False)
    if not min_det > 0:
        return Attempt(q, min_det, iteration, converged=False)
    while asked := search.asked(rotations):
        search.take((yield [(asked[0], rotations)]))
    return Attempt(q, min_det, iteration, converged=search.convex)


def run_in_step(inverse: Turning, passes: Iterator[Correcting]) -> Iterator[tuple[int, Attempt]]:
    """Run passes in groups that share each sweep over the factor.

    Yields the number and the outcome of each pass as it ends.
    """
    waiting: list[tuple[int, Correcting, Asked]] = []
    numbered = enumerate(passes)
    while True:
        while len(waiting) < TOGETHER and (item := next(numbered, None)) is not None:
            try:
                waiting.append((*item, next(item[1])))
            except StopIteration as ended:
                yield item[0], ended.value
        if not waiting:
            return
        residuals, rotations = zip(
            *[pair for _, _, asked in waiting for pair in asked], strict=True
        )
        answers = iter(inverse.solve_many(residuals, rotations))
        still = []
        for number, running, asked in waiting:
            try:
                still.append((number, running, running.send([next(answers) for _ in asked])))
            except StopIteration as ended:
                yield number, ended.value
        waiting = still
