"""The reduced energy of Saint Venant-Kirchhoff as the quartic polynomial that it is: Galerkin projection without quadrature.

With H = Σ qᵢ Hᵢ the displacement gradient of u = Φq, the Green-Lagrange strain is E = Σ qᵢ eᵢ + ½ Σ qᵢ qⱼ s_ij, with
eᵢ = sym(Hᵢ) and s_ij = sym(HᵢᵀHⱼ), and the energy ½ ∫ E:C:E has degree four in q. Its coefficients are summed over the mesh
once (Barbič and James: Real-time subspace integration for St. Venant-Kirchhoff deformable models, ACM Trans. Graph. 24,
2005); afterwards no query sees the mesh, and nothing is approximated beyond the basis.

Pairs (i <= j) are numbered j (j + 1) / 2 + i, so that the leading modes' own polynomial is the leading part of each array.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky

from mor_bench.counting import (
    cholesky_multiply_adds,
    count,
    counted,
    is_counting,
    triangular_multiply_adds,
)
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.assembly import State, discretisation_of, quadrature_of
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import HOPELESS, NewtonOptions, solve_equilibrium
from mor_bench.reduction.galerkin import DenseProblem
from mor_bench.reduction.subspace import extent_of
from mor_bench.scene.materials import SaintVenantKirchhoff
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]

CHUNK_BYTES = 64e6
"""Of the strains of the pairs of modes, which are summed a few cells at a time."""

MAX_SENTINELS = 64
"""Quadrature points at which det F is watched."""

MOST_MODES = 100
"""The polynomial of more would take a gigabyte."""

MOST_BYTES = 5e8
"""Of all polynomials of a method that has several."""

QUICK_ITERATIONS = 15
"""Newton steps before the safeguarded solve takes over; 3 to 6 are usual."""


def n_pairs(r: int) -> int:
    """Of modes (i <= j)."""
    return r * (r + 1) // 2


def _pairs(r: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(i, j) of each pair, in order."""
    j, i = np.tril_indices(r)
    return i, j


