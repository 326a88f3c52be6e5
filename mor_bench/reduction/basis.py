"""Reduced bases from snapshots: proper orthogonal decomposition by singular value decomposition.

The Gram matrix is not used. Its eigenvalues are squared singular values, so a basis from it loses
orthonormality.

Large matrices go through the randomised range finder of Halko, Martinsson and Tropp: Finding
structure with randomness, SIAM Review 53 (2011), algorithm 4.4, which orthonormalises after every
product.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, lapack, qr, solve_triangular, svd

from mor_bench.digests import digest_of_arrays
from mor_bench.errors import InvalidInputError, RankDeficientWarning

RANDOMISED_FROM = 2000
"""Least length of a snapshot matrix' shorter side for a randomised decomposition."""
RANDOMISED_SHARE = 10
"""Least ratio of that side to the wanted modes for a randomised decomposition."""
OVERSAMPLING = 20
"""Least number of directions beyond the wanted modes; half as many as the modes if that is more."""
POWER_ITERATIONS = 2
"""Subspace iterations; each brings the modes nearer to the exact ones."""
FIRST_DIRECTIONS = 64
"""Initial number of directions if the number of modes is not given; it doubles as needed."""
LEAST_RANDOMISED_TOLERANCE = 1e-6
"""Least energy tolerance of a randomised decomposition; round-off hides smaller shares."""
SEED = 0
EPS = float(np.finfo(np.float64).eps)
SOLVED = 1e-8
"""Relative error of displacements that the full-order model solved for, by its default."""
DETERMINED = 10
"""Least singular value of a mode that is more than the error of the solver, relative to that error.

Below, that error turns the mode by more than a tenth. In a nearly incompressible body the cubature
then matches mainly false changes of volume.
"""


@dataclass(frozen=True)
class Basis:
    """A basis, orthonormal in the chosen inner product, and its singular values.

    Attributes
    ----------
    modes : (n, r) float64
        Φ, in C order.
    singular_values : (k,) float64
        Largest first: all min(n_samples, n), or the r leading ones of a randomised decomposition.
    """

    modes: NDArray[np.float64]
    singular_values: NDArray[np.float64]


def pod(
    snapshots: NDArray[np.float64],
    n_modes: int | None = None,
    *,
    energy_tolerance: float | None = None,
    inner_product: Any = None,
) -> Basis:
    """Return the leading right singular vectors of a snapshot matrix, without removing the mean.

    With the mean removed, zero load would cause a displacement. Large matrices with few wanted
    modes use randomised subspace iteration, with the same result in every run. Other
    decompositions are exact.

    Parameters
    ----------
    snapshots : (n_samples, n) float64
    n_modes : int, optional
        Capped at the rank of the snapshots with a warning; the rank by default.
    energy_tolerance : float, optional
        Take the fewest modes n with √(Σ_{j>n} sⱼ² / Σ sⱼ²) at most this, where s are the singular
        values. It excludes `n_modes`.
    inner_product : (n, n) sparse array, optional
        Symmetric positive definite K: Φᵀ K Φ = I, and Φ is the best basis in the norm √(uᵀKu).
        Euclidean by default.

    Raises
    ------
    InvalidInputError
        If the snapshots are no matrix of finite real numbers, or all zero; if both `n_modes` and
        `energy_tolerance` are given, or one is out of range; if K has another shape or is not
        positive definite.
    """
    _check_wanted(n_modes, energy_tolerance)
    kind = getattr(snapshots, "dtype", np.dtype(int))
    precision = float(np.finfo(kind).eps) if kind.kind == "f" else EPS
    snapshots = _checked(snapshots, inner_product)
    if not snapshots.any():
        raise InvalidInputError("the snapshots are all zero: they span no basis.")
    found, key = None, ""
    if _remembered is not None:
        key = _remembered.key(snapshots, inner_product)
        found = _remembered.of(key, n_modes)
    if found is None:
        found, reach = _decomposed(snapshots, n_modes, energy_tolerance, inner_product)
        if _remembered is not None:
            _remembered.keep(key, found, reach)
    found.precision = max(precision, EPS)
    return found.truncated(n_modes, energy_tolerance)


def accurate_modes(
    displacements: NDArray[np.float64], n_modes: int, error: float = SOLVED
) -> NDArray[np.float64]:
    """Return the leading modes (n, r) of solved displacements, without those of the solver's error.

    A cubature would be trained on that error, and leave such modes almost without stiffness.

    Parameters
    ----------
    displacements : (n_samples, n) float64
        Displacements, m.
    n_modes : int
        Capped with a warning.
    error : float
        Largest error of the displacements, relative to their size.
    """
    basis = pod(displacements, n_modes)
    sizes = basis.singular_values[: basis.modes.shape[1]]
    least = DETERMINED * error
    kept = int((sizes > least * sizes[0]).sum())
    if kept < len(sizes):
        warnings.warn(
            f"{n_modes} modes were requested, but the samples determine {kept}: the others hold "
            f"less than {least:g} of the displacements, too near to the error of the solver. "
            f"{kept} modes are used.",
            RankDeficientWarning,
            stacklevel=2,
        )
    return np.ascontiguousarray(basis.modes[:, :kept])


