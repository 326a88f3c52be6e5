"""Numbering of degrees of freedom: node n has dofs 3n, 3n + 1 and 3n + 2 (x, y, z)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def dofs_of_nodes(nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the dofs (3 n,) of nodes (n,), in the order of the nodes."""
    return (3 * nodes[:, None] + np.arange(3)).ravel()


def by_node(still: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return nodes without a free component, and held dofs of the others, from (n_nodes, 3)."""
    fixed = np.all(still, axis=1, keepdims=True)
    return np.flatnonzero(fixed), np.flatnonzero(still & ~fixed)
