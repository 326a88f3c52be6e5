"""The smallest det F of a mesh of hexahedra, without stresses.

A check for inverted cells needs neither law nor force, so it has 81 multiply-adds per Gauss point,
where `kernels.internal_force` has 219. Layout and vectorisation are those of that file. The code is
not shared: numba's cache notices changes only in a function's own file.
"""

from __future__ import annotations

import numpy as np
from numba import njit

LANES = 32
"""Elements per batch, as in `kernels`."""

MULTIPLY_ADDS = 81
"""Multiply-adds per Gauss point: H 72, det F 9."""


@njit(inline="always")
def _component(u, g, i, j, l):
    """Return H_ij = Σ_a u_a,i g_a,j; LLVM would not vectorise a loop."""
    L = LANES
    h = u[i * L + l] * g[j * L + l] + u[(3 + i) * L + l] * g[(3 + j) * L + l]
    h += u[(6 + i) * L + l] * g[(6 + j) * L + l] + u[(9 + i) * L + l] * g[(9 + j) * L + l]
    h += u[(12 + i) * L + l] * g[(12 + j) * L + l] + u[(15 + i) * L + l] * g[(15 + j) * L + l]
    h += u[(18 + i) * L + l] * g[(18 + j) * L + l] + u[(21 + i) * L + l] * g[(21 + j) * L + l]
    return h


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def least_det_f(u, dofs, gradients):
    """Return the smallest det F over all Gauss points of batches of hexahedra.

    Parameters
    ----------
    u : (n,) float64
        Displacements, m. Fixed nodes and padding read zeros behind the unknowns.
    dofs : (n_batches, 8, LANES) uint32
        First of the three entries of each node in ``u``.
    gradients : (n, n_points, 24 * LANES) float64
        dN_a/dX_j at the Gauss points, entry (3a + j) * LANES + lane, 1/m. Batch b has those of
        b mod n.
    """
    u_e, least = np.empty(24 * LANES), np.full(LANES, np.inf)
    for b in range(dofs.shape[0]):
        for a in range(8):
            for l in range(LANES):
                d, o = np.uint64(dofs[b, a, l]), 3 * a * LANES + l
                u_e[o], u_e[o + LANES] = u[d], u[d + np.uint64(1)]
                u_e[o + 2 * LANES] = u[d + np.uint64(2)]
        for q in range(gradients.shape[1]):
            g = gradients[b % gradients.shape[0], q]
            for l in range(LANES):
                f00 = 1.0 + _component(u_e, g, 0, 0, l)
                f01, f02 = _component(u_e, g, 0, 1, l), _component(u_e, g, 0, 2, l)
                f10, f11 = _component(u_e, g, 1, 0, l), 1.0 + _component(u_e, g, 1, 1, l)
                f12, f20 = _component(u_e, g, 1, 2, l), _component(u_e, g, 2, 0, l)
                f21, f22 = _component(u_e, g, 2, 1, l), 1.0 + _component(u_e, g, 2, 2, l)
                det = f00 * (f11 * f22 - f12 * f21) - f01 * (f10 * f22 - f12 * f20)
                least[l] = min(least[l], det + f02 * (f10 * f21 - f11 * f20))
    return least.min()