def _decomposed(
    snapshots: NDArray[np.float64],
    n_modes: int | None,
    energy_tolerance: float | None,
    inner_product: Any,
) -> tuple[_Decomposition, int | None]:
    """Return a decomposition and its number of usable modes; None stands for all."""
    small = min(snapshots.shape)
    most = small // RANDOMISED_SHARE if small >= RANDOMISED_FROM else 0
    if n_modes is not None and n_modes <= most:
        # Later calls may want more modes of a remembered decomposition.
        reach = n_modes if _remembered is None else min(max(2 * n_modes, FIRST_DIRECTIONS), most)
        found = _randomised(snapshots, reach, None, inner_product, None)
        assert found is not None
        return found, reach
    tolerable = energy_tolerance is not None and energy_tolerance >= LEAST_RANDOMISED_TOLERANCE
    if most > FIRST_DIRECTIONS and tolerable:
        found = _randomised(snapshots, None, energy_tolerance, inner_product, most)
        if found is not None:
            return found, 0
    return _exact(snapshots, inner_product), None


def _check_wanted(n_modes: int | None, energy_tolerance: float | None) -> None:
    if n_modes is not None and energy_tolerance is not None:
        raise InvalidInputError("give `n_modes` or `energy_tolerance`, not both.")
    if n_modes is not None and n_modes < 1:
        raise InvalidInputError(f"`n_modes` must be an integer >= 1; got {n_modes}.")
    if energy_tolerance is not None and not 0 <= energy_tolerance < 1:
        raise InvalidInputError(f"`energy_tolerance` must be in [0, 1); got {energy_tolerance}.")


def _checked(rows: NDArray[np.float64], inner_product: Any) -> NDArray[np.float64]:
    """Return snapshots as finite float64 that fit the inner product."""
    real = getattr(rows, "ndim", None) == 2 and rows.dtype.kind in "fiu"
    if not real or rows.shape[1] == 0:
        came = type(rows).__name__
        if isinstance(rows, np.ndarray):
            came = f"shape {rows.shape} and dtype {rows.dtype}"
        raise InvalidInputError(
            f"the snapshots must be real numbers of shape (n_samples, n); got {came}."
        )
    n = rows.shape[1]
    if inner_product is not None and inner_product.shape != (n, n):
        raise InvalidInputError(
            f"`inner_product` must have shape ({n}, {n}); got {inner_product.shape}."
        )
    if not np.isfinite(rows).all():
        raise InvalidInputError("the snapshots hold NaN or infinity.")
    return rows.astype(np.float64, copy=False)


