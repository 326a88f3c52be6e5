"""Search trees for the nearest of many points.

SciPy's module is imported at the first tree: it would lengthen each start.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


def tree_of(points: NDArray[np.float64]) -> cKDTree:
    """Return a search tree of points (n, dimension)."""
    from scipy.spatial import cKDTree

    return cKDTree(points)
