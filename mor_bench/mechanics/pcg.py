"""Conjugate gradients on the tangent, preconditioned by the rest-state factor turned with the body.

A tangent far from rest is, to first order, the rest-state stiffness seen by an observer who turns with each node:
K ≈ R K₀ Rᵀ with R the block-diagonal matrix of nodal rotations, the polar factors of the nodal mean deformation
gradient. One single-precision factor of K₀ hence serves every Newton step of every load (corotational warping: Müller et
al., "Stable real-time deformations", SCA 2002; here it only preconditions, so that the answer stays exact).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mor_bench.mechanics.assembly import Pattern
from mor_bench.mechanics.linear import BandedFactor, NotPositiveDefiniteError

Array = NDArray[np.float64]

MAX_ITERATIONS = 400


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def nodal_rotations(u, cell_nodes, centre_gradients, volumes, rotations):
    """Rotation of the volume-weighted mean deformation gradient of the cells around each free node.

    Parameters
    ----------
    u : (n_free_nodes + 1, 3) float64
        Displacements, m; the last row, of fixed nodes, is zero.
    cell_nodes : (n_cells, n_cell_nodes) int32
    centre_gradients : (n_cells, n_cell_nodes, 3) float64
    volumes : (n_cells,) float64
    rotations : (n_free_nodes + 1, 3, 3) float64
        Overwritten.
    """
    rotations[:] = 0.0
    n = cell_nodes.shape[1]
    H, X, Y = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for c in range(len(cell_nodes)):
        for i in range(3):
            for j in range(3):
                h = 1.0 if i == j else 0.0
                for a in range(n):
                    h += u[cell_nodes[c, a], i] * centre_gradients[c, a, j]
                H[i, j] = volumes[c] * h
        for a in range(n):
            node = cell_nodes[c, a]
            for i in range(3):
                for j in range(3):
                    rotations[node, i, j] += H[i, j]
    for node in range(len(rotations) - 1):
        size = 0.0
        for i in range(3):
            for j in range(3):
                X[i, j] = rotations[node, i, j]
                size += X[i, j] * X[i, j]
        X *= np.sqrt(3.0 / size)
        for _ in range(8):  # Newton's iteration for the polar factor (Higham): quadratic, from within the basin
            Y[0, 0] = X[1, 1] * X[2, 2] - X[1, 2] * X[2, 1]
            Y[0, 1] = X[1, 2] * X[2, 0] - X[1, 0] * X[2, 2]
            Y[0, 2] = X[1, 0] * X[2, 1] - X[1, 1] * X[2, 0]
            Y[1, 0] = X[0, 2] * X[2, 1] - X[0, 1] * X[2, 2]
            Y[1, 1] = X[0, 0] * X[2, 2] - X[0, 2] * X[2, 0]
            Y[1, 2] = X[0, 1] * X[2, 0] - X[0, 0] * X[2, 1]
            Y[2, 0] = X[0, 1] * X[1, 2] - X[0, 2] * X[1, 1]
            Y[2, 1] = X[0, 2] * X[1, 0] - X[0, 0] * X[1, 2]
            Y[2, 2] = X[0, 0] * X[1, 1] - X[0, 1] * X[1, 0]
            det = X[0, 0] * Y[0, 0] + X[0, 1] * Y[0, 1] + X[0, 2] * Y[0, 2]
            if not det > 1e-6:  # a collapsed or mirrored neighbourhood: no rotation to speak of
                X[:] = np.eye(3)
                break
            change = 0.0
            for i in range(3):
                for j in range(3):
                    new = 0.5 * (X[i, j] + Y[i, j] / det)
                    change += abs(new - X[i, j])
                    X[i, j] = new
            if change < 1e-7:
                break
        rotations[node] = X


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _multiply(indptr, indices, values, x, y):
    """y = K x for the symmetric K whose upper triangle is given; all three dofs of a node are neighbours in the pattern."""
    y[:] = 0.0
    for a in range(len(x) // 3):
        i = 3 * a
        r0, r1, r2 = indptr[i], indptr[i + 1], indptr[i + 2]
        x0, x1, x2 = x[i], x[i + 1], x[i + 2]
        y0 = values[r0] * x0 + values[r0 + 1] * x1 + values[r0 + 2] * x2
        y1 = values[r0 + 1] * x0 + values[r1] * x1 + values[r1 + 1] * x2
        y2 = values[r0 + 2] * x0 + values[r1 + 1] * x1 + values[r2] * x2
        n_blocks = (r1 - r0 - 3) // 3
        r0, r1, r2 = r0 + 3, r1 + 2, r2 + 1
        for k in range(n_blocks):
            o = 3 * k
            j = indices[r0 + o]
            k00, k01, k02 = values[r0 + o], values[r0 + o + 1], values[r0 + o + 2]
            k10, k11, k12 = values[r1 + o], values[r1 + o + 1], values[r1 + o + 2]
            k20, k21, k22 = values[r2 + o], values[r2 + o + 1], values[r2 + o + 2]
            z0, z1, z2 = x[j], x[j + 1], x[j + 2]
            y0 += k00 * z0 + k01 * z1 + k02 * z2
            y1 += k10 * z0 + k11 * z1 + k12 * z2
            y2 += k20 * z0 + k21 * z1 + k22 * z2
            y[j] += k00 * x0 + k10 * x1 + k20 * x2
            y[j + 1] += k01 * x0 + k11 * x1 + k21 * x2
            y[j + 2] += k02 * x0 + k12 * x1 + k22 * x2
        y[i] += y0
        y[i + 1] += y1
        y[i + 2] += y2


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _banded_solve(band, x):
    """Solve L Lᵀ x = x in place; band (n, bandwidth + 1) float32 holds the columns of L, diagonals inverted.

    Four columns at once, so that x is loaded and stored once for four multiply-adds.
    """
    n, width = band.shape
    zero = np.float32(0.0)
    whole = n - n % 4
    for j in range(0, whole, 4):
        a, b, c, d = band[j], band[j + 1], band[j + 2], band[j + 3]
        x0 = x[j] * a[0]
        x1 = (x[j + 1] - a[1] * x0) * b[0]
        x2 = (x[j + 2] - a[2] * x0 - b[1] * x1) * c[0]
        x3 = (x[j + 3] - a[3] * x0 - b[2] * x1 - c[1] * x2) * d[0]
        x[j], x[j + 1], x[j + 2], x[j + 3] = x0, x1, x2, x3
        last = min(width - 4, n - j - 4)
        tail = x[j + 4 : j + 4 + last]
        a4, b4, c4, d4 = a[4 : 4 + last], b[3 : 3 + last], c[2 : 2 + last], d[1 : 1 + last]
        for k in range(last):
            tail[k] -= a4[k] * x0 + b4[k] * x1 + c4[k] * x2 + d4[k] * x3
        for k in range(last, min(width - 1, n - j - 4)):  # the ends of b, c, d reach beyond that of a
            at = x[j + 4 + k]
            if k + 3 < width:
                at -= b[k + 3] * x1
            if k + 2 < width:
                at -= c[k + 2] * x2
            at -= d[k + 1] * x3
            x[j + 4 + k] = at
    for j in range(whole, n):
        x[j] *= band[j, 0]
        for k in range(1, n - j):
            x[j + k] -= band[j, k] * x[j]
    for j in range(n - 1, whole - 1, -1):
        s = x[j]
        for k in range(1, n - j):
            s -= band[j, k] * x[j + k]
        x[j] = s * band[j, 0]
    for j in range(whole - 4, -1, -4):
        a, b, c, d = band[j], band[j + 1], band[j + 2], band[j + 3]
        last = min(width - 4, n - j - 4)
        tail = x[j + 4 : j + 4 + last]
        a4, b4, c4, d4 = a[4 : 4 + last], b[3 : 3 + last], c[2 : 2 + last], d[1 : 1 + last]
        s0, s1, s2, s3 = zero, zero, zero, zero
        for k in range(last):
            s0 += a4[k] * tail[k]
            s1 += b4[k] * tail[k]
            s2 += c4[k] * tail[k]
            s3 += d4[k] * tail[k]
        for k in range(last, min(width - 1, n - j - 4)):
            at = x[j + 4 + k]
            if k + 3 < width:
                s1 += b[k + 3] * at
            if k + 2 < width:
                s2 += c[k + 2] * at
            s3 += d[k + 1] * at
        x3 = (x[j + 3] - s3) * d[0]
        x2 = (x[j + 2] - s2 - c[1] * x3) * c[0]
        x1 = (x[j + 1] - s1 - b[1] * x2 - b[2] * x3) * b[0]
        x[j] = (x[j] - s0 - a[1] * x1 - a[2] * x2 - a[3] * x3) * a[0]
        x[j + 1], x[j + 2], x[j + 3] = x1, x2, x3


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _precondition(band, order, rotations, scale, r, work, z):
    """z = R K₀⁻¹ Rᵀ r, the solve in single precision; ``order`` is the factor's place of each node."""
    n_nodes = len(r) // 3
    for a in range(n_nodes):
        Q, i, p = rotations[a], 3 * a, 3 * order[a]
        r0, r1, r2 = scale * r[i], scale * r[i + 1], scale * r[i + 2]
        work[p] = Q[0, 0] * r0 + Q[1, 0] * r1 + Q[2, 0] * r2
        work[p + 1] = Q[0, 1] * r0 + Q[1, 1] * r1 + Q[2, 1] * r2
        work[p + 2] = Q[0, 2] * r0 + Q[1, 2] * r1 + Q[2, 2] * r2
    _banded_solve(band, work)
    for a in range(n_nodes):
        Q, i, p = rotations[a], 3 * a, 3 * order[a]
        w0, w1, w2 = work[p] / scale, work[p + 1] / scale, work[p + 2] / scale
        z[i] = Q[0, 0] * w0 + Q[0, 1] * w1 + Q[0, 2] * w2
        z[i + 1] = Q[1, 0] * w0 + Q[1, 1] * w1 + Q[1, 2] * w2
        z[i + 2] = Q[2, 0] * w0 + Q[2, 1] * w1 + Q[2, 2] * w2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _conjugate_gradients(indptr, indices, values, band, order, rotations, b, tolerance, max_iterations, x):
    """Solve K x = b; returns the iterations, negative where a direction of negative curvature was met."""
    n = len(b)
    r, z, p, q, work = b.copy(), np.empty(n), np.empty(n), np.empty(n), np.empty(n, dtype=np.float32)
    target = tolerance * np.sqrt((b * b).sum())
    x[:] = 0.0
    rz = 0.0
    for iteration in range(1, max_iterations + 1):
        size = np.sqrt((r * r).sum())
        if size <= target:
            return iteration - 1
        _precondition(band, order, rotations, 1.0 / size, r, work, z)
        before = rz
        rz = (r * z).sum()
        if iteration == 1:
            p[:] = z
        else:
            p[:] = z + (rz / before) * p
        _multiply(indptr, indices, values, p, q)
        curvature = (p * q).sum()
        if not curvature > 0.0:
            return -iteration
        alpha = rz / curvature
        x += alpha * p
        r -= alpha * q
    return max_iterations


