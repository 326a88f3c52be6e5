"""PGD from the weak form: separated displacements under one load, without snapshots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.model_arrays import take_array
from mor_bench.reduction.alternating_directions import decompose
from mor_bench.reduction.load_grid import load_grid
from mor_bench.reduction.subspace import at_wanted, wanted_dofs
from mor_bench.reduction.tensors import has_polynomial
from mor_bench.reduction.weak_form import Family, Term, WeakForm
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.load_range import LoadRange
from mor_bench.specs import DatasetSpec
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.monomials import Levels, by_degree, monomial_indices
from mor_bench.surrogates.pgd import load_coordinates, not_single

Array = NDArray[np.float64]


@dataclass(eq=False)
class WeakFormPGD(Surrogate):
    """u(x; p, d, m) = u₀(x) + Σ_k X_k(x) P_k(p) D_k(d) M_k(m), by alternating directions.

    The coordinates are the scene's patch p, and direction d and magnitude m of the force on it
    (Niroomandi, Alfaro, González, Cueto, Chinesta, IJNME 96 (2013) 129-149). The sum balances the
    weak form over all single loads (`mor_bench.reduction.weak_form`). Alternating directions find
    each term (`mor_bench.reduction.alternating_directions`). No load is solved for, and no snapshot
    is used.

    P has one value per patch. D is a homogeneous polynomial of the direction of degree j. The
    factors M of such a D are powers of the magnitude from m^j, with the parity of j. So no force
    gives no displacement, and small loads get u₀ and the terms of degree one.

    A load elsewhere gets the terms of the patch with the nearest centroid. Several loads are
    treated as one. The arrays of the model contain the `history` of the fit: number of terms, mean
    potential energy relative to twice that of the linear response, and root mean square of the
    residual relative to the load.

    Parameters
    ----------
    base : {"linear-response", "none"}
        u₀. "linear-response": K₀⁻¹f from the nodal forces; terms have degree 2 or more. "none":
        zero; terms have degree 1 or more.
    n_terms : int
        Upper bound on the terms of the sum.
    force_degree : int
        Largest degree in the force, 2 to 6.
    n_rings : int, optional
        Rings of directions in the grid of loads, 2 n_rings² directions. Default and least value:
        `force_degree` + 1.
    n_magnitudes : int, optional
        Magnitudes in the grid of loads. Default: `force_degree`.
    tolerance : float
        The updates after the last term end when they are shorter, relative to the linear response
        in the norm of the linear energy. In (0, 1].
    """

    base: Literal["linear-response", "none"] = "linear-response"
    n_terms: Annotated[int, Field(ge=1)] = 60
    force_degree: Annotated[int, Field(ge=2, le=6)] = 3
    n_rings: Annotated[int, Field(ge=3, le=16)] | None = None
    n_magnitudes: Annotated[int, Field(ge=1, le=16)] | None = None
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-4

    needs_snapshots: ClassVar[bool] = False

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene) or self._other_loads(scene)

    def _other_loads(self, scene: Scene) -> str | None:
        """Return why the loads or the law of a scene with known equations do not fit."""
        if not has_polynomial(scene):
            return (
                "it is for the law saint-venant-kirchhoff only; this law is "
                f"{scene.generated.material.law}"
            )
        if not isinstance(scene.spec, DatasetSpec) or scene.spec.loads is None:
            return "it needs the load patches of the scene, and no loads are given"
        return not_single(scene.spec.load_plan)

    @property
    def _degrees(self) -> range:
        """Degrees in the force, one for each family of terms."""
        return range(2 if self.base == "linear-response" else 1, self.force_degree + 1)

    @cached_property
    def _levels(self) -> Levels:
        return monomial_indices(3, self.force_degree)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        n_rings = self.n_rings or self.force_degree + 1
        n_magnitudes = self.n_magnitudes or self.force_degree
        if n_rings <= self.force_degree:
            raise InvalidInputError(
                f"`n_rings` must be larger than `force_degree`, {self.force_degree}; got {n_rings}."
            )
        grid = load_grid(scene, n_rings, n_magnitudes)
        largest = float(grid.magnitudes[-1])
        directions = by_degree(grid.directions, self._levels)
        powers = self._powers(grid.magnitudes / largest)
        families = [Family(directions[j], powers[:, j - 1 :: 2]) for j in self._degrees]
        if n_magnitudes < (most := max(family.powers.shape[1] for family in families)):
            raise InvalidInputError(
                f"`n_magnitudes` must be at least {most}, the number of powers of a factor; "
                f"got {n_magnitudes}."
            )
        model = FullOrderModel(scene)
        weak = WeakForm(model, grid, families, self.base == "linear-response")
        found = decompose(weak, self.n_terms, self.tolerance, self.time_limit_s)
        if not found.terms:
            raise SolverError(f"{scene.name}: no term of the separated displacement was found.")
        return {
            "centroids": _centroids(scene),
            "largest": np.array([largest]),
            "vectors": found.vectors,
            **self._factors(found.terms, families),
            "history": found.history,
        }

    def _powers(self, magnitudes: Array) -> Array:
        return np.asarray(magnitudes[:, None] ** np.arange(1, self.force_degree + 1))

    def _factors(self, terms: Sequence[Term], families: Sequence[Family]) -> dict[str, Array]:
        starts = np.cumsum([0, *(family.directions.shape[1] for family in families)])
        by_direction = np.zeros((int(starts[-1]), len(terms)))
        by_power = np.zeros((self.force_degree, len(terms)))
        for k, term in enumerate(terms):
            by_direction[starts[term.family] : starts[term.family + 1], k] = term.direction
            by_power[self._degrees[term.family] - 1 :: 2, k] = term.power
        by_patch = np.stack([term.position for term in terms], axis=1)
        return {"by_patch": by_patch, "by_direction": by_direction, "by_power": by_power}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        n_patches = len(scene.patch_nodes)
        self.centroids_ = take_array(model, "centroids", (n_patches, 3))
        self.largest_ = float(take_array(model, "largest", (1,))[0])
        if not self.largest_ > 0:
            raise InvalidInputError(f"`largest` must be > 0; got {self.largest_}.")
        self.range_ = LoadRange.of_single_loads(scene, self.largest_)
        self.vectors_ = take_array(model, "vectors", (None, len(scene.free_dofs)))
        n_terms = len(self.vectors_)
        n_directions = sum((j + 1) * (j + 2) // 2 for j in self._degrees)
        self.by_patch_ = take_array(model, "by_patch", (n_patches, n_terms))
        self.by_direction_ = take_array(model, "by_direction", (n_directions, n_terms))
        self.by_power_ = take_array(model, "by_power", (self.force_degree, n_terms))
        self.history_ = take_array(model, "history", (None, 3))
        if self.base == "linear-response":
            self.compliance_ = Compliance(FullOrderModel(scene))
        self._wanted = wanted_dofs(scene)
        rows = slice(None) if self._wanted is None else self._wanted
        self._expanding = np.ascontiguousarray(scene.at_all_dofs(self.vectors_)[:, rows])
        if self.base == "linear-response":
            self._respond = self.compliance_.at(self._wanted)

    def answer(self, forces: Array) -> Array:
        scene = self.scene_
        positions, vectors = load_coordinates(scene.mesh.points, forces)
        magnitudes = np.linalg.norm(vectors, axis=1)
        degrees = by_degree(
            vectors / np.where(magnitudes > 0, magnitudes, 1.0)[:, None], self._levels
        )
        direction = np.concatenate([degrees[j] for j in self._degrees], axis=1)
        powers = self._powers(magnitudes / self.largest_)
        away = positions[:, None] - self.centroids_
        patches = np.einsum("npi,npi->np", away, away).argmin(axis=1)
        terms = (
            self.by_patch_[patches] * (direction @ self.by_direction_) * (powers @ self.by_power_)
        )
        functions = direction.shape[1] + powers.shape[1]
        products = self.by_direction_.size + self.by_power_.size + 2 * terms.shape[1] + functions
        places = 7 * scene.mesh.n_nodes + self.centroids_.size
        expansion = min(self._expanding.size, self.vectors_.size)
        count(multiply_adds=len(forces) * (products + expansion + places))
        out = terms @ self._expanding
        loads = forces.reshape(len(forces), scene.mesh.n_dofs)
        if self.base == "linear-response":
            out += self._respond(loads)
        return at_wanted(out, self._wanted, loads.shape[1]).reshape(forces.shape)


def _centroids(scene: Scene) -> Array:
    """Return the centroid of the nodal forces of each patch, (n_patches, 3), m."""
    weights = scene.patch_weights.toarray()
    return load_coordinates(scene.mesh.points, weights[:, :, None] * np.array([1.0, 0.0, 0.0]))[0]
