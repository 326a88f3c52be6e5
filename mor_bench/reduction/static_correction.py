"""Static correction: the part of the linear response that a reduced basis lacks, added to the reduced solution.

A basis of few modes cannot hold the local dent under every load; at small strains the rest is a back-solve with the
stiffness at rest that every scene has. Known in linear dynamics as static correction, residual flexibility or the mode
acceleration method (MacNeal, Computers & Structures 1 (1971) 581-601; Dickens, Nakagawa, Wittbrodt, ibid. 62 (1997) 985-998).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.errors import InvertedElementError
from mor_bench.mechanics.linear import Factor
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.tensors import TensorProblem


def static_correction(
    rest_factor: Factor,
    reduced_factor: Factor,
    modes: NDArray[np.float64],
    load: NDArray[np.float64],
) -> NDArray[np.float64]:
    """What a reduced model lacks of the linear response, (K₀⁻¹ - Φ (ΦᵀK₀Φ)⁻¹ Φᵀ) f.

    Added to any reduced solution whose tangent space at rest is Φ, it makes the answer to a small load exact to first order,
    whatever the basis. It is linear in the load and does not turn with the body, so that it may invert cells; `refuse_inverted` looks.

    Parameters
    ----------
    rest_factor : Factor
        Of the full model's stiffness at rest K₀: its factor, or its `Compliance`.
    reduced_factor : Factor
        That of ΦᵀK₀Φ.
    modes : (n_free, r) float64
        Φ.
    load : (n_free,) float64
        f, N.

    Returns
    -------
    (n_free,) float64
        m.
    """
    count(multiply_adds=2 * modes.size)
    return rest_factor.solve(load) - modes @ reduced_factor.solve(modes.T @ load)


def predict_corrected(
    problem: GalerkinProblem | TensorProblem,
    modes: NDArray[np.float64],
    model: FullOrderModel,
    rest_factor: Factor,
    loads: NDArray[np.float64],
    tolerance: float,
) -> NDArray[np.float64]:
    """Reduced equilibria under loads (n, n_free), N, with their static corrections, (n, n_free) m.

    The modes are those of the problem on all free dofs, the factor that of the model's stiffness at rest. Raises `SolverError`
    if the reduced model has no valid equilibrium, or its correction inverts cells.
    """
    out = np.empty(loads.shape)
    count(multiply_adds=2 * modes.size * len(loads))
    for row, load in zip(out, loads, strict=True):
        reduced = modes.T @ load
        if isinstance(problem, TensorProblem):
            q = problem.solve(reduced, tolerance)
        else:
            q = solve_equilibrium(problem, reduced, options=NewtonOptions(tolerance)).displacement
        row[:] = rest_factor.solve(load) + modes @ (q - problem.rest_factor.solve(reduced))
        refuse_inverted(model, row)
    return out


def refuse_inverted(model: FullOrderModel, u: NDArray[np.float64]) -> None:
    """Raise `InvertedElementError` if cells are inverted at displacements u (n_free,), m."""
    least = model.force(u).min_det_f
    if not least > 0:
        raise InvertedElementError(
            f"the reduced answer inverts elements: its least det F is {least:.3g}."
        )
