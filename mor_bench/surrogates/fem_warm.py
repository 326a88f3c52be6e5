"""The full-order model, started from a known solution under a similar load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from mor_bench.counting import count
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.model_arrays import take_array
from mor_bench.reduction.basis import pod
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.free_dofs import answer_each

Array = NDArray[np.float64]

N_COORDINATES = 12
"""Number of principal coordinates of the linear response in which loads are compared."""

NEAR = 0.5
"""Largest distance between the linear responses of a known solution and of the query, as a
fraction of the norm of the query's."""


@dataclass(eq=False)
class WarmFEM(Surrogate):
    """The full-order solve, started at u* + K₀⁻¹(f - f*), with a known solution u* under a load f*.

    A solution is used only if its linear response lies within `NEAR` of the query's. Otherwise the
    solve starts at the linear response. A bad start costs time but never changes the answer: the
    tolerance and the checks are those of full-order FEM.

    Parameters
    ----------
    start : {"nearest", "previous"}
        "nearest": the training sample whose linear response is nearest. "previous": the last
        solution of this object, as in an interactive simulation. Then answers depend on the order
        of the queries, within the tolerance, and a loaded model begins at rest.
    tolerance : float
        Largest norm of the final residual relative to that of the load, in (0, 1].
    n_starts : int
        Training samples kept for "nearest"; the first ones, which cover the load regions evenly.
    """

    start: Literal["nearest", "previous"] = "nearest"
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-4
    n_starts: Annotated[int, Field(ge=1)] = 1000

    @property
    def needs_snapshots(self) -> bool:  # type: ignore[override]
        """True if known solutions come from the training samples."""
        return self.start == "nearest"

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        if self.start == "previous":
            return {}
        known = samples[: self.n_starts]
        model = FullOrderModel(scene)
        linear = model.rest_factor.solve(known.free_forces.T).T
        modes = pod(linear).modes[:, :N_COORDINATES]
        return {
            "shifts": known.free_displacements - linear,
            "to_coordinates": model.rest_factor.solve(modes),
            "coordinates": linear @ modes,
        }

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        n_free = len(scene.free_dofs)
        self.last_ = np.zeros(n_free), np.zeros(n_free)
        if self.start == "nearest":
            coordinates = take_array(model, "coordinates", (None, None))
            n_known, n_coordinates = coordinates.shape
            self.shifts_ = take_array(model, "shifts", (n_known, n_free))
            self.to_coordinates_ = take_array(model, "to_coordinates", (n_free, n_coordinates))
            self.tree_ = cKDTree(coordinates)
        self.model_ = FullOrderModel(scene)
        self.compliance_ = Compliance(self.model_)

    def answer(self, forces: Array) -> Array:
        return answer_each(self.scene_, forces, self._solve)

    def _solve(self, load: Array) -> Array:
        linear = self.compliance_.solve(load)
        start = linear + self._shift(load, linear)
        found = self.model_.solve(load, start, NewtonOptions(self.tolerance)).displacement
        self.last_ = linear, found - linear
        return found

    def _shift(self, load: Array, linear: Array) -> Array:
        """Return the nearest known solution minus its linear response, (n_free,) m.

        It is zero if no solution is near.
        """
        if self.start == "previous":
            before, shift = self.last_
            near = np.linalg.norm(linear - before) <= NEAR * np.linalg.norm(linear)
        else:
            count(multiply_adds=self.to_coordinates_.size)  # comparisons of the search do not count
            coordinates = load @ self.to_coordinates_
            distance, known = self.tree_.query(coordinates)
            near, shift = distance <= NEAR * np.linalg.norm(coordinates), self.shifts_[known]
        return shift if near else np.zeros_like(shift)
