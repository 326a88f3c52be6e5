"""Cubature by ECSW: few cells with non-negative weights that give the force of all cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from mor_bench.errors import InvalidInputError, MorBenchError
from mor_bench.mechanics.assembly import Assembler

Array = NDArray[np.float64]

DEPENDENT = 1e-12
"""Least part of a unit column outside the span of the chosen ones; less is linear dependence."""
OPTIMAL = 1e-10
"""Largest gradient, relative to the target, that counts as zero in the optimality conditions."""
LEAST_GRADIENT = 1e-14
"""Gradient, relative to the target, below which a column promises no progress."""
DRIFT = 1e-12
"""Passive gradient, relative to target or scaled weights, that calls for a fresh factor."""
MAX_ENTRIES = 2**26
"""Number of entries (512 MB) above which QR compresses a training matrix."""


class CubatureError(MorBenchError):
    """The weights missed the tolerance or the optimality conditions.

    Attributes
    ----------
    relative_residual : float or None
        The residual, if it missed the tolerance.
    """

    def __init__(self, message: str, *, relative_residual: float | None = None) -> None:
        super().__init__(message)
        self.relative_residual = relative_residual


@dataclass(frozen=True)
class SparseWeights:
    """Weights of a cubature, A weights ≈ b, with residual and gradients recomputed from them.

    Attributes
    ----------
    weights : (n,) float64
        Non-negative.
    relative_residual : float
        ‖A weights - b‖ / ‖b‖.
    passive_gradient : float
        Largest |aⱼᵀ(b - A weights)| / (‖aⱼ‖ ‖b‖) over the columns with positive weights. It is zero
        at the least-squares solution on these columns.
    dual_gradient : float
        Largest aⱼᵀ(b - A weights) / (‖aⱼ‖ ‖b‖) over the other columns, at least 0. If both
        gradients are zero, no non-negative weights are better (Karush, Kuhn and Tucker). A run
        with a tolerance stops before that.
    iterations : int
    """

    weights: Array
    relative_residual: float
    passive_gradient: float
    dual_gradient: float
    iterations: int

    @classmethod
    def of(cls, matrix: Array, target: Array, weights: Array, iterations: int) -> SparseWeights:
        """Compute residual and gradients from the weights."""
        size, residual = float(np.linalg.norm(target)), target - matrix @ weights
        if size == 0:
            return cls(weights, 0.0, 0.0, 0.0, iterations)
        gradient = (matrix.T @ residual) * _inverse_norms(matrix) / size
        passive = weights > 0
        relative = float(np.linalg.norm(residual)) / size
        return cls(
            weights,
            relative,
            float(np.abs(gradient[passive]).max(initial=0.0)),
            float(gradient[~passive].max(initial=0.0)),
            iterations,
        )


def _inverse_norms(matrix: Array) -> Array:
    """Return 1 / ‖aⱼ‖, and 0 for a column of zeros."""
    norms: Array = np.sqrt(np.einsum("ij,ij->j", matrix, matrix))  # without a copy of the matrix
    inverse: Array = np.zeros_like(norms)
    np.divide(1.0, norms, out=inverse, where=norms > 0)
    return inverse


@njit(cache=True, nogil=True, error_model="numpy")
def _remove(q: Any, r: Any, c: Any, position: int, n: int) -> None:
    """Remove a column from the factor QR of n columns; Givens rotations keep R triangular."""
    for j in range(position, n - 1):
        r[: j + 2, j] = r[: j + 2, j + 1]
    for j in range(position, n - 1):
        length = np.hypot(r[j, j], r[j + 1, j])
        cosine, sine = r[j, j] / length, r[j + 1, j] / length
        for k in range(j, n - 1):
            upper, lower = r[j, k], r[j + 1, k]
            r[j, k], r[j + 1, k] = cosine * upper + sine * lower, cosine * lower - sine * upper
        c[j], c[j + 1] = cosine * c[j] + sine * c[j + 1], cosine * c[j + 1] - sine * c[j]
        for k in range(q.shape[1]):
            upper, lower = q[j, k], q[j + 1, k]
            q[j, k], q[j + 1, k] = cosine * upper + sine * lower, cosine * lower - sine * upper


class ActiveColumns:
    """Least squares on a changing choice of a matrix's columns, with an updated QR factor.

    Columns are scaled to unit norm. A new column is orthogonalised twice. Givens rotations remove
    a column. Both cost O(m p) for p columns of length m.

    Parameters
    ----------
    matrix : (m, n) float64
    target : (m,) float64

    Attributes
    ----------
    chosen : list of int
        Numbers of the columns, in the order of the factor.
    scale : (n,) float64
        1 / ‖aⱼ‖; 0 for columns of zeros.
    """

    def __init__(self, matrix: Array, target: Array) -> None:
        self.matrix, self.target, self.scale = matrix, target, _inverse_norms(matrix)
        self.chosen: list[int] = []
        self._q, self._r, self._c = np.empty((0, len(matrix))), np.empty((0, 0)), np.empty(0)

    def _reserve(self, n: int) -> None:
        """Make room for n columns."""
        if n > len(self._q):
            old, room = len(self._q), max(64, 2 * n)
            q, r, c = np.zeros((room, len(self.matrix))), np.zeros((room, room)), np.zeros(room)
            q[:old], r[:old, :old], c[:old] = self._q, self._r, self._c
            self._q, self._r, self._c = q, r, c

    def append(self, column: int) -> bool:
        """Choose a column; return False, without a change, if it depends on the chosen ones."""
        n = len(self.chosen)
        self._reserve(n + 1)
        new, q = self.matrix[:, column] * self.scale[column], self._q[:n]
        share = q @ new
        new = new - share @ q
        again = q @ new
        new = new - again @ q
        rest = float(np.linalg.norm(new))
        if rest <= DEPENDENT:
            return False
        self._q[n] = new / rest
        self._r[:n, n], self._r[n, n], self._r[n, :n] = share + again, rest, 0.0
        self._c[n] = self._q[n] @ self.target
        self.chosen.append(column)
        return True

    def remove(self, column: int) -> None:
        """Drop a chosen column."""
        position = self.chosen.index(column)
        _remove(self._q, self._r, self._c, position, len(self.chosen))
        del self.chosen[position]

    def refactor(self) -> None:
        """Factorise the chosen columns afresh."""
        n = len(self.chosen)
        scaled = self.matrix[:, self.chosen] * self.scale[self.chosen]
        q, r = qr(scaled, mode="economic", check_finite=False)
        self._q[:n], self._r[:n, :n], self._c[:n] = q.T, r, q.T @ self.target

    def coefficients(self) -> Array:
        """Return the scaled least-squares solution on the chosen columns, in their order."""
        n = len(self.chosen)
        return np.asarray(solve_triangular(self._r[:n, :n], self._c[:n], check_finite=False))

    def residual(self, coefficients: Array) -> Array:
        """Return the target minus the chosen columns times their coefficients."""
        return self.target - self.matrix[:, self.chosen] @ (coefficients * self.scale[self.chosen])

    def gradient(self, residual: Array) -> Array:
        """Return aⱼᵀ residual / ‖aⱼ‖, (n,)."""
        return (residual @ self.matrix) * self.scale

    def weights(self, coefficients: Array) -> Array:
        """Return weights (n,) of the unscaled columns."""
        weights = np.zeros(self.matrix.shape[1])
        weights[self.chosen] = coefficients * self.scale[self.chosen]
        return weights


def check_finite(matrix: Array, target: Array) -> None:
    """Raise `InvalidInputError` if matrix or target hold NaN or infinity."""
    if not (np.isfinite(matrix).all() and np.isfinite(target).all()):
        raise InvalidInputError("the cubature's training matrix holds NaN or infinity.")


def sparse_nnls(
    matrix: Array, target: Array, tolerance: float, max_iterations: int | None = None
) -> SparseWeights:
    """Find few non-negative weights x with ‖A x - b‖ <= tolerance ‖b‖.

    Lawson and Hanson's active set, stopped early: Farhat, Avery, Chapman, Cortial: Dimensional
    reduction of nonlinear finite element dynamic models with finite rotations and energy-based mesh
    sampling and weighting for computational efficiency, IJNME 98 (2014), algorithm 1. Columns are
    scaled to unit norm, so that the choice does not favour large cells.

    The weights have a passive gradient of at most `OPTIMAL`. With tolerance 0 they are the
    non-negative least-squares solution, and the dual gradient is at most `OPTIMAL` too.

    Parameters
    ----------
    matrix : (m, n) float64
    target : (m,) float64
    tolerance : float
        Relative residual at which to stop; 0 runs to the optimum.
    max_iterations : int, optional
        Largest number of columns added or removed; 3 n by default.

    Raises
    ------
    InvalidInputError
        If an entry is not finite.
    CubatureError
        If the tolerance, or with tolerance 0 the optimum, is not reached.
    """
    check_finite(matrix, target)
    columns, size = ActiveColumns(matrix, target), float(np.linalg.norm(target))
    limit = 3 * matrix.shape[1] if max_iterations is None else max_iterations
    x, residual, iterations = np.zeros(0), target, 0
    unusable = columns.scale == 0
    rejected, enough = unusable.copy(), max(tolerance, LEAST_GRADIENT) * size
    while float(np.linalg.norm(residual)) > enough and iterations < limit:
        gradient = columns.gradient(residual)
        if np.abs(gradient[columns.chosen]).max(initial=0.0) > DRIFT * max(size, float(x.sum())):
            columns.refactor()
            x, residual = _feasible(columns, x, residual)
            gradient = columns.gradient(residual)
        gradient[columns.chosen] = -np.inf
        gradient[rejected] = -np.inf
        entering = int(gradient.argmax())
        if gradient[entering] <= LEAST_GRADIENT * size:
            break
        iterations += 1
        trial = _appended(columns, entering)
        if trial is None:
            rejected[entering] = True
            continue
        rejected = unusable.copy()
        x, removals = _positive(columns, np.append(x, 0.0), trial)
        residual, iterations = columns.residual(x), iterations + removals
    found = SparseWeights.of(matrix, target, columns.weights(x), iterations)
    _check(found, tolerance)
    return found


def _appended(columns: ActiveColumns, entering: int) -> Array | None:
    """Append a column and return the coefficients; None if it cannot have a positive weight.

    A dependent column, or one with a negative weight, would be chosen again and again.
    """
    if not columns.append(entering):
        return None
    trial = columns.coefficients()
    if trial[-1] > 0:
        return trial
    columns.remove(entering)
    return None


def _positive(columns: ActiveColumns, x: Array, trial: Array) -> tuple[Array, int]:
    """Remove columns between x and the trial until all coefficients are positive.

    Returns the least-squares coefficients on the remaining columns, and the number of removals.
    """
    removals = 0
    while not (trial > 0).all():
        shrinking = trial <= 0
        x = x + float((x[shrinking] / (x[shrinking] - trial[shrinking])).min()) * (trial - x)
        leaving = (x <= 1e-14 * x.max()) & shrinking
        for column in [columns.chosen[i] for i in np.flatnonzero(leaving)]:
            columns.remove(column)
        x, trial, removals = x[~leaving], columns.coefficients(), removals + 1
    return trial, removals


def _check(found: SparseWeights, tolerance: float) -> None:
    """Raise `CubatureError` if weights miss the tolerance or the optimality conditions."""
    iterations = found.iterations
    if found.relative_residual > tolerance * (1 + 1e-9) > 0:
        raise CubatureError(
            f"cubature reached a relative residual of {found.relative_residual:.3g} in "
            f"{iterations} iterations; the `tolerance` is {tolerance:.3g}.",
            relative_residual=found.relative_residual,
        )
    if found.passive_gradient > OPTIMAL or (tolerance == 0 and found.dual_gradient > OPTIMAL):
        raise CubatureError(
            f"cubature found no optimum in {iterations} iterations: the gradient is "
            f"{found.passive_gradient:.3g} on positive weights and {found.dual_gradient:.3g} on "
            f"the others; at most {OPTIMAL:.3g} is allowed."
        )


def _feasible(columns: ActiveColumns, x: Array, residual: Array) -> tuple[Array, Array]:
    """Return the solution of a fresh factor if it is positive; else x."""
    trial = columns.coefficients()
    return (trial, columns.residual(trial)) if (trial > 0).all() else (x, residual)


def ecsw_system(
    assembler: Assembler,
    cell_dofs: NDArray[np.int64],
    modes: Array,
    q: Array,
    max_entries: int = MAX_ENTRIES,
) -> Array:
    """Return the ECSW training matrix G, or a shorter one with the same least-squares problem.

    G[(s, i), e] = φ_iᵀ f_e(Φ q_s), (n_snapshots r, n_cells); the target is G·1. The triangle R of
    G = QR has the same problem, because ‖Gξ - G1‖ = ‖Rξ - R1‖. QR pays off above 4 rows per cell.
    If G has more than ``max_entries``, blocks of rows are compressed as they come.

    Parameters
    ----------
    assembler : Assembler
        Over all cells.
    cell_dofs : (n_cells, n_cell_dofs) int
        Row of Φ of each cell's dofs; ``n_dofs`` at supports.
    modes : (n_dofs, r) float64
    q : (n_snapshots, r) float64
        Projected snapshots.
    max_entries : int
    """
    local = np.vstack([modes, np.zeros(modes.shape[1])])[cell_dofs]
    n_cells, r = len(cell_dofs), modes.shape[1]
    most = max(2 * n_cells + r, min(len(q) * r, max_entries // n_cells))
    system, used = np.empty((most, n_cells)), 0
    for coordinates in q:
        if used + r > most:
            system[:n_cells], used = triangle(system[:used]), n_cells
        forces = assembler.cell_forces(modes @ coordinates)
        system[used : used + r] = np.matmul(forces[:, None], local)[:, 0].T
        used += r
    return short(system[:used])


def short(system: Array) -> Array:
    """Return a matrix with the same least-squares problem; QR pays above 4 rows per column."""
    return triangle(system) if len(system) > 4 * system.shape[1] else system


def triangle(matrix: Array) -> Array:
    """Return R of the QR factorisation, which has the same least-squares problem."""
    return np.asarray(qr(matrix, mode="r", check_finite=False)[0][: matrix.shape[1]])
