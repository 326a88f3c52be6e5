"""Hyperelastic laws at a quadrature point, and kernels that sum them over cells of any element.

A law is one function ``law(C, parameters, S, D) -> W``. Its input is the right Cauchy-Green
tensor C (3, 3) and the law's parameters. It writes S = 2 dW/dC (3, 3) and D = dS/dE (6, 6), and
returns the energy density W. S and D are zero on entry. D has the Voigt order 00 11 22 01 02 12
with engineering shear strains. To add a law, write the function, give it a number in `evaluate`,
and write a parameter class in `mor_bench.scene.materials`.

`general_force` takes one cell after the other: K_ab = w [ B_aᵀ D B_b + (g_a · S g_b) I ], with B_a
the strain-displacement matrix at F (Bonet & Wood, section 9.4). Saint Venant-Kirchhoff on H8 has
its own, vectorised kernel.

Longer than 400 lines because numba recompiles a function only after a change in its own file. Laws
and the kernels that call them hence stay together.
"""

from __future__ import annotations

from math import log, sqrt

import numpy as np
from numba import njit

SAINT_VENANT_KIRCHHOFF, NEO_HOOKEAN, MOONEY_RIVLIN, OGDEN = range(4)

_LAW_MULTIPLY_ADDS = {
    SAINT_VENANT_KIRCHHOFF: 55,
    NEO_HOOKEAN: 340,
    MOONEY_RIVLIN: 1563,
    OGDEN: 3313 + 122,
}
"""Multiply-adds per point for stress and tangent; Ogden's eigenvectors count as 9/2 n³ = 122."""

_OGDEN_TERM_MULTIPLY_ADDS = 44

_I = np.array([0, 1, 2, 0, 0, 1])
_J = np.array([0, 1, 2, 1, 2, 2])
_VOIGT = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


@njit(cache=True, nogil=True, error_model="numpy")
def _inverse(C, out):
    """Write the inverse of a symmetric (3, 3) matrix to ``out``; return the determinant."""
    out[0, 0] = C[1, 1] * C[2, 2] - C[1, 2] * C[1, 2]
    out[0, 1] = out[1, 0] = C[0, 2] * C[1, 2] - C[0, 1] * C[2, 2]
    out[0, 2] = out[2, 0] = C[0, 1] * C[1, 2] - C[0, 2] * C[1, 1]
    out[1, 1] = C[0, 0] * C[2, 2] - C[0, 2] * C[0, 2]
    out[1, 2] = out[2, 1] = C[0, 1] * C[0, 2] - C[0, 0] * C[1, 2]
    out[2, 2] = C[0, 0] * C[1, 1] - C[0, 1] * C[0, 1]
    det = C[0, 0] * out[0, 0] + C[0, 1] * out[0, 1] + C[0, 2] * out[0, 2]
    out /= det
    return det


@njit(cache=True, nogil=True, error_model="numpy")
def _add_dyad(D, factor, A, B):
    """Add factor (A ⊗ B + B ⊗ A) / 2 to D, for symmetric A and B."""
    for m in range(6):
        for n in range(6):
            both = A[_I[m], _J[m]] * B[_I[n], _J[n]] + B[_I[m], _J[m]] * A[_I[n], _J[n]]
            D[m, n] += 0.5 * factor * both


@njit(cache=True, nogil=True, error_model="numpy")
def _add_product(D, factor, A):
    """Add factor A ⊙ A to D, with (A ⊙ A)_ijkl = (A_ik A_jl + A_il A_jk) / 2.

    For A = C⁻¹ the product is minus the derivative of C⁻¹ by C.
    """
    for m in range(6):
        i, j = _I[m], _J[m]
        for n in range(6):
            k, q = _I[n], _J[n]
            D[m, n] += 0.5 * factor * (A[i, k] * A[j, q] + A[i, q] * A[j, k])


