"""The rest-state stiffness, rotated with the body, as an approximate inverse of any tangent.

To first order, a tangent is the rest-state stiffness rotated with each node: K ≈ R K₀ Rᵀ. R is the
block-diagonal matrix of nodal rotations. These are the polar factors of the nodal mean deformation
gradients. One single-precision factor of K₀ hence serves every iteration of every load.

Corotational warping: Müller et al., "Stable real-time deformations", SCA 2002. Here it only directs
the iteration, so the answer stays exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mor_bench.counting import count, is_counting, uncounted
from mor_bench.mechanics.linear import Factor, NotPositiveDefiniteError
from mor_bench.mechanics.pattern import Pattern
from mor_bench.mechanics.turned import along_axes, in_frames
from mor_bench.mechanics.warping import Warp

Array = NDArray[np.float64]

MAX_ITERATIONS = 400
"""Iteration limit for conjugate gradients with the rotated factor.

11 to 15 iterations are usual. A tangent that needs more than the limit is nearly singular.
"""


class SingleFactor(Protocol):
    """An exact or approximate factor in single precision, in its own order of unknowns.

    Attributes
    ----------
    place : (n,) int64
        Position of each unknown in that order.
    """

    place: NDArray[np.int64]

    def solve_in_place(self, x: NDArray[np.float32]) -> None:
        """Overwrite the right-hand sides x (m, n) by the solutions."""
        ...


@njit(inline="always")
def _to_rotation(Q):
    """Overwrite a (3, 3) matrix by its polar factor; return the number of iterations."""
    size = 0.0
    for row in range(3):
        for column in range(3):
            size += Q[row, column] * Q[row, column]
    scale = np.sqrt(3.0 / size)
    a, b, c = scale * Q[0, 0], scale * Q[0, 1], scale * Q[0, 2]
    d, e, f = scale * Q[1, 0], scale * Q[1, 1], scale * Q[1, 2]
    g, h, i = scale * Q[2, 0], scale * Q[2, 1], scale * Q[2, 2]
    # Higham's Newton iteration for the polar factor converges quadratically within the basin.
    for iteration in range(1, 9):  # noqa: B007 - returned
        ca, cb, cc = e * i - f * h, f * g - d * i, d * h - e * g
        det = a * ca + b * cb + c * cc
        if not det > 1e-6:  # a collapsed or mirrored neighbourhood has no rotation
            a, b, c, d, e, f, g, h, i = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
            break
        r = 0.5 / det
        cd, ce, cf = c * h - b * i, a * i - c * g, b * g - a * h
        cg, ch, ci = b * f - c * e, c * d - a * f, a * e - b * d
        change = (
            abs(r * ca - 0.5 * a)
            + abs(r * ce - 0.5 * e)
            + abs(r * ci - 0.5 * i)
            + abs(r * cb - 0.5 * b)
            + abs(r * cf - 0.5 * f)
        )
        change += (
            abs(r * cc - 0.5 * c)
            + abs(r * cd - 0.5 * d)
            + abs(r * cg - 0.5 * g)
            + abs(r * ch - 0.5 * h)
        )
        a, b, c = 0.5 * a + r * ca, 0.5 * b + r * cb, 0.5 * c + r * cc
        d, e, f = 0.5 * d + r * cd, 0.5 * e + r * ce, 0.5 * f + r * cf
        g, h, i = 0.5 * g + r * cg, 0.5 * h + r * ch, 0.5 * i + r * ci
        if change < 1e-4:  # the next change would be its square
            break
    Q[0, 0], Q[0, 1], Q[0, 2] = a, b, c
    Q[1, 0], Q[1, 1], Q[1, 2] = d, e, f
    Q[2, 0], Q[2, 1], Q[2, 2] = g, h, i
    return iteration


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def nodal_rotations(u, cell_nodes, centre_gradients, volumes, rotations):
    """Compute each free node's rotation from the mean over volume of its deformation gradient.

    Parameters
    ----------
    u : (n_free_nodes + 1, 3) float64
        Displacements, m; the last row, of fixed nodes, is zero.
    cell_nodes : (n_cells, n_cell_nodes) int32
    centre_gradients : (n_cells, n_cell_nodes, 3) float64
    volumes : (n_cells,) float64
    rotations : (n_free_nodes + 1, 3, 3) float64
        Overwritten.

    Returns
    -------
    int
        Iterations for polar factors, summed over the nodes.
    """
    iterations = 0
    rotations[:] = 0.0
    n = cell_nodes.shape[1]
    for k in range(len(cell_nodes)):
        nodes, G, v = cell_nodes[k], centre_gradients[k], volumes[k]
        h00, h01, h02, h10, h11, h12, h20, h21, h22 = v, 0.0, 0.0, 0.0, v, 0.0, 0.0, 0.0, v
        for m in range(n):
            x, y, z = u[nodes[m], 0], u[nodes[m], 1], u[nodes[m], 2]
            gx, gy, gz = v * G[m, 0], v * G[m, 1], v * G[m, 2]
            h00, h01, h02 = h00 + x * gx, h01 + x * gy, h02 + x * gz
            h10, h11, h12 = h10 + y * gx, h11 + y * gy, h12 + y * gz
            h20, h21, h22 = h20 + z * gx, h21 + z * gy, h22 + z * gz
        for m in range(n):
            Q = rotations[nodes[m]]
            Q[0, 0], Q[0, 1], Q[0, 2] = Q[0, 0] + h00, Q[0, 1] + h01, Q[0, 2] + h02
            Q[1, 0], Q[1, 1], Q[1, 2] = Q[1, 0] + h10, Q[1, 1] + h11, Q[1, 2] + h12
            Q[2, 0], Q[2, 1], Q[2, 2] = Q[2, 0] + h20, Q[2, 1] + h21, Q[2, 2] + h22
    for node in range(len(rotations) - 1):
        iterations += _to_rotation(rotations[node])
    return iterations


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def multiply(indptr, indices, values, x, y):
    """Write K x to y for the symmetric K whose upper triangle has these values in a `Pattern`."""
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _turn_back(place, rotations, scale, r, work):
    """Write scale Rᵀr to work, in the factor's order."""
    for a in range(len(place)):
        Q, i, p = rotations[a], 3 * a, 3 * place[a]
        r0, r1, r2 = scale * r[i], scale * r[i + 1], scale * r[i + 2]
        work[p] = Q[0, 0] * r0 + Q[1, 0] * r1 + Q[2, 0] * r2
        work[p + 1] = Q[0, 1] * r0 + Q[1, 1] * r1 + Q[2, 1] * r2
        work[p + 2] = Q[0, 2] * r0 + Q[1, 2] * r1 + Q[2, 2] * r2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _turn(place, rotations, scale, work, z):
    """Write R work / scale to z."""
    for a in range(len(place)):
        Q, i, p = rotations[a], 3 * a, 3 * place[a]
        w0, w1, w2 = work[p] / scale, work[p + 1] / scale, work[p + 2] / scale
        z[i] = Q[0, 0] * w0 + Q[0, 1] * w1 + Q[0, 2] * w2
        z[i + 1] = Q[1, 0] * w0 + Q[1, 1] * w1 + Q[1, 2] * w2
        z[i + 2] = Q[2, 0] * w0 + Q[2, 1] * w1 + Q[2, 2] * w2


