"""Several multigrid cycles as one approximate inverse, by Chebyshev's iteration.

The less compressible a material, the less a sweep over nodes reduces errors that keep the volume.
The smallest eigenvalue of (cycle) K is about 0.3 at a Poisson's ratio of 0.4, 0.03 at 0.49 and
0.005 at 0.499; the largest is one. Weights for this range make the best of several cycles. The
approximate inverse stays linear, symmetric and positive definite, also if the smallest eigenvalue
was estimated too high.

Saad, "Iterative Methods for Sparse Linear Systems", SIAM 2003, algorithm 12.1, and section 6.7.3
for the estimate by conjugate gradients.
"""

from __future__ import annotations

import numpy as np

from mor_bench.mechanics.cycles import Cycle, Floats

MAX_CYCLES_AT_ONCE = 50
LANCZOS_STEPS = 40
LANCZOS_TOLERANCE = 1e-4
"""Relative residual of conjugate gradients that ends the estimate of the smallest eigenvalue."""
RANGE = (1e-6, 0.99)
"""Limits of the smallest eigenvalue; single precision resolves none below."""


def lowest_eigenvalue(cycle: Cycle) -> float:
    """Return an estimate, from above, of the smallest eigenvalue of (cycle) K; at most 0.99.

    Conjugate gradients with a random right-hand side give the tridiagonal matrix of Lanczos.
    """
    dtype = cycle.level.lower[3].dtype
    r = np.random.default_rng(0).normal(size=cycle.n).astype(dtype)
    p, Kp, rz = np.zeros_like(r), np.zeros_like(r), np.inf
    target = LANCZOS_TOLERANCE * float(np.linalg.norm(r))
    lengths: list[float] = []
    shares: list[float] = []
    while len(lengths) < LANCZOS_STEPS and float(np.linalg.norm(r)) > target:
        z, Kz = cycle.with_product(r)
        rz, before = float(r @ z), rz
        share = rz / before
        p, Kp = z + share * p, Kz + share * Kp
        curvature = float(p @ Kp)
        # The matrix of an ill-conditioned body may not be definite in single precision.
        if not (0.0 < rz < np.inf and 0.0 < curvature < np.inf):
            break
        shares.append(share)
        lengths.append(rz / curvature)
        r = r - lengths[-1] * Kp
    if not lengths:
        return RANGE[1]
    length, share_of = np.array(lengths), np.array(shares)[1:]
    diagonal, beside = 1.0 / length, np.sqrt(share_of) / length[:-1]
    diagonal[1:] += share_of / length[:-1]
    matrix = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    return float(np.clip(np.linalg.eigvalsh(matrix)[0], *RANGE))


def cycles_for(lowest: float, reduction: float) -> int:
    """Return how many cycles reduce all errors to a fraction, if eigenvalues are at least lowest.

    At most `MAX_CYCLES_AT_ONCE`.
    """
    per_cycle = np.arccosh((1.0 + lowest) / (1.0 - lowest))
    return min(int(np.ceil(np.arccosh(1.0 / reduction) / per_cycle)), MAX_CYCLES_AT_ONCE)


class Chebyshev:
    """An approximate inverse by several cycles; eigenvalues of its product with K are at most one.

    Parameters
    ----------
    cycle : Cycle
    lowest : float
        The smallest eigenvalue of (cycle) K, in (0, 1); the largest is one.
    n_cycles : int
    """

    def __init__(self, cycle: Cycle, lowest: float, n_cycles: int) -> None:
        self._cycle, self.n_cycles = cycle, n_cycles
        ratio = (1.0 + lowest) / (1.0 - lowest)
        weight = 1.0 / ratio
        self._first = 2.0 / (1.0 + lowest)
        self._weights: list[tuple[float, float]] = []
        for _ in range(n_cycles - 1):
            before, weight = weight, 1.0 / (2.0 * ratio - weight)
            self._weights.append((weight * before, 4.0 * weight / (1.0 - lowest)))
        # The eigenvalues of the unscaled product are between 1 - left and 1 + left.
        left = float(1.0 / np.cosh(n_cycles * np.arccosh(ratio)))
        self._scale = 1.0 / (1.0 + left)

    @property
    def multiply_adds(self) -> int:
        more, n = self.n_cycles - 1, self._cycle.n
        per_product = self._cycle.level.product_multiply_adds + 4 * n
        return self.n_cycles * self._cycle.multiply_adds + more * per_product + n

    def __call__(self, b: Floats) -> Floats:
        """Return an approximate solution x (n,) of K x = b."""
        if not self._weights:
            return self._cycle(b)
        step, product = self._cycle.with_product(b)
        step, product = self._first * step, self._first * product
        x, r = step.copy(), b
        for kept, added in self._weights[:-1]:
            r = r - product
            found, of_found = self._cycle.with_product(r)
            step, product = kept * step + added * found, kept * product + added * of_found
            x += step
        kept, added = self._weights[-1]
        x += kept * step + added * self._cycle(r - product)
        x *= self._scale
        return x
