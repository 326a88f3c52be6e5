"""The reduced energy of Saint Venant-Kirchhoff as a quartic polynomial, evaluated without a mesh.

The displacement gradient of u = Φq is H = Σ qᵢ Hᵢ. The Green-Lagrange strain is
E = Σ qᵢ eᵢ + ½ Σ qᵢ qⱼ s_ij, with eᵢ = sym(Hᵢ) and s_ij = sym(HᵢᵀHⱼ). The energy ½ ∫ E:C:E hence
has degree four in q. Its coefficients are summed over the mesh once (Barbič and James: Real-time
subspace integration for St. Venant-Kirchhoff deformable models, ACM Trans. Graph. 24, 2005). No
query sees the mesh, and nothing is approximated beyond the basis.

Pairs (i <= j) are numbered j (j + 1) / 2 + i. The polynomial of the leading modes is hence the
leading part of each array.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
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
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.discretisation import discretisation_of, quadrature_of
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.reduction.galerkin import DenseProblem
from mor_bench.reduction.subspace import extent_of
from mor_bench.reduction.tensor_kernels import equilibrium, evaluate, min_det_f, strains
from mor_bench.scene.materials import SaintVenantKirchhoff
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]

CHUNK_BYTES = 64e6
"""Memory for strains of pairs of modes, bytes; it limits the number of cells summed at a time."""

MAX_SENTINELS = 64
"""Number of quadrature points at which det F is watched."""

MOST_MODES = 100
"""Largest number of modes of a polynomial; more would take a gigabyte."""

MOST_BYTES = 5e8
"""Memory limit for all polynomials of a method that has several, bytes."""


def n_pairs(r: int) -> int:
    """Return the number of pairs (i <= j) of r modes."""
    return r * (r + 1) // 2


def triangular_pairs(r: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return i and j of each pair, in order."""
    j, i = np.tril_indices(r)
    return i, j


@dataclass(frozen=True)
class ReducedTensors:
    """Symmetric derivatives of the reduced energy at rest.

    Attributes
    ----------
    quadratic : (r, r) float64
        Second derivatives, the stiffness ΦᵀK₀Φ.
    cubic : (n_pairs, r) float64
        Third derivatives, by pair (i, j) and mode k.
    quartic : (n_pairs, n_pairs) float64
        Fourth derivatives, by pairs (i, j) and (k, l).
    """

    quadratic: Array
    cubic: Array
    quartic: Array

    @property
    def n_modes(self) -> int:
        return len(self.quadratic)


class _Gradients:
    """Gradients of the modes at the quadrature points of a mesh, a few cells at a time."""

    def __init__(self, model: FullOrderModel, modes: Array, chunk_bytes_per_point: int) -> None:
        self.quadrature = quadrature_of(discretisation_of(model.scene))
        self.n_modes = modes.shape[1]
        self._modes = model.scene.columns_at_all_dofs(modes).reshape(-1, 3, self.n_modes)
        self._cells = model.scene.mesh.cells
        bytes_per_cell = chunk_bytes_per_point * self.quadrature.gradients.shape[1]
        self._step = max(1, int(CHUNK_BYTES / bytes_per_cell))

    def __iter__(self) -> Iterator[tuple[slice, Array]]:
        """Yield cells, and Hᵢ at their points (n, 3, 3, r)."""
        for first in range(0, len(self._cells), self._step):
            part = slice(first, first + self._step)
            local = self._modes[self._cells[part]]
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
        # E:C:E = 2μ |dev E|² + (3λ + 2μ) |vol E|². Only a volumetric part alone with a negative
        # Poisson's ratio is negative.
        weights = points.quadrature.weights[part]
        lame_lambda, lame_mu = np.tile(points.quadrature.parameters, (len(weights), 1)).T
        shape = 2 * lame_mu * weights.ravel()
        volume = (3 * lame_lambda + 2 * lame_mu) * weights.ravel()
        rows = np.empty((len(gradients), 6, width))
        strains(gradients, np.sqrt(shape), np.sqrt(np.abs(volume)), rows)
        flat = rows.reshape(-1, width)
        gram += flat.T @ flat
        if (volume < 0).any():
            wrong = rows[volume < 0, 5]
            gram -= 2 * wrong.T @ wrong
    return _symmetric(gram, r)


