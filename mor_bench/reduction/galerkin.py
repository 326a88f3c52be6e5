"""Galerkin projection of an assembled model on a basis: u = Φq, Φᵀ f_int(Φq) = Φᵀ f."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs

from mor_bench.counting import cholesky_multiply_adds, count, triangular_multiply_adds
from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.mechanics.assembly import Assembler, State
from mor_bench.mechanics.linear import Factor, NotPositiveDefiniteError
from mor_bench.mechanics.newton import (
    MAX_LOAD_N,
    NewtonOptions,
    Solution,
    solve_equilibrium,
)
from mor_bench.mechanics.pattern import Pattern
from mor_bench.mechanics.problem import is_linear
from mor_bench.reduction.points import ReducedPoints


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _symmetric_product(indptr: Any, indices: Any, values: Any, modes: Any, product: Any) -> None:
    """Add K modes to product, for the symmetric K with the given upper triangle in CSR form."""
    for i in range(len(indptr) - 1):
        for k in range(indptr[i], indptr[i + 1]):
            j, value = indices[k], values[k]
            for m in range(modes.shape[1]):
                product[i, m] += value * modes[j, m]
            if i != j:
                for m in range(modes.shape[1]):
                    product[j, m] += value * modes[i, m]


def stiffness_times(
    pattern: Pattern, values: NDArray[np.float64], modes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return K times modes, (n, r), for a stiffness K with the given upper triangle."""
    product = np.zeros_like(modes)
    _symmetric_product(pattern.indptr, pattern.indices, values, modes, product)
    return product


class _DenseFactor:
    """A dense Cholesky factor."""

    def __init__(self, cholesky: NDArray[np.float64]) -> None:
        self._cholesky = cholesky

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        r, m = len(rhs), 1 if rhs.ndim == 1 else rhs.shape[1]
        count(
            back_solves=m,
            reduced_back_solves=m,
            multiply_adds=m * triangular_multiply_adds(r, r - 1),
        )
        return np.asarray(dpotrs(self._cholesky, rhs)[0]).reshape(rhs.shape)


def dense_factor(tangent: NDArray[np.float64]) -> Factor:
    """Return a reduced tangent's Cholesky factor, or raise `NotPositiveDefiniteError`."""
    r = len(tangent)
    count(
        factorisations=1,
        reduced_factorisations=1,
        multiply_adds=cholesky_multiply_adds(r, r - 1),
    )
    cholesky, info = dpotrf(tangent)
    if info != 0:
        raise NotPositiveDefiniteError
    return _DenseFactor(cholesky)


class DenseProblem(ABC):
    """Base of reduced problems: symmetric dense tangents, and a Cholesky factor for each step."""

    accelerator = None
    n_unknowns: int
    extent: float
    linear_at_rest = True

    @property
    @abstractmethod
    def rest_tangent(self) -> NDArray[np.float64]: ...

    @abstractmethod
    def force(self, q: NDArray[np.float64]) -> State: ...

    @abstractmethod
    def linearise(self, q: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]: ...

    @cached_property
    def rest_factor(self) -> Factor:
        """Factor of the stiffness at rest; `SolverError` if it is not positive definite."""
        try:
            return self.factor(self.rest_tangent)
        except NotPositiveDefiniteError:
            raise SolverError(
                "the reduced stiffness at rest is not positive definite: its modes are linearly "
                "dependent, or too few cells or points are kept."
            ) from None

    def prepare(self) -> None:
        """Compute the factor that all solves share, so that no query has to."""
        _ = self.rest_factor

    def step(
        self,
        q: NDArray[np.float64],
        tangent: NDArray[np.float64],
        residual: NDArray[np.float64],
        tolerance: float,
    ) -> NDArray[np.float64]:
        return self.factor(tangent).solve(residual)

    def certify(self, q: NDArray[np.float64]) -> None:  # noqa: B027 - not to be overridden
        """Do nothing, since every step has a Cholesky factor."""

    def factor(self, tangent: NDArray[np.float64]) -> Factor:
        return dense_factor(tangent)


class GalerkinProblem(DenseProblem):
    """A reduced model over all cells (plain POD) or over weighted ones (ECSW).

    The basis has only the rows of the assembler's dofs. With few cells, the cost of a Newton step
    hence does not depend on the mesh.

    Parameters
    ----------
    assembler : Assembler
    modes : (assembler.n_dofs, r) float64
        Rows of Φ of the assembler's dofs.

    Raises
    ------
    InvalidInputError
        If the basis has another number of rows, NaN or infinity.
    """

    def __init__(self, assembler: Assembler, modes: NDArray[np.float64]) -> None:
        if modes.ndim != 2 or len(modes) != assembler.n_dofs or not np.isfinite(modes).all():
            raise InvalidInputError(
                f"`modes` must be a finite array of shape ({assembler.n_dofs}, r); "
                f"got shape {modes.shape}."
            )
        self.assembler = assembler
        self.modes = np.ascontiguousarray(modes)
        self.n_unknowns = modes.shape[1]
        # Modes that are orthonormal in another inner product may have any norm.
        largest = np.linalg.norm(modes, axis=0).max() or 1.0
        self.extent = assembler.extent_m * float(np.sqrt(len(modes)) / largest)

    @cached_property
    def rest_tangent(self) -> NDArray[np.float64]:
        return self.linearise(np.zeros(self.n_unknowns))[1]

    def _project(self, state: State) -> State:
        return State(self.modes.T @ state.force, state.energy_j, state.min_det_f)

    def force(self, q: NDArray[np.float64]) -> State:
        count(multiply_adds=2 * self.modes.size)
        return self._project(self.assembler.force(self.modes @ q))

    def linearise(self, q: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        state, values = self.assembler.force_and_tangent(self.modes @ q)
        # The terms are Φq, Φᵀf, KΦ with one stored triangle of K, and ΦᵀKΦ.
        n, r = self.modes.shape
        count(multiply_adds=2 * n * r + (2 * len(values) - n) * r + n * r**2)
        product = stiffness_times(self.assembler.pattern, values, self.modes)
        return self._project(state), self.modes.T @ product

    def solve(self, load: NDArray[np.float64], options: NewtonOptions) -> Solution:
        """Solve from rest; see `solve_equilibrium`."""
        return solve_equilibrium(self, load, options=options)


class CubatureProblem(DenseProblem):
    """A reduced model over weighted quadrature points; work and memory do not depend on the mesh.

    Parameters
    ----------
    points : ReducedPoints
        Points whose test functions are the modes.
    extent : float
        Coordinates of this size are displacements of the size of the body, see `Problem`.
    """

    def __init__(self, points: ReducedPoints, extent: float) -> None:
        self.points = points
        self.n_unknowns = points.n_unknowns
        self.extent = extent

    @cached_property
    def rest_tangent(self) -> NDArray[np.float64]:
        return self.linearise(np.zeros(self.n_unknowns))[1]

    def force(self, q: NDArray[np.float64]) -> State:
        return self.points.force(q)

    def linearise(self, q: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        return self.points.force_and_tangent(q)

    def solve(self, load: NDArray[np.float64], options: NewtonOptions) -> Solution:
        """Solve from rest; see `solve_equilibrium`.

        Saint Venant-Kirchhoff tries full Newton steps in one compiled loop first.
        """
        if 0 < np.abs(load).max() <= MAX_LOAD_N:
            q = self.rest_factor.solve(load)
            if not is_linear(self, q):
                found = self.points.full_steps(load, q, options.tolerance, self.extent)
                if found is not None:
                    return found
        return solve_equilibrium(self, load, options=options)
