"""Element kernels for Saint Venant-Kirchhoff on H8, vectorised over batches of elements.

Layout: every array ends in ``LANES`` elements. Each innermost loop does the same arithmetic on
neighbouring elements, which LLVM turns into vector instructions. Quantities per element are flat
arrays: component ``i`` of lane ``l`` is at ``i * LANES + l``. With 2-D arrays, LLVM cannot rule out
aliasing and does not vectorise. Padding lanes have zero gradients and weights, and the dummy dof
behind the last real one.

Strain: ``H`` = du/dX, ``F`` = I + H, ``E`` = (FᵀF - I)/2. Stress: ``S`` = λ tr(E) I + 2μE, ``P`` =
FS. Gradients: ``g_a`` = dN_a/dX, ``h_a`` = F g_a. Weight: ``w`` = Gauss weight times det J. Source
of the tangent block of nodes a and b, with the isotropic elasticity tensor: Bonet & Wood,
"Nonlinear Continuum Mechanics for FEA", sections 9.4-9.5, in material form.

    K_ab = w [ λ h_a ⊗ h_b + μ h_b ⊗ h_a + μ (g_a · g_b) F Fᵀ + (g_a · S g_b) I ].

Saint Venant-Kirchhoff is also written out in `laws` and in `reduction.point_kernels`. They do not
share code: numba's cache notices changes only in a function's own file. After an edit of a shared
file, the other kernels would use old machine code.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit

LANES = 32
"""Elements per batch; 32 gave the fastest tangents on beam-fine."""

N_UPPER = 300
"""Entries in the upper triangle of a 24x24 element matrix."""

FORCE_MULTIPLY_ADDS = 219
"""Multiply-adds per Gauss point for the force: H 72, E 24, S 8, energy 7, det F 9, P 27, f 72."""

TANGENT_MULTIPLY_ADDS = 1200
"""Multiply-adds per Gauss point for the tangent: M 24, h and t 192, blocks 144 + 840."""


@njit(inline="always")
def _gather(u, dofs, u_e):
    """Copy the displacements of the nodes of a batch; numba tests signed indices for < 0."""
    for a in range(8):
        for l in range(LANES):
            d, o = np.uint64(dofs[a, l]), 3 * a * LANES + l
            u_e[o], u_e[o + LANES], u_e[o + 2 * LANES] = (
                u[d],
                u[d + np.uint64(1)],
                u[d + np.uint64(2)],
            )


@njit(inline="always")
def _scatter(f_e, dofs, force):
    """Add the forces at the nodes of a batch to ``force``."""
    for a in range(8):
        for l in range(LANES):
            d, o = np.uint64(dofs[a, l]), 3 * a * LANES + l
            force[d] += f_e[o]
            force[d + np.uint64(1)] += f_e[o + LANES]
            force[d + np.uint64(2)] += f_e[o + 2 * LANES]


@njit(inline="always")
def _component(u_e, g, i, j, l):
    """Return H_ij = Σ_a u_a,i g_a,j."""
    return (
        u_e[i * LANES + l] * g[j * LANES + l]
        + u_e[(3 + i) * LANES + l] * g[(3 + j) * LANES + l]
        + u_e[(6 + i) * LANES + l] * g[(6 + j) * LANES + l]
        + u_e[(9 + i) * LANES + l] * g[(9 + j) * LANES + l]
        + u_e[(12 + i) * LANES + l] * g[(12 + j) * LANES + l]
        + u_e[(15 + i) * LANES + l] * g[(15 + j) * LANES + l]
        + u_e[(18 + i) * LANES + l] * g[(18 + j) * LANES + l]
        + u_e[(21 + i) * LANES + l] * g[(21 + j) * LANES + l]
    )


@njit(inline="always")
def _add_row(f_e, g, i, l, p0, p1, p2):
    """Add P_i · g_a to f_a,i for every node."""
    f_e[i * LANES + l] += p0 * g[l] + p1 * g[LANES + l] + p2 * g[2 * LANES + l]
    f_e[(3 + i) * LANES + l] += (
        p0 * g[3 * LANES + l] + p1 * g[4 * LANES + l] + p2 * g[5 * LANES + l]
    )
    f_e[(6 + i) * LANES + l] += (
        p0 * g[6 * LANES + l] + p1 * g[7 * LANES + l] + p2 * g[8 * LANES + l]
    )
    f_e[(9 + i) * LANES + l] += (
        p0 * g[9 * LANES + l] + p1 * g[10 * LANES + l] + p2 * g[11 * LANES + l]
    )
    f_e[(12 + i) * LANES + l] += (
        p0 * g[12 * LANES + l] + p1 * g[13 * LANES + l] + p2 * g[14 * LANES + l]
    )
    f_e[(15 + i) * LANES + l] += (
        p0 * g[15 * LANES + l] + p1 * g[16 * LANES + l] + p2 * g[17 * LANES + l]
    )
    f_e[(18 + i) * LANES + l] += (
        p0 * g[18 * LANES + l] + p1 * g[19 * LANES + l] + p2 * g[20 * LANES + l]
    )
    f_e[(21 + i) * LANES + l] += (
        p0 * g[21 * LANES + l] + p1 * g[22 * LANES + l] + p2 * g[23 * LANES + l]
    )


@njit(inline="always")
def _point(u_e, g, w_lam, w_mu, H, S, f_e, energy, min_det):
    """Add one Gauss point's nodal forces and energy; store H (9) and the weighted S (6).

    S is in the order 00 11 22 01 02 12. One loop over the lanes keeps F, S and P in registers. E is
    formed from H, because FᵀF - I would lose the digits of a small strain.
    """
    for l in range(LANES):
        h00 = _component(u_e, g, 0, 0, l)
        h01 = _component(u_e, g, 0, 1, l)
        h02 = _component(u_e, g, 0, 2, l)
        h10 = _component(u_e, g, 1, 0, l)
        h11 = _component(u_e, g, 1, 1, l)
        h12 = _component(u_e, g, 1, 2, l)
        h20 = _component(u_e, g, 2, 0, l)
        h21 = _component(u_e, g, 2, 1, l)
        h22 = _component(u_e, g, 2, 2, l)
        e00 = h00 + 0.5 * (h00 * h00 + h10 * h10 + h20 * h20)
        e11 = h11 + 0.5 * (h01 * h01 + h11 * h11 + h21 * h21)
        e22 = h22 + 0.5 * (h02 * h02 + h12 * h12 + h22 * h22)
        e01 = 0.5 * (h01 + h10 + h00 * h01 + h10 * h11 + h20 * h21)
        e02 = 0.5 * (h02 + h20 + h00 * h02 + h10 * h12 + h20 * h22)
        e12 = 0.5 * (h12 + h21 + h01 * h02 + h11 * h12 + h21 * h22)
        trace = e00 + e11 + e22
        wl = w_lam[l] * trace
        wm = 2.0 * w_mu[l]
        s00, s11, s22 = wl + wm * e00, wl + wm * e11, wl + wm * e22
        s01, s02, s12 = wm * e01, wm * e02, wm * e12
        energy[l] += 0.5 * (s00 * e00 + s11 * e11 + s22 * e22) + s01 * e01 + s02 * e02 + s12 * e12
        f00, f11, f22 = 1.0 + h00, 1.0 + h11, 1.0 + h22
        det = (
            f00 * (f11 * f22 - h12 * h21)
            - h01 * (h10 * f22 - h12 * h20)
            + h02 * (h10 * h21 - f11 * h20)
        )
        min_det[l] = min(min_det[l], det)
        H[l], H[1 * LANES + l], H[2 * LANES + l] = h00, h01, h02
        H[3 * LANES + l], H[4 * LANES + l], H[5 * LANES + l] = h10, h11, h12
        H[6 * LANES + l], H[7 * LANES + l], H[8 * LANES + l] = h20, h21, h22
        S[l], S[1 * LANES + l], S[2 * LANES + l] = s00, s11, s22
        S[3 * LANES + l], S[4 * LANES + l], S[5 * LANES + l] = s01, s02, s12
        p0 = f00 * s00 + h01 * s01 + h02 * s02
        p1 = f00 * s01 + h01 * s11 + h02 * s12
        p2 = f00 * s02 + h01 * s12 + h02 * s22
        _add_row(f_e, g, 0, l, p0, p1, p2)
        p0 = h10 * s00 + f11 * s01 + h12 * s02
        p1 = h10 * s01 + f11 * s11 + h12 * s12
        p2 = h10 * s02 + f11 * s12 + h12 * s22
        _add_row(f_e, g, 1, l, p0, p1, p2)
        p0 = h20 * s00 + h21 * s01 + f22 * s02
        p1 = h20 * s01 + h21 * s11 + f22 * s12
        p2 = h20 * s02 + h21 * s12 + f22 * s22
        _add_row(f_e, g, 2, l, p0, p1, p2)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _push_forward(H, S, g, w_lam, w_mu, h, h_lam, h_mu, t, M):
    """Compute h = F g, w λ h, w μ h and t = w S g for each node, and M (6) = w μ F Fᵀ."""
    for l in range(LANES):
        f00, f01, f02 = 1.0 + H[l], H[1 * LANES + l], H[2 * LANES + l]
        f10, f11, f12 = H[3 * LANES + l], 1.0 + H[4 * LANES + l], H[5 * LANES + l]
        f20, f21, f22 = H[6 * LANES + l], H[7 * LANES + l], 1.0 + H[8 * LANES + l]
        wm = w_mu[l]
        M[l] = wm * (f00 * f00 + f01 * f01 + f02 * f02)
        M[1 * LANES + l] = wm * (f10 * f10 + f11 * f11 + f12 * f12)
        M[2 * LANES + l] = wm * (f20 * f20 + f21 * f21 + f22 * f22)
        M[3 * LANES + l] = wm * (f00 * f10 + f01 * f11 + f02 * f12)
        M[4 * LANES + l] = wm * (f00 * f20 + f01 * f21 + f02 * f22)
        M[5 * LANES + l] = wm * (f10 * f20 + f11 * f21 + f12 * f22)
    for a in range(8):
        x, y, z = 3 * a, 3 * a + 1, 3 * a + 2
        for l in range(LANES):
            g0, g1, g2 = g[x * LANES + l], g[y * LANES + l], g[z * LANES + l]
            h0 = g0 + H[l] * g0 + H[1 * LANES + l] * g1 + H[2 * LANES + l] * g2
            h1 = g1 + H[3 * LANES + l] * g0 + H[4 * LANES + l] * g1 + H[5 * LANES + l] * g2
            h2 = g2 + H[6 * LANES + l] * g0 + H[7 * LANES + l] * g1 + H[8 * LANES + l] * g2
            wl, wm = w_lam[l], w_mu[l]
            h[x * LANES + l], h[y * LANES + l], h[z * LANES + l] = h0, h1, h2
            l0, l1, l2 = wl * h0, wl * h1, wl * h2
            n0, n1, n2 = wm * h0, wm * h1, wm * h2
            h_lam[x * LANES + l], h_lam[y * LANES + l], h_lam[z * LANES + l] = l0, l1, l2
            h_mu[x * LANES + l], h_mu[y * LANES + l], h_mu[z * LANES + l] = n0, n1, n2
            t[x * LANES + l] = S[l] * g0 + S[3 * LANES + l] * g1 + S[4 * LANES + l] * g2
            t[y * LANES + l] = S[3 * LANES + l] * g0 + S[1 * LANES + l] * g1 + S[5 * LANES + l] * g2
            t[z * LANES + l] = S[4 * LANES + l] * g0 + S[5 * LANES + l] * g1 + S[2 * LANES + l] * g2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add_blocks(g, h, h_lam, h_mu, t, M, k_e):
    """Add one Gauss point to the upper entries k_e of the element matrices."""
    p = 0
    for a in range(8):
        x, y, z = 3 * a, 3 * a + 1, 3 * a + 2
        block = k_e[p * LANES : (p + 6) * LANES]
        for l in range(LANES):
            g0, g1, g2 = g[x * LANES + l], g[y * LANES + l], g[z * LANES + l]
            gg = g0 * g0 + g1 * g1 + g2 * g2
            s = g0 * t[x * LANES + l] + g1 * t[y * LANES + l] + g2 * t[z * LANES + l]
            b0 = h_lam[x * LANES + l] + h_mu[x * LANES + l]
            b1 = h_lam[y * LANES + l] + h_mu[y * LANES + l]
            b2 = h_lam[z * LANES + l] + h_mu[z * LANES + l]
            block[l] += b0 * h[x * LANES + l] + gg * M[l] + s
            block[1 * LANES + l] += b0 * h[y * LANES + l] + gg * M[3 * LANES + l]
            block[2 * LANES + l] += b0 * h[z * LANES + l] + gg * M[4 * LANES + l]
            block[3 * LANES + l] += b1 * h[y * LANES + l] + gg * M[1 * LANES + l] + s
            block[4 * LANES + l] += b1 * h[z * LANES + l] + gg * M[5 * LANES + l]
            block[5 * LANES + l] += b2 * h[z * LANES + l] + gg * M[2 * LANES + l] + s
        p += 6
        for b in range(a + 1, 8):
            u, v, q = 3 * b, 3 * b + 1, 3 * b + 2
            block = k_e[p * LANES : (p + 9) * LANES]
            for l in range(LANES):
                g0, g1, g2 = g[u * LANES + l], g[v * LANES + l], g[q * LANES + l]
                gg = g[x * LANES + l] * g0 + g[y * LANES + l] * g1 + g[z * LANES + l] * g2
                s = g0 * t[x * LANES + l] + g1 * t[y * LANES + l] + g2 * t[z * LANES + l]
                m00, m11, m22 = gg * M[l] + s, gg * M[1 * LANES + l] + s, gg * M[2 * LANES + l] + s
                m01, m02, m12 = gg * M[3 * LANES + l], gg * M[4 * LANES + l], gg * M[5 * LANES + l]
                l0, l1, l2 = h_lam[x * LANES + l], h_lam[y * LANES + l], h_lam[z * LANES + l]
                n0, n1, n2 = h_mu[x * LANES + l], h_mu[y * LANES + l], h_mu[z * LANES + l]
                h0, h1, h2 = h[u * LANES + l], h[v * LANES + l], h[q * LANES + l]
                block[l] += l0 * h0 + n0 * h0 + m00
                block[1 * LANES + l] += l0 * h1 + n1 * h0 + m01
                block[2 * LANES + l] += l0 * h2 + n2 * h0 + m02
                block[3 * LANES + l] += l1 * h0 + n0 * h1 + m01
                block[4 * LANES + l] += l1 * h1 + n1 * h1 + m11
                block[5 * LANES + l] += l1 * h2 + n2 * h1 + m12
                block[6 * LANES + l] += l2 * h0 + n0 * h2 + m02
                block[7 * LANES + l] += l2 * h1 + n1 * h2 + m12
                block[8 * LANES + l] += l2 * h2 + n2 * h2 + m22
            p += 9


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def internal_force(u, dofs, gradients, w_lam, w_mu, force):
    """Add the internal force of batches of elements to ``force``.

    Parameters
    ----------
    u : (n,) float64
        Displacements, m. Fixed nodes and padding read zeros behind the unknowns.
    dofs : (n_batches, 8, LANES) uint32
        First of the three entries of each node in ``u`` and ``force``.
    gradients : (n, n_points, 24 * LANES) float64
        dN_a/dX_j at the Gauss points, entry (3a + j) * LANES + lane, 1/m. Batch b has those of
        b mod n.
    w_lam, w_mu : (n_batches, n_points, LANES) float64
        Gauss weight times det J (and a cubature weight) times λ and times μ, J. With selective
        integration a point carries only one of the two.
    force : (n,) float64
        Receives the sum, N.

    Returns
    -------
    (float, float)
        Stored energy, J, and the smallest det F over all Gauss points.
    """
    u_e, f_e = np.empty(24 * LANES), np.empty(24 * LANES)
    H, S = np.empty(9 * LANES), np.empty(6 * LANES)
    energy, min_det = np.zeros(LANES), np.full(LANES, np.inf)
    for b in range(dofs.shape[0]):
        own = gradients[b % gradients.shape[0]]
        _gather(u, dofs[b], u_e)
        f_e[:] = 0.0
        for q in range(gradients.shape[1]):
            _point(u_e, own[q], w_lam[b, q], w_mu[b, q], H, S, f_e, energy, min_det)
        _scatter(f_e, dofs[b], force)
    return energy.sum(), min_det.min()


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def internal_force_and_tangent(u, dofs, gradients, w_lam, w_mu, slots, force, values):
    """Add the internal force to ``force``, as `internal_force`, and the tangent to ``values``.

    Parameters
    ----------
    slots : (n_batches, 300, LANES) int32
        Index in ``values`` of each upper entry of an element matrix. Fixed dofs and padding have
        the index of its last, unused entry.
    values : (n_upper_nonzeros + 1,) float64
        Receives the sum, N/m.
    """
    u_e, f_e, k_e = np.empty(24 * LANES), np.empty(24 * LANES), np.empty(N_UPPER * LANES)
    H, S, M = np.empty(9 * LANES), np.empty(6 * LANES), np.empty(6 * LANES)
    h, h_lam = np.empty(24 * LANES), np.empty(24 * LANES)
    h_mu, t = np.empty(24 * LANES), np.empty(24 * LANES)
    energy, min_det = np.zeros(LANES), np.full(LANES, np.inf)
    for b in range(dofs.shape[0]):
        own = gradients[b % gradients.shape[0]]
        _gather(u, dofs[b], u_e)
        f_e[:] = 0.0
        k_e[:] = 0.0
        for q in range(gradients.shape[1]):
            g = own[q]
            _point(u_e, g, w_lam[b, q], w_mu[b, q], H, S, f_e, energy, min_det)
            _push_forward(H, S, g, w_lam[b, q], w_mu[b, q], h, h_lam, h_mu, t, M)
            _add_blocks(g, h, h_lam, h_mu, t, M, k_e)
        _scatter(f_e, dofs[b], force)
        for p in range(N_UPPER):
            for l in range(LANES):
                values[slots[b, p, l]] += k_e[p * LANES + l]
    return energy.sum(), min_det.min()


RUNNING, MET, DIVERGED = range(3)
"""Outcomes of a step of dynamic relaxation."""

TARGET, STEP, LOWEST, LIMIT = range(4)
"""Indices into ``control`` of `advance`, whose entries are squares.

