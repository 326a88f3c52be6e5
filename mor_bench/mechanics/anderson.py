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


NOISE = 1e-12
"""Squared sine of the angle to the span of other changes below which a change adds only noise."""

CHUNK = 2048
"""Entries of a vector that are read together, so that they stay in the cache."""


@njit(inline="always")
def _least_squares(gram, along):
    """Return c of least |ΔG c - g|, from ΔGᵀΔG and ΔGᵀg, by a Cholesky factor with pivoting.

    Columns are scaled to length one, since they shrink as the iteration converges.
    """
    held = len(along)
    scale, c = np.zeros(held), np.zeros(held)
    left, rest = np.zeros((held, held)), np.empty((held, held))
    for i in range(held):
        scale[i] = 1.0 / np.sqrt(gram[i, i]) if gram[i, i] > 0.0 else 0.0
    for i in range(held):
        for j in range(held):
            rest[i, j] = gram[i, j] * scale[i] * scale[j]
    order, rank, y = np.zeros(held, np.int64), 0, along * scale
    for _ in range(held):
        pivot = 0
        for i in range(held):
            if rest[i, i] > rest[pivot, pivot]:
                pivot = i
        if not rest[pivot, pivot] > NOISE:
            break
        root = np.sqrt(rest[pivot, pivot])
        order[rank] = pivot
        for i in range(held):
            left[i, rank] = rest[i, pivot] / root
        for i in range(held):
            for j in range(held):
                rest[i, j] -= left[i, rank] * left[j, rank]
        rest[pivot, :] = 0.0
        rest[:, pivot] = 0.0
        rank += 1
    for a in range(rank):
        for b in range(a):
            y[order[a]] -= left[order[a], b] * y[order[b]]
        y[order[a]] /= left[order[a], a]
    for a in range(rank - 1, -1, -1):
        c[order[a]] = y[order[a]]
        for b in range(a + 1, rank):
            c[order[a]] -= left[order[b], a] * c[order[b]]
        c[order[a]] /= left[order[a], a]
    return c * scale


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "reassoc"})
def _combine(correction, steps, changes, held, newest, gram, out):
    """Write g - (ΔQ + ΔG) c to ``out``, with c the least-squares solution of ΔG c = g.

    ΔQ and ΔG are the first ``held`` columns. Of ``gram``, ΔGᵀΔG, row and column ``newest`` are
    computed, the others are known.
    """
    n = len(correction)
    dots, along = np.zeros(held), np.zeros(held)
    for start in range(0, n, CHUNK):
        stop = min(start + CHUNK, n)
        for j in range(held):
            dot, share = 0.0, 0.0
            for k in range(start, stop):
                dot += changes[j, k] * changes[newest, k]
                share += changes[j, k] * correction[k]
            dots[j] += dot
            along[j] += share
    for j in range(held):
        gram[newest, j] = gram[j, newest] = dots[j]
    c = _least_squares(gram[:held, :held], along)
    for start in range(0, n, CHUNK):
        stop = min(start + CHUNK, n)
        for k in range(start, stop):
            out[k] = correction[k]
        for j in range(held):
            for k in range(start, stop):
                out[k] -= c[j] * (steps[j, k] + changes[j, k])


class Anderson:
    """Memory of the acceleration: the last differences of iterates and of corrections."""

    def __init__(self, n: int) -> None:
        self._steps, self._changes = np.empty((2, WINDOW, n))
        self._gram = np.zeros((WINDOW, WINDOW))
        self._held = 0
        self._count = 0
        self._last: tuple[Array, Array] | None = None

    def leap(self, keep: bool) -> None:
        """Take no difference to the next state, from which a disturbance separates the last one.

        With it, the next step would undo the disturbance, whatever its modes are. The earlier
        differences are forgotten as well, unless ``keep`` is true.
        """
        self._last = None
        if not keep:
            self._count = self._held = 0

    def advance(self, q: Array, correction: Array) -> Array:
        """Return the step from q, given the correction P⁻¹r of the residual r there."""
        slot = self._count % WINDOW
        if self._last is not None:
            q_before, correction_before = self._last
            np.subtract(q, q_before, out=self._steps[slot])
            np.subtract(correction, correction_before, out=self._changes[slot])
            self._count += 1
            self._held = min(self._count, WINDOW)
        self._last = q, correction
        held = self._held
        count(multiply_adds=len(q) * (4 * held + (held > 0)))
        step = np.empty_like(q)
        _combine(correction, self._steps, self._changes, held, slot, self._gram, step)
        return step
