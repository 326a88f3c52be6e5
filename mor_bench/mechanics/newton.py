"""The nonlinear solve of an equilibrium, full-order or reduced: fast passes first, a safe one last.

1. If the model has an approximate inverse of all tangents, an accelerated iteration with it goes
   first. It fails only at the largest deformations.
2. Newton's full steps follow. Their residual first rises by orders of magnitude without diverging.
3. If neither ends in a stable, uninverted state, the load is applied in increments. Each increment
   descends on the potential energy with a line search, and is halved on failure.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import (
    InvalidInputError,
    InvertedElementError,
    NoEquilibriumError,
    SolverError,
)
from mor_bench.machine import one_blas_thread
from mor_bench.mechanics.accelerated import accelerated, run_in_step
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.load_steps import LoadSteps
from mor_bench.mechanics.problem import Attempt, Problem, is_linear, is_round_off

Array = NDArray[np.float64]

PLAIN_ITERATIONS = 25
DAMPED_ITERATIONS = 60
HOPELESS = 1e10
"""Residual, as a multiple of the load, that ends the pass of full steps.

Near incompressibility the residual may rise 3,000-fold before it converges.
"""
ARMIJO = 1e-4
DAMPED_FORCING = 1e-3
"""Relative tolerance of an iterative solve in the safeguarded pass."""
MAX_HALVINGS = 14
MAX_LOAD_N = 1e30
MAX_ITERATIONS = 300
"""Largest number of Newton iterations, over all increments, before the solve gives up."""


@dataclass(frozen=True)
class NewtonOptions:
    """Tolerance and step control of the nonlinear solve.

    Parameters
    ----------
    tolerance : float
        Norm of the residual relative to that of the load, in (0, 1].
    max_cuts : int
        Largest number of halvings of an increment before the solve gives up.
    """

    tolerance: float = 1e-8
    max_cuts: int = 10

    def __post_init__(self) -> None:
        if not 0 < self.tolerance <= 1:
            raise InvalidInputError(f"`tolerance` must be in (0, 1]; got {self.tolerance}.")


@dataclass(frozen=True)
class Solution:
    """A stable equilibrium with det F > 0 at every Gauss point."""

    displacement: Array
    min_det_f: float
    iterations: int
    cuts: int


def _forcing(size: float, before: float, target: float) -> float:
    """Return the relative tolerance of the solve for a step.

    Eisenstat and Walker's second choice, SIAM J. Sci. Comput. 17 (1996), section 2.1, with γ = 0.9
    and exponent 2, but no smaller than the target needs.
    """
    return 0.1 if size <= target else min(0.1, max(0.9 * (size / before) ** 2, 0.3 * target / size))


def is_certified(problem: Problem, q: Array) -> bool:
    """Return whether no negative curvature was found at a solution; see `Problem.certify`."""
    try:
        problem.certify(q)
    except NotPositiveDefiniteError:
        return False
    return True


def full_steps(problem: Problem, load: Array, start: Array | None, tolerance: float) -> Attempt:
    """Take full Newton steps; from rest, the first one uses the factor that all solves share."""
    load_norm = float(np.linalg.norm(load))
    q = problem.rest_factor.solve(load) if start is None else start.copy()
    if start is None and is_linear(problem, q):
        return Attempt(q, 1.0, 1, converged=True)
    min_det, before, near = -np.inf, np.inf, False
    for iteration in range(1, PLAIN_ITERATIONS + 1):
        if near:  # one more residual is cheap, and usually no further tangent is needed
            state = problem.force(q)
            if float(np.linalg.norm(load - state.force)) <= tolerance * load_norm:
                return Attempt(q, state.min_det_f, iteration, converged=is_certified(problem, q))
        state, tangent = problem.linearise(q)
        residual, min_det = load - state.force, state.min_det_f
        size = float(np.linalg.norm(residual))
        if not (size <= HOPELESS * load_norm and np.isfinite(state.energy_j)):
            break
        try:
            # Also at convergence: the step verifies that the tangent is positive definite.
            step = problem.step(q, tangent, residual, _forcing(size, before, tolerance * load_norm))
        except NotPositiveDefiniteError:
            break
        if size <= tolerance * load_norm:
            return Attempt(q, min_det, iteration, converged=is_certified(problem, q))
        floor = problem.extent if size > 0.5 * before else 0.0
        near, before = size <= np.sqrt(tolerance) * load_norm, size
        q = q + step
        if is_round_off(step, q, floor):
            return Attempt(q, min_det, iteration, converged=is_certified(problem, q))
    return Attempt(q, min_det, iteration, converged=False)


def descent(problem: Problem, q: Array, tangent: Array, residual: Array) -> tuple[Array, bool]:
    """Return a descent direction, and whether the tangent itself was positive definite.

    An indefinite tangent is shifted towards the rest-state stiffness until it is positive definite.
    """
    try:
        return problem.step(q, tangent, residual, DAMPED_FORCING), True
    except NotPositiveDefiniteError:
        shift = 0.01
    while shift <= 1e6:
        shifted = tangent + shift * problem.rest_tangent
        try:
            return problem.step(q, shifted, residual, DAMPED_FORCING), False
        except NotPositiveDefiniteError:
            shift *= 4.0
    return problem.rest_factor.solve(residual), False


def _damped(problem: Problem, load: Array, start: Array, tolerance: float) -> Attempt:
    """Descend on the potential W(q) - f·q from a valid state, never leaving det F > 0."""
    load_norm = float(np.linalg.norm(load))
    q, before = start, np.inf
    for iteration in range(1, DAMPED_ITERATIONS + 1):
        state, tangent = problem.linearise(q)
        residual = load - state.force
        step, stable = descent(problem, q, tangent, residual)
        size = float(np.linalg.norm(residual))
        floor, before = problem.extent if size > 0.5 * before else 0.0, size
        if stable and (size <= tolerance * load_norm or is_round_off(step, q, floor)):
            return Attempt(q, state.min_det_f, iteration, converged=is_certified(problem, q))
        slope, work = float(residual @ step), float(load @ q)
        potential, noise = state.energy_j - work, 1e-14 * (state.energy_j + abs(work))
        for halving in range(MAX_HALVINGS):
            length = 0.5**halving
            trial_q = q + length * step
            trial = problem.force(trial_q)
            allowed = potential - ARMIJO * length * slope + noise
            if trial.min_det_f > 0 and trial.energy_j - float(load @ trial_q) <= allowed:
                break
        else:
            return Attempt(q, trial.min_det_f, iteration, converged=False)
        q = trial_q
    return Attempt(q, trial.min_det_f, DAMPED_ITERATIONS, converged=False)


def solve_equilibrium(
    problem: Problem,
    load: Array,
    start: Array | None = None,
    options: NewtonOptions = NewtonOptions(),
) -> Solution:
    """Find the stable equilibrium under a dead load.

    Parameters
    ----------
    problem : Problem
    load : (n_unknowns,) float64
        External force, N (projected on the basis for a reduced problem).
    start : (n_unknowns,) float64, optional
        A guess; rest by default.
    options : NewtonOptions

    Returns
    -------
    Solution

    Raises
    ------
    InvertedElementError
        If the load can be followed only through det F <= 0.
    NoEquilibriumError
        If no stable equilibrium was found within the allowed cut-backs.
    InvalidInputError
        If the load or the start has another shape, NaN or infinity, or the load exceeds
        `MAX_LOAD_N`.
    """
    found = next(solve_equilibria(problem, [load], [start], options))[1]
    if isinstance(found, SolverError):
        raise found
    return found


def _checked(values: ArrayLike, name: str, problem: Problem) -> Array:
    """Return a float64 vector of the problem's unknowns; the kernels check no bounds."""
    array = np.asarray(values)
    if (
        array.dtype.kind not in "fiu"
        or array.shape != (problem.n_unknowns,)
        or not np.isfinite(array).all()
    ):
        raise InvalidInputError(
            f"{name} must be finite real numbers of shape ({problem.n_unknowns},); "
            f"got shape {array.shape}, dtype {array.dtype}."
        )
    return np.ascontiguousarray(array, dtype=np.float64)


