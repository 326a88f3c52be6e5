"""Stability of an equilibrium, and the limit load of the path that begins at rest."""

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
from mor_bench.mechanics.newton import NewtonOptions, Problem, solve_equilibrium

Array = NDArray[np.float64]

DENSE_UP_TO = 300
"""Unknowns up to which all eigenvalues are computed."""
LEAP = 0.25
"""How far an increment may lie from the mean of the linear predictions at both its ends, relative to its length."""
FIRST_INCREMENT = 1.0 / 16.0


class AssembledProblem(Problem, Protocol):
    """A `Problem` that shows its assembler: `FullOrderModel`, `GalerkinProblem`."""

    assembler: Assembler


@dataclass(frozen=True)
class LimitPoint:
    """The end of the stable path that begins at rest.

    Attributes
    ----------
    factor : float
        Factor on the load.
    lowest_eigenvalue : float
        Of the last stable tangent, relative to rest; see `lowest_tangent_eigenvalue`.
    displacement : (n_unknowns,) float64
        The last stable state, m.
    """

    factor: float
    lowest_eigenvalue: float
    displacement: Array


def _matrix(problem: AssembledProblem, tangent: Array) -> Array | sp.csr_array:
    if tangent.ndim == 2:
        return tangent
    pattern = problem.assembler.pattern
    upper = sp.csr_array((tangent, pattern.indices, pattern.indptr), shape=(pattern.n, pattern.n))
    return sp.csr_array(upper + sp.triu(upper, 1).T)


def lowest_tangent_eigenvalue(problem: AssembledProblem, q: Array) -> float:
    """Lowest μ of K(q) x = μ K(0) x, without unit: 1 at rest, and not positive where the equilibrium is not stable.

    Relative to the stiffness at rest it depends on neither the mesh nor Young's modulus.

    Parameters
    ----------
    problem : AssembledProblem
    q : (n_unknowns,) float64
        m.
    """
    tangent, rest = (
        _matrix(problem, problem.linearise(q)[1]),
        _matrix(problem, problem.rest_tangent),
    )
    n = problem.n_unknowns
    if n <= DENSE_UP_TO:
        here, there = (m if isinstance(m, np.ndarray) else m.toarray() for m in (tangent, rest))
        return float(scipy.linalg.eigvalsh(here, there, subset_by_index=(0, 0))[0])
    inverse = LinearOperator((n, n), matvec=problem.rest_factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=n)
    return float(
        eigsh(
            tangent,
            1,
            M=rest,
            Minv=inverse,
            which="SA",
            v0=start,
            tol=1e-8,
            return_eigenvectors=False,
        )[0]
    )


def limit_load(
    problem: AssembledProblem, load: Array, most: float = 1.0, tolerance: float = 1e-8
) -> LimitPoint | None:
    """Follow the stable path from rest until its tangent is no longer positive definite.

    The load factor grows in increments, each solved from the state before and halved where the solver finds no stable
    equilibrium, or one that is not the neighbour of the state before (a snap-through).

    Parameters
    ----------
    problem : AssembledProblem
    load : (n_unknowns,) float64
        N.
    most : float
        Factor at which to stop.
    tolerance : float
        Of the limit's factor, relative.

    Returns
    -------
    LimitPoint or None
        None where the path is stable up to ``most``.
    """

    def speed(q: Array) -> Array:
        return problem.step(q, problem.linearise(q)[1], load, 1e-3)

    def neighbour(target: float) -> tuple[Array, Array] | None:
        """State and speed at the target, unless it was not reached or only by a leap to another path."""
        try:
            there = solve_equilibrium(
                problem, target * load, q, NewtonOptions(max_cuts=0)
            ).displacement
            after = speed(there)
        except (SolverError, NotPositiveDefiniteError):
            return None
        predicted = 0.5 * (target - reached) * (before + after)
        return (
            (there, after)
            if np.linalg.norm(there - q - predicted) <= LEAP * np.linalg.norm(there - q)
            else None
        )

    q, reached, increment, successes = np.zeros(problem.n_unknowns), 0.0, FIRST_INCREMENT * most, 0
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
    """The equilibrium that the body reaches when the load grows slowly from zero, (n_unknowns,) m.

    Raises
    ------
    LimitPointError
        If the path ends before; the message gives the limit's factor and the lowest eigenvalue there.
    """
    limit = limit_load(problem, load)
    if limit is not None:
        raise LimitPointError(
            f"no stable equilibrium on the path from rest: it ends at {limit.factor:.6g} of the load, "
            f"where the lowest tangent eigenvalue is {limit.lowest_eigenvalue:.3g} of that at rest.",
            load_factor=limit.factor,
            lowest_eigenvalue=limit.lowest_eigenvalue,
        )
    return solve_equilibrium(problem, load).displacement
