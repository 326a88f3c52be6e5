"""Kernels of `mor_bench.reduction.points`: quadrature points in batches of ``LANES``.

Every array ends in the lanes of a batch. The innermost loops run over neighbouring points, or over
all components of a batch, so that LLVM vectorises them (see `mor_bench.mechanics.kernels`).
Component (i, J) of H, P or a mode's gradient at lane l is at (3i + J) * LANES + l. Component
(i, J, k, L) of A = dP/dF is at (9 (3i + J) + 3k + L) * LANES + l.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit

LANES = 32
"""Points per batch; 32 gave the fastest tangents."""

_COMPONENTS = 9 * LANES


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "reassoc"})
def _dot(a, b):
    total = 0.0
    for l in range(_COMPONENTS):
        total += a[l] * b[l]
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "reassoc"})
def _dots(a, b, c, d, t, u):
    """Return the dot products of four vectors with two; each is read once."""
    at, bt, ct, dt, au, bu, cu, du = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for l in range(_COMPONENTS):
        at += a[l] * t[l]
        bt += b[l] * t[l]
        ct += c[l] * t[l]
        dt += d[l] * t[l]
        au += a[l] * u[l]
        bu += b[l] * u[l]
        cu += c[l] * u[l]
        du += d[l] * u[l]
    return at, bt, ct, dt, au, bu, cu, du


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _rows(A, X, Y, T, U):
    """Write a row of A : G for two modes."""
    L = LANES
    for l in range(LANES):
        a0, a1, a2, a3, a4 = A[l], A[L + l], A[2 * L + l], A[3 * L + l], A[4 * L + l]
        a5, a6, a7, a8 = A[5 * L + l], A[6 * L + l], A[7 * L + l], A[8 * L + l]
        T[l] = (
            (a0 * X[l] + a1 * X[L + l] + a2 * X[2 * L + l])
            + (a3 * X[3 * L + l] + a4 * X[4 * L + l] + a5 * X[5 * L + l])
            + (a6 * X[6 * L + l] + a7 * X[7 * L + l] + a8 * X[8 * L + l])
        )
        U[l] = (
            (a0 * Y[l] + a1 * Y[L + l] + a2 * Y[2 * L + l])
            + (a3 * Y[3 * L + l] + a4 * Y[4 * L + l] + a5 * Y[5 * L + l])
            + (a6 * Y[6 * L + l] + a7 * Y[7 * L + l] + a8 * Y[8 * L + l])
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _add_force(test, P, force):
    """Add G_m : P of a batch to f_m."""
    for m in range(len(force)):
        force[m] += _dot(test[m], P)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_tangent(test, trial, symmetric, A, T, tangent):
    """Add G_m : A : G_k of a batch to K_mk, only to the upper triangle if it is symmetric.

    T receives A : G of two modes.
    """
    r = len(tangent)
    for k in range(0, r, 2):
        other = min(k + 1, r - 1)  # equal to k if a single mode is left
        for c in range(9):
            lanes, row = slice(c * LANES, (c + 1) * LANES), A[c * _COMPONENTS :]
            _rows(row, trial[k], trial[other], T[0, lanes], T[1, lanes])
        n = other + 1 if symmetric else r
        for m in range(0, n - n % 4, 4):
            at, bt, ct, dt, au, bu, cu, du = _dots(
                test[m], test[m + 1], test[m + 2], test[m + 3], T[0], T[1]
            )
            tangent[m, k] += at
            tangent[m + 1, k] += bt
            tangent[m + 2, k] += ct
            tangent[m + 3, k] += dt
            if other > k:
                tangent[m, other] += au
                tangent[m + 1, other] += bu
                tangent[m + 2, other] += cu
                tangent[m + 3, other] += du
        for m in range(n - n % 4, n):
            tangent[m, k] += _dot(test[m], T[0])
            if other > k:
                tangent[m, other] += _dot(test[m], T[1])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add_scaled(factor, x, y):
    for l in range(_COMPONENTS):
        y[l] += factor * x[l]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _gradients(trial, q, H):
    """Write H = Σ q_m G_m of a batch."""
    H[:] = 0.0
    for m in range(len(q)):
        _add_scaled(q[m], trial[m], H)


@njit(inline="always")
def _derivative(H, w, lam, mu, S, A):
    """Write A_iJkL = λ F_iJ F_kL + μ F_iL F_kJ + μ b_ik δ_JL + δ_ik S_JL; H holds F here."""
    L = LANES
    for i in range(3):
        for k in range(i, 3):
            for l in range(L):
                wl, wm = w[l] * lam[l], w[l] * mu[l]
                i0, i1, i2 = H[3 * i * L + l], H[(3 * i + 1) * L + l], H[(3 * i + 2) * L + l]
                k0, k1, k2 = H[3 * k * L + l], H[(3 * k + 1) * L + l], H[(3 * k + 2) * L + l]
                b = wm * (i0 * k0 + i1 * k1 + i2 * k2)
                l0, l1, l2 = wl * i0, wl * i1, wl * i2
                m0, m1, m2 = wm * i0, wm * i1, wm * i2
                a00, a01, a02 = (l0 + m0) * k0 + b, l0 * k1 + m1 * k0, l0 * k2 + m2 * k0
                a10, a11, a12 = l1 * k0 + m0 * k1, (l1 + m1) * k1 + b, l1 * k2 + m2 * k1
                a20, a21, a22 = l2 * k0 + m0 * k2, l2 * k1 + m1 * k2, (l2 + m2) * k2 + b
                if i == k:
                    s00, s11, s22 = S[l], S[L + l], S[2 * L + l]
                    s01, s02, s12 = S[3 * L + l], S[4 * L + l], S[5 * L + l]
                    a00, a01, a02 = a00 + s00, a01 + s01, a02 + s02
                    a10, a11, a12 = a10 + s01, a11 + s11, a12 + s12
                    a20, a21, a22 = a20 + s02, a21 + s12, a22 + s22
                p = (27 * i + 3 * k) * L + l
                A[p], A[p + L], A[p + 2 * L] = a00, a01, a02
                A[p + 9 * L], A[p + 10 * L], A[p + 11 * L] = a10, a11, a12
                A[p + 18 * L], A[p + 19 * L], A[p + 20 * L] = a20, a21, a22
                if i != k:
                    p = (27 * k + 3 * i) * L + l
                    A[p], A[p + L], A[p + 2 * L] = a00, a10, a20
                    A[p + 9 * L], A[p + 10 * L], A[p + 11 * L] = a01, a11, a21
                    A[p + 18 * L], A[p + 19 * L], A[p + 20 * L] = a02, a12, a22


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _saint_venant_kirchhoff(H, w, lam, mu, want_tangent, P, S, A, energy, min_det):
    """Write weighted P and A of a batch; add energy, and update min det F.

    E is formed from H, because FᵀF - I would lose the digits of a small strain.
    """
    L = LANES
    for l in range(L):
        h00, h01, h02 = H[l], H[L + l], H[2 * L + l]
        h10, h11, h12 = H[3 * L + l], H[4 * L + l], H[5 * L + l]
        h20, h21, h22 = H[6 * L + l], H[7 * L + l], H[8 * L + l]
        e00 = h00 + 0.5 * (h00 * h00 + h10 * h10 + h20 * h20)
        e11 = h11 + 0.5 * (h01 * h01 + h11 * h11 + h21 * h21)
        e22 = h22 + 0.5 * (h02 * h02 + h12 * h12 + h22 * h22)
        e01 = 0.5 * (h01 + h10 + h00 * h01 + h10 * h11 + h20 * h21)
        e02 = 0.5 * (h02 + h20 + h00 * h02 + h10 * h12 + h20 * h22)
        e12 = 0.5 * (h12 + h21 + h01 * h02 + h11 * h12 + h21 * h22)
        wl, wm = w[l] * lam[l], w[l] * mu[l]
        pressure, wm2 = wl * (e00 + e11 + e22), 2.0 * wm
        s00, s11, s22 = pressure + wm2 * e00, pressure + wm2 * e11, pressure + wm2 * e22
        s01, s02, s12 = wm2 * e01, wm2 * e02, wm2 * e12
        energy[l] += 0.5 * (s00 * e00 + s11 * e11 + s22 * e22) + s01 * e01 + s02 * e02 + s12 * e12
        f00, f11, f22 = 1.0 + h00, 1.0 + h11, 1.0 + h22
        det = (
            f00 * (f11 * f22 - h12 * h21)
            - h01 * (h10 * f22 - h12 * h20)
            + h02 * (h10 * h21 - f11 * h20)
        )
        min_det[l] = min(min_det[l], det)
        P[l] = f00 * s00 + h01 * s01 + h02 * s02
        P[L + l] = f00 * s01 + h01 * s11 + h02 * s12
        P[2 * L + l] = f00 * s02 + h01 * s12 + h02 * s22
        P[3 * L + l] = h10 * s00 + f11 * s01 + h12 * s02
        P[4 * L + l] = h10 * s01 + f11 * s11 + h12 * s12
        P[5 * L + l] = h10 * s02 + f11 * s12 + h12 * s22
        P[6 * L + l] = h20 * s00 + h21 * s01 + f22 * s02
        P[7 * L + l] = h20 * s01 + h21 * s11 + f22 * s12
        P[8 * L + l] = h20 * s02 + h21 * s12 + f22 * s22
        if want_tangent:
            H[l], H[4 * L + l], H[8 * L + l] = f00, f11, f22  # F from here on
            S[l], S[L + l], S[2 * L + l] = s00, s11, s22
            S[3 * L + l], S[4 * L + l], S[5 * L + l] = s01, s02, s12
    if want_tangent:
        _derivative(H, w, lam, mu, S, A)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def gradients(trial, q, H):
    """Write H = Σ q_m G_m at all points, (n_batches, 9 * LANES)."""
    for b in range(len(H)):
        _gradients(trial[b], q, H[b])


@njit(cache=True, nogil=True, error_model="numpy")
def project(P, A, trial, test, symmetric, force, tangent):
    """Add the reduced force of P and, if ``tangent`` is not empty, the tangent of A.

    A is (n_batches, 81 * LANES).
    """
    T = np.empty((2, _COMPONENTS))
    for b in range(len(P)):
        _add_force(test[b], P[b], force)
        if len(tangent) > 0:
            _add_tangent(test[b], trial[b], symmetric, A[b], T, tangent)
    if symmetric:
        _mirror(tangent)


@njit(cache=True, nogil=True, error_model="numpy")
def _mirror(tangent):
    for m in range(len(tangent)):
        for k in range(m):
            tangent[m, k] = tangent[k, m]


@njit(cache=True, nogil=True, error_model="numpy")
def integrate(q, trial, test, symmetric, weights, lame, force, tangent):
    """Write reduced force and, if not empty, tangent for Saint Venant-Kirchhoff.

    Parameters
    ----------
    q : (r,) float64
    trial, test : (n_batches, r, 9 * LANES) float64
        Gradients of the modes and of the test functions, 1/m per unit of q.
    symmetric : bool
        Whether both are the same.
    weights : (n_batches, LANES) float64
        Quadrature weights, m³; zero for padding.
    lame : (n_batches, 2, LANES) float64
        λ and μ, Pa. With selective integration a point carries only one of them.
    force : (r,) float64
    tangent : (r, r) or (0, 0) float64

    Returns
    -------
    (float, float)
        Stored energy, J, and the smallest det F.
    """
    want_tangent = len(tangent) > 0
    force[:] = 0.0
    tangent[:] = 0.0
    H, P, T, S = (
        np.empty(_COMPONENTS),
        np.empty(_COMPONENTS),
        np.empty((2, _COMPONENTS)),
        np.empty(6 * LANES),
    )
    A = np.empty(9 * _COMPONENTS)
    energy, min_det = np.zeros(LANES), np.full(LANES, np.inf)
    for b in range(len(weights)):
        _gradients(trial[b], q, H)
        _saint_venant_kirchhoff(
            H, weights[b], lame[b, 0], lame[b, 1], want_tangent, P, S, A, energy, min_det
        )
        _add_force(test[b], P, force)
        if want_tangent:
            _add_tangent(test[b], trial[b], symmetric, A, T, tangent)
    if symmetric:
        _mirror(tangent)
    return energy.sum(), min_det.min()


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "reassoc"})
def _cholesky(matrix, lower):
    """Write the lower factor of a symmetric matrix; return whether it is positive definite."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            if i == j:
                if not rest > 0.0:
                    return False
                lower[i, i] = sqrt(rest)
            else:
                lower[i, j] = rest / lower[j, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(lower, rhs):
    x = rhs.copy()
    for i in range(len(x)):
        for k in range(i):
            x[i] -= lower[i, k] * x[k]
        x[i] /= lower[i, i]
    for i in range(len(x) - 1, -1, -1):
        x[i] /= lower[i, i]
        for k in range(i):
            x[k] -= lower[i, k] * x[i]
    return x


@njit(cache=True, nogil=True, error_model="numpy")
def full_steps(
    load, q, trial, weights, lame, tolerance, hopeless, round_off, extent, max_iterations
):
    """Take full Newton steps from q, as `mor_bench.mechanics.newton` does, in one compiled loop.

    It converges only if the tangent is positive definite where the load is met, or one step before.
    The safeguarded solve handles everything else.

    Returns
    -------
    converged : bool
    min_det : float
    iterations, tangents, forces, factors, solves : int
        Work done, for the count.
    """
    r = len(load)
    force, tangent, none, lower = np.empty(r), np.empty((r, r)), np.empty((0, 0)), np.empty((r, r))
    load_norm = sqrt((load * load).sum())
    before, near, min_det = np.inf, False, -np.inf
    tangents, forces, factors, solves = 0, 0, 0, 0
    for iteration in range(1, max_iterations + 1):
        if near:  # one more residual is cheap, and usually no further tangent is needed
            _, min_det = integrate(q, trial, trial, True, weights, lame, force, none)
            forces += 1
            if sqrt(((load - force) ** 2).sum()) <= tolerance * load_norm:
                return True, min_det, iteration, tangents, forces, factors, solves
        energy, min_det = integrate(q, trial, trial, True, weights, lame, force, tangent)
        tangents += 1
        residual = load - force
        size = sqrt((residual * residual).sum())
        if not (size <= hopeless * load_norm and np.isfinite(energy)):
            break
        factors += 1
        if not _cholesky(tangent, lower):
            break
        solves += 1
        step = _solve(lower, residual)
        if size <= tolerance * load_norm:
            return True, min_det, iteration, tangents, forces, factors, solves
        floor = extent if size > 0.5 * before else 0.0
        near, before = size <= sqrt(tolerance) * load_norm, size
        q += step
        if np.abs(step).max() <= round_off * max(np.abs(q).max(), floor):
            return True, min_det, iteration, tangents, forces, factors, solves
    return False, min_det, iteration, tangents, forces, factors, solves
