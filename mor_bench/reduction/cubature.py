"""Empirical cubature: a few cells with non-negative weights that give the same reduced force as all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lstsq, qr

from mor_bench.errors import InvalidInputError, MorBenchError
from mor_bench.mechanics.assembly import Assembler


class CubatureError(MorBenchError):
    """The non-negative least squares did not reach the tolerance within its iterations."""


@dataclass(frozen=True)
class SparseWeights:
    """The outcome of the non-negative least squares.

    Attributes
    ----------
    weights : (n,) float64
        Non-negative.
    relative_residual : float
        ‖A weights - b‖ / ‖b‖, recomputed from the weights.
    passive_gradient : float
        Largest |aⱼᵀ(b - A weights)| / (‖aⱼ‖ ‖b‖) over the columns with a positive weight: zero at the least-squares
        solution on these columns, recomputed from the weights.
    iterations : int
    """

    weights: NDArray[np.float64]
    relative_residual: float
    passive_gradient: float
    iterations: int


def sparse_nnls(matrix: NDArray[np.float64], target: NDArray[np.float64], tolerance: float, max_iterations: int | None = None) -> SparseWeights:
    """Few non-negative weights with ‖A x - b‖ <= tolerance ‖b‖: Lawson and Hanson's active set, stopped early.

    Farhat, Avery, Chapman, Cortial: Dimensional reduction of nonlinear finite element dynamic models with finite
    rotations and energy-based mesh sampling and weighting for computational efficiency, IJNME 98 (2014), algorithm 1.
    Columns are scaled to unit norm, so that the choice does not favour large cells.

    Parameters
    ----------
    matrix : (m, n) float64
    target : (m,) float64
    tolerance : float
        Relative residual at which to stop.
    max_iterations : int, optional
        Columns added or removed; 3 n by default.

    Raises
    ------
    InvalidInputError
        If an entry is not finite.
    CubatureError
        If the tolerance is not reached.
    """
    if not (np.isfinite(matrix).all() and np.isfinite(target).all()):
        raise InvalidInputError("the cubature's training matrix holds NaN or infinity.")
    norms = np.linalg.norm(matrix, axis=0)
    usable = norms > 0
    a = matrix / np.where(usable, norms, 1.0)
    size = float(np.linalg.norm(target))
    limit = 3 * matrix.shape[1] if max_iterations is None else max_iterations
    x, passive = np.zeros(matrix.shape[1]), np.zeros(matrix.shape[1], dtype=bool)
    residual, iterations = target.copy(), 0
    rejected = ~usable
    while float(np.linalg.norm(residual)) > tolerance * size and iterations < limit:
        gradient = np.where(passive | rejected, -np.inf, a.T @ residual)
        entering = int(gradient.argmax())
        if gradient[entering] <= 1e-15 * size:
            break
        passive[entering] = True
        first = True
        while True:
            iterations += 1
            columns = np.flatnonzero(passive)
            trial = lstsq(a[:, columns], target, check_finite=False)[0]
            if first and trial[columns == entering][0] <= 0:
                # Round-off: a (nearly) dependent column that cannot take a positive weight would enter for ever.
                passive[entering], rejected[entering] = False, True
                break
            first = False
            if (trial > 0).all():
                x[:] = 0.0
                x[columns] = trial
                rejected = ~usable
                break
            shrinking = trial <= 0
            old = x[columns]
            step = float((old[shrinking] / (old[shrinking] - trial[shrinking])).min())
            x[columns] = old + step * (trial - old)
            passive[columns[x[columns] <= 1e-14 * x.max()]] = False
            x[~passive] = 0.0
        residual = target - a @ x
    weights = x / np.where(usable, norms, 1.0)
    residual = target - matrix @ weights
    reached = float(np.linalg.norm(residual)) / size if size > 0 else 0.0
    gradient = np.abs(a.T @ residual)[weights > 0] / size if size > 0 else np.zeros(0)
    if reached > tolerance * (1 + 1e-9):
        raise CubatureError(
            f"cubature reached a relative residual of {reached:.3g} in {iterations} iterations; `tolerance` asks for {tolerance:.3g}."
        )
    return SparseWeights(weights, reached, float(gradient.max(initial=0.0)), iterations)


def ecsw_system(assembler: Assembler, cell_dofs: NDArray[np.int64], modes: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The ECSW training matrix, compressed by QR: G (n_snapshots r, n_cells) → R (at most n_cells rows).

    G[(s, i), e] = φ_iᵀ f_e(Φ q_s); the target is G·1. Since ‖Gξ - G1‖ = ‖Rξ - R1‖, the least squares need only R.

    Parameters
    ----------
    assembler : Assembler
        Over all cells.
    cell_dofs : (n_cells, 24) int
        Row of Φ of each cell's dofs; ``n_dofs`` for supports.
    modes : (n_dofs, r) float64
    q : (n_snapshots, r) float64
        Projected snapshots.
    """
    padded = np.vstack([modes, np.zeros(modes.shape[1])])
    local = padded[cell_dofs]
    rows = [np.einsum("eir,ei->re", local, assembler.cell_forces(modes @ coordinates)) for coordinates in q]
    return np.asarray(qr(np.concatenate(rows), mode="r", check_finite=False)[0][: assembler.n_cells])
