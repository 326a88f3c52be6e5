"""Element kernels for any law of `mor_bench.mechanics.laws` on any element, one cell after the other.

K_ab = w [ B_aᵀ D B_b + (g_a · S g_b) I ], with B_a the strain-displacement matrix at F (Bonet & Wood, section 9.4).
Saint Venant-Kirchhoff on H8 has its own, vectorised kernel.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mor_bench.mechanics.laws import evaluate


@njit(cache=True, nogil=True, error_model="numpy")
def general_force(u, dofs, gradients, weights, law, parameters, slots, force, values):
    """Internal force and, where ``values`` is not empty, the upper triangle of the tangent, added into both.

    Parameters
    ----------
    u : (n_dofs + 1,) float64
        Displacements, m; the last entry, of the dummy dof, is zero.
    dofs : (n_cells, 3 n_nodes) int32
    gradients : (n_cells, n_points, n_nodes, 3) float64
        dN_a/dX, 1/m.
    weights : (n_cells, n_points) float64
        Quadrature weight times det J, m³.
    law : int
    parameters : (n_points, n_parameters) float64
        Of each quadrature point: a point may carry only the volumetric part, or only the rest.
    slots : (n_cells, n_upper) int32
    force : (n_dofs + 1,) float64
    values : (n_upper_nonzeros + 1,) or (0,) float64

    Returns
    -------
    (float, float)
        Stored energy, J, and the smallest det F over all quadrature points. Where det F <= 0 the energy is infinite,
        since these laws have no meaning there.
    """
    n = gradients.shape[2]
    H, F, C, S, D = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((6, 6))
    B, DB, Sg = np.empty((n, 6, 3)), np.empty((6, 3)), np.empty((n, 3))
    u_e, f_e, k_e = np.empty((n, 3)), np.empty((n, 3)), np.empty(slots.shape[1])
    energy, min_det = 0.0, np.inf
    for e in range(dofs.shape[0]):
        for a in range(n):
            for i in range(3):
                u_e[a, i] = u[dofs[e, 3 * a + i]]
        f_e[:] = 0.0
        k_e[:] = 0.0
        for q in range(gradients.shape[1]):
            g, w = gradients[e, q], weights[e, q]
            for i in range(3):
                for j in range(3):
                    H[i, j] = 0.0
                    for a in range(n):
                        H[i, j] += u_e[a, i] * g[a, j]
                    F[i, j] = H[i, j] + (1.0 if i == j else 0.0)
            det = (
                F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
                - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
                + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
            )
            min_det = min(min_det, det)
            if not det > 0.0:
                energy = np.inf
                continue
            for i in range(3):
                for j in range(3):
                    C[i, j] = H[i, j] + H[j, i] + (1.0 if i == j else 0.0)
                    for k in range(3):
                        C[i, j] += H[k, i] * H[k, j]
            energy += w * evaluate(law, C, parameters[q], S, D)
            for a in range(n):
                for i in range(3):
                    Sg[a, i] = w * (S[i, 0] * g[a, 0] + S[i, 1] * g[a, 1] + S[i, 2] * g[a, 2])
                for i in range(3):
                    f_e[a, i] += F[i, 0] * Sg[a, 0] + F[i, 1] * Sg[a, 1] + F[i, 2] * Sg[a, 2]
                    B[a, 0, i] = F[i, 0] * g[a, 0]
                    B[a, 1, i] = F[i, 1] * g[a, 1]
                    B[a, 2, i] = F[i, 2] * g[a, 2]
                    B[a, 3, i] = F[i, 0] * g[a, 1] + F[i, 1] * g[a, 0]
                    B[a, 4, i] = F[i, 0] * g[a, 2] + F[i, 2] * g[a, 0]
                    B[a, 5, i] = F[i, 1] * g[a, 2] + F[i, 2] * g[a, 1]
            if len(values) == 0:
                continue
            p = 0
            for a in range(n):
                for m in range(6):
                    for i in range(3):
                        DB[m, i] = 0.0
                        for k in range(6):
                            DB[m, i] += w * D[m, k] * B[a, k, i]
                for b in range(a, n):
                    geometric = g[b, 0] * Sg[a, 0] + g[b, 1] * Sg[a, 1] + g[b, 2] * Sg[a, 2]
                    for i in range(3):
                        for j in range(i if a == b else 0, 3):
                            k_ab = geometric if i == j else 0.0
                            for m in range(6):
                                k_ab += DB[m, i] * B[b, m, j]
                            k_e[p] += k_ab
                            p += 1
        for a in range(n):
            for i in range(3):
                force[dofs[e, 3 * a + i]] += f_e[a, i]
        if len(values) > 0:
            for p in range(slots.shape[1]):
                values[slots[e, p]] += k_e[p]
    return energy, min_det
