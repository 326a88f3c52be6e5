"""Empirical cubature (ECM): cells that integrate a basis of the reduced cell forces exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, svd

from mor_bench.reduction.cubature import ActiveColumns, CubatureError, SparseWeights, check_finite

Array = NDArray[np.float64]

BLOCK = 64
"""Number of directions that the range finder adds at a time."""
EXACT = 1e-8
"""Relative residual at which the equations for the weights count as solved."""


def cell_basis(matrix: Array, tolerance: float) -> Array:
    """Return leading right singular vectors; the others contribute at most ``tolerance``.

    The tolerance is relative to the matrix' Frobenius norm.

    Random combinations of rows give the range block by block, with one step of subspace iteration,
    until the rest is small enough. The singular vectors are then those of a small matrix. Source:
    Halko, Martinsson, Tropp, SIAM Review 53, 2011, algorithms 4.3 and 4.4.

    Parameters
    ----------
    matrix : (m, n) float64
    tolerance : float

    Returns
    -------
    (n, k) float64, orthonormal
    """
    rng = np.random.default_rng(0)
    total = float(np.linalg.norm(matrix))
    rows = np.zeros((0, matrix.shape[1]))
    while True:
        size = min(BLOCK, min(matrix.shape) - len(rows))
        left = qr(matrix @ (matrix.T @ rng.normal(size=(len(matrix), size))), mode="economic")[0]
        new = left.T @ matrix
        largest = float(np.linalg.norm(new, axis=1).max())
        for _ in range(2):
            new -= (new @ rows.T) @ rows
            new = new[
                np.linalg.norm(new, axis=1) > 1e-13 * largest
            ]  # within the span of the others but for round-off
        fresh, triangular = qr(new.T, mode="economic")
        fresh = fresh[:, np.abs(np.diag(triangular)) > 1e-13 * largest]
        fresh -= rows.T @ (rows @ fresh)
        rows = np.vstack([rows, qr(fresh, mode="economic")[0].T])
        projected = matrix @ rows.T
        rest = float(np.linalg.norm(matrix - projected @ rows))
        if (
            rest <= max(0.5 * tolerance, 1e-13) * total
            or fresh.shape[1] == 0
            or len(rows) == min(matrix.shape)
        ):
            break
    _, values, vt = svd(projected, full_matrices=False, check_finite=False)
    tails = np.sqrt(np.append(np.cumsum(values[::-1] ** 2)[::-1], 0.0) + rest**2)
    enough = np.flatnonzero(tails <= max(tolerance, 1e-12) * total)
    if not len(enough):
        raise CubatureError(
            f"the basis of the cell forces has a relative error of {rest / total:.3g}; "
            f"`cubature_tolerance` is {tolerance:.3g}."
        )
    kept = int(enough[0]) or 1
    return np.ascontiguousarray((vt[:kept] @ rows).T)


def empirical_cubature(
    matrix: Array, tolerance: float, max_iterations: int | None = None
) -> SparseWeights:
    """Find weights that exactly integrate 1 and the training matrix' leading singular vectors.

    Hernández, Caicedo, Ferrer: Dimensional hyper-reduction of nonlinear finite element models via
    empirical cubature, CMAME 313 (2017), section 3. The sum of the weights is constrained as in
    Kratos: the part of the constant outside the basis becomes one more basis function. Cells enter
    greedily, and cells with negative weights leave. There are at most as many cells as basis
    functions.

    Parameters
    ----------
    matrix : (m, n) float64
        G of `ecsw_system`; the target is G·1.
    tolerance : float
        Share of the matrix' Frobenius norm that the basis may lack.
    max_iterations : int, optional
        Largest number of columns added or removed; 3 n by default.

    Returns non-negative weights and the residual of their equations, at most `EXACT`. Raises
    `InvalidInputError` if an entry is not finite. Raises `CubatureError` if the matrix is zero or
    the equations are not solved within the iterations.
    """
    equations = _equations(matrix, tolerance)
    target = equations.sum(axis=1)
    columns, size = ActiveColumns(equations, target), float(np.linalg.norm(target))
    limit = 3 * matrix.shape[1] if max_iterations is None else max_iterations
    x, residual, iterations = np.zeros(0), target, 0
    rejected = columns.scale == 0
    while float(np.linalg.norm(residual)) > EXACT * size and iterations < limit:
        gradient = columns.gradient(residual)
        gradient[columns.chosen] = -np.inf
        gradient[rejected] = -np.inf
        entering = int(gradient.argmax())
        if gradient[entering] <= 0:
            break
        iterations += 1
        if not columns.append(entering):
            rejected[entering] = True
            continue
        x = columns.coefficients()
        while (x <= 0).any():
            for column in [columns.chosen[i] for i in np.flatnonzero(x <= 0)]:
                columns.remove(column)
                rejected[column] |= column == entering
            x, iterations = columns.coefficients(), iterations + 1
        before, residual = float(np.linalg.norm(residual)), columns.residual(x)
        if float(np.linalg.norm(residual)) < before:
            rejected = columns.scale == 0
        else:  # a cell that did not help would come and go for ever
            rejected[entering] = True
    found = SparseWeights.of(equations, target, columns.weights(x), iterations)
    if found.relative_residual > EXACT * (1 + 1e-6):
        raise CubatureError(
            f"cubature reached a relative residual of {found.relative_residual:.3g} in "
            f"{iterations} iterations; it must be at most {EXACT:g}."
        )
    return found


def _equations(matrix: Array, tolerance: float) -> Array:
    """Return the orthonormal rows (k, n) that the weights must integrate exactly."""
    ones = np.ones(matrix.shape[1])
    check_finite(matrix, ones)
    if not matrix.any():
        raise CubatureError("cubature has nothing to integrate: the training matrix is zero.")
    basis = cell_basis(matrix, tolerance)
    constant = ones - basis @ (basis.T @ ones)
    if np.linalg.norm(constant) > 1e-6 * np.linalg.norm(ones):
        basis = np.column_stack([basis, constant / np.linalg.norm(constant)])
    return np.ascontiguousarray(basis.T)