class RotatedRest:
    """The approximate inverse R K₀⁻¹ Rᵀ, with the solve in single precision.

    Parameters
    ----------
    factor : SingleFactor
        Factor of the stiffness at rest, with the three dofs of a node as neighbours.
    pattern : Pattern
        Pattern of the stiffness.
    cells : tuple of arrays
        (n_cells, n_cell_nodes) int32: index of each cell's nodes among the nodes with a free dof;
        fixed nodes have the index n_free_nodes. (n_cells, n_cell_nodes, 3) float64: dN_a/dX at the
        cells' centres, 1/m. (n_cells,) float64: volumes of the cells, m³.
    frames : tuple of arrays, optional
        Indices (n,) of nodes whose vectors are in a frame, and its axes (n, 3, 3), as rows.
    warp : Warp, optional
        Bends linear responses.
    """

    def __init__(
        self,
        factor: SingleFactor,
        pattern: Pattern,
        cells: tuple[NDArray[np.int32], Array, Array],
        frames: tuple[NDArray[np.int64], Array] | None = None,
        warp: Warp | None = None,
    ) -> None:
        self._factor, self._pattern, self.frames = factor, pattern, frames
        self._warp = warp
        self._place = np.ascontiguousarray(factor.place[::3] // 3)
        self.cells = cells
        self._identity = np.tile(np.eye(3), (len(self._place) + 1, 1, 1))

    def at_nodes(self, q: Array) -> Array:
        """Return displacements (n_free_nodes + 1, 3), m; the last row, of fixed nodes, is zero."""
        u = np.append(self._pattern.pad(q), np.zeros(3)).reshape(-1, 3)
        return u if self.frames is None else along_axes(u, *self.frames)

    def turned(self, q: Array | None) -> Array:
        """Return nodal rotations (n_nodes + 1, 3, 3) at displacements q (n,), m.

        Without q they are the identity.
        """
        if q is None:
            return self._identity
        rotations = np.empty_like(self._identity)
        iterations = nodal_rotations(self.at_nodes(q), *self.cells, rotations)
        # The terms count components of the cells' nodes, nodes, and iterations.
        count(multiply_adds=4 * self.cells[1].size + 20 * len(self._place) + 40 * int(iterations))
        return rotations if self.frames is None else in_frames(rotations, *self.frames)

    def bent(self, q: Array) -> Array | None:
        """Return a linear response q (n,), m, with true rotations; None without a warp."""
        warp = self._warp
        return None if warp is None else self._pattern.cut(warp(self.at_nodes(q)).ravel())

    def solve_many(self, residuals: Sequence[Array], rotations: Sequence[Array]) -> Array:
        """Return approximate displacements (m, n), m, under forces (n,), N.

        Each force has its own rotations. One sweep over the factor serves all forces. An answer
        does not depend on the other forces, to the last digit.
        """
        # Forces are scaled to one, so that single precision neither underflows nor overflows.
        scales = [1.0 / (float(np.abs(residual).max()) or 1.0) for residual in residuals]
        work = np.empty((len(residuals), 3 * len(self._place)), dtype=np.float32)
        for row, residual, Q, scale in zip(work, residuals, rotations, scales, strict=True):
            _turn_back(self._place, Q, scale, self._pattern.pad(residual), row)
        self._factor.solve_in_place(work)
        if is_counting():
            count(multiply_adds=8 * work.size)
        z = np.empty(work.shape)
        for out, row, Q, scale in zip(z, work, rotations, scales, strict=True):
            _turn(self._place, Q, scale, row, out)
        return z if self._pattern.completion is None else self._pattern.cut(z.T).T.copy()

    @cached_property
    def _soft(self) -> NDArray[np.float32]:
        force = np.random.default_rng(0).normal(size=(1, 3 * len(self._place))).astype(np.float32)
        response = force.copy()
        with uncounted():
            self._factor.solve_in_place(response)
        return np.asarray(np.concatenate([response, force]) / np.abs(response).max())

    def soft(self, rotations: Array) -> tuple[Array, Array]:
        """Return the rotated response at rest to a random force, of size one, and this force."""
        count(multiply_adds=4 * self._soft.size)
        z = np.empty(self._soft.shape)
        for vector, out in zip(self._soft, z, strict=True):
            _turn(self._place, rotations, 1.0, vector, out)
        return self._pattern.cut(z[0]), self._pattern.cut(z[1])

    def at(self, q: Array | None) -> Turned:
        """Return the preconditioner of a tangent at displacements q (n,), m."""
        return Turned(self, self.turned(q))


@dataclass(frozen=True)
class Turned:
    """A `RotatedRest` under given rotations."""

    rest: RotatedRest
    rotations: Array

    def solve(self, residual: Array) -> Array:
        return np.asarray(self.rest.solve_many([residual], [self.rotations])[0])


class BlockJacobi:
    """The plain preconditioner: the inverse of each node's 3x3 block of the tangent itself."""

    def __init__(self, pattern: Pattern) -> None:
        self._pattern, indptr = pattern, pattern.whole.indptr
        first, second, third = indptr[:-1:3], indptr[1::3], indptr[2::3]
        top, middle = (first, first + 1, first + 2), (first + 1, second, second + 1)
        bottom = (first + 2, second + 1, third)
        self._places = np.stack([*top, *middle, *bottom], axis=1)

    def take(self, values: Array) -> None:
        """Invert the diagonal blocks of a tangent."""
        count(multiply_adds=27 * len(self._places))
        try:
            blocks = self._pattern.complete(values)[self._places].reshape(-1, 3, 3)
            self._inverse = np.linalg.inv(blocks)
        except np.linalg.LinAlgError as error:
            raise NotPositiveDefiniteError from error

    def solve(self, residual: Array) -> Array:
        count(multiply_adds=9 * len(self._places))
        blocks = self._pattern.pad(residual).reshape(-1, 3, 1)
        return self._pattern.cut(np.asarray((self._inverse @ blocks).ravel()))


class Preconditioner(Protocol):
    """An approximate inverse."""

    def solve(self, residual: Array) -> Array: ...


def product(pattern: Pattern, values: Array, x: Array) -> Array:
    """Return K x for the symmetric K whose upper triangle has these values."""
    whole, y = pattern.whole, np.empty(pattern.whole.n)
    multiply(whole.indptr, whole.indices, pattern.complete(values), pattern.pad(x), y)
    return pattern.cut(y)


def condition_number(pattern: Pattern, values: Array, factor: Factor, iterations: int = 4) -> float:
    """Estimate a symmetric positive definite matrix' condition number, from below.

    Power iterations with the matrix and with its inverse give the extreme eigenvalues.
    """
    x = np.random.default_rng(0).normal(size=pattern.n)
    y = x / np.linalg.norm(x)
    largest = smallest = 1.0
    for _ in range(iterations):
        x = product(pattern, values, x / np.linalg.norm(x))
        largest = float(np.linalg.norm(x))
        y = factor.solve(y)
        smallest = 1.0 / float(np.linalg.norm(y))
        y = y * smallest
    return largest / smallest


def conjugate_gradients(
    pattern: Pattern,
    values: Array,
    preconditioner: Preconditioner,
    rhs: Array,
    tolerance: float,
    max_iterations: int = MAX_ITERATIONS,
) -> tuple[Array, int]:
    """Solve K x = rhs to a relative tolerance; return x and the number of iterations.

    Raises
    ------
    NotPositiveDefiniteError
        If a direction of negative curvature is met, or the iterations do not suffice.
    """
    whole, values, r = pattern.whole, pattern.complete(values), pattern.pad(rhs).copy()
    x, p, q = np.zeros_like(r), np.zeros_like(r), np.empty_like(r)
    target, rz = tolerance * float(np.linalg.norm(rhs)), 1.0
    for iteration in range(max_iterations):
        if float(np.linalg.norm(r)) <= target:
            return pattern.cut(x), iteration
        z = pattern.pad(preconditioner.solve(pattern.cut(r)))
        rz, before = float(r @ z), rz
        p = z + (rz / before) * p
        multiply(whole.indptr, whole.indices, values, p, q)
        # One product with K, whose upper triangle is stored, and six with vectors.
        count(multiply_adds=2 * len(values) + 5 * len(p))
        curvature = float(p @ q)
        if not curvature > 0.0:
            raise NotPositiveDefiniteError
        x += (rz / curvature) * p
        r -= (rz / curvature) * q
    raise NotPositiveDefiniteError


class JacobiFactor:
    """A `Factor` without a factorisation, by conjugate gradients with the diagonal blocks."""

    def __init__(self, pattern: Pattern, values: Array) -> None:
        self._pattern, self._values, self._jacobi = pattern, values, BlockJacobi(pattern)
        self._jacobi.take(values)

    def solve(self, rhs: Array) -> Array:
        if rhs.ndim == 2:
            return np.stack([self.solve(column) for column in rhs.T], axis=1)
        return conjugate_gradients(self._pattern, self._values, self._jacobi, rhs, 1e-10, 20_000)[0]
