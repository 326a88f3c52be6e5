"""Hyperelastic laws at a quadrature point, and kernels that sum them over cells of any element.

Layout: as in `mor_bench.mechanics.kernels`, every array ends in ``LANES`` elements or points, and
component ``i`` of lane ``l`` is at ``i * LANES + l``. A kernel takes each batch through stages:
gradient H = du/dX, strain, law, stress P, forces and blocks. Each stage is a loop over the lanes
that LLVM vectorises. The factories `general_force` and `point_stresses` compile the kernels of one
law and one element; a scene compiles only its own.

A law is one function ``law(E, p, S, D)`` on a batch. Its input is the Green-Lagrange strain E (6
components, then J = det F > 0) and the law's parameters p. It writes S = dW/dE (6 components, then
the energy density W) and D = dS/dE (21, the upper triangle row by row). D is None if only forces
are asked for. The order of the 6 components is 00 11 22 01 02 12, with engineering shear strains
in D. LLVM vectorises a loop only if it uses few arrays, so those belong together. To add a law,
write the function, give it a number, call it in the two kernels, and write a parameter class in
`mor_bench.scene.materials`.

Straight tetrahedra need the gradients of their barycentric coordinates only: du/dX = Σ_i c_i ⊗ grad
λ_i, where c_i is the displacement of a corner of T4, and for T10 that of `_corner_displacements`.

Tangent block of nodes a and b: K_ab = w g_a · A · g_b, with A = dP/dF. Saint Venant-Kirchhoff on
H8 has a kernel of its own, which uses the structure of that law.

Longer than 400 lines because numba recompiles a function only after a change in its own file. Laws
and the kernels that call them hence stay together.
"""

from __future__ import annotations

from functools import cache
from math import sqrt

import numpy as np
from llvmlite import ir
from numba import float64, njit, uint64
from numba.extending import intrinsic

SAINT_VENANT_KIRCHHOFF, NEO_HOOKEAN, MOONEY_RIVLIN, OGDEN, YEOH, COROTATIONAL = range(6)
HOLZAPFEL_GASSER_OGDEN = 6

LANES = 32
"""Elements or points per batch."""

THIRD = 1.0 / 3.0
"""Factor instead of a division, which takes several times as long."""

SWEEPS = 6
"""Largest number of Jacobi sweeps; 3 x 3 matrices need at most 5 for all digits."""

VECTORS, SQUARES, LOGS, BETA, SLOPES, GAMMA = (k * LANES for k in (6, 15, 18, 21, 24, 27))
"""Places of the principal values in the work array of a law of principal stretches.

These are the eigenvectors of C, the squared stretches v_a and their logarithms, β_a = dW/dlnλ_a,
and for the tangent (β_a - β_b) / (v_a - v_b) and γ_ab = dβ_a/dlnλ_b.
"""


@intrinsic
def _bits(typing_context, x):
    """Return the bits of a float64 as uint64."""
    return uint64(float64), lambda _, builder, __, given: builder.bitcast(given[0], ir.IntType(64))


@intrinsic
def _from_bits(typing_context, bits):
    """Return the float64 with the given bits."""
    return float64(uint64), lambda _, builder, __, given: builder.bitcast(given[0], ir.DoubleType())


