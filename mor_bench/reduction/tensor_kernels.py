"""Kernels of `mor_bench.reduction.tensors`: strains of pairs of modes, Newton's method.

The Cholesky factorisation does not share the code of `point_kernels`. Their orders of summation
differ, so sharing code would change last digits. Numba's cache also notices changes only in a
function's own file.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from mor_bench.mechanics.newton import HOPELESS

QUICK_ITERATIONS = 15
"""Newton steps before the safeguarded solve takes over; 3 to 6 are usual."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def strains(gradients, shape_scale, volume_scale, rows):
    """Write scaled strains eᵢ, then s_ij, to rows (n, 6, r + n_pairs), from Hᵢ (n, 3, 3, r).

    The six components refer to an orthonormal basis of symmetric tensors. Five are those of the
    deviator; the sixth is the trace over √3.
    """
    r = gradients.shape[3]
    trace, half, sixth = np.sqrt(1.0 / 3.0), np.sqrt(0.5), np.sqrt(1.0 / 6.0)
    for point in range(len(gradients)):
        H, out, a, b = gradients[point], rows[point], shape_scale[point], volume_scale[point]
        for i in range(r):
            x, y, z = H[0, 0, i], H[1, 1, i], H[2, 2, i]
            out[0, i] = a * half * (H[0, 1, i] + H[1, 0, i])
            out[1, i] = a * half * (H[0, 2, i] + H[2, 0, i])
            out[2, i] = a * half * (H[1, 2, i] + H[2, 1, i])
            out[3, i] = a * half * (x - y)
            out[4, i] = a * sixth * (x + y - 2.0 * z)
            out[5, i] = b * trace * (x + y + z)
        for j in range(r):
            first = r + j * (j + 1) // 2
            x0, y0, z0 = H[0, 0, j], H[0, 1, j], H[0, 2, j]
            x1, y1, z1 = H[1, 0, j], H[1, 1, j], H[1, 2, j]
            x2, y2, z2 = H[2, 0, j], H[2, 1, j], H[2, 2, j]
            for i in range(j + 1):
                X0, Y0, Z0 = H[0, 0, i], H[0, 1, i], H[0, 2, i]
                X1, Y1, Z1 = H[1, 0, i], H[1, 1, i], H[1, 2, i]
                X2, Y2, Z2 = H[2, 0, i], H[2, 1, i], H[2, 2, i]
                x = X0 * x0 + X1 * x1 + X2 * x2
                y = Y0 * y0 + Y1 * y1 + Y2 * y2
                z = Z0 * z0 + Z1 * z1 + Z2 * z2
                shear = X0 * y0 + X1 * y1 + X2 * y2 + Y0 * x0 + Y1 * x1 + Y2 * x2
                out[0, first + i] = a * half * shear
                shear = X0 * z0 + X1 * z1 + X2 * z2 + Z0 * x0 + Z1 * x1 + Z2 * x2
                out[1, first + i] = a * half * shear
                shear = Y0 * z0 + Y1 * z1 + Y2 * z2 + Z0 * y0 + Z1 * y1 + Z2 * y2
                out[2, first + i] = a * half * shear
                out[3, first + i] = a * half * (x - y)
                out[4, first + i] = a * sixth * (x + y - 2.0 * z)
                out[5, first + i] = b * trace * (x + y + z)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _dot(a, b, n):
    total = 0.0
    for i in range(n):
        total += a[i] * b[i]
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def evaluate(quadratic, cubic, quartic, q, products, force, hessian):
    """Write force and lower Hessian at q in one sweep over the tensors; return the energy."""
    r, p = len(q), 0
    for j in range(r):
        for i in range(j):
            products[p] = q[i] * q[j]
            p += 1
        products[p] = 0.5 * q[j] * q[j]
        p += 1
    energy = 0.0
    for i in range(r):
        force[i] = 0.0
    pair = 0
    for j in range(r):
        for i in range(j + 1):
            k = quadratic[j, i]
            third = _dot(cubic[pair], q, r)
            fourth = _dot(quartic[pair], products, p)
            hessian[j, i] = k + third + fourth
            share = k + third / 2 + fourth / 3
            force[j] += share * q[i]
            density = (k / 2 + third / 6 + fourth / 12) * q[i] * q[j]
            if i != j:
                force[i] += share * q[j]
                density *= 2.0
            energy += density
            pair += 1
    return energy


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _cholesky(a, r):
    """Factorise the lower triangle in place; return whether it is positive definite."""
    for j in range(r):
        pivot = a[j, j] - _dot(a[j], a[j], j)
        if not pivot > 0.0:
            return False
        root = np.sqrt(pivot)
        a[j, j] = root
        for i in range(j + 1, r):
            a[i, j] = (a[i, j] - _dot(a[i], a[j], j)) / root
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _back_solve(a, r, x):
    """Overwrite x by the solution with both triangles of the lower factor a."""
    for i in range(r):
        x[i] = (x[i] - _dot(a[i], x, i)) / a[i, i]
    for i in range(r - 1, -1, -1):
        x[i] /= a[i, i]
        for k in range(i):
            x[k] -= a[i, k] * x[i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def equilibrium(quadratic, cubic, quartic, rest, load, tolerance, q):
    """Take full Newton steps from the linear response; accept only a positive definite Hessian.

    ``rest`` is the factor at rest. Returns the number of Hessians, negative if they fail.
    """
    r = len(load)
    products, force = np.empty(r * (r + 1) // 2), np.empty(r)
    step, hessian = np.empty(r), np.empty((r, r))
    q[:] = load
    _back_solve(rest, r, q)
    size = np.sqrt(_dot(load, load, r))
    for iteration in range(1, QUICK_ITERATIONS + 1):
        evaluate(quadratic, cubic, quartic, q, products, force, hessian)
        for i in range(r):
            step[i] = load[i] - force[i]
        residual = np.sqrt(_dot(step, step, r))
        if not residual <= HOPELESS * size or not _cholesky(hessian, r):
            return -iteration
        if residual <= tolerance * size:
            return iteration
        _back_solve(hessian, r, step)
        for i in range(r):
            q[i] += step[i]
    return -QUICK_ITERATIONS


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def min_det_f(sentinels, q):
    """Return the smallest det F at points whose modes have the gradients ``sentinels``."""
    least = np.inf
    r = len(q)
    for point in range(len(sentinels)):
        H = sentinels[point]
        a, b, c = 1.0 + _dot(H[0], q, r), _dot(H[1], q, r), _dot(H[2], q, r)
        d, e, f = _dot(H[3], q, r), 1.0 + _dot(H[4], q, r), _dot(H[5], q, r)
        g, h, i = _dot(H[6], q, r), _dot(H[7], q, r), 1.0 + _dot(H[8], q, r)
        least = min(least, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
    return least
