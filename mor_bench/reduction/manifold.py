"""Galerkin projection on a quadratic manifold, u(q) = Φq + ½ Σ qᵢqⱼψᵢⱼ.

It solves T(q)ᵀ (f_int(u(q)) - f) = 0 with the tangent space T = ∂u/∂q.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.assembly import Assembler, State
from mor_bench.mechanics.linear import Factor
from mor_bench.reduction.cubature import triangle
from mor_bench.reduction.derivative_modes import pairs
from mor_bench.reduction.galerkin import DenseProblem, GalerkinProblem, stiffness_times


class QuadraticManifold:
    """The map u(q) and its derivatives.

    Jain, Tiso, Rutzmoser, Rixen: A quadratic manifold for model order reduction of nonlinear
    structural dynamics, Computers & Structures 188 (2017), equation 11.

    Parameters
    ----------
    modes : (n, r) float64
        Φ.
    derivatives : (n, r (r + 1) / 2) float64
        ψᵢⱼ for `pairs`, 1/m.

    Raises
    ------
    InvalidInputError
        If a shape is wrong, or an entry is NaN or infinite.
    """

    def __init__(self, modes: NDArray[np.float64], derivatives: NDArray[np.float64]) -> None:
        n, r = modes.shape
        first, second = pairs(r)
        if derivatives.shape != (n, len(first)) or not np.isfinite(derivatives).all():
            raise InvalidInputError(
                f"`derivatives` must be a finite array of shape ({n}, {len(first)}); "
                f"got shape {derivatives.shape}."
            )
        # Fitted and loaded arrays need the same memory order, because BLAS rounds differently.
        self.modes = np.ascontiguousarray(modes)
        self.derivatives = np.ascontiguousarray(derivatives)
        self._bend = np.empty((n, r, r))
        self._bend[:, first, second] = derivatives
        self._bend[:, second, first] = derivatives

    def at(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the displacement u(q), (n,), and the tangent space T(q), (n, r)."""
        count(multiply_adds=self._bend.size + self.modes.size)
        bent: NDArray[np.float64] = (self._bend.reshape(-1, len(q)) @ q).reshape(self.modes.shape)
        tangents = self.modes + bent
        return 0.5 * ((self.modes + tangents) @ q), tangents

    def curvature(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Σₐ fₐ ∂²uₐ/∂q², (r, r), the part of a tangent due to the manifold's curvature."""
        count(multiply_adds=self._bend.size)
        r = self.modes.shape[1]
        return (force @ self._bend.reshape(-1, r * r)).reshape(r, r)


def manifold_system(
    assembler: Assembler,
    cell_dofs: NDArray[np.int64],
    manifold: QuadraticManifold,
    states: list[NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Return the ECSW training matrix on a manifold, compressed by QR as in `cubature.ecsw_system`.

    G[(s, i), e] = T(q_s)ᵢᵀ f_e(u(q_s)); the target is G·1. Jain, Tiso: Hyper-reduction over
    nonlinear manifolds for large nonlinear mechanical systems, J. Comput. Nonlinear Dynam. 14
    (2019).

    Parameters
    ----------
    assembler : Assembler
        Over all cells.
    cell_dofs : (n_cells, 24 or 12) int
        Row of each cell's dofs; ``n_dofs`` at supports.
    manifold : QuadraticManifold
    states : list of (r,) float64
        Coordinates q_s.
    """
    rows = []
    for q in states:
        u, tangents = manifold.at(q)
        local = np.vstack([tangents, np.zeros(len(q))])[cell_dofs]
        rows.append(np.einsum("eir,ei->re", local, assembler.cell_forces(u)))
    return triangle(np.concatenate(rows))


class ManifoldProblem(DenseProblem):
    """The potential W(u(q)) - f·u(q) as a problem for the nonlinear solve, under the load Φᵀf.

    The rest of the load's work, f·(u(q) - Φq) = ½ q·Bq, counts as stored energy. Force and tangent
    are then exact derivatives of one potential, so that all checks of the solve hold. A solution
    has no direction of negative curvature on the manifold.

    Parameters
    ----------
    linear : GalerkinProblem
        On Φ, the manifold's tangent space at rest, over all cells or over weighted ones.
    manifold : QuadraticManifold
        On the assembler's dofs.
    bending_load : (r, r) float64
        B = Σₐ fₐ ∂²uₐ/∂q² over all dofs, N/m.
    """

    def __init__(
        self,
        linear: GalerkinProblem,
        manifold: QuadraticManifold,
        bending_load: NDArray[np.float64],
    ) -> None:
        self._linear, self._manifold, self._bending_load = linear, manifold, bending_load
        self.n_unknowns, self.extent = linear.n_unknowns, linear.extent

    @property
    def rest_tangent(self) -> NDArray[np.float64]:
        # The load's part is left out: the tangent only scales shifts and the first step.
        return self._linear.rest_tangent

    @cached_property
    def rest_factor(self) -> Factor:
        return self._linear.rest_factor

    def _state(self, q: NDArray[np.float64], state: State, tangents: NDArray[np.float64]) -> State:
        count(multiply_adds=tangents.size)
        done = self._bending_load @ q
        energy_j = state.energy_j - 0.5 * float(done @ q)
        return State(tangents.T @ state.force - done, energy_j, state.min_det_f)

    def force(self, q: NDArray[np.float64]) -> State:
        u, tangents = self._manifold.at(q)
        return self._state(q, self._linear.assembler.force(u), tangents)

    def linearise(self, q: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        u, tangents = self._manifold.at(q)
        state, values = self._linear.assembler.force_and_tangent(u)
        # The terms are KT with one stored triangle of K, and TᵀKT.
        n, r = tangents.shape
        count(multiply_adds=(2 * len(values) - n) * r + n * r**2)
        product = stiffness_times(self._linear.assembler.pattern, values, tangents)
        bending = self._manifold.curvature(state.force) - self._bending_load
        return self._state(q, state, tangents), tangents.T @ product + bending
