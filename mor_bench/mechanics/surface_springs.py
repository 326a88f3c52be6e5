"""Springs on the surface, as a part of the internal force."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.pattern import Pattern

Array = NDArray[np.float64]


class SurfaceSprings:
    """Springs over the rows of a pattern.

    The nodes of a spring share a cell, so that the pattern has all entries if it has all cells.

    Parameters
    ----------
    springs : (n_dofs, n_dofs) sparse float64
        Their stiffness, N/m.
    dofs : (n_dofs,) int64
        Row of each dof in the vectors; ``pattern.n`` at supports.
    pattern : Pattern
    """

    def __init__(self, springs: sp.csr_array, dofs: NDArray[np.int64], pattern: Pattern) -> None:
        found = springs.tocoo()
        rows, columns = dofs[found.row], dofs[found.col]
        free = (rows < pattern.n) & (columns < pattern.n)
        rows, columns, entries = rows[free], columns[free], found.data[free]
        self._matrix = sp.csr_array((entries, (rows, columns)), shape=(pattern.n, pattern.n))
        upper = rows <= columns
        keys = pattern.rows * pattern.n + pattern.indices
        self._slots = np.searchsorted(keys, rows[upper] * pattern.n + columns[upper])
        self._entries = entries[upper]

    def add(self, u: Array, force: Array, values: Array) -> float:
        """Add to the force and, where ``values`` is not empty, to the tangent; return the energy.

        Displacements ``u`` (n,), m, are those from the undeformed body.
        """
        own = self._matrix @ u
        count(multiply_adds=self._matrix.nnz)
        force[: len(u)] += own
        if len(values):
            values[self._slots] += self._entries
        return 0.5 * float(own @ u)
