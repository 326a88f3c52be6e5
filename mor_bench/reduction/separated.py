"""Separated representations from samples: sums of products of functions of few coordinates.

    y(s, d, m) ≈ Σ_k X_k S_k(s) D_k(d) M_k(m),   S_k = Σ_j a_kj φ_j(s), and so on.

Alternating least squares find one term after the other, on the residual of the earlier ones. After
each term, all vectors X_k are fitted again together. This is the progressive proper generalised
decomposition with update (Nouy, CMAME 199, 2010, section 3). It is fitted to samples as in the
sparse, non-intrusive one (Ibáñez et al., Complexity 2018, section 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]
Family = Sequence[Array]

ITERATIONS = 8
"""Largest number of alternations for a term."""

STAGNANT = 1e-2
"""Relative change of a term's sampled function below which its alternation ends."""

RANK = 1e-9
"""Least singular value of a factor's functions, relative to the largest."""

EXHAUSTED = 1e-12
"""Relative residual below which nothing is left to separate."""


@dataclass(frozen=True)
class Term:
    """A product of one function per factor of a family.

    Attributes
    ----------
    family : int
    coefficients : tuple of (n_functions,) float64
        Coefficients of each factor's functions.
    """

    family: int
    coefficients: tuple[Array, ...]


@dataclass(frozen=True)
class Separation:
    """Terms, and the vectors that they multiply.

    Attributes
    ----------
    terms : tuple of Term
    vectors : (n_terms, n_outputs) float64
    """

    terms: tuple[Term, ...]
    vectors: Array


def _regularised(matrix: Array, ridge: float) -> Array:
    """Return the matrix plus the ridge times its mean diagonal entry; it is never singular."""
    mean = max(float(np.trace(matrix)) / len(matrix), 1e-300)
    return np.asarray(matrix + (ridge + 1e-14) * mean * np.eye(len(matrix)))


def _solve(matrix: Array, rhs: Array, ridge: float) -> Array:
    return np.asarray(cho_solve(cho_factor(_regularised(matrix, ridge)), rhs))


def _orthonormal(values: Array) -> tuple[Array, Array]:
    """Return orthonormal combinations (n, r) of sampled functions, and their coefficients.

    The coefficients are (n_functions, r).
    """
    scale = np.sqrt((values**2).mean(axis=0))
    scale[scale == 0] = 1.0
    left, s, vt = np.linalg.svd(values / scale, full_matrices=False)
    kept = s > RANK * s[0]
    return left[:, kept], vt[kept].T / s[kept] / scale[:, None]


def _product(factors: Family, coefficients: Sequence[Array], without: int = -1) -> Array:
    """Return the product over all factors, or over all but one, at the samples."""
    sampled = [
        f @ c for j, (f, c) in enumerate(zip(factors, coefficients, strict=True)) if j != without
    ]
    return np.asarray(np.prod(sampled, axis=0))


def _rank_one(residual: Array, factors: Family, ridge: float) -> tuple[list[Array], Array] | None:
    """Fit one term; return its coefficients and its values at the samples, of unit norm.

    The iteration begins with the residual's direction of largest variance, and the function of the
    last factors that fits it best. Returns None if the family has nothing to add.
    """
    values, directions = np.linalg.eigh(residual.T @ residual)
    x = directions[:, -1] * np.sqrt(max(values[-1], 0.0))
    coefficients = [np.eye(1, f.shape[1])[0] for f in factors]
    pairs = np.einsum("n,ni,nj->ij", residual @ x, factors[-2], factors[-1])
    u, _, vt = np.linalg.svd(pairs)
    # The first factor begins as the function of its span that is nearest to a constant.
    constant = factors[0].T @ np.ones(len(residual))
    if constant.any():
        coefficients[0] = constant
    coefficients[-2], coefficients[-1] = u[:, 0], vt[0]
    z = _product(factors, coefficients)
    for _ in range(ITERATIONS):
        before = z / (np.linalg.norm(z) or 1.0)
        for j, f in enumerate(factors):
            weighted = f * _product(factors, coefficients, without=j)[:, None]
            found = _solve(weighted.T @ weighted, weighted.T @ (residual @ x), ridge)
            size = float(np.linalg.norm(found))
            if not 0.0 < size < np.inf:
                return None
            coefficients[j] = found / size
        z = _product(factors, coefficients)
        size = float(np.linalg.norm(z))
        if not size > 0.0:
            return None
        x = residual.T @ z / size**2
        if not x.any():
            return None
        if np.linalg.norm(z / size - before) <= STAGNANT:
            break
    coefficients[0] = coefficients[0] / size
    return coefficients, z / size


def separate(targets: Array, families: Sequence[Family], n_terms: int, ridge: float) -> Separation:
    """Fit a separated representation to samples.

    Parameters
    ----------
    targets : (n_samples, n_outputs) float64
    families : sequence of sequences of (n_samples, n_functions) float64
        For each family of terms, the functions of its factors, two or more, at the samples. Each
        term comes from the family that leaves the smallest residual.
    n_terms : int
        Largest number of terms; fewer if the residual vanishes.
    ridge : float
        Tikhonov weight of every least-squares problem, relative to its matrix' mean diagonal.
    """
    bases = [[_orthonormal(values) for values in family] for family in families]
    factors = [[basis for basis, _ in family] for family in bases]
    norm = float(np.linalg.norm(targets))
    terms: list[Term] = []
    sampled = np.zeros((len(targets), 0))
    vectors, residual = np.zeros((0, targets.shape[1])), targets
    while len(terms) < n_terms and np.linalg.norm(residual) > EXHAUSTED * norm:
        found = [
            (number, term)
            for number, family in enumerate(factors)
            if (term := _rank_one(residual, family, ridge))
        ]
        if not found:
            break
        number, (coefficients, z) = max(
            found, key=lambda item: float(np.linalg.norm(residual.T @ item[1][1]))
        )
        terms.append(
            Term(
                number,
                tuple(back @ c for (_, back), c in zip(bases[number], coefficients, strict=True)),
            )
        )
        sampled = np.hstack([sampled, z[:, None]])
        vectors = _solve(sampled.T @ sampled, sampled.T @ targets, ridge)
        residual = targets - sampled @ vectors
    return Separation(tuple(terms), vectors)