The entries are the residual to reach, the step, the lowest frequency, and the divergence residual.
"""

ADVANCE_MULTIPLY_ADDS = 7
"""Multiply-adds of `advance` per unknown."""

MOST_CURVATURE = 3.8
"""Limit on the Rayleigh quotient times the squared step; above 4 the steps are unstable."""

LEAST_LOWEST = 0.01
"""Least eigenvalue for the damping of a softened body, relative to the lowest at rest."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def advance(u, v, force, before, load, mass, control):
    """Take one step of central differences in place, unless the residual is met.

    v ← [(2 - c) v + 2h² M⁻¹ (f - f_int)] / (2 + c), u ← u + v, with v = h u̇ and c = 2h √λ. This c
    damps the lowest mode critically. λ is the lowest eigenvalue at rest or, if smaller, the
    Rayleigh quotient v·Δf_int / v·Mv of the last step. Source: Joldes, Wittek, Miller, CMAME 200,
    2011, section 3. The step is shortened when the quotient nears the limit of stability.

    Parameters
    ----------
    u : (n,) float64
        Displacements, m; entries behind the unknowns do not change.
    v : (n_dofs,) float64
        The last step, m.
    force : (n,) float64
        Internal force at u, N; set to zero for the next step.
    before : (n_dofs,) float64
        Internal force before the last step, N.
    load, mass : (n_dofs,) float64
        Load, N, and fictitious mass, N/m, so that eigenvalues of M⁻¹K have no unit.
    control : (4,) float64
        Squared settings, see `TARGET`; the squared step may be reduced in place.

    Returns `RUNNING`, `MET` or `DIVERGED`.
    """
    residual = curvature = inertia = 0.0
    for i in range(len(load)):
        r = load[i] - force[i]
        residual += r * r
        curvature += v[i] * (force[i] - before[i])
        inertia += mass[i] * v[i] * v[i]
    if residual <= control[TARGET]:
        return MET
    if not residual <= control[LIMIT]:
        return DIVERGED
    lowest, shorter = control[LOWEST], 1.0
    if inertia > 0.0:
        quotient = curvature / inertia
        if quotient * control[STEP] > MOST_CURVATURE:
            shorter = 0.9 * sqrt(MOST_CURVATURE / (quotient * control[STEP]))
            control[STEP] *= shorter * shorter
        lowest = min(lowest, max(quotient, LEAST_LOWEST * lowest))
    c = min(2.0 * sqrt(lowest * control[STEP]), 1.9)
    keep, push = shorter * (2.0 - c) / (2.0 + c), 2.0 * control[STEP] / (2.0 + c)
    for i in range(len(load)):
        v[i] = keep * v[i] + push * (load[i] - force[i]) / mass[i]
        u[i] += v[i]
        before[i] = force[i]
        force[i] = 0.0
    force[len(load) :] = 0.0
    return RUNNING


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def relax(u, v, before, load, mass, control, n_steps, dofs, gradients, w_lam, w_mu):
    """Take at most ``n_steps`` steps of `advance` with `internal_force`.

    Returns the number of steps, how the last one ended, and min det F there.
    """
    force, status, min_det = np.zeros(len(u)), RUNNING, np.inf
    for step in range(1, n_steps + 1):
        _, min_det = internal_force(u, dofs, gradients, w_lam, w_mu, force)
        status = advance(u, v, force, before, load, mass, control)
        if status != RUNNING:
            return step, status, min_det
    return n_steps, status, min_det
