"""The weak form of equilibrium over all single loads of a scene, for separated displacements.

A displacement depends on the position x in the body, the patch p, the direction d and the magnitude
m of the load:

    u(x; p, d, m) = u₀ + Σ_k X_k(x) P_k(p) D_k(d) M_k(m)                                        (1)

The mean potential energy over the loads is, with the stored energy W and the load f,

    Π(u) = ⟨ω (W(u) - f·u)⟩,   1/ω = fᵀK₀⁻¹f,                                                   (2)

with weights that give every load the same linear energy. Its stationarity is the weak form

    ⟨ω (f - f_int(u))·v⟩ = 0   for every v = X P D M.                                           (3)

P has one value per patch. D is a homogeneous polynomial, and M a polynomial in m. The mean is a sum
over a grid of loads. Only forces are evaluated there; no load is solved for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.load_grid import LoadGrid

Array = NDArray[np.float64]

IMMOBILE = 1e-12
"""Patches with a smaller compliance, relative to the largest, have no weight: they are held."""

STIFF = 1e-6
"""Least linear energy in the weight of a load, relative to those of the patch along three axes."""


@dataclass(frozen=True)
class Family:
    """Functions of direction and magnitude whose products form the terms of one kind.

    Attributes
    ----------
    directions : (n_directions, n_d) float64
        Functions of the direction at the grid's directions.
    powers : (n_magnitudes, n_m) float64
        Functions of the magnitude at the grid's magnitudes.
    """

    directions: Array
    powers: Array


@dataclass(frozen=True)
class Term:
    """The parametric functions of one term: P, and the coefficients of D and M.

    Attributes
    ----------
    family : int
    position : (n_patches,) float64
    direction : (n_d,) float64
    power : (n_m,) float64
    """

    family: int
    position: Array
    direction: Array
    power: Array


@dataclass(frozen=True)
class Balance:
    """The weak form at one separated displacement.

    Attributes
    ----------
    energy : float
        Π; it is -1/2 for the linear response of a linear body.
    residuals : (n_patches, n_functions, n_free) float64
        ⟨ω (f - f_int(u)) ψ⟩ on each patch, for each product ψ of direction and magnitude.
    relative : float
        Root mean square of ‖f - f_int(u)‖ / ‖f‖ over the grid.
    """

    energy: float
    residuals: Array
    relative: float


class WeakForm:
    """Equations (2) and (3) on a grid of loads.

    Parameters
    ----------
    model : FullOrderModel
    grid : LoadGrid
    families : sequence of Family
    linear : bool
        Whether u₀ is the linear response. It is zero otherwise.

    Attributes
    ----------
    gram : (n_patches, n_functions, n_functions) float64
        ⟨ω ψᵢ ψⱼ⟩ on each patch.
    blocks : list of slice
        The functions of each family.
    """

    def __init__(
        self, model: FullOrderModel, grid: LoadGrid, families: Sequence[Family], linear: bool
    ) -> None:
        self.model, self.grid, self.families = model, grid, families
        self.n_patches, self.n_free = len(grid.forces), grid.forces.shape[2]
        rows = grid.forces.reshape(-1, self.n_free)
        responses = self.respond(rows).reshape(grid.forces.shape)
        compliance = grid.forces @ responses.transpose(0, 2, 1)
        traces = np.trace(compliance, axis1=1, axis2=2)
        moving = traces > IMMOBILE * traces.max()
        vectors = grid.vectors
        works = np.einsum("gi,pij,gj->pg", vectors, compliance, vectors)
        least = STIFF * np.outer(traces, (vectors**2).sum(axis=1))
        shares = grid.weights.ravel() / moving.sum()
        self.weights = np.zeros(works.shape)
        self.weights[moving] = shares / np.maximum(works, least)[moving]
        self._shares = np.where(moving[:, None], shares, 0.0)
        self._vectors = vectors
        self._base = responses if linear else np.zeros(responses.shape)
        functions = [np.kron(family.directions, family.powers) for family in families]
        ends = np.cumsum([0, *(f.shape[1] for f in functions)])
        self.blocks = [slice(a, b) for a, b in pairwise(ends.tolist())]
        self.functions = np.hstack(functions)
        self.gram = np.stack(
            [self.functions.T @ (w[:, None] * self.functions) for w in self.weights]
        )

    def respond(self, loads: Array) -> Array:
        """Return the linear responses K₀⁻¹f (n, n_free), m, to loads of the same shape, N."""
        return np.ascontiguousarray(self.model.rest_factor.solve(loads.T).T)

    def coefficients(self, term: Term) -> Array:
        """Return the coefficients (n_functions,) of D M among the products of all families."""
        out = np.zeros(self.functions.shape[1])
        out[self.blocks[term.family]] = np.kron(term.direction, term.power)
        return out

    def balance(self, vectors: Array, positions: Array, coefficients: Array) -> Balance:
        """Evaluate the weak form.

        Parameters
        ----------
        vectors : (n_terms, n_free) float64
            X, m.
        positions : (n_terms, n_patches) float64
            P.
        coefficients : (n_terms, n_functions) float64
            Those of D M, from `coefficients`.
        """
        at_loads = self.functions @ coefficients.T
        residuals = np.zeros((self.n_patches, self.functions.shape[1], self.n_free))
        energy = squares = 0.0
        for p in np.flatnonzero(self.weights.any(axis=1)):
            u = self._vectors @ self._base[p] + (at_loads * positions[:, p]) @ vectors
            loads = self._vectors @ self.grid.forces[p]
            states = [self.model.force(row) for row in u]
            left = loads - np.stack([state.force for state in states])
            stored = np.array([state.energy_j for state in states])
            work = np.einsum("gn,gn->g", loads, u)
            energy += float(self.weights[p] @ (stored - work))
            residuals[p] = (self.weights[p][:, None] * self.functions).T @ left
            sizes = np.einsum("gn,gn->g", loads, loads)
            parts = np.einsum("gn,gn->g", left, left) / np.where(sizes > 0, sizes, 1.0)
            squares += float(self._shares[p] @ parts)
        return Balance(energy, residuals, float(np.sqrt(squares)))