_ROOT_HALF, _BIAS = np.uint64(0x3FE6A09E667F3BCD), np.uint64(1023)
_MANTISSA, _INTEGER = np.uint64(52), np.uint64(0x4330000000000000)
_HALF = np.uint64(32)


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _log(x):
    """Return ln x for a normal x > 0, below 1 ulp (fdlibm); LLVM vectorises it, unlike libm's."""
    bits = _bits(x)  # type: ignore[call-arg, var-annotated]
    biased = (bits - _ROOT_HALF + (_BIAS << _MANTISSA)) >> _MANTISSA
    exponent = _from_bits(biased | _INTEGER) - (4503599627370496.0 + 1023.0)
    f = _from_bits(bits - ((biased - _BIAS) << _MANTISSA)) - 1.0
    s = f / (2.0 + f)
    z = s * s
    r = 0.1531383769920937332 + z * 0.1479819860511658591
    r = 0.2222219843214978396 + z * (0.1818357216161805012 + z * r)
    r = z * (
        0.6666666666666735130 + z * (0.3999999999940941908 + z * (0.2857142874366239149 + z * r))
    )
    half = 0.5 * f * f
    low = s * (half + r) + exponent * 1.90821492927058770002e-10
    return exponent * 0.693147180369123816490 - ((half - low) - f)


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _exp(x):
    """Return eˣ below 1 ulp (fdlibm); beyond |x| = 700 return the value there."""
    x = min(max(x, -700.0), 700.0)
    shifted = x * 1.44269504088896338700 + 6755399441055744.0
    n = shifted - 6755399441055744.0
    high, low = x - n * 0.693147180369123816490, n * 1.90821492927058770002e-10
    r = high - low
    t = r * r
    c = -2.77777777770155933842e-03 + t * (
        6.61375632143793436117e-05
        + t * (-1.65339022054652515390e-06 + t * 4.13813679705723846039e-08)
    )
    c = r - t * (0.166666666666666019037 + t * c)
    y = 1.0 - ((low - (r * c) / (2.0 - c)) - high)
    bits = _bits(y) + (_bits(shifted) << _MANTISSA)  # type: ignore[call-arg]
    return _from_bits(bits)


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _inverse_cube_root(x):
    """Return x^(-1/3) of a normal x > 0, below 2 ulp, without the divisions of `_exp` and `_log`.

    The first guess divides the exponent by three, in the upper half of the bits (error 3 %). Each
    of two steps takes four terms of the series of (1 - z)^(-1/3).
    """
    bits = _bits(x)  # type: ignore[call-arg, var-annotated]
    upper = _from_bits((bits >> _HALF) | _INTEGER) - 4503599627370496.0
    guess = (4503599627370496.0 + 1430186360.0) - THIRD * upper
    y = _from_bits(_bits(guess) << _HALF)
    z = 1.0 - x * (y * y * y)
    y += y * z * (THIRD + z * (2.0 / 9.0 + z * (14.0 / 81.0)))
    z = 1.0 - x * (y * y * y)
    return y + y * z * (THIRD + z * (2.0 / 9.0 + z * (14.0 / 81.0)))


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _inverse(E, k, l):
    """Return the six components of C⁻¹ = (I + 2E)⁻¹, with k = 1 / det C = 1 / J²."""
    a, b, c = 1.0 + 2.0 * E[l], 1.0 + 2.0 * E[LANES + l], 1.0 + 2.0 * E[2 * LANES + l]
    d, e, f = 2.0 * E[3 * LANES + l], 2.0 * E[4 * LANES + l], 2.0 * E[5 * LANES + l]
    return (
        k * (b * c - f * f),
        k * (a * c - e * e),
        k * (a * b - d * d),
        k * (e * f - d * c),
        k * (d * f - e * b),
        k * (d * e - a * f),
    )


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _write(D, l, y, i, q):
    """Write D = (y ⊗ i + i ⊗ y) / 2 + 2q i ⊙ i, for symmetric tensors y and i of 6 components.

    (i ⊙ i)_klmn = (i_km i_ln + i_kn i_lm) / 2; for i = C⁻¹ it is minus the derivative of C⁻¹ by C.
    """
    a, b, c, d, e, f = i
    p0, p1, p2, p3, p4, p5 = 0.5 * a, 0.5 * b, 0.5 * c, 0.5 * d, 0.5 * e, 0.5 * f
    y0, y1, y2, y3, y4, y5 = y
    r = 2.0 * q
    ra, rb, rc, rd, re, rf = r * a, r * b, r * c, r * d, r * e, r * f
    qa, qb, qd, qe = q * a, q * b, q * d, q * e
    D[l] = y0 * a + ra * a
    D[LANES + l] = y0 * p1 + p0 * y1 + rd * d
    D[2 * LANES + l] = y0 * p2 + p0 * y2 + re * e
    D[3 * LANES + l] = y0 * p3 + p0 * y3 + ra * d
    D[4 * LANES + l] = y0 * p4 + p0 * y4 + ra * e
    D[5 * LANES + l] = y0 * p5 + p0 * y5 + rd * e
    D[6 * LANES + l] = y1 * b + rb * b
    D[7 * LANES + l] = y1 * p2 + p1 * y2 + rf * f
    D[8 * LANES + l] = y1 * p3 + p1 * y3 + rd * b
    D[9 * LANES + l] = y1 * p4 + p1 * y4 + rd * f
    D[10 * LANES + l] = y1 * p5 + p1 * y5 + rb * f
    D[11 * LANES + l] = y2 * c + rc * c
    D[12 * LANES + l] = y2 * p3 + p2 * y3 + re * f
    D[13 * LANES + l] = y2 * p4 + p2 * y4 + re * c
    D[14 * LANES + l] = y2 * p5 + p2 * y5 + rf * c
    D[15 * LANES + l] = y3 * d + qa * b + qd * d
    D[16 * LANES + l] = y3 * p4 + p3 * y4 + qa * f + qd * e
    D[17 * LANES + l] = y3 * p5 + p3 * y5 + qd * f + qe * b
    D[18 * LANES + l] = y4 * e + qa * c + qe * e
    D[19 * LANES + l] = y4 * p5 + p4 * y5 + qd * c + qe * f
    D[20 * LANES + l] = y5 * f + qb * c + q * f * f


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add_products(D, l, y, i, q, w, n):
    """Add to D what `_write` writes, and w n ⊗ n for a symmetric tensor n of 6 components."""
    a, b, c, d, e, f = i
    p0, p1, p2, p3, p4, p5 = 0.5 * a, 0.5 * b, 0.5 * c, 0.5 * d, 0.5 * e, 0.5 * f
    y0, y1, y2, y3, y4, y5 = y
    n0, n1, n2, n3, n4, n5 = n
    m0, m1, m2, m3, m4, m5 = w * n0, w * n1, w * n2, w * n3, w * n4, w * n5
    r = 2.0 * q
    ra, rb, rc, rd, re, rf = r * a, r * b, r * c, r * d, r * e, r * f
    qa, qb, qd, qe = q * a, q * b, q * d, q * e
    D[l] += y0 * a + ra * a + m0 * n0
    D[LANES + l] += y0 * p1 + p0 * y1 + rd * d + m0 * n1
    D[2 * LANES + l] += y0 * p2 + p0 * y2 + re * e + m0 * n2
    D[3 * LANES + l] += y0 * p3 + p0 * y3 + ra * d + m0 * n3
    D[4 * LANES + l] += y0 * p4 + p0 * y4 + ra * e + m0 * n4
    D[5 * LANES + l] += y0 * p5 + p0 * y5 + rd * e + m0 * n5
    D[6 * LANES + l] += y1 * b + rb * b + m1 * n1
    D[7 * LANES + l] += y1 * p2 + p1 * y2 + rf * f + m1 * n2
    D[8 * LANES + l] += y1 * p3 + p1 * y3 + rd * b + m1 * n3
    D[9 * LANES + l] += y1 * p4 + p1 * y4 + rd * f + m1 * n4
    D[10 * LANES + l] += y1 * p5 + p1 * y5 + rb * f + m1 * n5
    D[11 * LANES + l] += y2 * c + rc * c + m2 * n2
    D[12 * LANES + l] += y2 * p3 + p2 * y3 + re * f + m2 * n3
    D[13 * LANES + l] += y2 * p4 + p2 * y4 + re * c + m2 * n4
    D[14 * LANES + l] += y2 * p5 + p2 * y5 + rf * c + m2 * n5
    D[15 * LANES + l] += y3 * d + qa * b + qd * d + m3 * n3
    D[16 * LANES + l] += y3 * p4 + p3 * y4 + qa * f + qd * e + m3 * n4
    D[17 * LANES + l] += y3 * p5 + p3 * y5 + qd * f + qe * b + m3 * n5
    D[18 * LANES + l] += y4 * e + qa * c + qe * e + m4 * n4
    D[19 * LANES + l] += y4 * p5 + p4 * y5 + qd * c + qe * f + m4 * n5
    D[20 * LANES + l] += y5 * f + qb * c + q * f * f + m5 * n5


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _saint_venant_kirchhoff(E, p, S, D):
    """Saint Venant-Kirchhoff, W = λ/2 tr(E)² + μ tr(E²); p = (λ, μ)."""
    L = LANES
    for l in range(LANES):
        lam, mu = p[l], p[L + l]
        e00, e11, e22, e01, e02, e12 = (
            E[l],
            E[L + l],
            E[2 * L + l],
            E[3 * L + l],
            E[4 * L + l],
            E[5 * L + l],
        )
        pressure, twice = lam * (e00 + e11 + e22), 2.0 * mu
        s00, s11, s22 = pressure + twice * e00, pressure + twice * e11, pressure + twice * e22
        s01, s02, s12 = twice * e01, twice * e02, twice * e12
        S[l], S[L + l], S[2 * L + l] = s00, s11, s22
        S[3 * L + l], S[4 * L + l], S[5 * L + l] = s01, s02, s12
        S[6 * L + l] = 0.5 * (s00 * e00 + s11 * e11 + s22 * e22) + s01 * e01 + s02 * e02 + s12 * e12
    if D is not None:
        D[:] = 0.0
        for l in range(LANES):
            lam, mu = p[l], p[L + l]
            D[L + l], D[2 * L + l], D[7 * L + l] = lam, lam, lam
            normal = lam + 2.0 * mu
            D[l], D[6 * L + l], D[11 * L + l] = normal, normal, normal
            D[15 * L + l], D[18 * L + l], D[20 * L + l] = mu, mu, mu


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _neo_hookean(E, p, S, D):
    """Neo-Hooke, W = μ/2 (tr C - 3) - μ ln J + λ/2 (ln J)²; p = (λ, μ).

    Bonet & Wood, section 6.4.3.
    """
    L = LANES
    for l in range(LANES):
        lam, mu, J = p[l], p[L + l], E[6 * L + l]
        inverse = _inverse(E, 1.0 / (J * J), l)
        i0, i1, i2, i3, i4, i5 = inverse
        log_j = _log(J)
        s = lam * log_j - mu
        S[l], S[L + l], S[2 * L + l] = mu + s * i0, mu + s * i1, mu + s * i2
        S[3 * L + l], S[4 * L + l], S[5 * L + l] = s * i3, s * i4, s * i5
        trace = E[l] + E[L + l] + E[2 * L + l]
        S[6 * L + l] = mu * trace + (0.5 * lam * log_j - mu) * log_j
        if D is not None:
            y = lam * i0, lam * i1, lam * i2, lam * i3, lam * i4, lam * i5
            _write(D, l, y, inverse, -s)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _mooney_rivlin(E, p, S, D):
    """Mooney-Rivlin, W = c10 (J^(-2/3) I₁ - 3) + c01 (J^(-4/3) I₂ - 3) + κ/2 (J - 1)².

    p = (c10, c01, κ). Holzapfel, section 6.5.
    """
    L = LANES
    for l in range(LANES):
        c10, c01, bulk = p[l], p[L + l], p[2 * L + l]
        e00, e11, e22, e01, e02, e12 = (
            E[l],
            E[L + l],
            E[2 * L + l],
            E[3 * L + l],
            E[4 * L + l],
            E[5 * L + l],
        )
        J = E[6 * L + l]
        cube_root = _inverse_cube_root(J)
        root = cube_root * cube_root
        inverse = _inverse(E, root * root * root, l)
        i0, i1, i2, i3, i4, i5 = inverse
        a, b, d_u = 2.0 * c10 * root, 2.0 * c01 * root * root, bulk * (J - 1.0)
        c00, c11, c22 = 1.0 + 2.0 * e00, 1.0 + 2.0 * e11, 1.0 + 2.0 * e22
        first, shears = c00 + c11 + c22, e01 * e01 + e02 * e02 + e12 * e12
        second = c00 * c11 + c11 * c22 + c22 * c00 - 4.0 * shears
        # d = dI₂/dC = I₁ I - C.
        d0, d1, d2 = c11 + c22, c22 + c00, c00 + c11
        d3, d4, d5 = -2.0 * e01, -2.0 * e02, -2.0 * e12
        third_a, third_b = THIRD * a * first, 2.0 * THIRD * b * second
        s = J * d_u - third_a - third_b
        S[l], S[L + l], S[2 * L + l] = a + b * d0 + s * i0, a + b * d1 + s * i1, a + b * d2 + s * i2
        S[3 * L + l], S[4 * L + l], S[5 * L + l] = b * d3 + s * i3, b * d4 + s * i4, b * d5 + s * i5
        energy = 0.5 * (a * first + b * second) - 3.0 * (c10 + c01)
        S[6 * L + l] = energy + 0.5 * d_u * (J - 1.0)
        if D is not None:
            # dS/dE = 2 dS/dC; terms with C⁻¹ first.
            x, v = -4.0 / 3.0 * a, -8.0 / 3.0 * b
            t = J * (d_u + J * bulk) + 2.0 * THIRD * (third_a + 2.0 * third_b)
            y = (
                x + v * d0 + t * i0,
                x + v * d1 + t * i1,
                x + v * d2 + t * i2,
                v * d3 + t * i3,
                v * d4 + t * i4,
                v * d5 + t * i5,
            )
            _write(D, l, y, inverse, -s)
            # 2b (I ⊗ I - I ⊙ I).
            D[L + l] += 2.0 * b
            D[2 * L + l] += 2.0 * b
            D[7 * L + l] += 2.0 * b
            D[15 * L + l] -= b
            D[18 * L + l] -= b
            D[20 * L + l] -= b


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _yeoh(E, p, S, D):
    """Yeoh, W = c10 x + c20 x² + c30 x³ + κ/2 (J - 1)², with x = J^(-2/3) I₁ - 3.

    p = (c10, c20, c30, κ). Yeoh, Rubber Chemistry and Technology 66 (1993), 754-771.
    """
    L = LANES
    for l in range(LANES):
        c10, c20, c30, bulk = p[l], p[L + l], p[2 * L + l], p[3 * L + l]
        J = E[6 * L + l]
        cube_root = _inverse_cube_root(J)
        root = cube_root * cube_root
        inverse = _inverse(E, root * root * root, l)
        i0, i1, i2, i3, i4, i5 = inverse
        first = 3.0 + 2.0 * (E[l] + E[L + l] + E[2 * L + l])
        x, d_u = root * first - 3.0, bulk * (J - 1.0)
        # S = a I + s C⁻¹, with a = 2 J^(-2/3) dW/dx.
        a = 2.0 * root * (c10 + x * (2.0 * c20 + 3.0 * c30 * x))
        third = THIRD * a * first
        s = J * d_u - third
        S[l], S[L + l], S[2 * L + l] = a + s * i0, a + s * i1, a + s * i2
        S[3 * L + l], S[4 * L + l], S[5 * L + l] = s * i3, s * i4, s * i5
        S[6 * L + l] = x * (c10 + x * (c20 + x * c30)) + 0.5 * d_u * (J - 1.0)
        if D is not None:
            # dx/dC = J^(-2/3) (I - I₁/3 C⁻¹); 4 d²W/dx² dx/dC ⊗ dx/dC, with I ⊗ I last.
            w = 4.0 * root * root * (2.0 * c20 + 6.0 * c30 * x)
            wide = THIRD * w * first
            v = -4.0 / 3.0 * a - 2.0 * wide
            t = J * (d_u + J * bulk) + THIRD * (2.0 * third + wide * first)
            y = v + t * i0, v + t * i1, v + t * i2, t * i3, t * i4, t * i5
            _write(D, l, y, inverse, -s)
            D[l] += w
            D[L + l] += w
            D[2 * L + l] += w
            D[6 * L + l] += w
            D[7 * L + l] += w
            D[11 * L + l] += w


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _add_fibres(I, E, stiffness, N, S, D):
    """Add a family of fibres, k1/(2 k2) (exp(k2 x²) - 1) with x = J^(-2/3) N:C - 1 >= 0.

    ``I`` holds C⁻¹ (6), J^(-2/3), and places for four factors of D.
    """
    L = LANES
    for l in range(LANES):
        inverse = I[l], I[L + l], I[2 * L + l], I[3 * L + l], I[4 * L + l], I[5 * L + l]
        i0, i1, i2, i3, i4, i5 = inverse
        n0, n1, n2 = N[l], N[L + l], N[2 * L + l]
        n3, n4, n5 = N[3 * L + l], N[4 * L + l], N[5 * L + l]
        root, k2 = I[6 * L + l], stiffness[L + l]
        normal = n0 * E[l] + n1 * E[L + l] + n2 * E[2 * L + l]
        shear = n3 * E[3 * L + l] + n4 * E[4 * L + l] + n5 * E[5 * L + l]
        length = 1.0 + 2.0 * (normal + 2.0 * shear)
        x = root * length - 1.0
        growth, k1 = _exp(k2 * x * x), stiffness[l] if x >= 0.0 else 0.0
        # S = a N + s C⁻¹, with a = 2 J^(-2/3) dW/dx.
        a = 2.0 * root * k1 * x * growth
        third = THIRD * a * length
        S[l] += a * n0 - third * i0
        S[L + l] += a * n1 - third * i1
        S[2 * L + l] += a * n2 - third * i2
        S[3 * L + l] += a * n3 - third * i3
        S[4 * L + l] += a * n4 - third * i4
        S[5 * L + l] += a * n5 - third * i5
        S[6 * L + l] += 0.5 * k1 / k2 * (growth - 1.0)
        if D is not None:
            # dx/dC = J^(-2/3) (N - N:C/3 C⁻¹); 4 d²W/dx² dx/dC ⊗ dx/dC, with N ⊗ N last.
            w = 4.0 * root * root * k1 * (1.0 + 2.0 * k2 * x * x) * growth
            wide = THIRD * w * length
            I[7 * L + l], I[8 * L + l] = w, third
            I[9 * L + l] = -4.0 / 3.0 * a - 2.0 * wide
            I[10 * L + l] = THIRD * (2.0 * third + wide * length)
    if D is not None:
        for l in range(LANES):
            inverse = I[l], I[L + l], I[2 * L + l], I[3 * L + l], I[4 * L + l], I[5 * L + l]
            i0, i1, i2, i3, i4, i5 = inverse
            n = N[l], N[L + l], N[2 * L + l], N[3 * L + l], N[4 * L + l], N[5 * L + l]
            n0, n1, n2, n3, n4, n5 = n
            v, t = I[9 * L + l], I[10 * L + l]
            y = (
                v * n0 + t * i0,
                v * n1 + t * i1,
                v * n2 + t * i2,
                v * n3 + t * i3,
                v * n4 + t * i4,
                v * n5 + t * i5,
            )
            _add_products(D, l, y, inverse, I[8 * L + l], I[7 * L + l], n)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _holzapfel_gasser_ogden(E, p, S, D):
    """Neo-Hooke with families of fibres, W = c10 (J^(-2/3) I₁ - 3) + κ/2 (J - 1)² + `_add_fibres`.

    p = (c10, κ, k1, k2, then N of each family); N = d I + (1 - 3d) a ⊗ a for fibres along a with
    dispersion d. Gasser, Ogden & Holzapfel, Journal of the Royal Society Interface 3 (2006), 15-35.
    """
    L = LANES
    work = np.empty(11 * L)
    for l in range(LANES):
        c10, bulk, J = p[l], p[L + l], E[6 * L + l]
        cube_root = _inverse_cube_root(J)
        root = cube_root * cube_root
        inverse = _inverse(E, root * root * root, l)
        i0, i1, i2, i3, i4, i5 = inverse
        work[l], work[L + l], work[2 * L + l] = i0, i1, i2
        work[3 * L + l], work[4 * L + l], work[5 * L + l] = i3, i4, i5
        work[6 * L + l] = root
        first, d_u = 3.0 + 2.0 * (E[l] + E[L + l] + E[2 * L + l]), bulk * (J - 1.0)
        a = 2.0 * c10 * root
        third = THIRD * a * first
        s = J * d_u - third
        S[l], S[L + l], S[2 * L + l] = a + s * i0, a + s * i1, a + s * i2
        S[3 * L + l], S[4 * L + l], S[5 * L + l] = s * i3, s * i4, s * i5
        S[6 * L + l] = c10 * (root * first - 3.0) + 0.5 * d_u * (J - 1.0)
        if D is not None:
            x, t = -4.0 / 3.0 * a, J * (d_u + J * bulk) + 2.0 * THIRD * third
            y = x + t * i0, x + t * i1, x + t * i2, t * i3, t * i4, t * i5
            _write(D, l, y, inverse, -s)
    for k in range(4, len(p) // LANES, 6):
        _add_fibres(work, E, p[2 * L : 4 * L], p[k * L : (k + 6) * L], S, D)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _sweep(A, V):
    """Rotate A (6, symmetric) by one cyclic Jacobi sweep, and the columns of V (9) with it."""
    L = LANES
    for axis in range(3):  # rotate the plane p, q; the third axis is r
        p, q, r = axis // 2, min(axis + 1, 2), 2 - axis
        pq, rp, rq = 3 + axis, (2 + p + r) * L, (2 + q + r) * L
        for l in range(LANES):
            app, aqq, apq = A[p * L + l], A[q * L + l], A[pq * L + l]
            d = aqq - app
            root = sqrt(d * d + 4.0 * apq * apq) + 1e-300
            t = 2.0 * apq / (d - root if d < 0.0 else d + root)
            c = 1.0 / sqrt(1.0 + t * t)
            s = t * c
            A[p * L + l], A[q * L + l], A[pq * L + l] = app - t * apq, aqq + t * apq, 0.0
            arp, arq = A[rp + l], A[rq + l]
            A[rp + l], A[rq + l] = c * arp - s * arq, s * arp + c * arq
            v0, v1, v2 = V[p * L + l], V[(3 + p) * L + l], V[(6 + p) * L + l]
            w0, w1, w2 = V[q * L + l], V[(3 + q) * L + l], V[(6 + q) * L + l]
            V[p * L + l], V[q * L + l] = c * v0 - s * w0, s * v0 + c * w0
            V[(3 + p) * L + l], V[(3 + q) * L + l] = c * v1 - s * w1, s * v1 + c * w1
            V[(6 + p) * L + l], V[(6 + q) * L + l] = c * v2 - s * w2, s * v2 + c * w2


@njit(error_model="numpy", fastmath={"contract", "nsz", "reassoc"})
def _is_diagonal(A):
    """Return whether no entry off the diagonals matters beside C = I + 2A."""
    off = 0.0
    for l in range(3 * LANES, 6 * LANES):
        off += A[l] * A[l]
    return off < 1e-34


@njit(error_model="numpy")
def _diagonalise(A, V):
    """Write eigenvalues and eigenvectors of A (6): the diagonal of A, and the columns of V (9).

    Jacobi rotations keep all digits where eigenvalues are equal, unlike the closed form.
    """
    V[:] = 0.0
    V[:LANES] = 1.0
    V[4 * LANES : 5 * LANES] = 1.0
    V[8 * LANES :] = 1.0
    for _ in range(SWEEPS):
        if _is_diagonal(A):
            break
        _sweep(A, V)


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _series(t):
    """Return sinh(√t)/√t for 0 <= t <= 1/4."""
    series = 1.0 + t * (1.0 / 110.0) * (1.0 + t * (1.0 / 156.0))
    series = 1.0 + t * (1.0 / 42.0) * (1.0 + t * (1.0 / 72.0) * series)
    return 1.0 + t * (1.0 / 6.0) * (1.0 + t * (1.0 / 20.0) * series)


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _slope(p_a, p_b, v_a, v_b, half, z):
    """Return (p_a - p_b) / (v_a - v_b) with p = vᵏ, k = ``half``, z = ln(v_a / v_b) / 2.

    p_a - p_b = 2 sqrt(p_a p_b) sinh(kz), with the series of sinh(t)/t for small t. Then z cancels.
    """
    t, y = half * half * z * z, z * z
    rise = 2.0 * half * sqrt(p_a * p_b) * _series(min(t, 0.25))
    run = 2.0 * sqrt(v_a * v_b) * _series(min(y, 0.25))
    unit = z if max(t, y) >= 0.25 else 1.0
    rise *= unit
    run *= unit
    return (rise if t < 0.25 else p_a - p_b) / (run if y < 0.25 else v_a - v_b)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _add_term(work, mu, alpha, S, D):
    """Add a term of Ogden's law to the energy and to the principal values."""
    L = LANES
    for l in range(LANES):
        x0, x1, x2, m, a = (
            work[LOGS + l],
            work[LOGS + L + l],
            work[LOGS + 2 * L + l],
            mu[l],
            alpha[l],
        )
        middle, half = THIRD * (x0 + x1 + x2), 0.5 * a
        p0 = _exp(half * (x0 - middle))
        p1 = _exp(half * (x1 - middle))
        p2 = _exp(half * (x2 - middle))
        mean = THIRD * (p0 + p1 + p2)
        S[6 * L + l] += 3.0 * (m / a) * (mean - 1.0)
        work[BETA + l] += m * (p0 - mean)
        work[BETA + L + l] += m * (p1 - mean)
        work[BETA + 2 * L + l] += m * (p2 - mean)
        if D is not None:
            f = THIRD * m * a
            work[GAMMA + l] += f * (mean + p0)
            work[GAMMA + L + l] += f * (mean + p1)
            work[GAMMA + 2 * L + l] += f * (mean + p2)
            work[GAMMA + 3 * L + l] += f * (mean - p0 - p1)
            work[GAMMA + 4 * L + l] += f * (mean - p0 - p2)
            work[GAMMA + 5 * L + l] += f * (mean - p1 - p2)
            v0, v1, v2 = work[SQUARES + l], work[SQUARES + L + l], work[SQUARES + 2 * L + l]
            z01, z02, z12 = 0.5 * (x0 - x1), 0.5 * (x0 - x2), 0.5 * (x1 - x2)
            work[SLOPES + l] += m * _slope(p0, p1, v0, v1, half, z01)
            work[SLOPES + L + l] += m * _slope(p0, p2, v0, v2, half, z02)
            work[SLOPES + 2 * L + l] += m * _slope(p1, p2, v1, v2, half, z12)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _add_volumetric(work, E, bulk, S, D):
    """Add U = κ/2 (J - 1)² to the energy and to the principal values."""
    L = LANES
    for l in range(LANES):
        J = E[6 * L + l]
        d_u = bulk[l] * (J - 1.0)
        S[6 * L + l] += 0.5 * d_u * (J - 1.0)
        stress = J * d_u
        work[BETA + l] += stress
        work[BETA + L + l] += stress
        work[BETA + 2 * L + l] += stress
        if D is not None:
            slope = J * (d_u + J * bulk[l])
            work[GAMMA + l] += slope
            work[GAMMA + L + l] += slope
            work[GAMMA + 2 * L + l] += slope
            work[GAMMA + 3 * L + l] += slope
            work[GAMMA + 4 * L + l] += slope
            work[GAMMA + 5 * L + l] += slope


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _principal_tangent(work, D):
    """Write D = Σ_ab n_ab N_a ⊗ N_b + Σ_a<b s_ab M_ab ⊗ M_ab; Holzapfel, section 6.6.

    N_a = a ⊗ a, M_ab = a ⊗ b + b ⊗ a, n_ab = (γ_ab - 2 β_a δ_ab) / (v_a v_b) and
    s_ab = (S_a - S_b) / (v_a - v_b). Overwrites the principal values.
    """
    L = LANES
    V, v, beta = work[VECTORS:SQUARES], work[SQUARES:LOGS], work[BETA:SLOPES]
    slopes, gamma = work[SLOPES:GAMMA], work[GAMMA:]
    for l in range(LANES):
        r0, r1, r2 = 1.0 / v[l], 1.0 / v[L + l], 1.0 / v[2 * L + l]
        b0, b1, b2 = beta[l], beta[L + l], beta[2 * L + l]
        s01 = slopes[l] * (v[l] + v[L + l]) - b0 - b1
        s02 = slopes[L + l] * (v[l] + v[2 * L + l]) - b0 - b2
        s12 = slopes[2 * L + l] * (v[L + l] + v[2 * L + l]) - b1 - b2
        slopes[l], slopes[L + l] = 0.5 * s01 * r0 * r1, 0.5 * s02 * r0 * r2
        slopes[2 * L + l] = 0.5 * s12 * r1 * r2
        gamma[l] = (gamma[l] - 2.0 * b0) * r0 * r0
        gamma[L + l] = (gamma[L + l] - 2.0 * b1) * r1 * r1
        gamma[2 * L + l] = (gamma[2 * L + l] - 2.0 * b2) * r2 * r2
        gamma[3 * L + l] *= r0 * r1
        gamma[4 * L + l] *= r0 * r2
        gamma[5 * L + l] *= r1 * r2
    pairs = np.empty(72 * L)
    for m in range(6):
        i, j, pair = V[3 * _I[m] * L :], V[3 * _J[m] * L :], pairs[12 * m * L :]
        for l in range(LANES):
            n0, n1, n2 = i[l] * j[l], i[L + l] * j[L + l], i[2 * L + l] * j[2 * L + l]
            m0 = i[l] * j[L + l] + i[L + l] * j[l]
            m1 = i[l] * j[2 * L + l] + i[2 * L + l] * j[l]
            m2 = i[L + l] * j[2 * L + l] + i[2 * L + l] * j[L + l]
            g01, g02, g12 = gamma[3 * L + l], gamma[4 * L + l], gamma[5 * L + l]
            pair[l], pair[L + l], pair[2 * L + l] = n0, n1, n2
            pair[3 * L + l], pair[4 * L + l], pair[5 * L + l] = m0, m1, m2
            pair[6 * L + l] = gamma[l] * n0 + g01 * n1 + g02 * n2
            pair[7 * L + l] = g01 * n0 + gamma[L + l] * n1 + g12 * n2
            pair[8 * L + l] = g02 * n0 + g12 * n1 + gamma[2 * L + l] * n2
            pair[9 * L + l] = slopes[l] * m0
            pair[10 * L + l] = slopes[L + l] * m1
            pair[11 * L + l] = slopes[2 * L + l] * m2
    c = 0
    for m in range(6):
        for n in range(m, 6):
            x, y, out = pairs[12 * m * L :], pairs[(12 * n + 6) * L :], D[c * L :]
            for l in range(LANES):
                normal = x[l] * y[l] + x[L + l] * y[L + l] + x[2 * L + l] * y[2 * L + l]
                shear = x[3 * L + l] * y[3 * L + l] + x[4 * L + l] * y[4 * L + l]
                out[l] = normal + (shear + x[5 * L + l] * y[5 * L + l])
            c += 1


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _principal_stress(work, S, D):
    """Write S = Σ_a β_a / v_a a ⊗ a from the principal values, and D if it is not None."""
    L = LANES
    V, v, beta = work[VECTORS:SQUARES], work[SQUARES:LOGS], work[BETA:SLOPES]
    for l in range(LANES):
        s0, s1, s2 = beta[l] / v[l], beta[L + l] / v[L + l], beta[2 * L + l] / v[2 * L + l]
        a0, a1, a2 = V[l], V[L + l], V[2 * L + l]
        b0, b1, b2 = V[3 * L + l], V[4 * L + l], V[5 * L + l]
        c0, c1, c2 = V[6 * L + l], V[7 * L + l], V[8 * L + l]
        x0, x1, x2 = s0 * a0, s1 * a1, s2 * a2
        y0, y1, y2 = s0 * b0, s1 * b1, s2 * b2
        S[l] = x0 * a0 + x1 * a1 + x2 * a2
        S[L + l] = y0 * b0 + y1 * b1 + y2 * b2
        S[2 * L + l] = s0 * c0 * c0 + s1 * c1 * c1 + s2 * c2 * c2
        S[3 * L + l] = x0 * b0 + x1 * b1 + x2 * b2
        S[4 * L + l] = x0 * c0 + x1 * c1 + x2 * c2
        S[5 * L + l] = y0 * c0 + y1 * c1 + y2 * c2
    if D is not None:
        _principal_tangent(work, D)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _ogden(E, p, S, D):
    """Ogden, W = Σ μ_p/α_p (λ̄₁^α_p + λ̄₂^α_p + λ̄₃^α_p - 3) + κ/2 (J - 1)².

    λ̄ = J^(-1/3) λ; p = (κ, μ₁, α₁, μ₂, α₂, …). Holzapfel, sections 6.5 and 6.6.
    """
    L = LANES
    work = np.empty(33 * LANES)
    A, v, logs = work[:VECTORS], work[SQUARES:LOGS], work[LOGS:BETA]
    A[:] = E[: 6 * L]
    work[BETA:] = 0.0
    _diagonalise(A, work[VECTORS:SQUARES])
    for l in range(3 * LANES):
        v[l] = max(1.0 + 2.0 * A[l], 1e-300)
        logs[l] = _log(v[l])
    S[6 * L :] = 0.0
    for k in range(1, len(p) // LANES, 2):
        _add_term(work, p[k * L : (k + 1) * L], p[(k + 1) * L : (k + 2) * L], S, D)
    _add_volumetric(work, E, p[:L], S, D)
    _principal_stress(work, S, D)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _corotational(E, p, S, D):
    """Corotational linear elasticity, W = μ Σ (λ_a - 1)² + λ/2 (Σ (λ_a - 1))²; p = (λ, μ).

    This is Hooke's law of U - I, with F = R U. Its β_a - β_b has the factor λ_a - λ_b, so that the
    division by v_a - v_b is exact.
    """
    L = LANES
    work = np.empty(33 * LANES)
    A, v = work[:VECTORS], work[SQUARES:LOGS]
    A[:] = E[: 6 * L]
    _diagonalise(A, work[VECTORS:SQUARES])
    for l in range(3 * LANES):
        v[l] = max(1.0 + 2.0 * A[l], 1e-300)
    for l in range(LANES):
        lam, twice = p[l], 2.0 * p[L + l]
        s0, s1, s2 = sqrt(v[l]), sqrt(v[L + l]), sqrt(v[2 * L + l])
        # λ_a - 1 without the loss of digits at small strains.
        e0, e1 = 2.0 * A[l] / (1.0 + s0), 2.0 * A[L + l] / (1.0 + s1)
        e2 = 2.0 * A[2 * L + l] / (1.0 + s2)
        trace = e0 + e1 + e2
        pressure = lam * trace
        S[6 * L + l] = 0.5 * (twice * (e0 * e0 + e1 * e1 + e2 * e2) + pressure * trace)
        b0, b1 = s0 * (twice * e0 + pressure), s1 * (twice * e1 + pressure)
        b2 = s2 * (twice * e2 + pressure)
        work[BETA + l], work[BETA + L + l], work[BETA + 2 * L + l] = b0, b1, b2
        if D is not None:
            stiff, rest = twice + lam, pressure - twice
            work[GAMMA + l] = b0 + stiff * v[l]
            work[GAMMA + L + l] = b1 + stiff * v[L + l]
            work[GAMMA + 2 * L + l] = b2 + stiff * v[2 * L + l]
            work[GAMMA + 3 * L + l] = lam * (s0 * s1)
            work[GAMMA + 4 * L + l] = lam * (s0 * s2)
            work[GAMMA + 5 * L + l] = lam * (s1 * s2)
            work[SLOPES + l] = twice + rest / (s0 + s1)
            work[SLOPES + L + l] = twice + rest / (s0 + s2)
            work[SLOPES + 2 * L + l] = twice + rest / (s1 + s2)
    _principal_stress(work, S, D)


_I = np.array([0, 1, 2, 0, 0, 1])
_J = np.array([0, 1, 2, 1, 2, 2])


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _component(u, g, i, j, l, n):
    """Return H_ij = Σ_a u_a,i g_a,j of 4, 8 or 10 nodes; LLVM would not vectorise a loop."""
    L = LANES
    h = u[i * L + l] * g[j * L + l] + u[(3 + i) * L + l] * g[(3 + j) * L + l]
    h += u[(6 + i) * L + l] * g[(6 + j) * L + l] + u[(9 + i) * L + l] * g[(9 + j) * L + l]
    if n >= 8:
        h += u[(12 + i) * L + l] * g[(12 + j) * L + l] + u[(15 + i) * L + l] * g[(15 + j) * L + l]
        h += u[(18 + i) * L + l] * g[(18 + j) * L + l] + u[(21 + i) * L + l] * g[(21 + j) * L + l]
    if n == 10:
        h += u[(24 + i) * L + l] * g[(24 + j) * L + l] + u[(27 + i) * L + l] * g[(27 + j) * L + l]
    return h


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _displacement_gradient(u, g, H, n):
    """Write H_ij = Σ_a u_a,i g_a,j of a batch of cells with n nodes."""
    L = LANES
    for l in range(LANES):
        H[l] = _component(u, g, 0, 0, l, n)
        H[L + l] = _component(u, g, 0, 1, l, n)
        H[2 * L + l] = _component(u, g, 0, 2, l, n)
        H[3 * L + l] = _component(u, g, 1, 0, l, n)
        H[4 * L + l] = _component(u, g, 1, 1, l, n)
        H[5 * L + l] = _component(u, g, 1, 2, l, n)
        H[6 * L + l] = _component(u, g, 2, 0, l, n)
        H[7 * L + l] = _component(u, g, 2, 1, l, n)
        H[8 * L + l] = _component(u, g, 2, 2, l, n)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _strain(H, w, F, totals):
    """Write F (9), E (6), det F and the weights to ``F`` (17) of a batch; update min det F.

    E is formed from H, because FᵀF - I would lose the digits of a small strain. Laws have no
    meaning where det F <= 0: such a point is taken at rest with no weight and infinite energy.
    """
    L = LANES
    for l in range(LANES):
        h00, h01, h02 = H[l], H[L + l], H[2 * L + l]
        h10, h11, h12 = H[3 * L + l], H[4 * L + l], H[5 * L + l]
        h20, h21, h22 = H[6 * L + l], H[7 * L + l], H[8 * L + l]
        f00, f11, f22 = 1.0 + h00, 1.0 + h11, 1.0 + h22
        det = (
            f00 * (f11 * f22 - h12 * h21)
            - h01 * (h10 * f22 - h12 * h20)
            + h02 * (h10 * h21 - f11 * h20)
        )
        is_valid = det > 0.0
        k = 0.5 if is_valid else 0.0
        F[l], F[L + l], F[2 * L + l] = f00, h01, h02
        F[3 * L + l], F[4 * L + l], F[5 * L + l] = h10, f11, h12
        F[6 * L + l], F[7 * L + l], F[8 * L + l] = h20, h21, f22
        F[9 * L + l] = k * (h00 + h00 + h00 * h00 + h10 * h10 + h20 * h20)
        F[10 * L + l] = k * (h11 + h11 + h01 * h01 + h11 * h11 + h21 * h21)
        F[11 * L + l] = k * (h22 + h22 + h02 * h02 + h12 * h12 + h22 * h22)
        F[12 * L + l] = k * (h01 + h10 + h00 * h01 + h10 * h11 + h20 * h21)
        F[13 * L + l] = k * (h02 + h20 + h00 * h02 + h10 * h12 + h20 * h22)
        F[14 * L + l] = k * (h12 + h21 + h01 * h02 + h11 * h12 + h21 * h22)
        F[15 * L + l] = det if is_valid else 1.0
        F[16 * L + l] = w[l] if is_valid else 0.0
        totals[l] = totals[l] if is_valid else np.inf
        totals[L + l] = min(totals[L + l], det if w[l] != 0.0 else np.inf)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _weigh(F, S, P, totals):
    """Multiply S by the weights, write P = F S, and add the energy."""
    L = LANES
    for l in range(LANES):
        w = F[16 * L + l]
        totals[l] += w * S[6 * L + l]
        s00, s11, s22 = w * S[l], w * S[L + l], w * S[2 * L + l]
        s01, s02, s12 = w * S[3 * L + l], w * S[4 * L + l], w * S[5 * L + l]
        S[l], S[L + l], S[2 * L + l] = s00, s11, s22
        S[3 * L + l], S[4 * L + l], S[5 * L + l] = s01, s02, s12
        f0, f1, f2 = F[l], F[L + l], F[2 * L + l]
        P[l] = f0 * s00 + f1 * s01 + f2 * s02
        P[L + l] = f0 * s01 + f1 * s11 + f2 * s12
        P[2 * L + l] = f0 * s02 + f1 * s12 + f2 * s22
        f0, f1, f2 = F[3 * L + l], F[4 * L + l], F[5 * L + l]
        P[3 * L + l] = f0 * s00 + f1 * s01 + f2 * s02
        P[4 * L + l] = f0 * s01 + f1 * s11 + f2 * s12
        P[5 * L + l] = f0 * s02 + f1 * s12 + f2 * s22
        f0, f1, f2 = F[6 * L + l], F[7 * L + l], F[8 * L + l]
        P[6 * L + l] = f0 * s00 + f1 * s01 + f2 * s02
        P[7 * L + l] = f0 * s01 + f1 * s11 + f2 * s12
        P[8 * L + l] = f0 * s02 + f1 * s12 + f2 * s22


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _turned(x, f0, f1, f2):
    """Return the symmetric matrix of 6 components times a vector."""
    x0, x1, x2, x3, x4, x5 = x
    return (
        x0 * f0 + x3 * f1 + x4 * f2,
        x3 * f0 + x1 * f1 + x5 * f2,
        x4 * f0 + x5 * f1 + x2 * f2,
    )


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _derivative(F, S, D, X, A):
    """Write A_iJkL = w F_iM D_MJNL F_kN + δ_ik S_JL, with the weighted S; X (18) is work."""
    L = LANES
    for k in range(3):
        f = F[3 * k * L : (3 * k + 3) * L]
        for l in range(LANES):
            w = F[16 * L + l]
            f0, f1, f2 = w * f[l], w * f[L + l], w * f[2 * L + l]
            d01, d02, d03, d04, d05 = (
                D[L + l],
                D[2 * L + l],
                D[3 * L + l],
                D[4 * L + l],
                D[5 * L + l],
            )
            d12, d13, d14, d15 = D[7 * L + l], D[8 * L + l], D[9 * L + l], D[10 * L + l]
            d23, d24, d25 = D[12 * L + l], D[13 * L + l], D[14 * L + l]
            d34, d35, d45 = D[16 * L + l], D[17 * L + l], D[19 * L + l]
            x = _turned((D[l], d01, d02, d03, d04, d05), f0, f1, f2)
            X[l], X[L + l], X[2 * L + l] = x
            x = _turned((d01, D[6 * L + l], d12, d13, d14, d15), f0, f1, f2)
            X[3 * L + l], X[4 * L + l], X[5 * L + l] = x
            x = _turned((d02, d12, D[11 * L + l], d23, d24, d25), f0, f1, f2)
            X[6 * L + l], X[7 * L + l], X[8 * L + l] = x
            x = _turned((d03, d13, d23, D[15 * L + l], d34, d35), f0, f1, f2)
            X[9 * L + l], X[10 * L + l], X[11 * L + l] = x
            x = _turned((d04, d14, d24, d34, D[18 * L + l], d45), f0, f1, f2)
            X[12 * L + l], X[13 * L + l], X[14 * L + l] = x
            x = _turned((d05, d15, d25, d35, d45, D[20 * L + l]), f0, f1, f2)
            X[15 * L + l], X[16 * L + l], X[17 * L + l] = x
        for i in range(k + 1):
            for n in range(3):
                y = X[n * L :]
                for l in range(LANES):
                    f0, f1, f2 = F[3 * i * L + l], F[(3 * i + 1) * L + l], F[(3 * i + 2) * L + l]
                    x = y[l], y[3 * L + l], y[6 * L + l], y[9 * L + l], y[12 * L + l], y[15 * L + l]
                    a0, a1, a2 = _turned(x, f0, f1, f2)
                    o = (27 * i + 3 * k + n) * L + l
                    A[o], A[o + 9 * L], A[o + 18 * L] = a0, a1, a2
        for i in range(k):
            for j in range(3):
                for n in range(3):
                    here, there = (27 * k + 9 * n + 3 * i + j) * L, (27 * i + 9 * j + 3 * k + n) * L
                    for l in range(LANES):
                        A[here + l] = A[there + l]
        o = 30 * k * L
        for l in range(LANES):
            A[o + l] += S[l]
            A[o + L + l] += S[3 * L + l]
            A[o + 2 * L + l] += S[4 * L + l]
            A[o + 9 * L + l] += S[3 * L + l]
            A[o + 10 * L + l] += S[L + l]
            A[o + 11 * L + l] += S[5 * L + l]
            A[o + 18 * L + l] += S[4 * L + l]
            A[o + 19 * L + l] += S[5 * L + l]
            A[o + 20 * L + l] += S[2 * L + l]


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add_row(f, g, a, p, i, l):
    """Add f_a,i += P_i · g_a for one node."""
    L = LANES
    f[(3 * a + i) * L + l] += (
        p[0] * g[3 * a * L + l] + p[1] * g[(3 * a + 1) * L + l] + p[2] * g[(3 * a + 2) * L + l]
    )


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add_forces(P, g, f, n):
    """Add f_a,i += P_iJ g_a,J of a batch."""
    L = LANES
    for i in range(3):
        rows = P[3 * i * L :]
        for l in range(LANES):
            p = rows[l], rows[L + l], rows[2 * L + l]
            _add_row(f, g, 0, p, i, l)
            _add_row(f, g, 1, p, i, l)
            _add_row(f, g, 2, p, i, l)
            _add_row(f, g, 3, p, i, l)
            if n >= 8:
                _add_row(f, g, 4, p, i, l)
                _add_row(f, g, 5, p, i, l)
                _add_row(f, g, 6, p, i, l)
                _add_row(f, g, 7, p, i, l)
            if n == 10:
                _add_row(f, g, 8, p, i, l)
                _add_row(f, g, 9, p, i, l)


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _add_blocks(g, A, T, k_e, n):
    """Add g_a · A · g_b of a batch to the upper entries k_e; T (27) is work for g_a · A."""
    L = LANES
    o = 0
    for a in range(n):
        ga = g[3 * a * L : (3 * a + 3) * L]
        for i in range(3):
            for k in range(3):
                x, t = A[(27 * i + 3 * k) * L :], T[(9 * i + 3 * k) * L :]
                for l in range(LANES):
                    g0, g1, g2 = ga[l], ga[L + l], ga[2 * L + l]
                    t[l] = g0 * x[l] + g1 * x[9 * L + l] + g2 * x[18 * L + l]
                    t[L + l] = g0 * x[L + l] + g1 * x[10 * L + l] + g2 * x[19 * L + l]
                    t[2 * L + l] = g0 * x[2 * L + l] + g1 * x[11 * L + l] + g2 * x[20 * L + l]
        block = k_e[o * L : (o + 6) * L]
        for l in range(LANES):
            g0, g1, g2 = ga[l], ga[L + l], ga[2 * L + l]
            block[l] += T[l] * g0 + T[L + l] * g1 + T[2 * L + l] * g2
            block[L + l] += T[3 * L + l] * g0 + T[4 * L + l] * g1 + T[5 * L + l] * g2
            block[2 * L + l] += T[6 * L + l] * g0 + T[7 * L + l] * g1 + T[8 * L + l] * g2
            block[3 * L + l] += T[12 * L + l] * g0 + T[13 * L + l] * g1 + T[14 * L + l] * g2
            block[4 * L + l] += T[15 * L + l] * g0 + T[16 * L + l] * g1 + T[17 * L + l] * g2
            block[5 * L + l] += T[24 * L + l] * g0 + T[25 * L + l] * g1 + T[26 * L + l] * g2
        o += 6
        for b in range(a + 1, n):
            gb, block = g[3 * b * L : (3 * b + 3) * L], k_e[o * L : (o + 9) * L]
            for l in range(LANES):
                g0, g1, g2 = gb[l], gb[L + l], gb[2 * L + l]
                block[l] += T[l] * g0 + T[L + l] * g1 + T[2 * L + l] * g2
                block[L + l] += T[3 * L + l] * g0 + T[4 * L + l] * g1 + T[5 * L + l] * g2
                block[2 * L + l] += T[6 * L + l] * g0 + T[7 * L + l] * g1 + T[8 * L + l] * g2
                block[3 * L + l] += T[9 * L + l] * g0 + T[10 * L + l] * g1 + T[11 * L + l] * g2
                block[4 * L + l] += T[12 * L + l] * g0 + T[13 * L + l] * g1 + T[14 * L + l] * g2
                block[5 * L + l] += T[15 * L + l] * g0 + T[16 * L + l] * g1 + T[17 * L + l] * g2
                block[6 * L + l] += T[18 * L + l] * g0 + T[19 * L + l] * g1 + T[20 * L + l] * g2
                block[7 * L + l] += T[21 * L + l] * g0 + T[22 * L + l] * g1 + T[23 * L + l] * g2
                block[8 * L + l] += T[24 * L + l] * g0 + T[25 * L + l] * g1 + T[26 * L + l] * g2
            o += 9


NEAR, FAR = 0.13819660112501053, 0.58541019662496841
"""Barycentric coordinates of the points of T10: point q has FAR at corner q, NEAR at the others."""

RISE = 4.0 * (FAR - NEAR)
"""Difference of the factor of a node in c (see `_corner_displacements`) between two points."""

_MIDDLE = np.array([0, 4, 6, 7, 4, 1, 5, 8, 6, 5, 2, 9, 7, 8, 9, 3])
"""Node of T10 in the middle between corners i and j, at 4 i + j; a corner between it and itself."""


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _corner_gradients(three, g):
    """Return g (1, 12): gradients of barycentric coordinates, from those of the last three (1, 9).

    Their sum is zero.
    """
    N, x, out = 3 * LANES, three[0], g[0]
    for k in range(N):
        out[k], out[N + k] = -(x[k] + x[N + k] + x[2 * N + k]), x[k]
        out[2 * N + k], out[3 * N + k] = x[N + k], x[2 * N + k]
    return g


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _quadratic_gradients(corners, q, g):
    """Return g (30), gradients of the shape functions of a straight T10 at its q-th point."""
    N = 3 * LANES
    for i in range(4):
        at_i = 4.0 * (FAR if i == q else NEAR)
        for j in range(i + 1):
            at_j = 4.0 * (FAR if j == q else NEAR)
            x, y, out = corners[i * N :], corners[j * N :], g[_MIDDLE[4 * i + j] * N :]
            both = at_i - 1.0 - at_j if i == j else at_i
            for k in range(N):
                out[k] = at_j * x[k] + both * y[k]
    return g


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _mean_corners(u, work):
    """Write what `_corner_displacements` has in common at all points (12), and zeros (9)."""
    N = 3 * LANES
    work[8 * N :] = 0.0
    for i in range(4):
        m, n, o = (i + 1) % 4, (i + 2) % 4, (i + 3) % 4
        x, out = u[i * N : (i + 1) * N], work[(4 + i) * N : (5 + i) * N]
        y0, y1, y2 = (
            u[_MIDDLE[4 * i + m] * N :],
            u[_MIDDLE[4 * i + n] * N :],
            u[_MIDDLE[4 * i + o] * N :],
        )
        for k in range(N):
            out[k] = (4.0 * NEAR - 1.0) * x[k] + 4.0 * NEAR * (y0[k] + y1[k] + y2[k])


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _corner_displacements(u, q, work):
    """Return c (12) at point q of a straight T10, with du/dX = Σ_i c_i ⊗ grad λ_i.

    c_i = (4 λ_i - 1) u_i + 4 Σ_j λ_j u_ij, with u_ij of the middle between corners i and j.
    """
    N = 3 * LANES
    for i in range(4):
        x, y, out = work[(4 + i) * N : (5 + i) * N], u[_MIDDLE[4 * i + q] * N :], work[i * N :]
        for k in range(N):
            out[k] = x[k] + RISE * y[k]
    return work[: 4 * N]


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _add_quadratic_forces(P, corners, q, work, f):
    """Add to f (30) forces conjugate to `_corner_displacements`, and P to its sum (9)."""
    L = LANES
    total = work[24 * L :]
    for i in range(4):
        g, out = corners[3 * i * L : (3 * i + 3) * L], f[3 * _MIDDLE[4 * i + q] * L :]
        for l in range(LANES):
            g0, g1, g2 = RISE * g[l], RISE * g[L + l], RISE * g[2 * L + l]
            out[l] += P[l] * g0 + P[L + l] * g1 + P[2 * L + l] * g2
            out[L + l] += P[3 * L + l] * g0 + P[4 * L + l] * g1 + P[5 * L + l] * g2
            out[2 * L + l] += P[6 * L + l] * g0 + P[7 * L + l] * g1 + P[8 * L + l] * g2
    for k in range(9 * L):
        total[k] += P[k]


@njit(error_model="numpy", fastmath={"contract", "nsz"})
def _add_mean_forces(corners, work, f):
    """Add to f (30) the forces conjugate to `_mean_corners`, of the sum of P over the points."""
    N = 3 * LANES
    t = work[: 4 * N]
    t[:] = 0.0
    _add_forces(work[8 * N :], corners, t, 4)
    for i in range(4):
        x, out = t[i * N :], f[i * N :]
        for k in range(N):
            out[k] += (4.0 * NEAR - 1.0) * x[k]
        for j in range(i):
            y, out = t[j * N :], f[_MIDDLE[4 * i + j] * N :]
            for k in range(N):
                out[k] += 4.0 * NEAR * (x[k] + y[k])


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _gather(u, dofs, u_e, n):
    """Copy the displacements of the nodes of a batch; numba tests signed indices for < 0."""
    L = LANES
    for a in range(n):
        for l in range(LANES):
            d, o = np.uint64(dofs[a, l]), 3 * a * L + l
            u_e[o], u_e[o + L], u_e[o + 2 * L] = u[d], u[d + np.uint64(1)], u[d + np.uint64(2)]


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _add_node(f, dofs, a, l, force):
    """Add the three forces of node a of cell l."""
    L = LANES
    d, o = np.uint64(dofs[a, l]), 3 * a * L + l
    force[d] += f[o]
    force[d + np.uint64(1)] += f[o + L]
    force[d + np.uint64(2)] += f[o + 2 * L]


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _scatter(f, dofs, force, n):
    """Add the nodal forces f of a batch of cells with n nodes to ``force``.

    Neighbouring tetrahedra share nodes. If the inner loop ran over them, each sum would wait for
    the one before it.
    """
    if n == 8:
        for a in range(n):
            for l in range(LANES):
                _add_node(f, dofs, a, l, force)
    else:
        for l in range(LANES):
            for a in range(n):
                _add_node(f, dofs, a, l, force)


@njit(forceinline=True, error_model="numpy", fastmath={"contract", "nsz"})
def _move_tangents(k_e, slots, values):
    """Add the upper entries k_e of a batch to ``values``, and set them to zero."""
    for o in range(len(slots)):
        for l in range(LANES):
            values[slots[o, l]] += k_e[o * LANES + l]
    k_e[:] = 0.0


# Longer than 60 lines because numba knows the constants of a kernel only where it is defined.
@cache
def general_force(law: int, n_nodes: int, is_straight: bool):
    """Return the kernel ``force(u, dofs, gradients, weights, parameters, slots, force, values)``.

    It adds the internal force of batches of cells to ``force`` and, if it is not None, the tangent
    to ``values``. numba prunes the other laws, because ``law`` is a constant for it.

    Parameters of the kernel
    ------------------------
    u : (n,) float64
        Displacements, m. Fixed nodes and padding read zeros behind the unknowns.
    dofs : (n_batches, n_nodes, LANES) uint32
        First of the three entries of each node in ``u`` and ``force``.
    gradients : (n, n_points, 3 n_nodes * LANES) or (n, 1, 9 * LANES) float64
        dN_a/dX_j at entry (3a + j) * LANES + lane, 1/m. Batch b has those of b mod n. Straight
        tetrahedra have the gradients of their last three barycentric coordinates.
    weights : (n_batches, n_points, LANES) float64
        Quadrature weight times det J, m³; zero for padding.
    parameters : (n_points, n_parameters * LANES) float64
        Law parameters of each quadrature point. A point may carry only the volumetric part, or
        only the rest.
    slots : (n_batches, n_upper, LANES) int32 or None
    force : (n,) float64
    values : (n_upper_nonzeros + 1,) float64 or None

    Returns
    -------
    (float, float)
        Stored energy, J, and the smallest det F over all quadrature points. The energy is infinite
        where det F <= 0, because the laws have no meaning there.
    """

    is_quadratic = is_straight and n_nodes == 10

    @njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
    def kernel(u, dofs, gradients, weights, parameters, slots, force, values):
        L = LANES
        u_e, f_e = np.empty(3 * n_nodes * L), np.empty(3 * n_nodes * L)
        corners, work, g = np.empty((1, 12 * L)), np.empty(33 * L), np.empty(30 * L)
        H, F, S, P = np.empty(9 * L), np.empty(17 * L), np.empty(7 * L), np.empty(9 * L)
        E, D = F[9 * L : 16 * L], None if values is None else np.empty(21 * L)
        totals = np.zeros(2 * L)
        totals[L:] = np.inf
        if values is not None:
            X, A, T = np.empty(18 * L), np.empty(81 * L), np.empty(27 * L)
            k_e = np.zeros(slots.shape[1] * L)
        for b in range(dofs.shape[0]):
            _gather(u, dofs[b], u_e, n_nodes)
            f_e[:] = 0.0
            given = gradients[b % gradients.shape[0]]
            shapes = _corner_gradients(given, corners) if is_straight else given
            if is_quadratic:
                _mean_corners(u_e, work)
            for q in range(len(parameters)):
                if is_quadratic:
                    _displacement_gradient(_corner_displacements(u_e, q, work), corners[0], H, 4)
                else:
                    _displacement_gradient(u_e, shapes[q], H, n_nodes)
                _strain(H, weights[b, q], F, totals)
                if law == SAINT_VENANT_KIRCHHOFF:
                    _saint_venant_kirchhoff(E, parameters[q], S, D)
                elif law == NEO_HOOKEAN:
                    _neo_hookean(E, parameters[q], S, D)
                elif law == MOONEY_RIVLIN:
                    _mooney_rivlin(E, parameters[q], S, D)
                elif law == YEOH:
                    _yeoh(E, parameters[q], S, D)
                elif law == COROTATIONAL:
                    _corotational(E, parameters[q], S, D)
                elif law == HOLZAPFEL_GASSER_OGDEN:
                    _holzapfel_gasser_ogden(E, parameters[q], S, D)
                else:
                    _ogden(E, parameters[q], S, D)
                _weigh(F, S, P, totals)
                if is_quadratic:
                    _add_quadratic_forces(P, corners[0], q, work, f_e)
                else:
                    _add_forces(P, shapes[q], f_e, n_nodes)
                if values is not None:
                    _derivative(F, S, D, X, A)
                    own = _quadratic_gradients(corners[0], q, g) if is_quadratic else shapes[q]
                    _add_blocks(own, A, T, k_e, n_nodes)
            if is_quadratic:
                _add_mean_forces(corners[0], work, f_e)
            _scatter(f_e, dofs[b], force, n_nodes)
            if values is not None:
                _move_tangents(k_e, slots[b], values)
        return totals[:L].sum(), totals[L:].min()

    return kernel


@cache
def point_stresses(law: int):
    """Return the kernel ``stresses(H, weights, parameters, P, A)`` of the law with this number.

    It writes the weighted first Piola-Kirchhoff stress P and, if A is not None, A = dP/dF.

    Parameters of the kernel
    ------------------------
    H : (n_batches, 9 * LANES) float64
        du/dX; point l of a batch has component (i, J) at (3i + J) * LANES + l.
    weights : (n_batches, LANES) float64
        Zero for padding.
    parameters : (n_batches, n_parameters * LANES) float64
        Law parameters of each point, valid ones for padding too.
    P : (n_batches, 9 * LANES) float64
    A : (n_batches, 81 * LANES) float64 or None
        Component (i, J, k, L) at (9 (3i + J) + 3k + L) * LANES + l.

    Returns
    -------
    (float, float)
        Stored energy and the smallest det F; the energy is infinite where det F <= 0.
    """

    @njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
    def kernel(H, weights, parameters, P, A):
        L = LANES
        F, S, X = np.empty(17 * L), np.empty(7 * L), np.empty(18 * L)
        E, D = F[9 * L : 16 * L], None if A is None else np.empty(21 * L)
        totals = np.zeros(2 * L)
        totals[L:] = np.inf
        for b in range(len(weights)):
            _strain(H[b], weights[b], F, totals)
            if law == SAINT_VENANT_KIRCHHOFF:
                _saint_venant_kirchhoff(E, parameters[b], S, D)
            elif law == NEO_HOOKEAN:
                _neo_hookean(E, parameters[b], S, D)
            elif law == MOONEY_RIVLIN:
                _mooney_rivlin(E, parameters[b], S, D)
            elif law == YEOH:
                _yeoh(E, parameters[b], S, D)
            elif law == COROTATIONAL:
                _corotational(E, parameters[b], S, D)
            elif law == HOLZAPFEL_GASSER_OGDEN:
                _holzapfel_gasser_ogden(E, parameters[b], S, D)
            else:
                _ogden(E, parameters[b], S, D)
            _weigh(F, S, P[b], totals)
            if A is not None:
                _derivative(F, S, D, X, A[b])
        return totals[:L].sum(), totals[L:].min()

    return kernel


SWEEP_MULTIPLY_ADDS = 87
"""Multiply-adds of a Jacobi sweep and of the check before it, per point."""

_LAW_MULTIPLY_ADDS = {
    SAINT_VENANT_KIRCHHOFF: (15, 1),
    NEO_HOOKEAN: (38, 87),
    MOONEY_RIVLIN: (70, 102),
    YEOH: (51, 102),
    COROTATIONAL: (56 + 4 * SWEEP_MULTIPLY_ADDS, 294),
    OGDEN: (40 + 4 * SWEEP_MULTIPLY_ADDS, 284),
    HOLZAPFEL_GASSER_OGDEN: (45, 91),
}
"""Multiply-adds per point for energy and stress, and for the tangent; 4 sweeps are usual."""

_OGDEN_TERM_MULTIPLY_ADDS, _FIBRE_MULTIPLY_ADDS = (15, 128), (33, 135)
"""Those of a term of Ogden's law, and of a family of fibres."""

_STRAIN_MULTIPLY_ADDS, _WEIGH_MULTIPLY_ADDS, _DERIVATIVE_MULTIPLY_ADDS = 33, 34, 333


def point_multiply_adds(law: int, n_parameters: int) -> tuple[int, int]:
    """Return multiply-adds of `point_stresses` per point: without A, and the addition for A."""
    terms, (term_stress, term_tangent) = 0, _OGDEN_TERM_MULTIPLY_ADDS
    if law == OGDEN:
        terms = n_parameters // 2
    elif law == HOLZAPFEL_GASSER_OGDEN:
        terms, (term_stress, term_tangent) = (n_parameters - 4) // 6, _FIBRE_MULTIPLY_ADDS
    by_stress, by_tangent = _LAW_MULTIPLY_ADDS[law]
    stress = _STRAIN_MULTIPLY_ADDS + by_stress + terms * term_stress + _WEIGH_MULTIPLY_ADDS
    return stress, by_tangent + terms * term_tangent + _DERIVATIVE_MULTIPLY_ADDS


def general_multiply_adds(
    law: int, n_parameters: int, n_nodes: int, n_points: int, is_straight: bool
) -> tuple[int, int]:
    """Return multiply-adds of `general_force` per cell: the force alone, and with tangent."""
    stress, derivative = point_multiply_adds(law, n_parameters)
    blocks = n_nodes * (81 + 18) + n_nodes * (n_nodes - 1) // 2 * 27
    shapes, mean, gradients = 18 * n_nodes, 0, 0
    if is_straight and n_nodes == 10:
        shapes, mean, gradients = 96, 90, 60
    force = n_points * (shapes + stress)
    return mean + force, mean + force + n_points * (derivative + gradients + blocks)
