"""Searches for negative curvature of the tangent K along the accelerated iteration.

A symmetric load never shows the mode in which the body buckles. Hence both searches begin with the
response to a random force, which contains every mode. P is the approximate inverse's stiffness.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.anderson import WINDOW
from mor_bench.mechanics.problem import Problem, Turning

Array = NDArray[np.float64]

FINE = 1e-7
"""Largest tolerance, relative to the load, at which a disturbance is removed almost entirely."""
SHARE = 1.5e-5
"""Residual of the disturbance per mode, relative to the load.

The tolerance must be much smaller. At 1e-5, 5 of 1,300 unstable equilibria were accepted, with
lowest eigenvalues of -4e-4 of those at rest; at this share, none.
"""
LARGEST = 1e-2
"""Largest residual of the disturbance in all modes, relative to the load."""
STILL = 5e-4
"""Largest correction, relative to the body, that hardly changes the tangent."""
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


class Search(Protocol):
    """A search for negative curvature, which follows an iteration."""

    @property
    def over(self) -> bool:
        """True if the iteration may end where it has converged."""
        ...

    @property
    def convex(self) -> bool:
        """True if the search is complete and found no negative curvature."""
        ...

    def arrive(self, q: Array, residual: Array) -> None:
        """Record the next state of the iteration and its residual."""
        ...

    def asked(self, rotations: Array) -> list[Array]:
        """Return forces whose corrections the search needs."""
        ...

    def take(self, answers: list[Array]) -> None:
        """Record these corrections."""
        ...

    def disturb(
        self, correction: Array, rotations: Array, ended: bool
    ) -> tuple[Array, bool] | None:
        """Return a displacement to add to the next state, or None if it is not time for one.

        Also return whether the last `WINDOW` steps of the iteration have no negative curvature.
        The iteration has ``ended`` if it has converged.
        """
        ...


def search_of(
    problem: Problem, inverse: Turning, load: Array, tolerance: float, symmetric: bool
) -> Search:
    """Return the cheapest search for a load (n_unknowns,), N, and a relative tolerance."""
    if tolerance <= FINE and symmetric:
        return Disturbance(problem, inverse, load)
    return Probes(problem, inverse, load)


class Disturbance:
    """A search that needs no products with K: the iteration removes a random disturbance.

    Once, the state is moved along the rotated response at rest to a random force. Only steps that
    contain a mode can remove that mode. Differences of residuals give the product of each step
    with K. So the matrix sᵢ·K sⱼ of all later steps shows whether K has negative curvature.
    """

    def __init__(self, problem: Problem, inverse: Turning, load: Array) -> None:
        self._inverse, self._extent = inverse, problem.extent
        self._load_norm = float(np.linalg.norm(load))
        self._last: tuple[Array, Array] | None = None
        self.over = False
        self._forget()

    def _forget(self) -> None:
        self._steps: list[Array] = []
        self._products: list[Array] = []
        self._matrix = np.zeros((0, 0))

    def arrive(self, q: Array, residual: Array) -> None:
        if self._last is not None:
            self._add(q - self._last[0], self._last[1] - residual)
        self._last = q, residual

    def _add(self, step: Array, product: Array) -> None:
        """Add a step; before the disturbance, only the steps in Anderson's memory are kept."""
        first = 0 if self.over else max(0, len(self._steps) + 1 - WINDOW)
        self._steps = [*self._steps[first:], step]
        self._products = [*self._products[first:], product]
        n = len(self._steps)
        matrix = np.zeros((n, n))
        matrix[:-1, :-1] = self._matrix[first:, first:]
        matrix[:, -1] = [float(each @ product) for each in self._steps]
        matrix[-1, :-1] = [float(step @ each) for each in self._products[:-1]]
        self._matrix = matrix
        count(multiply_adds=len(step) * (2 * n - 1))

    def asked(self, rotations: Array) -> list[Array]:
        return []

    def take(self, answers: list[Array]) -> None:
        assert not answers

    def disturb(
        self, correction: Array, rotations: Array, ended: bool
    ) -> tuple[Array, bool] | None:
        assert self._last is not None
        still = float(np.abs(correction).max()) <= STILL * self._extent
        near = still and float(np.linalg.norm(self._last[1])) <= self._load_norm
        if self.over or not (ended or near):
            return None
        move, force = self._inverse.soft(rotations)
        size = min(SHARE * np.sqrt(len(force)), LARGEST) * self._load_norm
        known = not self._steps or _is_positive(self._matrix)
        self.over, self._last = True, None
        self._forget()
        return np.asarray(size / np.linalg.norm(force) * move), known

    @property
    def convex(self) -> bool:
        return bool(self._steps) and _is_positive(self._matrix)


class Probes:
    """A search for loose tolerances, with one more residual per step.

    The first probe is the rotated response to a random force, which soft modes dominate. Each next
    probe is P⁻¹K of the previous one, as in Lanczos' method. Products with K are differences of
    the internal force. The probes suffice when their lowest curvature relative to P has settled.
    """

    over = True

    def __init__(self, problem: Problem, inverse: Turning, load: Array) -> None:
        self._problem, self._inverse, self._load = problem, inverse, load
        self._last: tuple[Array, Array] | None = None
        self._rises: deque[float] = deque(maxlen=WINDOW)
        self._probes: list[Array] = []
        self._products: list[Array] = []
        self._pulls: list[Array] = []
        self._lowest = np.nan
        self._settled = False

    def arrive(self, q: Array, residual: Array) -> None:
        if self._last is not None:
            self._rises.append(float((q - self._last[0]) @ (self._last[1] - residual)))
        self._last = q, residual

    def asked(self, rotations: Array) -> list[Array]:
        if not self._probes:
            self._add(*self._inverse.soft(rotations))
        complete = self._settled or len(self._probes) >= PROBES or self._lowest <= 0.0
        return [] if complete else [self._products[-1]]

    def take(self, answers: list[Array]) -> None:
        for answer in answers:
            self._add(answer, self._products[-1])

    def disturb(self, correction: Array, rotations: Array, ended: bool) -> None:
        return None

    def _add(self, answer: Array, pull: Array) -> None:
        """Add a probe from its correction and P times it."""
        assert self._last is not None
        q, residual = self._last
        for probe, of_probe in zip(self._probes, self._pulls, strict=True):
            part = float(probe @ answer) / float(probe @ probe)
            answer, pull = answer - part * probe, pull - part * of_probe
        length = PROBE_LENGTH * self._problem.extent / (float(np.abs(answer).max()) or 1.0)
        probe = length * answer
        self._probes.append(probe)
        self._pulls.append(length * pull)
        self._products.append(self._problem.force(q + probe).force - (self._load - residual))
        before, curvatures = self._lowest, self._curvatures()
        self._lowest, two = float(curvatures[0]), len(curvatures) == 2
        falls_little = before - self._lowest <= (FALL_OF_TWO if two else FALL) * self._lowest
        self._settled = falls_little and not (two and curvatures[1] - curvatures[0] > SPREAD)

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
        """True if the curvature has settled, and is positive along the last steps as well."""
        matrix = np.array(self._probes) @ np.array(self._products).T
        return self._settled and min(self._rises, default=1.0) > 0 and _is_positive(matrix)


def _is_positive(matrix: Array) -> bool:
    """Return whether the symmetric part of a matrix is positive definite."""
    scale = np.sqrt(np.abs(np.diag(matrix)))
    scaled = 0.5 * (matrix + matrix.T) / np.outer(scale, scale)
    return bool(np.isfinite(scaled).all()) and float(np.linalg.eigvalsh(scaled)[0]) > 0
