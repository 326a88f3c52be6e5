"""PGD fitted to snapshots: sums of functions of position, direction and magnitude of one load.

`pgd_weak_form` finds such a sum from the equations, without snapshots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import error_weights
from mor_bench.reduction.separated import Family, Term, separate
from mor_bench.reduction.subspace import at_wanted, wanted_dofs
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import DatasetSpec
from mor_bench.specs.loads_spec import AnyLoads, Pressure
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.monomials import Levels, by_degree, monomial_indices

Array = NDArray[np.float64]


def not_single(plan: AnyLoads) -> str | None:
    """Return why loads are not forces on one patch at a time; None if they are."""
    if isinstance(plan, Pressure):
        return "it is for forces on patches, and here pressures act"
    return (
        "it handles one load patch, and here several act at once" if plan.simultaneous > 1 else None
    )


FLAT = 1e-6
"""Smallest extent of the load positions along a coordinate axis, relative to the body."""

LEAST_WEIGHED = 0.05
"""Errors are divided by the displacement's norm, but at least by this fraction of its root mean
square."""


@dataclass(frozen=True)
class LoadFunctions:
    """Functions of position, direction and magnitude of a load.

    Attributes
    ----------
    frame : (4, n_axes) float64
        Maps a position x to coordinates s = x @ frame[:3] + frame[3] in [-1, 1].
    ends : (2, n_axes) float64
        Bounds of s in training.
    largest : float
        Largest magnitude in training, N.
    position_degree, force_degree : int
        Degrees of the polynomials.
    """

    frame: Array
    ends: Array
    largest: float
    position_degree: int
    force_degree: int

    def __call__(self, positions: Array, vectors: Array) -> tuple[Array, list[Array], Array]:
        """Evaluate at positions (n, 3), m, and forces (n, 3), N.

        Returns
        -------
        by_position : (n, n_functions) float64
        by_direction : list of (n, n_functions) float64
            Homogeneous polynomials, by degree from 0.
        by_power : (n, force_degree) float64
        """
        s = np.minimum(
            np.maximum(positions @ self.frame[:3] + self.frame[3], self.ends[0]), self.ends[1]
        )
        length = np.linalg.norm(vectors, axis=1)
        d = vectors / np.where(length > 0, length, 1.0)[:, None]
        m = length / (self.largest or 1.0)
        of_position, of_direction = self._levels
        by_position, by_direction = by_degree(s, of_position), by_degree(d, of_direction)
        powers = m[:, None] ** np.arange(1, self.force_degree + 1)
        return np.concatenate(by_position[: self.position_degree + 1], axis=1), by_direction, powers

    @cached_property
    def _levels(self) -> tuple[Levels, Levels]:
        return (
            monomial_indices(self.frame.shape[1], self.position_degree),
            monomial_indices(3, self.force_degree),
        )


@dataclass(eq=False)
class SeparatedLoad(Surrogate):
    """u(x; s, d, m) = u₀(x) + Σ_k X_k(x) S_k(s) D_k(d) M_k(m), by alternating least squares.

    The load position is a coordinate of the solution (Niroomandi, González, Alfaro, Cueto, Chinesta
    2013, section 3). The terms are fitted to samples instead of to the equations (Ibáñez et al.
    2018). Every load is treated as one patch: s is the centroid of the nodal forces weighted by
    their lengths; d and m are direction and length of their sum. S are polynomials in the principal
    axes of the positions. u is an analytic function of the force. So the factors M of a homogeneous
    polynomial D of degree j are powers of m from m^j, with the parity of j. No force gives no
    displacement.

    Several patches are treated as one at their centroid; `out_of_range` flags them. Positions
    outside the bounding box of the training positions move to its nearest point.

    Parameters
    ----------
    base : {"linear-response", "none"}
        u₀. "linear-response": K₀⁻¹f from the nodal forces; terms have degree 2 or more and learn
        only the nonlinear part. "none": zero, which needs no equations.
    n_terms : int
        Upper bound on the terms of the sum.
    position_degree : int
        Degree of the polynomials in the position, 0 to 8.
    force_degree : int
        Degree of the polynomials in the force, 2 to 6.
    n_output_modes : int
        Size of the POD basis for the X_k; capped at the rank with a warning.
    ridge : float
        Tikhonov weight relative to the mean diagonal entry of each least-squares problem.
    """

    base: Literal["linear-response", "none"] = "linear-response"
    n_terms: Annotated[int, Field(ge=1)] = 100
    position_degree: Annotated[int, Field(ge=0, le=8)] = 4
    force_degree: Annotated[int, Field(ge=2, le=6)] = 3
    n_output_modes: Annotated[int, Field(ge=1)] = 40
    ridge: Annotated[float, Field(ge=0)] = 1e-4

    def supports(self, scene: Scene) -> str | None:
        if isinstance(scene.spec, DatasetSpec) and (reason := not_single(scene.spec.load_plan)):
            return reason
        return (
            unknown_equations(scene) if self.base == "linear-response" else super().supports(scene)
        )

    @property
    def _degrees(self) -> range:
        """Degrees in the force, one for each family of terms."""
        return range(2 if self.base == "linear-response" else 1, self.force_degree + 1)

    def _functions_of(self, model: Mapping[str, NDArray[Any]]) -> LoadFunctions:
        return LoadFunctions(
            np.ascontiguousarray(model["frame"]),
            np.ascontiguousarray(model["ends"]),
            float(model["largest"][0]),
            self.position_degree,
            self.force_degree,
        )

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        targets = samples.free_displacements
        if self.base == "linear-response":
            self.compliance_ = Compliance(FullOrderModel(scene))
            responses = self.compliance_.respond(samples.forces.reshape(len(samples), -1))
            targets = targets - scene.at_free_dofs(responses)
        positions, vectors = load_coordinates(scene.mesh.points, samples.forces)
        frame, ends = _frame(positions[vectors.any(axis=1)], scene.mesh.points)
        largest = float(np.linalg.norm(vectors, axis=1).max())
        model = {"frame": frame, "ends": ends, "largest": np.array([largest])}
        position, directions, powers = self._functions_of(model)(positions, vectors)
        weights = error_weights(samples.free_displacements, LEAST_WEIGHED)
        families: list[Family] = [
            (position, directions[degree], powers[:, degree - 1 :: 2] * weights[:, None])
            for degree in self._degrees
        ]
        modes = pod(targets, self.n_output_modes).modes
        found = separate((targets @ modes) * weights[:, None], families, self.n_terms, self.ridge)
        return {
            **model,
            "modes": modes,
            "vectors": found.vectors,
            **self._coefficients(found.terms, families),
        }

    def _coefficients(self, terms: Sequence[Term], families: list[Family]) -> dict[str, Array]:
        starts = np.cumsum([0, *(direction.shape[1] for _, direction, _ in families)])
        by_position = np.zeros((families[0][0].shape[1], len(terms)))
        by_direction = np.zeros((int(starts[-1]), len(terms)))
        by_power = np.zeros((self.force_degree, len(terms)))
        for k, term in enumerate(terms):
            degree = self._degrees[term.family]
            own = slice(starts[term.family], starts[term.family + 1])
            by_position[:, k] = term.coefficients[0]
            by_direction[own, k] = term.coefficients[1]
            by_power[degree - 1 :: 2, k] = term.coefficients[2]
        return {"by_position": by_position, "by_direction": by_direction, "by_power": by_power}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        frame = take_array(model, "frame", (4, None))
        ends = take_array(model, "ends", (2, frame.shape[1]))
        largest = take_array(model, "largest", (1,))
        self.functions_ = self._functions_of({"frame": frame, "ends": ends, "largest": largest})
        self.modes_ = take_array(model, "modes", (len(scene.free_dofs), None))
        n_terms, n_axes = len(model["vectors"]), frame.shape[1]
        self.vectors_ = take_array(model, "vectors", (n_terms, self.modes_.shape[1]))
        n_positions = comb(n_axes + self.position_degree, n_axes)
        n_directions = sum(comb(degree + 2, 2) for degree in self._degrees)
        self.by_position_ = take_array(model, "by_position", (n_positions, n_terms))
        self.by_direction_ = take_array(model, "by_direction", (n_directions, n_terms))
        self.by_power_ = take_array(model, "by_power", (self.force_degree, n_terms))
        if self.base == "linear-response" and not hasattr(self, "compliance_"):
            self.compliance_ = Compliance(FullOrderModel(scene))
        self._wanted = wanted_dofs(scene)
        rows = slice(None) if self._wanted is None else self._wanted
        self._expanding = np.ascontiguousarray(scene.columns_at_all_dofs(self.modes_)[rows].T)
        if self.base == "linear-response":
            self._respond = self.compliance_.at(self._wanted)

    def answer(self, forces: Array) -> Array:
        scene = self.scene_
        position, directions, powers = self.functions_(*load_coordinates(scene.mesh.points, forces))
        direction = np.concatenate([directions[degree] for degree in self._degrees], axis=1)
        terms = (
            (position @ self.by_position_)
            * (direction @ self.by_direction_)
            * (powers @ self.by_power_)
        )
        functions = position.shape[1] + direction.shape[1] + powers.shape[1]
        coefficients = self.by_position_.size + self.by_direction_.size + self.by_power_.size
        expansion = self.vectors_.size + min(self._expanding.size, self.modes_.size)
        products = coefficients + 2 * terms.shape[1] + functions + expansion
        count(multiply_adds=len(forces) * (products + 7 * scene.mesh.n_nodes))
        out = (terms @ self.vectors_) @ self._expanding
        loads = forces.reshape(len(forces), scene.mesh.n_dofs)
        if self.base == "linear-response":
            out += self._respond(loads)
        return at_wanted(out, self._wanted, loads.shape[1]).reshape(forces.shape)


def load_coordinates(points: Array, forces: Array) -> tuple[Array, Array]:
    """Return weighted centroids (n, 3), m, and sums (n, 3), N, of nodal forces (n, n_nodes, 3).

    The weights are the lengths of the forces. For a uniform traction with consistent nodal forces,
    the centroid is that of its patch; for no force it is the origin.
    """
    lengths = np.sqrt(np.einsum("nai,nai->na", forces, forces))
    total = lengths.sum(axis=1)
    return (lengths @ points) / np.where(total > 0, total, 1.0)[:, None], (
        np.ones((1, len(points))) @ forces
    )[:, 0]


def _frame(positions: Array, points: Array) -> tuple[Array, Array]:
    """Return the principal axes of positions, scaled to [-1, 1], and the bounds on each.

    The axes (4, n_axes) give s = x @ frame[:3] + frame[3]; the bounds are (2, n_axes).
    """
    if not len(positions):
        positions = points.mean(axis=0, keepdims=True)
    centre = 0.5 * (positions.min(axis=0) + positions.max(axis=0))
    axes = np.linalg.eigh((positions - centre).T @ (positions - centre))[1].T[::-1]
    along = (positions - centre) @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    extent = float(np.ptp(points, axis=0).max())
    used = np.flatnonzero(high - low > FLAT * extent)
    used = used if len(used) else np.arange(1)
    half = np.where(high - low > FLAT * extent, 0.5 * (high - low), extent)[used]
    axes = axes[used] / half[:, None]
    frame = np.vstack([axes.T, -(centre @ axes.T) - 0.5 * (low + high)[used] / half])
    along = positions @ frame[:3] + frame[3]
    return frame, np.stack([along.min(axis=0), along.max(axis=0)])