def _about_rest(tensors: ReducedTensors) -> ReducedTensors:
    """Return the polynomial of modes 1, 2, … about the state where mode 0 has the coordinate 1.

    The Taylor series of a quartic polynomial ends, so nothing is neglected. Its linear term is
    balanced by the pre-load.
    """
    i, j = triangular_pairs(tensors.n_modes)
    kept, with_rest = np.flatnonzero(i > 0), np.flatnonzero((i == 0) & (j > 0))
    cubic, quartic = tensors.cubic[kept], tensors.quartic[kept]
    quadratic = tensors.quadratic[1:, 1:].copy()
    change = cubic[:, 0] + 0.5 * quartic[:, 0]
    rows, columns = i[kept] - 1, j[kept] - 1
    quadratic[rows, columns] += change
    quadratic[columns, rows] += np.where(rows == columns, 0.0, change)
    return ReducedTensors(quadratic, cubic[:, 1:] + quartic[:, with_rest], quartic[:, kept])


def sentinels_of(model: FullOrderModel, modes: Array, samples: Array) -> Array:
    """Return the modes' gradients (n, 9, r) where typical states have their smallest det F.

    Parameters
    ----------
    model : FullOrderModel
    modes : (n_free, r) float64
    samples : (n_samples, r) float64
        Reduced coordinates of the states. At most `MAX_SENTINELS` points are kept.
    """
    least, watched = np.full(len(samples), np.inf), np.zeros((len(samples), 9, modes.shape[1]))
    for _, gradients in _Gradients(model, modes, 8 * 9 * (modes.shape[1] + len(samples))):
        H = gradients.reshape(-1, 9, modes.shape[1])
        F = (H.reshape(-1, H.shape[2]) @ samples.T).reshape(-1, 9, len(samples))
        F += np.eye(3).reshape(1, 9, 1)
        det = np.linalg.det(np.moveaxis(F, 1, 2).reshape(-1, 3, 3)).reshape(-1, len(samples))
        lowest = det.argmin(axis=0)
        lower = np.flatnonzero(det.min(axis=0) < least)
        least[lower], watched[lower] = det[lowest[lower], lower], H[lowest[lower]]
    points = watched[np.argsort(least, kind="stable")]
    first = np.unique(points, axis=0, return_index=True)[1]  # many samples share a point
    return points[np.sort(first)[:MAX_SENTINELS]]


def _symmetric(gram: Array, r: int) -> ReducedTensors:
    """Return the derivatives from the Gram matrix of strains: ∫ e:C:e, ∫ e:C:s and ∫ s:C:s.

    W = ½ q q ee + ½ q qq es + ⅛ qq qq ss. A derivative is the sum over the ways to distribute its
    indices.
    """
    i, j = triangular_pairs(r)
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
    quadratic = 0.5 * (gram[:r, :r] + gram[:r, :r].T)
    return ReducedTensors(quadratic, cubic, 0.5 * (symmetric + symmetric.T))


def has_polynomial(scene: Scene) -> bool:
    """Return whether the scene's energy is a polynomial of the displacement."""
    return isinstance(scene.material, SaintVenantKirchhoff)


def polynomial_pays(model: FullOrderModel, n_modes: int, n_bases: int = 1) -> bool:
    """Return whether polynomials solve faster than integration over the mesh.

    A multiply-add of the polynomial, whose coefficients come from memory, takes about three times
    as long as one of the mesh.
    """
    if not has_polynomial(model.scene) or 8 * n_bases * n_pairs(n_modes) ** 2 > MOST_BYTES:
        return False
    with counted() as mesh:
        model.assembler.force_and_tangent(np.zeros(model.n_unknowns))
    products = 2 * len(model.assembler.pattern.indices) * n_modes + model.n_unknowns * n_modes**2
    return 3 * n_pairs(n_modes) ** 2 <= mesh.multiply_adds + products


