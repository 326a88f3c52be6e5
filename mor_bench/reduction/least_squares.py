"""Least-squares Petrov-Galerkin (LSPG) projection on a curved manifold, by Gauss-Newton steps.

It minimises ‖A (f_int(u(q)) - f)‖² over q. The weighting matrix A = L⁻¹Φᵀ has L Lᵀ = ΦᵀK₀Φ, so the
norm is that of the energy in the span of Φ at rest. Without L it is the Euclidean norm of the
residual in Φ. Lee, Carlberg: Model reduction of dynamical systems on nonlinear manifolds using deep
convolutional autoencoders, J. Comput. Phys. 404 (2020), equation 3.12.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from mor_bench.counting import count
from mor_bench.errors import InvertedElementError, NoEquilibriumError
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.load_steps import LoadSteps
from mor_bench.mechanics.newton import ARMIJO, MAX_HALVINGS, MAX_ITERATIONS, NewtonOptions
from mor_bench.mechanics.problem import is_linear, is_round_off
from mor_bench.reduction.curved import CurvedLoad, CurvedModel, CurvedProblem
from mor_bench.reduction.galerkin import dense_factor

Array = NDArray[np.float64]

GAUSS_NEWTON_ITERATIONS = 60
"""Largest number of steps per increment. A residual that stays makes convergence linear."""


@dataclass(frozen=True)
class Weighting:
    """The norm of the residual in Φ.

    Attributes
    ----------
    modes : (n_rows, N) float64
        Φ on the rows of the cells.
    lower : (N, N) float64, optional
        L; None for the Euclidean norm.
    """

    modes: Array
    lower: Array | None = None

    def of(self, values: Array) -> Array:
        """Return L⁻¹ values, for values (N,) or (N, k)."""
        if self.lower is None:
            return values
        count(multiply_adds=self.lower.size // 2 * (values.size // len(values)))
        return np.asarray(solve_triangular(self.lower, values, lower=True, check_finite=False))


@dataclass(frozen=True)
class _Descent:
    """The end of a descent: coordinates if it found a minimum, last det F, and iterations."""

    q: Array | None
    min_det_f: float
    iterations: int


def solve_least_squares(
    model: CurvedModel,
    load: CurvedLoad,
    weighting: Weighting,
    options: NewtonOptions = NewtonOptions(),
) -> Array:
    """Return coordinates (r,) that minimise the weighted residual, reached from rest.

    The gradient of the squared residual, relative to that at rest, meets the tolerance. det F is
    positive in every sampled cell, and the stiffness on the tangent space is positive definite.

    Parameters
    ----------
    model : CurvedModel
    load : CurvedLoad
    weighting : Weighting
    options : NewtonOptions

    Raises
    ------
    InvertedElementError
        If the load can be followed only through det F <= 0.
    NoEquilibriumError
        If no such minimum was found within the allowed cut-backs.
    """
    problem = CurvedProblem(model, load)
    if not load.at_rest.any():
        return np.zeros(problem.n_unknowns)
    start = problem.rest_factor.solve(load.at_rest)
    if is_linear(problem, start):
        return start
    found = _descend(problem, weighting, start, options.tolerance)
    if found.q is not None:
        return found.q
    q, steps, iterations = np.zeros(problem.n_unknowns), LoadSteps(0.5), found.iterations
    while True:
        part = CurvedProblem(model, load.times(steps.target))
        found = _descend(part, weighting, q, options.tolerance)
        iterations += found.iterations
        if found.q is not None:
            q = found.q
            steps.accept()
            if steps.complete:
                return q
            continue
        steps.cut()
        if steps.cuts > options.max_cuts or iterations > MAX_ITERATIONS:
            story = steps.story(iterations)
            if found.min_det_f <= 0:
                raise InvertedElementError(
                    f"elements invert: {story}; the smallest det F was {found.min_det_f:.3g}.",
                    cuts=steps.cuts,
                )
            raise NoEquilibriumError(
                f"no stable minimum of the residual found: {story}.", cuts=steps.cuts
            )


def _descend(
    problem: CurvedProblem, weighting: Weighting, start: Array, tolerance: float
) -> _Descent:
    """Take Gauss-Newton steps; each lowers the residual and keeps det F > 0."""
    q, scale, min_det = start, 0.0, np.inf
    for iteration in range(1, GAUSS_NEWTON_ITERATIONS + 1):
        state, residual, (tangents, forces) = problem.differentiate(q)
        min_det, r = state.min_det_f, len(q)
        if not (min_det > 0 and np.isfinite(residual).all()):
            return _Descent(None, min_det, iteration)
        weighted, jacobian = weighting.of(residual), weighting.of(weighting.modes.T @ forces)
        count(multiply_adds=forces.size * len(residual) + jacobian.size * (r + 1))
        gradient = jacobian.T @ weighted
        scale = scale or float(np.linalg.norm(jacobian.T @ weighting.of(problem.load.projected)))
        try:
            step = -dense_factor(jacobian.T @ jacobian).solve(gradient)
        except NotPositiveDefiniteError:
            return _Descent(None, min_det, iteration)
        if float(np.linalg.norm(gradient)) <= tolerance * scale or is_round_off(step, q):
            return _Descent(q if _is_stable(tangents, forces) else None, min_det, iteration)
        now, slope = float(weighted @ weighted), float(gradient @ step)
        for halving in range(MAX_HALVINGS):
            trial = q + 0.5**halving * step
            there, min_det = problem.residual(trial)
            there = weighting.of(there)
            if min_det > 0 and there @ there <= now + 2 * ARMIJO * 0.5**halving * slope:
                break
        else:
            return _Descent(None, min_det, iteration)
        q = trial
    return _Descent(None, min_det, GAUSS_NEWTON_ITERATIONS)


def _is_stable(tangents: Array, forces: Array) -> bool:
    """Return whether TᵀKT is positive definite, from T and KT."""
    count(multiply_adds=tangents.size * tangents.shape[1])
    try:
        dense_factor(tangents.T @ forces)
    except NotPositiveDefiniteError:
        return False
    return True
