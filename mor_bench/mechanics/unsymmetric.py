"""Unsymmetric tangents of loads without a potential: a direct solver, and a test of stability."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse import linalg as sp_linalg

from mor_bench.counting import count, is_counting
from mor_bench.mechanics.linear import NotPositiveDefiniteError, n_columns

Array = NDArray[np.float64]

LU_UP_TO = 20_000
"""Largest number of unknowns of a model that factorises unsymmetric tangents."""
SYMMETRIC = 1e-12
"""Largest entry of a skew part, relative to that of the symmetric part, that is round-off."""
EIGENVALUES = 6
"""Number of eigenvalues that decide on stability."""
DENSE_UP_TO = 30
"""Largest number of unknowns for which a dense solver finds all eigenvalues."""
EIGENVALUE_TOLERANCE = 1e-6
REAL = 1e-2
"""Imaginary part of an eigenvalue, relative to its modulus, up to which it counts as real."""


class GeneralFactor:
    """SuperLU's factors of a matrix with a symmetric pattern, with pivoting.

    Raises
    ------
    NotPositiveDefiniteError
        If the matrix is singular.
    """

    def __init__(self, matrix: sp.csr_array) -> None:
        try:
            self._lu = sp_linalg.splu(
                sp.csc_matrix(matrix),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.01,  # pivoting by size fills the factors
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise NotPositiveDefiniteError from error
        if is_counting():
            below = np.diff(self._lu.L.tocsc().indptr) - 1
            right = np.diff(self._lu.U.tocsr().indptr) - 1
            count(factorisations=1, multiply_adds=int((below * (1 + right)).sum()))
            self._per_solve = int((below + right + 1).sum())

    def solve(self, rhs: Array) -> Array:
        """Return the solutions for one (n,) or several (n, m) right-hand sides."""
        if is_counting():
            m = n_columns(rhs)
            count(back_solves=m, multiply_adds=m * self._per_solve)
        return np.asarray(self._lu.solve(rhs))


def whole_matrix(symmetric: sp.csr_array, skew: sp.csr_array) -> sp.csr_array | None:
    """Return the sum of both parts of a matrix; None if the skew part is round-off."""
    if abs(skew).max() <= SYMMETRIC * abs(symmetric).max():
        return None
    return sp.csr_array(symmetric + skew)


def is_stable(tangent: sp.csr_array, rest: sp.csr_array) -> bool:
    """Return whether no real μ <= 0 of K x = μ K₀ x was found, with the stiffness at rest K₀.

    Such a μ means divergence, the instability that statics can show. Flutter, a pair of complex μ,
    depends on inertia and damping, so it does not count (Bolotin, Nonconservative Problems of the
    Theory of Elastic Stability, 1963).

    The Cayley transform θ = (μ - 1) / (μ + 1) maps exactly the μ with a real part > 0 into the unit
    circle. Arnoldi's method finds the θ of largest modulus (Meerbergen, Spence and Roose, BIT 34,
    1994). If all of them are outside, there may be more, and the state counts as unstable. So it
    does if Arnoldi's method does not converge.
    """
    n = rest.shape[0]
    if n <= DENSE_UP_TO:
        count(multiply_adds=30 * n**3)
        return not _diverges(scipy.linalg.eigvals(tangent.toarray(), rest.toarray())).any()
    factor = GeneralFactor(sp.csr_array(tangent + rest))

    def transformed(x: Array) -> Array:
        count(multiply_adds=rest.nnz)
        return x - 2.0 * factor.solve(rest @ x)

    try:
        theta = sp_linalg.eigs(
            sp_linalg.LinearOperator((n, n), matvec=transformed, dtype=np.float64),
            EIGENVALUES,
            which="LM",
            v0=np.random.default_rng(0).normal(size=n),
            tol=EIGENVALUE_TOLERANCE,
            return_eigenvectors=False,
        )
    except sp_linalg.ArpackNoConvergence:
        return False
    mu = (1.0 + theta) / (1.0 - theta)
    return not (_diverges(mu).any() or (mu.real <= 0.0).all())


def _diverges(mu: NDArray[np.complexfloating]) -> NDArray[np.bool_]:
    """Return which eigenvalues are real and not positive."""
    return np.asarray((mu.real <= 0.0) & (np.abs(mu.imag) <= REAL * np.abs(mu)))