class _Decomposition:
    """The SVD of a matrix (n_samples, n), from a C (n, k) whose columns span its singular vectors.

    C = Q R by Householder reflections. With an inner product, QᵀKQ = L Lᵀ, and the SVD of Lᵀ R
    replaces that of R: Φ = Q L⁻ᵀ U has Φᵀ K Φ = I, without a factor of K. L is at most as
    ill-conditioned as K, which costs digits of orthonormality. A second Cholesky factorisation, of
    the r wanted modes, restores them.

    Parameters
    ----------
    tall : (n, k) float64, k <= n
    inner_product : (n, n) sparse array or None
    n_samples : int
    energy : float, optional
        Sum of squares of all singular values, if C has only some of them.
    """

    precision = EPS
    """Round-off of the snapshots' dtype; relatively smaller singular values do not count."""

    def __init__(
        self,
        tall: NDArray[np.float64],
        inner_product: Any,
        n_samples: int,
        energy: float | None = None,
    ) -> None:
        (self._reflections, self._scales), r = qr(tall, mode="raw", check_finite=False)
        n, k = tall.shape
        self._inner_product, self._energy = inner_product, energy
        self.n_samples, self.n = n_samples, n
        if inner_product is None:
            self._left, self.values, _ = svd(
                np.triu(r[:k]), full_matrices=False, check_finite=False
            )
            return
        q = self._expanded(np.eye(k))
        try:
            upper = cholesky(_symmetric(q.T @ (inner_product @ q)), check_finite=False)
        except np.linalg.LinAlgError:
            raise InvalidInputError("`inner_product` is not positive definite.") from None
        left, self.values, _ = svd(upper @ np.triu(r[:k]), full_matrices=False, check_finite=False)
        self._left = solve_triangular(upper, left, check_finite=False)

    def _expanded(self, coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Q times a matrix (k, r), without forming Q."""
        padded = np.zeros((self.n, coefficients.shape[1]), order="F")
        padded[: len(coefficients)] = coefficients
        size = int(lapack.dormqr("L", "N", self._reflections, self._scales, padded, -1)[1][0])
        factors = self._reflections, self._scales
        return np.asarray(lapack.dormqr("L", "N", *factors, padded, size, overwrite_c=1)[0])

    def modes(self, r: int) -> NDArray[np.float64]:
        """Return the r leading modes."""
        found = self._expanded(self._left[:, :r])
        if self._inner_product is not None:
            gram = _symmetric(found.T @ (self._inner_product @ found))
            upper = cholesky(gram, check_finite=False)
            found = solve_triangular(upper, found.T, trans="T", check_finite=False).T
        return np.ascontiguousarray(found)

    @cached_property
    def rank(self) -> int:
        """Number of singular values above round-off."""
        least = self.values[0] * max(self.n_samples, self.n) * self.precision
        return int((self.values > least).sum())

    def n_modes_of(self, energy_tolerance: float) -> int:
        """Return the fewest modes that meet the tolerance; one more than exist if none do."""
        squares, rest = (self.values / self.values[0]) ** 2, 0.0
        if self._energy is not None:
            rest = max(self._energy / float(self.values[0]) ** 2 - float(squares.sum()), 0.0)
        tails = np.append(np.cumsum(squares[::-1])[::-1], 0.0) + rest
        enough = np.flatnonzero(tails <= energy_tolerance**2 * tails[0])
        return max(1, int(enough[0])) if len(enough) else len(squares) + 1

    def truncated(self, n_modes: int | None, energy_tolerance: float | None) -> Basis:
        """Return the wanted basis, cut to the rank."""
        wanted = self.n_modes_of(energy_tolerance) if energy_tolerance is not None else n_modes
        if wanted is not None and wanted > self.rank:
            warnings.warn(
                f"{wanted} modes were requested, but the {self.n_samples} samples have "
                f"rank {self.rank}: {self.rank} modes are used.",
                RankDeficientWarning,
                stacklevel=3,
            )
        kept = self.rank if wanted is None else min(wanted, self.rank)
        return Basis(self.modes(kept), self.values if self._energy is None else self.values[:kept])


def _symmetric(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.5 * (matrix + matrix.T)


def _exact(snapshots: NDArray[np.float64], inner_product: Any) -> _Decomposition:
    n_samples, n = snapshots.shape
    tall: Any = snapshots.T
    if n_samples > n:  # the triangular factor has the same right singular vectors
        tall = qr(snapshots, mode="r", check_finite=False)[0][:n].T
    return _Decomposition(tall, inner_product, n_samples)


def _randomised(
    snapshots: NDArray[np.float64],
    n_modes: int | None,
    energy_tolerance: float | None,
    inner_product: Any,
    most: int | None,
) -> _Decomposition | None:
    """Iterate on subspaces: Y = A K V, Q = orth(Y), V = the modes of QᵀA, for snapshots A.

    Returns None if that needs more than ``most`` directions.
    """
    n_samples, n = snapshots.shape
    generator = np.random.default_rng(SEED)
    directions, more = np.zeros((n, 0)), POWER_ITERATIONS
    n_directions = FIRST_DIRECTIONS
    if n_modes is not None:
        n_directions = n_modes + max(OVERSAMPLING, n_modes // 2)
    weighted = snapshots if inner_product is None else (inner_product @ snapshots.T).T
    energy = float(np.vdot(snapshots, weighted))
    while True:
        drawn = generator.normal(size=(n, max(min(n_directions, n) - directions.shape[1], 0)))
        directions = np.hstack([directions, drawn])
        images = snapshots @ (directions if inner_product is None else inner_product @ directions)
        q = qr(images, mode="economic", overwrite_a=True, check_finite=False)[0]
        n_directions = q.shape[1]
        found = _Decomposition(snapshots.T @ q, inner_product, n_samples, energy)
        if (
            energy_tolerance is not None
            and n_directions < min(n_samples, n)
            and found.n_modes_of(energy_tolerance) > n_directions - OVERSAMPLING
        ):
            directions, n_directions = found.modes(found.rank), 2 * n_directions
            if most is not None and n_directions > most:
                return None
            continue
        if more == 0:
            return found
        more -= 1
        directions = found.modes(found.rank)
        n_directions = found.rank


class _Remembered:
    """Decompositions by the digest of their matrices, each with its number of usable modes."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[_Decomposition, int | None]] = {}

    @staticmethod
    def key(snapshots: NDArray[np.float64], inner_product: Any) -> str:
        arrays = {"snapshots": snapshots}
        if inner_product is not None:
            arrays |= {name: getattr(inner_product, name) for name in ("data", "indices", "indptr")}
        return digest_of_arrays(arrays)

    def of(self, key: str, n_modes: int | None) -> _Decomposition | None:
        found, reach = self._known.get(key, (None, None))
        return found if reach is None or (n_modes is not None and n_modes <= reach) else None

    def keep(self, key: str, found: _Decomposition, reach: int | None) -> None:
        self._known[key] = found, reach


_remembered: _Remembered | None = None


@contextmanager
def remembering() -> Iterator[None]:
    """Let `pod` decompose equal snapshots only once inside the block, for any number of modes."""
    global _remembered
    around, _remembered = _remembered, _Remembered()
    try:
        yield
    finally:
        _remembered = around
