"""Projection on a curved manifold in a subspace: u = s + Φ c(q), with few coordinates q.

Φ has primary and secondary modes. A smooth map c(q) of the coordinates, with c(0) = 0, curves the
manifold. The offset s depends on the load only, for example the static correction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.linear import Factor
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.cubature import MAX_ENTRIES, short, triangle
from mor_bench.reduction.derivative_modes import pairs
from mor_bench.reduction.galerkin import DenseProblem, GalerkinProblem, stiffness_times

Array = NDArray[np.float64]


class CoordinateMap(Protocol):
    """A smooth map from r latent coordinates to N coordinates of Φ, with c(0) = 0."""

    n_latent: int

    def at(self, q: Array) -> tuple[Array, Array]:
        """Return c(q), (N,), and D(q) = ∂c/∂q, (N, r)."""
        ...

    def curvature(self, q: Array, weights: Array) -> Array:
        """Return Σₖ wₖ ∂²cₖ/∂q², (r, r), for weights (N,)."""
        ...


class QuadraticMap:
    """The map c(q) = (q, Σ qᵢqⱼ ξᵢⱼ) over `pairs`.

    Parameters
    ----------
    n_latent : int
    coefficients : (r (r + 1) / 2, m) float64
        ξ, 1/m: contributions of the products to the m secondary coordinates.
    """

    def __init__(self, n_latent: int, coefficients: Array) -> None:
        self.n_latent = n_latent
        first, second = pairs(n_latent)
        # Half of every coefficient in both places, so that the second derivative is their sum.
        self._bend = np.zeros((coefficients.shape[1], n_latent, n_latent))
        self._bend[:, first, second] += coefficients.T
        self._bend[:, second, first] += coefficients.T

    def at(self, q: Array) -> tuple[Array, Array]:
        count(multiply_adds=self._bend.size + self._bend[:, 0].size)
        slopes = self._bend @ q
        both = np.concatenate([np.eye(len(q)), slopes])
        return np.concatenate([q, 0.5 * (slopes @ q)]), both

    def curvature(self, q: Array, weights: Array) -> Array:
        count(multiply_adds=self._bend.size)
        r = self.n_latent
        return np.asarray(weights[r:] @ self._bend.reshape(-1, r * r)).reshape(r, r)


@dataclass(frozen=True)
class CurvedModel:
    """A manifold over all cells or over weighted ones, which all loads share.

    Attributes
    ----------
    sampled : GalerkinProblem
        On the rows of Φ that the cells touch.
    curve : CoordinateMap
    """

    sampled: GalerkinProblem
    curve: CoordinateMap

    @cached_property
    def slope(self) -> Array:
        """D at rest, (N, r)."""
        return self.curve.at(np.zeros(self.curve.n_latent))[1]

    @cached_property
    def linear(self) -> GalerkinProblem:
        """Galerkin projection on the tangent space at rest."""
        return GalerkinProblem(self.sampled.assembler, self.sampled.modes @ self.slope)

    @cached_property
    def rest_forces(self) -> Array:
        """The stiffness at rest times Φ on the rows of the cells, (n_rows, N)."""
        assembler = self.sampled.assembler
        values = assembler.force_and_tangent(np.zeros(assembler.n_dofs))[1]
        return stiffness_times(assembler.pattern, values, self.sampled.modes)


@dataclass(frozen=True)
class CurvedLoad:
    """A load on a manifold.

    Attributes
    ----------
    projected : (N,) float64
        l = Φᵀf, N.
    at_rest : (r,) float64
        p = D(0)ᵀ (l - ΦᵀK₀s), N; the stiffness at rest maps the linear response to it.
    offset : (n_rows,) float64
        s on the rows of the cells, m.
    """

    projected: Array
    at_rest: Array
    offset: Array

    def times(self, factor: float) -> CurvedLoad:
        """Return a fraction of the load."""
        return CurvedLoad(factor * self.projected, factor * self.at_rest, factor * self.offset)


class CurvedProblem(DenseProblem):
    """The potential W(u(q)) - l·c(q) as a problem for the nonlinear solve, under the load p.

    Residual and tangent are those of Galerkin projection on the tangent space T = Φ D(q): the
    residual is D(q)ᵀ (Φᵀ f_int - l). Lee, Carlberg: Model reduction of dynamical systems on
    nonlinear manifolds using deep convolutional autoencoders, J. Comput. Phys. 404 (2020). The work
    of the load beyond p·q counts as stored energy. Force and tangent, with the curvature of the
    manifold, are then exact derivatives of one potential, so all checks of the solve hold.
    """

    def __init__(self, model: CurvedModel, load: CurvedLoad) -> None:
        self._model, self.load = model, load
        self.n_unknowns, self.extent = model.linear.n_unknowns, model.linear.extent

    @property
    def rest_tangent(self) -> Array:
        return self._model.linear.rest_tangent

    @cached_property
    def rest_factor(self) -> Factor:
        return self._model.linear.rest_factor

    def _state(self, q: Array, c: Array, slopes: Array, state: State) -> tuple[State, Array]:
        """Return the reduced state, and the residual Φᵀf_int - l, (N,)."""
        modes = self._model.sampled.modes
        count(multiply_adds=modes.size + slopes.size)
        load = self.load
        residual = modes.T @ state.force - load.projected
        energy_j = state.energy_j - float(load.projected @ c) + float(load.at_rest @ q)
        return State(slopes.T @ residual + load.at_rest, energy_j, state.min_det_f), residual

    def _displacement(self, c: Array) -> Array:
        count(multiply_adds=self._model.sampled.modes.size)
        return np.asarray(self.load.offset + self._model.sampled.modes @ c)

    def force(self, q: Array) -> State:
        c, slopes = self._model.curve.at(q)
        state = self._model.sampled.assembler.force(self._displacement(c))
        return self._state(q, c, slopes, state)[0]

    def linearise(self, q: Array) -> tuple[State, Array]:
        state, residual, (tangents, forces) = self.differentiate(q)
        count(multiply_adds=tangents.size * tangents.shape[1])
        return state, tangents.T @ forces + self._model.curve.curvature(q, residual)

    def residual(self, q: Array) -> tuple[Array, float]:
        """Return Φᵀf_int - l, (N,), and the smallest det F."""
        c, slopes = self._model.curve.at(q)
        state = self._model.sampled.assembler.force(self._displacement(c))
        return self._state(q, c, slopes, state)[1], state.min_det_f

    def differentiate(self, q: Array) -> tuple[State, Array, tuple[Array, Array]]:
        """Return the reduced state, the residual (N,), and T and KT, each (n_rows, r)."""
        c, slopes = self._model.curve.at(q)
        sampled = self._model.sampled
        whole, values = sampled.assembler.force_and_tangent(self._displacement(c))
        tangents = sampled.modes @ slopes
        n, r = tangents.shape
        # The terms are ΦD, and KT with one stored triangle of K.
        count(multiply_adds=sampled.modes.size * r + (2 * len(values) - n) * r)
        forces = stiffness_times(sampled.assembler.pattern, values, tangents)
        return *self._state(q, c, slopes, whole), (tangents, forces)


def curved_system(model: FullOrderModel, modes: Array, states: list[tuple[Array, Array]]) -> Array:
    """Return the training matrix of a cubature on the manifold, compressed by QR.

    G[(s, i), e] = (D_sᵀ Φᵀ)ᵢ f_e(u_s); the target is G·1. Jain, Tiso: Hyper-reduction over
    nonlinear manifolds for large nonlinear mechanical systems, J. Comput. Nonlinear Dynam. 14
    (2019).

    Parameters
    ----------
    model : FullOrderModel
    modes : (n_free, N) float64
        Φ.
    states : list of ((n_free,), (N, k)) float64
        Displacement u_s and matrix D_s of each training state.
    """
    local = np.vstack([modes, np.zeros(modes.shape[1])])[model.cell_dofs]
    n_cells, rows, used = len(local), [np.empty((0, len(local)))], 0
    for u, slopes in states:
        forces = model.assembler.cell_forces(u)
        rows.append(slopes.T @ np.matmul(forces[:, None], local)[:, 0].T)
        used += len(rows[-1])
        if used * n_cells > max(MAX_ENTRIES, 4 * n_cells**2):
            rows = [triangle(np.concatenate(rows))]
            used = len(rows[0])
    system = np.concatenate(rows)
    return short(system)
