"""Quadrature of triangles, and shape functions of a triangle with six nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DEGREE_2 = np.array([[1.0, 1.0], [4.0, 1.0], [1.0, 4.0]]) / 6.0
"""Points (3, 2) of a rule with equal weights that is exact for quadratic polynomials."""

_A, _B = 0.445948490915964886, 0.091576213509770743
DEGREE_4 = np.array(
    [[c[i], c[j]] for a in (_A, _B) for c in [[a, 1 - 2 * a]] for i, j in ((0, 0), (0, 1), (1, 0))]
)
"""Points (6, 2) of a rule that is exact for polynomials of degree 4 (Dunavant 1985)."""

DEGREE_4_WEIGHTS = np.repeat([0.223381589678011466, 0.109951743655321868], 3) / 2.0
"""Weights (6,) of `DEGREE_4`; their sum is the triangle's area, 1/2."""


def quadratic_triangle(
    at: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return shape functions (n, 6) at points (n, 2), and derivatives (n, 6, 2).

    The corners are at (0, 0), (1, 0) and (0, 1); then come the middles of the edges 01, 12 and 20.
    """
    r = np.column_stack([1.0 - at.sum(axis=1), at])
    slopes = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    a, b = r, np.roll(r, -1, axis=1)
    middles = a[:, :, None] * np.roll(slopes, -1, axis=0) + b[:, :, None] * slopes
    values = np.hstack([r * (2.0 * r - 1.0), 4.0 * a * b])
    return values, np.concatenate([(4.0 * r - 1.0)[:, :, None] * slopes, 4.0 * middles], axis=1)