class TensorProblem(DenseProblem):
    """A reduced model of Saint Venant-Kirchhoff as a polynomial.

    Parameters
    ----------
    tensors : ReducedTensors
    sentinels : (n, 9, r) or (n, 9, r + 1) float64
        Gradients of the modes where det F is watched. Under gravity, those of the rest state come
        first.
    usual : (1,) float64
        Smallest det F of typical states there.
    extent : float
        Reduced coordinates of this size are displacements of the size of the body.

    Raises
    ------
    InvalidInputError
        If shapes do not fit each other, or an array has NaN or infinity.
    """

    def __init__(
        self, tensors: ReducedTensors, sentinels: Array, usual: Array, extent: float
    ) -> None:
        r = tensors.n_modes
        shapes = {
            "quadratic": (r, r),
            "cubic": (n_pairs(r), r),
            "quartic": (n_pairs(r), n_pairs(r)),
            "sentinels": (len(sentinels), 9, r + (sentinels.shape[-1] == r + 1)),
            "usual": (1,),
        }
        arrays = {**vars(tensors), "sentinels": sentinels, "usual": usual}
        for name, shape in shapes.items():
            array = arrays[name]
            fits = array.dtype == np.float64 and array.shape == shape
            if not (fits and np.isfinite(array).all()):
                raise InvalidInputError(
                    f"`{name}` must be finite float64 of shape {shape}; "
                    f"got {array.dtype} of shape {array.shape}."
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
        """Make the problem from modes (n_free, r) and coordinates (n, r) of typical states."""
        if model.rest is not None:
            modes = np.column_stack([model.rest, modes])
            samples = np.column_stack([np.ones(len(samples)), samples])
        tensors = reduce_energy(model, modes)
        sentinels = np.ascontiguousarray(sentinels_of(model, modes, samples))
        usual = min((float(min_det_f(sentinels, q)) for q in samples), default=1.0)
        if model.rest is not None:
            tensors, modes = _about_rest(tensors), modes[:, 1:]
        if model.springs is not None:
            stiffness = tensors.quadratic + modes.T @ (model.springs @ modes)
            tensors = replace(tensors, quadratic=stiffness)
        return cls(tensors, sentinels, np.array([usual]), extent_of(model.scene))

    @property
    def arrays(self) -> dict[str, Array]:
        """The arrays from which `of_arrays` restores the problem."""
        return {**vars(self.tensors), "sentinels": self.sentinels, "usual": self.usual}

    @classmethod
    def of_arrays(cls, scene: Scene, arrays: Mapping[str, Array]) -> TensorProblem:
        """Restore the problem; raise `InvalidInputError` or KeyError on unsuitable arrays."""
        tensors = ReducedTensors(*(arrays[name] for name in ("quadratic", "cubic", "quartic")))
        return cls(tensors, arrays["sentinels"], arrays["usual"], extent_of(scene))

    def solve(self, load: Array, tolerance: float) -> Array:
        """Return the coordinates (r,) under a load Φᵀf; raise `SolverError` if there are none."""
        q = self.quick(load, tolerance)
        if q is None:
            q = solve_equilibrium(self, load, options=NewtonOptions(tolerance)).displacement
        return q

    def unlike(self, q: Array) -> bool:
        """Return whether cells are compressed more than in typical states.

        The watched points may then not be the worst.
        """
        return self.min_det_f(q) < float(self.usual[0])

    def quick(self, load: Array, tolerance: float) -> Array | None:
        """Return the stable equilibrium (r,) with det F > 0 by full Newton steps, or None."""
        q = np.empty(self.n_unknowns)
        quadratic, cubic, quartic = self._arrays
        iterations: int = equilibrium(quadratic, cubic, quartic, self._rest, load, tolerance, q)
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
        """Return the smallest det F at the watched points."""
        if is_counting():
            count(multiply_adds=self.sentinels.size)
        if self.sentinels.shape[2] > len(q):
            q = np.append(1.0, q)
        return float(min_det_f(self.sentinels, q))

    def linearise(self, q: Array) -> tuple[State, Array]:
        r = self.n_unknowns
        products, force, hessian = np.empty(n_pairs(r)), np.empty(r), np.empty((r, r))
        count(multiply_adds=self._evaluation)
        quadratic, cubic, quartic = self._arrays
        energy = evaluate(quadratic, cubic, quartic, q, products, force, hessian)
        state = State(force, energy, self.min_det_f(q))
        return state, np.tril(hessian) + np.tril(hessian, -1).T

    def force(self, q: Array) -> State:
        return self.linearise(q)[0]

    @cached_property
    def rest_tangent(self) -> Array:
        return self._arrays[0]
