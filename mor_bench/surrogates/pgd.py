"""PGD: displacements in separated form over the position, the direction and the magnitude of one load."""

from __future__ import annotations

from math import comb
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.reduction.basis import pod
from mor_bench.reduction.separated import Family, separate
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import ImportedDatasetSpec
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.monomials import monomial_indices

Array = NDArray[np.float64]

FLAT = 1e-6
"""Extent of the loads' positions along an axis, relative to the body, below which it is no coordinate."""

LEAST_WEIGHED = 0.02
"""Magnitude, over the largest of training, down to which a sample's error is weighed by one over its magnitude."""


Levels = list[tuple[NDArray[np.int64], NDArray[np.int64]]]


def _by_degree(x: Array, levels: Levels) -> list[Array]:
    """The monomials of each degree from 0 on of the variables x (n, n_variables)."""
    found = [np.ones((len(x), 1)), x]
    for parents, variables in levels:
        found.append(found[-1].take(parents, axis=1) * x.take(variables, axis=1))
    return found


class SeparatedLoad(Surrogate):
    """u(x; s, d, m) = u₀(x) + Σ_k X_k(x) S_k(s) D_k(d) M_k(m), fitted to the snapshots by alternating least squares.

    The load position is a coordinate of the solution (Niroomandi, González, Alfaro, Cueto, Chinesta 2013, section 3); the
    terms are fitted to samples instead of to the equations (Ibáñez et al. 2018). A load is taken for one patch: s is the
    centroid of the nodal forces weighted by their lengths, d and m are direction and length of their sum. S are polynomials
    in the principal axes of the positions; since u is an analytic function of the force, a homogeneous polynomial D of
    degree j goes with powers M of m from m^j on, of the same parity. No force gives no displacement.

    A load of several patches is answered as if it were one at their centroid; `out_of_range` flags it. Positions outside
    those of training are moved to the nearest of their bounding box.

    Parameters
    ----------
    base : {"linear-response", "none"}
        What u₀ is: the linear response K₀⁻¹f to the nodal forces themselves, so that terms are of degree 2 and more and
        need only learn the nonlinear rest; or nothing, for which no equations need be known.
    n_terms : int
        Terms of the sum, at most.
    position_degree : int
        Degree of the polynomials in the position.
    force_degree : int
        Degree of the polynomials in the force.
    n_output_modes : int
        Size of the POD basis in which the X_k are sought; capped at the rank with a warning.
    ridge : float
        Tikhonov weight relative to the mean diagonal entry of each least-squares problem.
    """

    def __init__(
        self,
        base: Literal["linear-response", "none"] = "linear-response",
        n_terms: Annotated[int, Field(ge=1)] = 100,
        position_degree: Annotated[int, Field(ge=0, le=8)] = 4,
        force_degree: Annotated[int, Field(ge=2, le=6)] = 3,
        n_output_modes: Annotated[int, Field(ge=1)] = 40,
        ridge: Annotated[float, Field(ge=0)] = 1e-4,
    ) -> None:
        self.base = base
        self.n_terms = n_terms
        self.position_degree = position_degree
        self.force_degree = force_degree
        self.n_output_modes = n_output_modes
        self.ridge = ridge

    def supports(self, scene: Scene) -> str | None:
        if not isinstance(scene.spec, ImportedDatasetSpec) and scene.spec.loads.simultaneous > 1:
            return "its coordinates are those of one load patch, and here several act at once"
        return (
            unknown_equations(scene) if self.base == "linear-response" else super().supports(scene)
        )

    @property
    def _degrees(self) -> range:
        """Degrees in the force of the families of terms."""
        return range(2 if self.base == "linear-response" else 1, self.force_degree + 1)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            snapshots = self._checked_snapshots(snapshots)
            targets = snapshots.free_displacements
            if self.base == "linear-response":
                self.compliance_ = Compliance(FullOrderModel(scene))
                targets = (
                    targets
                    - self.compliance_.respond(snapshots.forces.reshape(len(snapshots), -1))[
                        :, scene.free_dofs
                    ]
                )
            positions, vectors = _coordinates(scene.mesh.points, snapshots.forces)
            frame, ends = _frame(positions[vectors.any(axis=1)], scene.mesh.points)
            largest = float(np.linalg.norm(vectors, axis=1).max())
            state = {"frame": frame, "ends": ends, "largest": np.array([largest])}
            self._take(state)
            position, directions, powers = self._functions(positions, vectors)
            # Errors count relative to the load: small loads would else be fitted by chance.
            magnitude = np.linalg.norm(vectors, axis=1) / (largest or 1.0)
            weights = 1.0 / np.maximum(magnitude, LEAST_WEIGHED)
            families: list[Family] = [
                (position, directions[degree], powers[:, degree - 1 :: 2] * weights[:, None])
                for degree in self._degrees
            ]
            modes = pod(targets, self.n_output_modes).modes
            found = separate(
                (targets @ modes) * weights[:, None], families, self.n_terms, self.ridge
            )
            n_directions = sum(directions[degree].shape[1] for degree in self._degrees)
            by_position, by_direction = (
                np.zeros((position.shape[1], len(found.terms))),
                np.zeros((n_directions, len(found.terms))),
            )
            by_power = np.zeros((self.force_degree, len(found.terms)))
            starts = np.cumsum([0, *(directions[degree].shape[1] for degree in self._degrees)])
            for k, term in enumerate(found.terms):
                degree = self._degrees[term.family]
                by_position[:, k] = term.coefficients[0]
                by_direction[starts[term.family] : starts[term.family + 1], k] = term.coefficients[
                    1
                ]
                by_power[degree - 1 :: 2, k] = term.coefficients[2]
            state |= {
                "modes": modes,
                "vectors": found.vectors,
                "by_position": by_position,
                "by_direction": by_direction,
                "by_power": by_power,
            }
            self._restore(state)
        return self

    def _functions(self, positions: Array, vectors: Array) -> tuple[Array, list[Array], Array]:
        """Functions of the positions (n, n_functions), of the directions by degree, and powers of the magnitudes (n, force_degree)."""
        s = np.minimum(
            np.maximum(positions @ self.frame_[:3] + self.frame_[3], self.ends_[0]), self.ends_[1]
        )
        length = np.linalg.norm(vectors, axis=1)
        d = vectors / np.where(length > 0, length, 1.0)[:, None]
        m = length / (self.largest_ or 1.0)
        by_position, by_direction = _by_degree(s, self._levels[0]), _by_degree(d, self._levels[1])
        powers = m[:, None] ** np.arange(1, self.force_degree + 1)
        return np.concatenate(by_position[: self.position_degree + 1], axis=1), by_direction, powers

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        scene = self.scene_
        position, directions, powers = self._functions(*_coordinates(scene.mesh.points, batch))
        direction = np.concatenate([directions[degree] for degree in self._degrees], axis=1)
        terms = (
            (position @ self.by_position_)
            * (direction @ self.by_direction_)
            * (powers @ self.by_power_)
        )
        per_term = (
            self.by_position_.size
            + self.by_direction_.size
            + self.by_power_.size
            + 2 * terms.shape[1]
        )
        functions = position.shape[1] + direction.shape[1] + powers.shape[1]
        products = (
            per_term + functions + self.vectors_.size + self.modes_.size + 7 * scene.mesh.n_nodes
        )
        count(multiply_adds=len(batch) * products)
        out = np.zeros((len(batch), scene.mesh.n_dofs))
        out[:, scene.free_dofs] = (terms @ self.vectors_) @ self.modes_.T
        if self.base == "linear-response":
            out += self.compliance_.respond(batch.reshape(out.shape))
        return out.reshape(np.shape(forces))

    def _state(self) -> dict[str, NDArray[Any]]:
        return {
            "frame": self.frame_,
            "ends": self.ends_,
            "largest": np.array([self.largest_]),
            "modes": self.modes_,
            "vectors": self.vectors_,
            "by_position": self.by_position_,
            "by_direction": self.by_direction_,
            "by_power": self.by_power_,
        }

    def _take(self, state: dict[str, NDArray[Any]]) -> None:
        self.frame_, self.ends_, self.largest_ = (
            np.ascontiguousarray(state["frame"]),
            np.ascontiguousarray(state["ends"]),
            float(state["largest"][0]),
        )
        self._levels = (
            monomial_indices(self.frame_.shape[1], self.position_degree),
            monomial_indices(3, self.force_degree),
        )

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        state = {name: np.ascontiguousarray(array) for name, array in state.items()}
        n_axes, n_modes, n_terms = (
            state["frame"].shape[1],
            state["modes"].shape[1],
            state["vectors"].shape[0],
        )
        n_positions = comb(n_axes + self.position_degree, n_axes)
        n_directions = sum(comb(degree + 2, 2) for degree in self._degrees)
        shapes = {
            "frame": (4, n_axes),
            "ends": (2, n_axes),
            "largest": (1,),
            "modes": (len(self.scene_.free_dofs), n_modes),
            "vectors": (n_terms, n_modes),
            "by_position": (n_positions, n_terms),
            "by_direction": (n_directions, n_terms),
            "by_power": (self.force_degree, n_terms),
        }
        for name, shape in shapes.items():
            if state[name].shape != shape or not np.isfinite(state[name]).all():
                raise InvalidInputError(
                    f"`{name}` must be a finite array of shape {shape}; got shape {state[name].shape}."
                )
        self._take(state)
        self.modes_, self.vectors_ = state["modes"], state["vectors"]
        self.by_position_, self.by_direction_, self.by_power_ = (
            state["by_position"],
            state["by_direction"],
            state["by_power"],
        )
        if self.base == "linear-response" and not hasattr(self, "compliance_"):
            self.compliance_ = Compliance(FullOrderModel(self.scene_))


def _coordinates(points: Array, forces: Array) -> tuple[Array, Array]:
    """Centroids of nodal forces (n, n_nodes, 3), weighted by their lengths, (n, 3) m, and their sums (n, 3) N.

    Of a uniform traction, whose nodal forces are consistent, this is the centroid of its patch. Of no force it is the
    origin.
    """
    lengths = np.sqrt(np.einsum("nai,nai->na", forces, forces))
    total = lengths.sum(axis=1)
    return (lengths @ points) / np.where(total > 0, total, 1.0)[:, None], (
        np.ones((1, len(points))) @ forces
    )[:, 0]


def _frame(positions: Array, points: Array) -> tuple[Array, Array]:
    """Principal axes of positions, scaled to [-1, 1], as (4, n_axes): s = x @ frame[:3] + frame[3]; and the ends of each (2, n_axes)."""
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