@njit(cache=True, nogil=True, error_model="numpy")
def _saint_venant_kirchhoff(C, p, S, D):
    """Saint Venant-Kirchhoff, W = λ/2 tr(E)² + μ tr(E²); p = (λ, μ)."""
    lam, mu = p[0], p[1]
    trace = 0.5 * (C[0, 0] + C[1, 1] + C[2, 2] - 3.0)
    W = 0.5 * lam * trace * trace
    for i in range(3):
        for j in range(3):
            e = 0.5 * (C[i, j] - (1.0 if i == j else 0.0))
            W += mu * e * e
            S[i, j] = 2.0 * mu * e
        S[i, i] += lam * trace
        for j in range(3):
            D[i, j] = lam
        D[i, i] += 2.0 * mu
        D[3 + i, 3 + i] = mu
    return W


@njit(cache=True, nogil=True, error_model="numpy")
def _neo_hookean(C, p, S, D):
    """Neo-Hooke, W = μ/2 (tr C - 3) - μ ln J + λ/2 (ln J)²; p = (λ, μ).

    Bonet & Wood, section 6.4.3.
    """
    lam, mu = p[0], p[1]
    inverse = np.empty((3, 3))
    log_j = 0.5 * log(_inverse(C, inverse))
    for i in range(3):
        for j in range(3):
            S[i, j] = (lam * log_j - mu) * inverse[i, j]
        S[i, i] += mu
    _add_dyad(D, lam, inverse, inverse)
    _add_product(D, 2.0 * (mu - lam * log_j), inverse)
    return 0.5 * mu * (C[0, 0] + C[1, 1] + C[2, 2] - 3.0) - mu * log_j + 0.5 * lam * log_j * log_j


