"""Static equilibria by dynamic relaxation: total Lagrangian explicit dynamics with damping.

The body is released under the whole load and moves by central differences, with a fictitious mass
and damping, until it rests. No stiffness is assembled or factorised for an answer, and a step costs
one internal force (Miller, Joldes, Lance, Wittek, Commun. Numer. Meth. Engng 23, 2007; NiftySim:
Johnsen et al., IJCARS 10, 2015). The mass of a node is a Gershgorin bound of its rows of the
stiffness at rest. All parts of the mesh then have the same critical step (Underwood 1983;
Joldes, Wittek, Miller, CMAME 200, 2011).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvertedElementError, NoEquilibriumError
from mor_bench.mechanics.kernels import MET
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import Solution
from mor_bench.mechanics.rotated import product

Array = NDArray[np.float64]

MARGIN = 1.1
"""Largest eigenvalue for which the step is stable, relative to the largest at rest."""

POWER_ITERATIONS = 60

GROWN = 1e6
"""Residual, as a multiple of the load, that counts as divergence."""

SECOND_STEP = 0.25
"""Squared step of the second attempt, relative to the first."""


def _row_sums(model: FullOrderModel) -> Array:
    """Return Σ_j |K_ij| of the stiffness at rest, (n,), N/m."""
    pattern, values = model.assembler.pattern, np.abs(model.rest_tangent)
    sums = np.bincount(pattern.rows, values, pattern.n)
    sums += np.bincount(pattern.indices, values, pattern.n)
    return np.asarray(sums - values[pattern.indptr[:-1]])


class DynamicRelaxation:
    """A model's fictitious mass and extreme frequencies, and the relaxation with them.

    Parameters
    ----------
    model : FullOrderModel

    Attributes
    ----------
    mass : (n_unknowns,) float64
        Mass of each free dof, equal for the dofs of a node, N/m. It is scaled such that the
        largest eigenvalue of M⁻¹K at rest is 1.
    lowest : float
        Smallest eigenvalue of M⁻¹K at rest.
    """

    def __init__(self, model: FullOrderModel) -> None:
        self.model = model
        # With one mass along all axes, the frequencies do not change when the body turns.
        node = np.unique(model.scene.free_dofs // 3, return_inverse=True)[1]
        most = np.zeros(node.max() + 1)
        np.maximum.at(most, node, _row_sums(model))
        mass = most[node]
        x = np.random.default_rng(0).normal(size=model.n_unknowns)
        for _ in range(POWER_ITERATIONS):
            y = product(model.assembler.pattern, model.rest_tangent, x) / mass
            highest = float((mass * y) @ y / ((mass * x) @ y))
            x = y / np.linalg.norm(y)
        self.mass = highest * mass
        for _ in range(POWER_ITERATIONS):
            y = model.rest_factor.solve(self.mass * x)
            self.lowest = float((self.mass * x) @ y / ((self.mass * y) @ y))
            x = y / np.linalg.norm(y)

    def solve(
        self, load: Array, tolerance: float, max_steps: int, start: Array | None = None
    ) -> Solution:
        """Let the body come to rest under a load (n_unknowns,), N.

        If the body diverges or comes to rest inverted, it is released once more with half the step.

        Parameters
        ----------
        load : (n_unknowns,) float64
        tolerance : float
            Norm of the residual, relative to that of the load, at which the body is at rest.
        max_steps : int
            Largest number of steps in each of the two attempts.
        start : (n_unknowns,) float64, optional
            Start of the first attempt, m; undeformed by default.

        Raises
        ------
        InvertedElementError
            If the body comes to rest with det F <= 0 at some point.
        NoEquilibriumError
            If the body diverges, or does not come to rest within the steps.
        """
        size, done = float(np.linalg.norm(load)), 0
        if size == 0.0:
            return Solution(np.zeros_like(load), 1.0, 0, 0)
        for attempt, first in enumerate((start, None)):
            step = 4.0 / MARGIN * (SECOND_STEP if attempt else 1.0)
            control = np.array([(tolerance * size) ** 2, step, self.lowest, (GROWN * size) ** 2])
            u = np.zeros_like(load) if first is None else first.copy()
            steps, status, min_det = self.model.assembler.relax(
                u, load, self.mass, control, max_steps
            )
            done += steps
            if status == MET and min_det > 0.0:
                return Solution(u, min_det, done, attempt)
            if steps == max_steps:
                break
        if status == MET:
            raise InvertedElementError(
                f"elements invert: after {done} steps the body is at rest, and its "
                f"smallest det F is {min_det:.3g}."
            )
        residual = np.inf
        if np.isfinite(u).all():
            residual = float(np.linalg.norm(load - self.model.force(u).force)) / size
        raise NoEquilibriumError(
            f"the body does not come to rest: after {done} steps the residual is {residual:.3g} "
            "of the load."
        )