def checked_load(values: ArrayLike, number: int, problem: Problem) -> Array:
    """Return a load as float64, (n_unknowns,) N; `InvalidInputError` as `solve_equilibrium`."""
    load = _checked(values, f"load {number}", problem)
    if np.abs(load).max() > MAX_LOAD_N:
        largest = load[np.abs(load).argmax()]
        raise InvalidInputError(f"load {number} must be within ±{MAX_LOAD_N:g} N; got {largest:g}.")
    return load


def solve_equilibria(
    problem: Problem,
    loads: Sequence[Array],
    starts: Sequence[Array | None] | None = None,
    options: NewtonOptions = NewtonOptions(),
) -> Iterator[tuple[int, Solution | SolverError]]:
    """Solve for many loads, which share the sweeps over the factor; see `solve_equilibrium`.

    Yields the number of each load with its solution, or with the error that `solve_equilibrium`
    would raise. Loads come in the order in which they finish. A solution does not depend on the
    other loads, to the last digit.
    """
    loads = [checked_load(load, number, problem) for number, load in enumerate(loads)]
    starts = [
        None if start is None else _checked(start, "`start`", problem)
        for start in starts or [None] * len(loads)
    ]
    pending = [i for i, load in enumerate(loads) if load.any()]
    for i in sorted(set(range(len(loads))) - set(pending)):
        yield i, Solution(np.zeros(problem.n_unknowns), 1.0, 0, 0)
    inverse = problem.accelerator
    outcomes: Iterator[tuple[int, Attempt | None]] = ((n, None) for n in range(len(pending)))
    if inverse is not None:
        outcomes = run_in_step(
            inverse,
            (
                accelerated(problem, inverse, loads[i], starts[i], options.tolerance)
                for i in pending
            ),
        )
    for number, first in outcomes:
        i = pending[number]
        if first is not None and first.valid:
            yield i, Solution(first.q, first.min_det_f, first.iterations, 0)
            continue
        spent = first.iterations if first else 0
        try:
            with one_blas_thread():
                found: Solution | SolverError = _by_newton(
                    problem, loads[i], starts[i], options, spent
                )
        except SolverError as error:
            found = error
        yield i, found


