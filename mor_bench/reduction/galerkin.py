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
    """product += K modes for the symmetric K whose upper triangle is given in CSR form."""
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
    """K modes, (n, r), of a stiffness whose upper triangle is given."""
    product = np.zeros_like(modes)
    _symmetric_product(pattern.indptr, pattern.indices, values, modes, product)
    return product


class _DenseFactor:
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
    """Cholesky factor of a reduced tangent (r, r); raises `NotPositiveDefiniteError`."""
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
    """What reduced problems share: symmetric dense tangents, each step by a Cholesky factor."""

    accelerator = None

    @property
    @abstractmethod
    def rest_tangent(self) -> NDArray[np.float64]: ...

    @cached_property
    def rest_factor(self) -> Factor:
        """Raises `SolverError` where the reduced stiffness at rest is not positive definite."""
        try:
            return self.factor(self.rest_tangent)
        except NotPositiveDefiniteError:
            raise SolverError(
                "the reduced stiffness at rest is not positive definite: its modes depend on each other, or too few cells or points are kept."
            ) from None

    def step(
        self,
        q: NDArray[np.float64],
        tangent: NDArray[np.float64],
        residual: NDArray[np.float64],
        tolerance: float,
    ) -> NDArray[np.float64]:
        return self.factor(tangent).solve(residual)

    def certify(self, q: NDArray[np.float64]) -> None:  # noqa: B027 - not to be overridden
        """Nothing to do: every step has a Cholesky factor."""

    def factor(self, tangent: NDArray[np.float64]) -> Factor:
        return dense_factor(tangent)


class GalerkinProblem(DenseProblem):
    """A reduced model over all cells (plain POD) or over weighted ones (ECSW).

    The basis need only hold the rows of the dofs that the assembler sees, so that with few cells the cost of a Newton
    step does not depend on the mesh.

    Parameters
    ----------
    assembler : Assembler
    modes : (assembler.n_dofs, r) float64
        The rows of Φ that belong to the assembler's dofs.

    Raises
    ------
    InvalidInputError
        If the basis has another number of rows, NaN or infinity: the kernels behind check no bounds.
    """

    def __init__(self, assembler: Assembler, modes: NDArray[np.float64]) -> None:
        if modes.ndim != 2 or len(modes) != assembler.n_dofs or not np.isfinite(modes).all():
            raise InvalidInputError(
                f"`modes` must be a finite array of shape ({assembler.n_dofs}, r); got shape {modes.shape}."
            )
        self.assembler = assembler
        self.modes = np.ascontiguousarray(modes)
        self.n_unknowns = modes.shape[1]
        # Of an orthonormal basis the largest mode has norm 1, of one that is so in another inner product any.
        self.extent = assembler.extent_m * float(
            np.sqrt(len(modes)) / (np.linalg.norm(modes, axis=0).max() or 1.0)
        )

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
        # Φq, Φᵀf, KΦ with the K of which one triangle is stored, ΦᵀKΦ.
        n, r = self.modes.shape
        count(multiply_adds=2 * n * r + (2 * len(values) - n) * r + n * r**2)
        return self._project(state), self.modes.T @ stiffness_times(
            self.assembler.pattern, values, self.modes
        )


class CubatureProblem(DenseProblem):
    """A reduced model over weighted quadrature points: neither work nor memory of a step depends on the mesh.

    Parameters
    ----------
    points : ReducedPoints
        Whose test functions are the modes.
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
        """`solve_equilibrium` from rest; Saint Venant-Kirchhoff tries full Newton steps in one compiled loop first.

        With 11 cells and 3 modes of beam-coarse a solve took 0.026 ms instead of 0.068, with 20 modes 0.50 instead of 0.57.
        """
        if 0 < np.abs(load).max() <= MAX_LOAD_N:
            q = self.rest_factor.solve(load)
            if not is_linear(self, q):
                found = self.points.full_steps(load, q, options.tolerance, self.extent)
                if found is not None:
                    return found
        return solve_equilibrium(self, load, options=options)