@dataclass(frozen=True)
class ReducedTensors:
    """The symmetric derivatives of the reduced energy at rest.

    Attributes
    ----------
    quadratic : (r, r) float64
        Second derivatives, the stiffness ΦᵀK₀Φ.
    cubic : (n_pairs, r) float64
        Third derivatives: of pair (i, j) and mode k.
    quartic : (n_pairs, n_pairs) float64
        Fourth derivatives: of pairs (i, j) and (k, l).
    """

    quadratic: Array
    cubic: Array
    quartic: Array

    @property
    def n_modes(self) -> int:
        return len(self.quadratic)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _strains(gradients: Any, shape_scale: Any, volume_scale: Any, rows: Any) -> None:
    """eᵢ, then s_ij, at points from Hᵢ (n, 3, 3, r): (n, 6, r + n_pairs) in an orthonormal basis of symmetric tensors, scaled.

    First five components of the deviator, then the trace over √3.
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
                x, y, z = (
                    X0 * x0 + X1 * x1 + X2 * x2,
                    Y0 * y0 + Y1 * y1 + Y2 * y2,
                    Z0 * z0 + Z1 * z1 + Z2 * z2,
                )
                out[0, first + i] = (
                    a * half * (X0 * y0 + X1 * y1 + X2 * y2 + Y0 * x0 + Y1 * x1 + Y2 * x2)
                )
                out[1, first + i] = (
                    a * half * (X0 * z0 + X1 * z1 + X2 * z2 + Z0 * x0 + Z1 * x1 + Z2 * x2)
                )
                out[2, first + i] = (
                    a * half * (Y0 * z0 + Y1 * z1 + Y2 * z2 + Z0 * y0 + Z1 * y1 + Z2 * y2)
                )
                out[3, first + i] = a * half * (x - y)
                out[4, first + i] = a * sixth * (x + y - 2.0 * z)
                out[5, first + i] = b * trace * (x + y + z)


class _Gradients:
    """Gradients of the modes at the quadrature points of a mesh, a few cells at a time."""

    def __init__(self, model: FullOrderModel, modes: Array, chunk_bytes_per_point: int) -> None:
        self.quadrature = quadrature_of(discretisation_of(model.scene))
        self.n_modes = modes.shape[1]
        self._local = np.vstack([modes, np.zeros(self.n_modes)])
        self._cell_dofs = model.cell_dofs
        self._step = max(
            1, int(CHUNK_BYTES / (chunk_bytes_per_point * self.quadrature.gradients.shape[1]))
        )

    def __iter__(self) -> Iterator[tuple[slice, Array]]:
        """Cells, and Hᵢ at their points (n, 3, 3, r)."""
        n_cells, _, n_nodes, _ = self.quadrature.gradients.shape
        for first in range(0, n_cells, self._step):
            part = slice(first, first + self._step)
            local = self._local[self._cell_dofs[part]].reshape(-1, n_nodes, 3, self.n_modes)
            gradients = np.einsum(
                "cqaj,caim->cqijm", self.quadrature.gradients[part], local, optimize=True
            )
            yield part, gradients.reshape(-1, 3, 3, self.n_modes)


def reduce_energy(model: FullOrderModel, modes: Array) -> ReducedTensors:
    """Sum the reduced energy of Saint Venant-Kirchhoff over a mesh, for modes (n_free, r)."""
    r = modes.shape[1]
    width = r + n_pairs(r)
    gram = np.zeros((width, width))
    points = _Gradients(model, modes, 8 * 6 * width)
    for part, gradients in points:
        # E:C:E = 2μ |dev E|² + (3λ + 2μ) |vol E|²; both are >= 0 but for the volumetric part alone of a negative Poisson's ratio.
        weights = points.quadrature.weights[part]
        lame_lambda, lame_mu = np.tile(points.quadrature.parameters, (len(weights), 1)).T
        shape, volume = (
            2 * lame_mu * weights.ravel(),
            (3 * lame_lambda + 2 * lame_mu) * weights.ravel(),
        )
        rows = np.empty((len(gradients), 6, width))
        _strains(gradients, np.sqrt(shape), np.sqrt(np.abs(volume)), rows)
        flat = rows.reshape(-1, width)
        gram += flat.T @ flat
        if (volume < 0).any():
            wrong = rows[volume < 0, 5]
            gram -= 2 * wrong.T @ wrong
    return _symmetric(gram, r)


def sentinels_of(model: FullOrderModel, modes: Array, samples: Array) -> Array:
    """Gradients of the modes (n, 9, r) at those points where typical states have their smallest det F.

    Parameters
    ----------
    model : FullOrderModel
    modes : (n_free, r) float64
    samples : (n_samples, r) float64
        Reduced coordinates of the states; at most `MAX_SENTINELS` points are kept, of the smallest det F.
    """
    least, watched = np.full(len(samples), np.inf), np.zeros((len(samples), 9, modes.shape[1]))
    for _, gradients in _Gradients(model, modes, 8 * 9 * (modes.shape[1] + len(samples))):
        H = gradients.reshape(-1, 9, modes.shape[1])
        F = (H.reshape(-1, H.shape[2]) @ samples.T).reshape(-1, 9, len(samples)) + np.eye(
            3
        ).reshape(1, 9, 1)
        det = np.linalg.det(np.moveaxis(F, 1, 2).reshape(-1, 3, 3)).reshape(-1, len(samples))
        lowest = det.argmin(axis=0)
        lower = np.flatnonzero(det.min(axis=0) < least)
        least[lower], watched[lower] = det[lowest[lower], lower], H[lowest[lower]]
    points = watched[np.argsort(least, kind="stable")]
    first = np.unique(points, axis=0, return_index=True)[1]  # many samples share a point
    return points[np.sort(first)[:MAX_SENTINELS]]


def _symmetric(gram: Array, r: int) -> ReducedTensors:
    """Derivatives from the Gram matrix of strains, which is ∫ e:C:e, ∫ e:C:s and ∫ s:C:s.

    W = ½ q q ee + ½ q qq es + ⅛ qq qq ss; a derivative is the sum over the ways to distribute its indices.
    """
    i, j = _pairs(r)
    number = np.empty((r, r), dtype=np.int64)
    number[i, j] = number[j, i] = np.arange(len(i))
    mixed, quartic = gram[:r, r:], gram[r:, r:]
    k = np.arange(r)
    cubic = (
        mixed[k, np.arange(len(i))[:, None]]
        + mixed[i[:, None], number[j[:, None], k]]
        + mixed[j[:, None], number[i[:, None], k]]
    )
    symmetric = quartic.copy()
    for row in range(len(i)):
        symmetric[row] += (
            quartic[number[i[row], i], number[j[row], j]]
            + quartic[number[i[row], j], number[j[row], i]]
        )
    return ReducedTensors(
        0.5 * (gram[:r, :r] + gram[:r, :r].T), cubic, 0.5 * (symmetric + symmetric.T)
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _dot(a, b, n):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(n):
        total += a[i] * b[i]
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _evaluate(
    quadratic: Any, cubic: Any, quartic: Any, q: Any, products: Any, force: Any, hessian: Any
) -> float:
    """Force and lower Hessian at q, both from one sweep over the tensors; returns the energy."""
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
def _cholesky(a, r):  # type: ignore[no-untyped-def]
    """Factorise the lower triangle in place; False if it is not positive definite."""
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
def _back_solve(a, r, x):  # type: ignore[no-untyped-def]
    for i in range(r):
        x[i] = (x[i] - _dot(a[i], x, i)) / a[i, i]
    for i in range(r - 1, -1, -1):
        x[i] /= a[i, i]
        for k in range(i):
            x[k] -= a[i, k] * x[i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _equilibrium(
    quadratic: Any, cubic: Any, quartic: Any, rest: Any, load: Any, tolerance: float, q: Any
) -> int:
    """Full Newton steps from the linear response, by the rest-state factor; the Hessian at the answer is positive definite.

    Returns the number of Hessians, negative where there is no answer.
    """
    r = len(load)
    products, force, step, hessian = (
        np.empty(r * (r + 1) // 2),
        np.empty(r),
        np.empty(r),
        np.empty((r, r)),
    )
    q[:] = load
    _back_solve(rest, r, q)
    size = np.sqrt(_dot(load, load, r))
    for iteration in range(1, QUICK_ITERATIONS + 1):
        _evaluate(quadratic, cubic, quartic, q, products, force, hessian)
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
def _min_det_f(sentinels, q):  # type: ignore[no-untyped-def]
    least = np.inf
    r = len(q)
    for point in range(len(sentinels)):
        H = sentinels[point]
        a, b, c = 1.0 + _dot(H[0], q, r), _dot(H[1], q, r), _dot(H[2], q, r)
        d, e, f = _dot(H[3], q, r), 1.0 + _dot(H[4], q, r), _dot(H[5], q, r)
        g, h, i = _dot(H[6], q, r), _dot(H[7], q, r), 1.0 + _dot(H[8], q, r)
        least = min(least, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
    return least


def has_polynomial(scene: Scene) -> bool:
    """Whether the scene's energy is a polynomial of the displacement."""
    return isinstance(scene.material, SaintVenantKirchhoff)


