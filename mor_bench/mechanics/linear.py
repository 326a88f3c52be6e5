"""Interfaces of solvers for symmetric positive definite matrices, and sparse direct ones.

A failed Cholesky factorisation means that the equilibrium is not stable. Each direct solver
therefore reports whether the matrix was positive definite.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse import linalg as sp_linalg

from mor_bench.counting import count, is_counting
from mor_bench.mechanics.pattern import Pattern


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has an eigenvalue <= 0 (or the factorisation met a zero pivot)."""


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the solutions for one (n,) or several (n, m) right-hand sides."""
        ...


class LinearSolver(Protocol):
    """Factorises matrices of one sparsity pattern."""

    def factor(self, values: NDArray[np.float64]) -> Factor:
        """Factorise, or raise `NotPositiveDefiniteError`."""
        ...


def n_columns(rhs: NDArray[Any]) -> int:
    """Return the number of right-hand sides in (n,) or (n, m)."""
    return 1 if rhs.ndim == 1 else int(rhs.shape[1])


@dataclass(frozen=True)
class SparseFactor:
    """SuperLU's factors."""

    lu: sp_linalg.SuperLU
    solver: SparseLU

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        if is_counting():  # the first count factorises once more
            m = n_columns(rhs)
            count(back_solves=m, multiply_adds=m * self.solver.multiply_adds[1])
        return np.asarray(self.lu.solve(rhs))


class SparseLU:
    """SuperLU in symmetric mode without pivoting, ordered by minimum degree.

    The signs of U's diagonal show whether the matrix is positive definite.
    """

    def __init__(self, pattern: Pattern) -> None:
        rows, columns = pattern.rows, pattern.indices
        off = np.flatnonzero(rows != columns)
        number = np.arange(1, len(rows) + 1)
        entries = (
            np.concatenate([number, number[off]]),
            (np.concatenate([rows, columns[off]]), np.concatenate([columns, rows[off]])),
        )
        template = sp.csc_array(entries, shape=(pattern.n, pattern.n))
        template.sort_indices()
        self._template, self._gather = template, template.data - 1

    def _splu(self, entries: NDArray[np.float64]) -> sp_linalg.SuperLU:
        t = self._template
        matrix = sp.csc_matrix((entries, t.indices, t.indptr), shape=t.shape)
        return sp_linalg.splu(
            matrix,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    @cached_property
    def multiply_adds(self) -> tuple[int, int]:
        """Multiply-adds of a factorisation and of a solve.

        They assume that no entry of the factors cancels. The factorisation ignores the symmetry.
        """
        t = self._template
        counts = np.diff(t.indptr)
        columns = np.repeat(np.arange(len(counts)), counts)
        lu = self._splu(np.where(t.indices == columns, counts[columns], -1.0))
        below, right = np.diff(lu.L.tocsc().indptr) - 1, np.diff(lu.U.tocsr().indptr) - 1
        return int((below * (1 + right)).sum()), int((below + right + 1).sum())

    def factor(self, values: NDArray[np.float64]) -> SparseFactor:
        if is_counting():  # the first count factorises once more
            count(factorisations=1, multiply_adds=self.multiply_adds[0])
        try:
            lu = self._splu(values[self._gather])
        except RuntimeError as error:
            raise NotPositiveDefiniteError from error
        if not np.all(lu.U.diagonal() > 0):
            raise NotPositiveDefiniteError
        return SparseFactor(lu, self)


class Pardiso:
    """MKL's parallel sparse Cholesky, from the extra `mkl`; the symbolic phase runs once."""

    def __init__(self, pattern: Pattern) -> None:
        from pypardiso import PyPardisoSolver
        from pypardiso.pardiso_wrapper import PyPardisoError

        self._error: type[Exception] = PyPardisoError
        self._solver = PyPardisoSolver(mtype=2)
        # Without the variable, each solver searches all of Python's folders for MKL.
        os.environ.setdefault("PYPARDISO_MKL_RT", self._solver.libmkl._name)
        indices, indptr = pattern.indices.astype(np.int32), pattern.indptr.astype(np.int32)
        self._matrix = sp.csr_matrix(
            (np.ones(len(indices)), indices, indptr), shape=(pattern.n, pattern.n)
        )
        self._phase(11, np.zeros(pattern.n))

    def _phase(self, phase: int, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        # The wrapper's `factorize` repeats the symbolic phase and copies the matrix, and its
        # `solve` compares the matrix.
        self._solver.set_phase(phase)
        return np.asarray(self._solver._call_pardiso(self._matrix, np.asfortranarray(rhs)))

    def factor(self, values: NDArray[np.float64]) -> Pardiso:
        """Factorise; the previous factor is lost."""
        self._matrix.data = np.ascontiguousarray(values)
        try:
            self._phase(22, np.zeros(len(self._matrix.indptr) - 1))
        except self._error as error:
            raise NotPositiveDefiniteError from error
        # MKL reports whole millions of operations. Columns of equal length give a lower bound for
        # the number of entries.
        least = self._entries**2 // (2 * self._matrix.shape[0])
        count(
            factorisations=1,
            multiply_adds=max(500_000 * int(self._solver.get_iparm(19)), least),
        )
        return self

    @property
    def _entries(self) -> int:
        """Entries of L, as MKL reports them."""
        return int(self._solver.get_iparm(18))

    def solve(self, rhs: NDArray[np.float64]) -> NDArray[np.float64]:
        m = n_columns(rhs)
        count(back_solves=m, multiply_adds=m * 2 * self._entries)
        return self._phase(33, rhs)
