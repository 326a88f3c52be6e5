"""The accelerated pass: Anderson's iteration with an approximate inverse, for many loads."""

from __future__ import annotations

from collections.abc import Generator, Iterator

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.anderson import Anderson
from mor_bench.mechanics.assembly import State
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
PROBES = 8
"""Most directions, soft ones first, that are probed for negative curvature."""
FALL_OF_TWO, FALL, SPREAD = 0.1, 0.2, 0.4
"""When the lowest curvature of the probes, relative to P, has settled.

The last probe lowered it by at most this share: of two probes, whose curvatures differ by at most
`SPREAD`, or of more. Columns that are guided at both ends need up to five probes: with two, the
lowest curvature is still 0.9 where buckling has made the true one negative.
"""
PROBE_LENGTH = 1e-6
"""Length of the finite difference along a probe, relative to the body."""
TOGETHER = 16
"""Loads solved together; a back-solve on beam-fine takes 2.4 ms alone, 0.7 ms in a group of 16."""

Asked = list[tuple[Array, Array]]
Correcting = Generator[Asked, list[Array], Attempt]
"""A pass as a generator, which yields residuals with rotations and receives the corrections."""


class Probes:
    """A search for negative curvature along the iteration, with one more residual per step.

    The first probe is the rotated response to a random force, which soft modes dominate. Each next
    probe is P⁻¹K of the previous one, as in Lanczos' method. Products with K are differences of
    the internal force. The probes suffice when their lowest curvature relative to P has settled.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._probes: list[Array] = []
        self._products: list[Array] = []
        self._pulls: list[Array] = []
        self._lowest = np.nan
        self._settled = False

    @property
    def begun(self) -> bool:
        return bool(self._probes)

    @property
    def wanted(self) -> Array:
        """The residual whose correction is the next probe."""
        return self._products[-1]

    def add(self, answer: Array, pull: Array, q: Array, force: Array) -> None:
        """Add a probe from its correction, P times it, the state q and the internal force at q."""
        for probe, of_probe in zip(self._probes, self._pulls, strict=True):
            part = float(probe @ answer) / float(probe @ probe)
            answer, pull = answer - part * probe, pull - part * of_probe
        length = PROBE_LENGTH * self._problem.extent / (float(np.abs(answer).max()) or 1.0)
        probe = length * answer
        self._probes.append(probe)
        self._pulls.append(length * pull)
        self._products.append(self._problem.force(q + probe).force - force)
        before, curvatures = self._lowest, self._curvatures()
        self._lowest, two = float(curvatures[0]), len(curvatures) == 2
        falls_little = before - self._lowest <= (FALL_OF_TWO if two else FALL) * self._lowest
        self._settled = falls_little and not (two and curvatures[1] - curvatures[0] > SPREAD)

    @property
    def complete(self) -> bool:
        """True if no further probe is needed or allowed."""
        return self._settled or len(self._probes) >= PROBES or self._lowest <= 0.0

    def _curvatures(self) -> Array:
        """Return the curvatures of the probes relative to P in ascending order, (n,), or NaN."""
        if len(self._probes) == 1:
            (probe,), (product,), (pull,) = self._probes, self._products, self._pulls
            return np.array([float(probe @ product) / float(probe @ pull)])
        probes, products = np.array(self._probes), np.array(self._products)
        size, matrix = probes @ np.array(self._pulls).T, probes @ products.T
        if not (np.isfinite(matrix).all() and float(np.linalg.det(size)) > 0):
            return np.full(len(probes), np.nan)
        return np.sort(np.linalg.eigvals(np.linalg.solve(size, matrix)).real)

    @property
    def convex(self) -> bool:
        """True if the lowest curvature has settled, and no combination of probes has a negative."""
        if not self._settled:
            return False
        probes, products = np.array(self._probes), np.array(self._products)
        matrix = probes @ products.T
        scale = np.sqrt(np.abs(np.diag(matrix)))
        matrix = 0.5 * (matrix + matrix.T) / np.outer(scale, scale)
        return bool(np.isfinite(matrix).all()) and float(np.linalg.eigvalsh(matrix)[0]) > 0


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
    problem: Problem, inverse: Turning, load: Array, start: Array | None, tolerance: float
) -> Correcting:
    """Iterate with Anderson acceleration; reject a solution if negative curvature was seen."""
    load_norm = float(np.linalg.norm(load))
    memory, probes = Anderson(problem.n_unknowns), Probes(problem)
    rotations = inverse.turned(start)
    q = (yield [(load, rotations)])[0] if start is None else start.copy()
    if start is None and is_linear(problem, q):
        return Attempt(problem.rest_factor.solve(load), 1.0, 1, converged=True)
    turning, min_det, before = True, -np.inf, np.inf
    for iteration in range(1, ACCELERATED_ITERATIONS + 1):
        state = problem.force(q)
        residual, min_det = load - state.force, state.min_det_f
        size = float(np.linalg.norm(residual))
        if size <= tolerance * load_norm:
            break
        if iteration == 1 and start is None and size > STRETCHED * load_norm:
            q, state = _bent(problem, inverse, load, q, state)
            residual, min_det = load - state.force, state.min_det_f
            size = float(np.linalg.norm(residual))
        if not size <= DIVERGED * load_norm:
            return Attempt(q, min_det, iteration, converged=False)
        if turning:
            rotations = inverse.turned(q)
        asked = [(residual, rotations)]
        if size <= PROBE_FROM * load_norm and not probes.complete:
            if not probes.begun:
                probes.add(*inverse.soft(rotations), q, state.force)
            asked.append((probes.wanted, rotations))
        correction, *answers = yield asked
        for answer in answers:
            probes.add(answer, probes.wanted, q, state.force)
        if size > 0.5 * before and is_round_off(correction, q, problem.extent):
            break
        before = size
        turning = float(np.abs(correction).max()) > TURNING * float(np.abs(q).max())
        q = q + memory.advance(q, correction, residual)
    else:
        return Attempt(q, min_det, ACCELERATED_ITERATIONS, converged=False)
    if not (min_det > 0 and memory.convex):
        return Attempt(q, min_det, iteration, converged=False)
    if not probes.begun:
        probes.add(*inverse.soft(rotations), q, state.force)
    while not probes.complete:
        (answer,) = yield [(probes.wanted, rotations)]
        probes.add(answer, probes.wanted, q, state.force)
    return Attempt(q, min_det, iteration, converged=probes.convex)


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
