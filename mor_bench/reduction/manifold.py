"""Galerkin projection on a quadratic manifold: u(q) = Φq + ½ Σ qᵢqⱼψᵢⱼ, T(q)ᵀ (f_int(u(q)) - f) = 0 with T = ∂u/∂q."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench import counting
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.linear import Factor
from mor_bench.reduction.galerkin import GalerkinProblem, _symmetric_product
from mor_bench.reduction.modal_derivatives import pairs


class QuadraticManifold:
    """Jain, Tiso, Rutzmoser, Rixen: A quadratic manifold for model order reduction of nonlinear structural dynamics,
    Computers & Structures 188 (2017), equation 11.

    Parameters
    ----------
    modes : (n, r) float64
        Φ.
    derivatives : (n, r (r + 1) / 2) float64
        ψᵢⱼ for `pairs`, 1/m.

    Raises
    ------
    InvalidInputError
        On other shapes, NaN or infinity.
    """

    def __init__(self, modes: NDArray[np.float64], derivatives: NDArray[np.float64]) -> None:
        n, r = modes.shape
        first, second = pairs(r)
        if derivatives.shape != (n, len(first)) or not np.isfinite(derivatives).all():
            raise InvalidInputError(f"`derivatives` must be a finite array of shape ({n}, {len(first)}); got shape {derivatives.shape}.")
        self.modes = np.ascontiguousarray(modes)
        self._bend = np.empty((n, r, r))
        self._bend[:, first, second] = derivatives
        self._bend[:, second, first] = derivatives

    def at(self, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The displacement u(q), and what the tangent space T(q) has beyond Φ, (n, r)."""
        if counting.running is not None:
            counting.running.add(multiply_adds=self._bend.size + self.modes.size)
        bent: NDArray[np.float64] = (self._bend.reshape(-1, len(q)) @ q).reshape(self.modes.shape)
        return self.modes @ q + 0.5 * (bent @ q), bent

    def curvature(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Σₐ fₐ ∂²uₐ/∂q², (r, r): the part of a tangent that comes of the manifold's own curvature."""
        if counting.running is not None:
            counting.running.add(multiply_adds=self._bend.size)
        r = self.modes.shape[1]
        return (force @ self._bend.reshape(-1, r * r)).reshape(r, r)


class ManifoldProblem:
    """The potential W(u(q)) - f·u(q) as a problem for the nonlinear solve, under the constant reduced load Φᵀf.

    The rest of the load's work, f·(u(q) - Φq), counts as stored energy: force and tangent are exact derivatives of one
    potential, so that all checks and safeguards of the solve hold, and a solution has no direction of negative curvature
    on the manifold.

    Parameters
    ----------
    linear : GalerkinProblem
        Over all cells, on Φ, the manifold's tangent space at rest.
    manifold : QuadraticManifold
    load : (n_free,) float64
        f, N.
    """

    def __init__(self, linear: GalerkinProblem, manifold: QuadraticManifold, load: NDArray[np.float64]) -> None:
        self._linear, self._manifold, self._load = linear, manifold, load
        self.n_unknowns, self.extent, self.accelerator = linear.n_unknowns, linear.extent, None

    @property
    def rest_tangent(self) -> NDArray[np.float64]:
        # The manifold's curvature times the load is left out: this is the stiffness at rest without a load.
        return self._linear.rest_tangent

    @property
    def rest_factor(self) -> Factor:
        return self._linear.rest_factor

    def _state(self, q: NDArray[np.float64], state: State, bent: NDArray[np.float64]) -> State:
        if counting.running is not None:
            counting.running.add(multiply_adds=2 * bent.size)
        modes = self._linear.modes
        # f·(u - Φq) = ½ f·(bent q)
        stored = state.energy_j - 0.5 * float((self._load @ bent) @ q)
        return State(modes.T @ state.force + bent.T @ (state.force - self._load), stored, state.min_det_f)

    def force(self, q: NDArray[np.float64]) -> State:
        u, bent = self._manifold.at(q)
        return self._state(q, self._linear.assembler.force(u), bent)

    def linearise(self, q: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        u, bent = self._manifold.at(q)
        state, values = self._linear.assembler.force_and_tangent(u)
        tangents = self._linear.modes + bent
        if counting.running is not None:  # KT with the K of which one triangle is stored, TᵀKT
            n, r = tangents.shape
            counting.running.add(multiply_adds=(2 * len(values) - n) * r + n * r**2)
        pattern, product = self._linear.assembler.pattern, np.zeros_like(tangents)
        _symmetric_product(pattern.indptr, pattern.indices, values, tangents, product)
        return self._state(q, state, bent), tangents.T @ product + self._manifold.curvature(state.force - self._load)

    def step(
        self, q: NDArray[np.float64], tangent: NDArray[np.float64], residual: NDArray[np.float64], tolerance: float
    ) -> NDArray[np.float64]:  # fmt: skip
        return self._linear.factor(tangent).solve(residual)

    def certify(self, q: NDArray[np.float64]) -> None:
        """Nothing to do: every step has a Cholesky factor."""