def polynomial_pays(model: FullOrderModel, n_modes: int, n_bases: int = 1) -> bool:
    """Whether models reduced to so many modes are better solved by their polynomials than over the mesh.

    A multiply-add of the polynomial, whose coefficients come from memory, takes about three times as long as one of the mesh: on
    beam-coarse 60 modes took 3.5 ms by it and 1.9 over the mesh, 40 modes 0.5 and 1.4.
    """
    if not has_polynomial(model.scene) or 8 * n_bases * n_pairs(n_modes) ** 2 > MOST_BYTES:
        return False
    with counted() as mesh:
        model.assembler.force_and_tangent(np.zeros(model.n_unknowns))
    products = 2 * len(model.assembler.pattern.indices) * n_modes + model.n_unknowns * n_modes**2
    return 3 * n_pairs(n_modes) ** 2 <= mesh.multiply_adds + products


class TensorProblem(DenseProblem):
    """A reduced model of Saint Venant-Kirchhoff by its polynomial.

    Parameters
    ----------
    tensors : ReducedTensors
    sentinels : (n, 9, r) float64
        Gradients of the modes where det F is watched.
    usual : (1,) float64
        The least det F of typical states there: what goes below is unlike them.
    extent : float
        Reduced coordinates of this size are displacements of the size of the body.

    Raises
    ------
    InvalidInputError
        If an array has another shape than the others ask for, NaN or infinity: the kernels behind check no bounds.
    """

    def __init__(
        self, tensors: ReducedTensors, sentinels: Array, usual: Array, extent: float
    ) -> None:
        r = tensors.n_modes
        shapes = {
            "quadratic": (r, r),
            "cubic": (n_pairs(r), r),
            "quartic": (n_pairs(r), n_pairs(r)),
            "sentinels": (len(sentinels), 9, r),
            "usual": (1,),
        }
        arrays = {**vars(tensors), "sentinels": sentinels, "usual": usual}
        for name, shape in shapes.items():
            if (
                arrays[name].dtype != np.float64
                or arrays[name].shape != shape
                or not np.isfinite(arrays[name]).all()
            ):
                raise InvalidInputError(
                    f"`{name}` must be finite float64 of shape {shape}; got {arrays[name].dtype} of shape {arrays[name].shape}."
                )
        self._arrays = tuple(
            np.ascontiguousarray(arrays[name]) for name in ("quadratic", "cubic", "quartic")
        )
        self.tensors, self.sentinels, self.usual = tensors, np.ascontiguousarray(sentinels), usual
        self.n_unknowns = r
        self.extent = extent
        try:
            self._rest = np.ascontiguousarray(cholesky(tensors.quadratic, lower=True))
        except LinAlgError:
            raise InvalidInputError(
                "`quadratic`, the reduced stiffness at rest, must be positive definite."
            ) from None

    @classmethod
    def of_modes(cls, model: FullOrderModel, modes: Array, samples: Array) -> TensorProblem:
        """Of modes (n_free, r) of a mesh; det F is watched where states with coordinates ``samples`` (n, r) have their smallest."""
        sentinels = np.ascontiguousarray(sentinels_of(model, modes, samples))
        usual = min((float(_min_det_f(sentinels, q)) for q in samples), default=1.0)
        return cls(
            reduce_energy(model, modes), sentinels, np.array([usual]), extent_of(model.scene)
        )

    @property
    def arrays(self) -> dict[str, Array]:
        """What `of_arrays` makes it from."""
        return {**vars(self.tensors), "sentinels": self.sentinels, "usual": self.usual}

    @classmethod
    def of_arrays(cls, scene: Scene, arrays: Mapping[str, Array]) -> TensorProblem:
        """From arrays that were saved; raises `InvalidInputError`, or KeyError, where they make none."""
        tensors = ReducedTensors(*(arrays[name] for name in ("quadratic", "cubic", "quartic")))
        return cls(tensors, arrays["sentinels"], arrays["usual"], extent_of(scene))

    def solve(self, load: Array, tolerance: float) -> Array:
        """Reduced coordinates (r,) at the equilibrium under a load Φᵀf; raises `SolverError` where there is none."""
        q = self.quick(load, tolerance)
        return (
            solve_equilibrium(self, load, options=NewtonOptions(tolerance)).displacement
            if q is None
            else q
        )

    def unlike(self, q: Array) -> bool:
        """Whether cells are squeezed more than in typical states, where the watched points may not be the worst."""
        return self.min_det_f(q) < float(self.usual[0])

    def quick(self, load: Array, tolerance: float) -> Array | None:
        """The equilibrium (r,) by full Newton steps, or None where they lead to none that is stable with det F > 0."""
        q = np.empty(self.n_unknowns)
        quadratic, cubic, quartic = self._arrays
        iterations: int = _equilibrium(quadratic, cubic, quartic, self._rest, load, tolerance, q)
        if is_counting():
            r, times = self.n_unknowns, abs(iterations)
            dense = cholesky_multiply_adds(r, r - 1) + triangular_multiply_adds(r, r - 1)
            count(
                factorisations=times,
                reduced_factorisations=times,
                back_solves=times,
                reduced_back_solves=times,
                multiply_adds=times * (self._evaluation + dense),
            )
        return q if iterations > 0 and self.min_det_f(q) > 0 else None

    @property
    def _evaluation(self) -> int:
        """Multiply-adds of a force with its tangent."""
        r = self.n_unknowns
        return n_pairs(r) * (n_pairs(r) + r + 1)

    def min_det_f(self, q: Array) -> float:
        """The smallest det F at the watched points."""
        if is_counting():
            count(multiply_adds=self.sentinels.size)
        return float(_min_det_f(self.sentinels, q))

    def linearise(self, q: Array) -> tuple[State, Array]:
        r = self.n_unknowns
        products, force, hessian = np.empty(n_pairs(r)), np.empty(r), np.empty((r, r))
        count(multiply_adds=self._evaluation)
        quadratic, cubic, quartic = self._arrays
        energy = _evaluate(quadratic, cubic, quartic, q, products, force, hessian)
        return State(force, energy, self.min_det_f(q)), np.tril(hessian) + np.tril(hessian, -1).T

    def force(self, q: Array) -> State:
        return self.linearise(q)[0]

    @cached_property
    def rest_tangent(self) -> Array:
        return self._arrays[0]
