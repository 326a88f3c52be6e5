"""Discrete empirical interpolation (DEIM): recover a vector from a few of its entries."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from mor_bench.errors import InvalidInputError

Selection = Literal["greedy", "pivoted-qr"]


def interpolation_rows(basis: NDArray[np.float64], selection: Selection) -> NDArray[np.int64]:
    """Choose as many rows of a basis U as it has columns, such that PᵀU is well conditioned.

    greedy
        Take each next row where interpolation of the next column has its largest error.
        Chaturantabut & Sorensen, Nonlinear model reduction via discrete empirical interpolation,
        SIAM J. Sci. Comput. 32 (2010), algorithm 1.
    pivoted-qr
        Take the pivots of a QR factorisation of Uᵀ. Drmač & Gugercin, A new selection operator for
        the discrete empirical interpolation method, SIAM J. Sci. Comput. 38 (2016), algorithm 1
        (Q-DEIM).

    Parameters
    ----------
    basis : (n, k) float64
        Basis U of full rank.
    selection : {"greedy", "pivoted-qr"}

    Returns
    -------
    (k,) int64
        Numbers of the chosen rows, in the order of choice.
    """
    n, k = basis.shape
    if k > n:
        raise InvalidInputError(f"a basis of {n} rows cannot have {k} independent columns.")
    if selection == "pivoted-qr":
        pivots = qr(basis.T, mode="r", pivoting=True, check_finite=False)[1]
        return np.asarray(pivots[:k], dtype=np.int64)
    rows = [int(np.abs(basis[:, 0]).argmax())]
    for column in range(1, k):
        coefficients = np.linalg.solve(basis[rows, :column], basis[rows, column])
        error = np.abs(basis[:, column] - basis[:, :column] @ coefficients)
        rows.append(int(error.argmax()))
    return np.array(rows, dtype=np.int64)