@njit(cache=True, nogil=True, error_model="numpy")
def _add_volumetric(J, inverse, bulk, S, D):
    """Add stress and tangent of U = κ/2 (J - 1)²; return its energy."""
    d_u = bulk * (J - 1.0)
    S += (J * d_u) * inverse
    _add_dyad(D, J * (d_u + J * bulk), inverse, inverse)
    _add_product(D, -2.0 * J * d_u, inverse)
    return 0.5 * bulk * (J - 1.0) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _mooney_rivlin(C, p, S, D):
    """Mooney-Rivlin, W = c10 (J^(-2/3) I₁ - 3) + c01 (J^(-4/3) I₂ - 3) + κ/2 (J - 1)².

    p = (c10, c01, κ). Holzapfel, section 6.5.
    """
    c10, c01, bulk = p[0], p[1], p[2]
    inverse, identity = np.empty((3, 3)), np.eye(3)
    J = sqrt(_inverse(C, inverse))
    first = C[0, 0] + C[1, 1] + C[2, 2]
    second = 0.5 * (first * first - (C * C).sum())
    a, b = c10 * J ** (-2.0 / 3.0), c01 * J ** (-4.0 / 3.0)
    d_second = first * identity - C
    S += 2.0 * a * (identity - first / 3.0 * inverse) + 2.0 * b * (
        d_second - 2.0 / 3.0 * second * inverse
    )
    # dS/dE = 2 dS/dC, term by term.
    _add_dyad(D, -8.0 / 3.0 * a, identity, inverse)
    _add_dyad(D, 4.0 / 9.0 * a * first, inverse, inverse)
    _add_product(D, 4.0 / 3.0 * a * first, inverse)
    _add_dyad(D, -16.0 / 3.0 * b, d_second, inverse)
    _add_dyad(D, 16.0 / 9.0 * b * second, inverse, inverse)
    _add_product(D, 8.0 / 3.0 * b * second, inverse)
    _add_dyad(D, 4.0 * b, identity, identity)
    _add_product(D, -4.0 * b, identity)
    return a * first - 3.0 * c10 + b * second - 3.0 * c01 + _add_volumetric(J, inverse, bulk, S, D)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_shear(D, factor, a, b):
    """Add factor/2 (a ⊗ b + b ⊗ a) ⊗ (a ⊗ b + b ⊗ a) to D, for vectors a and b."""
    for m in range(6):
        i, j = _I[m], _J[m]
        for n in range(6):
            k, q = _I[n], _J[n]
            D[m, n] += factor * 0.5 * (a[i] * b[j] + a[j] * b[i]) * (a[k] * b[q] + a[q] * b[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _ogden(C, p, S, D):
    """Ogden, W = Σ μ_p/α_p (λ̄₁^α_p + λ̄₂^α_p + λ̄₃^α_p - 3) + κ/2 (J - 1)².

    λ̄ = J^(-1/3) λ; p = (κ, μ₁, α₁, μ₂, α₂, …). Principal form with the limit of equal stretches:
    Holzapfel, sections 6.5 and 6.6.
    """
    values, vectors = np.linalg.eigh(C)
    inverse = np.empty((3, 3))
    J = sqrt(_inverse(C, inverse))
    stretch = np.sqrt(values)
    energy = 0.0
    beta, gamma = np.zeros(3), np.zeros((3, 3))
    for term in range(1, len(p), 2):
        mu, alpha = p[term], p[term + 1]
        powers = (stretch * J ** (-1.0 / 3.0)) ** alpha
        mean = powers.sum() / 3.0
        energy += mu / alpha * (3.0 * mean - 3.0)
        for a in range(3):
            beta[a] += mu * (powers[a] - mean)
            for b in range(3):
                own = powers[a] * 3.0 if a == b else 0.0
                gamma[a, b] += mu * alpha / 3.0 * (own - powers[a] - powers[b] + mean)
    # S_a = β_a / λ_a²; dS_a/dlnλ_b gives the normal block, differences of S the shear block.
    principal = beta / values
    for a in range(3):
        Na = np.outer(vectors[:, a], vectors[:, a])
        S += principal[a] * Na
        for b in range(3):
            Nb = np.outer(vectors[:, b], vectors[:, b])
            normal = (gamma[a, b] - (2.0 * beta[a] if a == b else 0.0)) / (values[a] * values[b])
            _add_dyad(D, normal, Na, Nb)
            if b != a:
                if abs(values[a] - values[b]) > 1e-6 * values[a]:
                    shear = (principal[a] - principal[b]) / (values[a] - values[b])
                else:
                    middle = 0.5 * (values[a] + values[b])
                    shear = 0.5 * (gamma[a, a] - gamma[a, b] - 2.0 * beta[a]) / (middle * middle)
                _add_shear(D, shear, vectors[:, a], vectors[:, b])
    return energy + _add_volumetric(J, inverse, p[0], S, D)


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate(law, C, parameters, S, D):
    """Evaluate the law with the given number; S and D are overwritten."""
    S[:] = 0.0
    D[:] = 0.0
    if law == SAINT_VENANT_KIRCHHOFF:
        return _saint_venant_kirchhoff(C, parameters, S, D)
    if law == NEO_HOOKEAN:
        return _neo_hookean(C, parameters, S, D)
    if law == MOONEY_RIVLIN:
        return _mooney_rivlin(C, parameters, S, D)
    return _ogden(C, parameters, S, D)


# Longer than 60 lines because splitting it into compiled functions, even inlined ones, made it 6 to
# 44 % slower.
@njit(cache=True, nogil=True, error_model="numpy")
def general_force(u, dofs, gradients, weights, law, parameters, slots, force, values):
    """Add the internal force to ``force`` and, if not empty, the tangent to ``values``.

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
        Law parameters of each quadrature point. A point may carry only the volumetric part, or
        only the rest.
    slots : (n_cells, n_upper) int32
    force : (n_dofs + 1,) float64
    values : (n_upper_nonzeros + 1,) or (0,) float64

    Returns
    -------
    (float, float)
        Stored energy, J, and the smallest det F over all quadrature points. The energy is infinite
        where det F <= 0, because the laws have no meaning there.
    """
    n = gradients.shape[2]
    H, F, C, S, D = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((6, 6)),
    )
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


# Longer than 60 lines because splitting the similar `general_force` into compiled functions made it
# 6 to 44 % slower.
@njit(cache=True, nogil=True, error_model="numpy")
def point_stresses(H, weights, law, parameters, P, A):
    """Write the weighted first Piola-Kirchhoff stress P and, if not empty, A = dP/dF.

    Parameters
    ----------
    H : (n_batches, 9 * n_lanes) float64
        du/dX; point l of a batch has component (i, J) at (3i + J) * n_lanes + l.
    weights : (n_batches, n_lanes) float64
    law : int
    parameters : (n_points, n_parameters) float64
        Law parameters of each point; the last batch may have fewer points than lanes.
    P : (n_batches, 9 * n_lanes) float64
    A : (n_batches, 81 * n_lanes) or (0, 81 * n_lanes) float64
        Component (i, J, k, L) at (9 (3i + J) + 3k + L) * n_lanes + l.

    Returns
    -------
    (float, float)
        Stored energy and the smallest det F; the energy is infinite where det F <= 0.
    """
    n_lanes = weights.shape[1]
    F, C, S, D, DL = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((6, 6)),
        np.empty((6, 9)),
    )
    energy, min_det = 0.0, np.inf
    P[:] = 0.0
    A[:] = 0.0
    for point in range(len(parameters)):
        b, l = point // n_lanes, point % n_lanes
        h, w = H[b], weights[b, l]
        for i in range(3):
            for j in range(3):
                F[i, j] = h[(3 * i + j) * n_lanes + l] + (1.0 if i == j else 0.0)
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
                C[i, j] = (
                    h[(3 * i + j) * n_lanes + l]
                    + h[(3 * j + i) * n_lanes + l]
                    + (1.0 if i == j else 0.0)
                )
                for k in range(3):
                    C[i, j] += h[(3 * k + i) * n_lanes + l] * h[(3 * k + j) * n_lanes + l]
        energy += w * evaluate(law, C, parameters[point], S, D)
        for i in range(3):
            for j in range(3):
                P[b, (3 * i + j) * n_lanes + l] = w * (
                    F[i, 0] * S[0, j] + F[i, 1] * S[1, j] + F[i, 2] * S[2, j]
                )
        if len(A) == 0:
            continue
        # dE = sym(Fᵀ dH): dH_iJ changes the strains with index J, each by a component of row i.
        for m in range(6):
            for i in range(3):
                for j in range(3):
                    DL[m, 3 * i + j] = w * (
                        D[m, _VOIGT[0, j]] * F[i, 0]
                        + D[m, _VOIGT[1, j]] * F[i, 1]
                        + D[m, _VOIGT[2, j]] * F[i, 2]
                    )
        for i in range(3):
            for j in range(3):
                for d in range(9):
                    a = (
                        F[i, 0] * DL[_VOIGT[0, j], d]
                        + F[i, 1] * DL[_VOIGT[1, j], d]
                        + F[i, 2] * DL[_VOIGT[2, j], d]
                    )
                    if d // 3 == i:
                        a += w * S[j, d % 3]
                    A[b, (9 * (3 * i + j) + d) * n_lanes + l] = a
    return energy, min_det


def point_multiply_adds(law: int, n_parameters: int) -> tuple[int, int]:
    """Return multiply-adds of `point_stresses` per point: without A, and the addition for A."""
    terms = n_parameters // 2 if law == OGDEN else 0
    stress = 27 + 9 + 37 + _LAW_MULTIPLY_ADDS[law] + terms * _OGDEN_TERM_MULTIPLY_ADDS
    return stress, 9 * 6 * 4 + 81 * 3 + 27


def general_multiply_adds(law: int, n_parameters: int, n_nodes: int) -> tuple[int, int]:
    """Return multiply-adds of `general_force` per point: the force alone, and with tangent."""
    terms = n_parameters // 2 if law == OGDEN else 0
    force = 57 * n_nodes + 37 + _LAW_MULTIPLY_ADDS[law] + terms * _OGDEN_TERM_MULTIPLY_ADDS
    tangent = n_nodes * (216 + 39) + n_nodes * (n_nodes - 1) // 2 * 57
    return force, force + tangent