class RotatedPCG:
    """Solver of tangents by conjugate gradients with the turned rest-state factor as preconditioner.

    Parameters
    ----------
    pattern : Pattern
        Of the tangent; the three dofs of a free node must be neighbours in it.
    rest_factor : BandedFactor
    cell_nodes : (n_cells, n_cell_nodes) int32
        Number of each cell's nodes among the free ones; the number of free nodes for a fixed one.
    centre_gradients : (n_cells, n_cell_nodes, 3) float64
        dN_a/dX at the cells' centres, 1/m.
    volumes : (n_cells,) float64
        m³.

    Attributes
    ----------
    iterations : int
        Of the last solve.
    """

    def __init__(
        self, pattern: Pattern, rest_factor: BandedFactor, cell_nodes: NDArray[np.int32], centre_gradients: Array, volumes: Array
    ) -> None:  # fmt: skip
        self._pattern = pattern
        self._band, order = rest_factor.single_precision()
        self._order = np.ascontiguousarray(order[::3] // 3)
        self._cells = cell_nodes, centre_gradients, volumes
        self.iterations = 0
        self._rotations = np.empty((pattern.n // 3 + 1, 3, 3))

    def solve(self, q: Array, values: Array, rhs: Array, tolerance: float) -> Array:
        """Solve K x = rhs for the tangent at displacements q to a relative tolerance.

        Raises
        ------
        NotPositiveDefiniteError
            Where a direction of negative curvature is met, or the iterations do not suffice.
        """
        nodal_rotations(np.append(q, np.zeros(3)).reshape(-1, 3), *self._cells, self._rotations)
        x = np.empty_like(rhs)
        pattern = self._pattern
        iterations = _conjugate_gradients(
            pattern.indptr, pattern.indices, values, self._band, self._order, self._rotations, rhs, tolerance, MAX_ITERATIONS, x
        )
        self.iterations = abs(iterations)
        if not 0 <= iterations < MAX_ITERATIONS:
            raise NotPositiveDefiniteError
        return x
