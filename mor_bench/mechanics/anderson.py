"""Anderson acceleration of the iteration q ← q + P⁻¹ (f - f_int(q)), which needs no tangent.

Walker & Ni, "Anderson acceleration for fixed-point iterations", SIAM J. Numer. Anal. 49 (2011).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mor_bench.counting import count

Array = NDArray[np.float64]

WINDOW = 5
"""Number of differences that are kept."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "reassoc"})
def _combine(correction, steps, changes, held, basis, out):
    """Write g - (ΔQ + ΔG) c to ``out``, with c the least-squares solution of ΔG c = g.

    Modified Gram-Schmidt finds c.
    """
    n = len(correction)
    triangle, c = np.zeros((held, held)), np.zeros(held)
    for j in range(held):
        before = 0.0
        for k in range(n):
            basis[j, k] = changes[j, k]
            before += changes[j, k] * changes[j, k]
        for i in range(j):
            dot = 0.0
            for k in range(n):
                dot += basis[i, k] * basis[j, k]
            triangle[i, j] = dot
            for k in range(n):
                basis[j, k] -= dot * basis[i, k]
        after = 0.0
        for k in range(n):
            after += basis[j, k] * basis[j, k]
        triangle[j, j] = np.sqrt(after)
        # A change within the span of the others adds nothing but noise.
        inverse = 1.0 / np.sqrt(after) if after > 1e-16 * before else 0.0
        dot = 0.0
        for k in range(n):
            basis[j, k] *= inverse
            dot += basis[j, k] * correction[k]
        c[j] = dot
    for j in range(held - 1, -1, -1):
        for i in range(j + 1, held):
            c[j] -= triangle[j, i] * c[i]
        c[j] = c[j] / triangle[j, j] if triangle[j, j] > 0.0 else 0.0
    for k in range(n):
        s = correction[k]
        for j in range(held):
            s -= c[j] * (steps[j, k] + changes[j, k])
        out[k] = s


class Anderson:
    """Memory of the acceleration: the last differences of iterates, corrections and residuals."""

    def __init__(self, n: int) -> None:
        self._steps, self._changes, self._basis = np.empty((3, WINDOW, n))
        self._held = 0
        self._count = 0
        self._last: tuple[Array, Array, Array] | None = None
        self._curvatures = np.ones(WINDOW)

    @property
    def convex(self) -> bool:
        """True if the force rose along every kept step: no negative curvature was seen."""
        return bool((self._curvatures > 0).all())

    def advance(self, q: Array, correction: Array, residual: Array) -> Array:
        """Return the step from q, given the correction P⁻¹r and the residual r there."""
        if self._last is not None:
            slot = self._count % WINDOW
            q_before, correction_before, residual_before = self._last
            np.subtract(q, q_before, out=self._steps[slot])
            np.subtract(correction, correction_before, out=self._changes[slot])
            self._curvatures[slot] = float(self._steps[slot] @ (residual_before - residual))
            self._count += 1
            self._held = min(self._count, WINDOW)
        self._last = q, correction, residual
        count(multiply_adds=len(q) * (self._held * (self._held + 4) + (self._held > 0)))
        step = np.empty_like(q)
        _combine(correction, self._steps, self._changes, self._held, self._basis, step)
        return step
