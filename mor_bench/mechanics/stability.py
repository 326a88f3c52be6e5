"""Stability of an equilibrium, and the limit load of the equilibrium path from rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh

from mor_bench.errors import LimitPointError, SolverError
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.mechanics.problem import Problem

Array = NDArray[np.float64]

DENSE_UP_TO = 300
"""Largest number of unknowns for which a dense solver finds the eigenvalue."""
LEAP = 0.25
"""Largest distance of an increment from the mean of the linear predictions at its two ends.

It is relative to the increment's length. A larger distance is a jump to another path.
"""
FIRST_INCREMENT = 1.0 / 16.0


class AssembledProblem(Problem, Protocol):
    """A `Problem` with an assembler, e.g. `FullOrderModel` or `GalerkinProblem`."""

    assembler: Assembler


@dataclass(frozen=True)
class LimitPoint:
    """End of the stable path from rest.

    Attributes
    ----------
    factor : float
        Factor on the load.
    lowest_eigenvalue : float
        Lowest eigenvalue of the last stable tangent; see `lowest_tangent_eigenvalue`.
    displacement : (n_unknowns,) float64
        Last stable state, m.
    """

    factor: float
    lowest_eigenvalue: float
    displacement: Array


def _matrix(problem: AssembledProblem, tangent: Array) -> Array | sp.csr_array:
    if tangent.ndim == 2:
        return tangent
    return problem.assembler.pattern.symmetric(tangent)


def lowest_tangent_eigenvalue(problem: AssembledProblem, q: Array) -> float:
    """Return the lowest μ of K(q) x = μ K(0) x at displacements q (n_unknowns,), m.

    It is 1 at rest and not positive where the equilibrium is unstable. It depends on neither the
    mesh size nor Young's modulus.
    """
    tangent = _matrix(problem, problem.linearise(q)[1])
    rest, n = _matrix(problem, problem.rest_tangent), problem.n_unknowns
    if n <= DENSE_UP_TO:
        here, there = (m if isinstance(m, np.ndarray) else m.toarray() for m in (tangent, rest))
        return float(scipy.linalg.eigvalsh(here, there, subset_by_index=(0, 0))[0])
    inverse = LinearOperator((n, n), matvec=problem.rest_factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=n)
    lowest = eigsh(
        tangent,
        1,
        M=rest,
        Minv=inverse,
        which="SA",
        v0=start,
        tol=1e-8,
        return_eigenvectors=False,
    )
    return float(lowest[0])


def limit_load(
    problem: AssembledProblem, load: Array, most: float = 1.0, tolerance: float = 1e-8
) -> LimitPoint | None:
    """Follow the stable path from rest until its tangent is no longer positive definite.

    The load factor grows in increments, each solved from the previous state. An increment is halved
    if the solver finds no stable equilibrium, or one on another path (a snap-through).

    Parameters
    ----------
    problem : AssembledProblem
    load : (n_unknowns,) float64
        Load, N.
    most : float
        Load factor at which to stop.
    tolerance : float
        Relative tolerance of the limit's load factor.

    Returns
    -------
    LimitPoint or None
        None if the path is stable up to ``most``.
    """

    def speed(q: Array) -> Array:
        return problem.step(q, problem.linearise(q)[1], load, 1e-3)

    def neighbour(target: float) -> tuple[Array, Array] | None:
        """Return state and speed at the target; None if it is not reached on this path."""
        try:
            found = solve_equilibrium(problem, target * load, q, NewtonOptions(max_cuts=0))
            there = found.displacement
            after = speed(there)
        except (SolverError, NotPositiveDefiniteError):
            return None
        predicted = 0.5 * (target - reached) * (before + after)
        leaps = np.linalg.norm(there - q - predicted) > LEAP * np.linalg.norm(there - q)
        return None if leaps else (there, after)

    q, reached = np.zeros(problem.n_unknowns), 0.0
    increment, successes = FIRST_INCREMENT * most, 0
    before = speed(q)
    while reached < most:
        target = min(most, reached + increment)
        found = neighbour(target)
        if found is None:
            increment, successes = 0.5 * increment, 0
            if increment <= tolerance * max(reached, tolerance * most):
                return LimitPoint(reached, lowest_tangent_eigenvalue(problem, q), q)
            continue
        (q, before), reached, successes = found, target, successes + 1
        if successes > 1:
            increment *= 2.0
    return None


def solve_on_path(problem: AssembledProblem, load: Array) -> Array:
    """Return the equilibrium (n_unknowns,), m, that a slowly growing load reaches from rest.

    Raises
    ------
    LimitPointError
        If the path ends at a smaller load. The message gives the limit's load factor and lowest
        eigenvalue.
    """
    limit = limit_load(problem, load)
    if limit is not None:
        raise LimitPointError(
            f"no stable equilibrium: the path from rest ends at {limit.factor:.6g} of the "
            f"load. There, the lowest tangent eigenvalue is {limit.lowest_eigenvalue:.3g} "
            "of its value at rest.",
            load_factor=limit.factor,
            lowest_eigenvalue=limit.lowest_eigenvalue,
        )
    return solve_equilibrium(problem, load).displacement