def _by_newton(
    problem: Problem, load: Array, start: Array | None, options: NewtonOptions, spent: int
) -> Solution:
    """Solve by full Newton steps, then by increments, after ``spent`` earlier iterations."""
    first = full_steps(problem, load, start, options.tolerance)
    iterations = spent + first.iterations
    if first.valid:
        return Solution(first.q, first.min_det_f, iterations, 0)
    if start is not None:  # it may lie on a branch that cannot be reached from rest
        attempt = _damped(problem, load, start, options.tolerance)
        iterations += attempt.iterations
        if attempt.valid:
            return Solution(attempt.q, attempt.min_det_f, iterations, 0)
    q, steps = np.zeros(problem.n_unknowns), LoadSteps(0.5)
    while True:
        attempt = _damped(problem, steps.target * load, q, options.tolerance)
        iterations += attempt.iterations
        if attempt.valid:
            q = attempt.q
            steps.accept()
            if steps.complete:
                return Solution(q, attempt.min_det_f, iterations, steps.cuts)
            continue
        steps.cut()
        if steps.cuts > options.max_cuts or iterations > MAX_ITERATIONS:
            story = steps.story(iterations)
            if attempt.min_det_f <= 0 or (first.converged and first.min_det_f <= 0):
                smallest = min(attempt.min_det_f, first.min_det_f)
                raise InvertedElementError(
                    f"elements invert: {story}; the smallest det F was {smallest:.3g}.",
                    cuts=steps.cuts,
                )
            raise NoEquilibriumError(
                f"no stable equilibrium found: {story}; "
                "`mor_bench.mechanics.stability.limit_load` finds the limit load.",
                cuts=steps.cuts,
            )
