"""The full-order model started from a known solution under a similar load instead of from rest."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from mor_bench.counting import count
from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.reduction.basis import pod
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

N_COORDINATES = 12
"""Principal coordinates of the linear response in which loads are compared."""

NEAR = 0.5
"""How far the linear response of a known solution may be from the query's, as a fraction of the latter's norm."""


class WarmFEM(Surrogate):
    """The full-order solve, started at u* + K₀⁻¹(f - f*), with u* the known solution under a load f*.

    A solution is used only if its linear response lies within `NEAR` of the query's; else the start is rest. A bad start
    costs time and never the answer: the tolerance and the checks are those of full-order FEM, and where the start leads
    nowhere the safeguarded pass begins at rest.

    Parameters
    ----------
    start : {"nearest", "previous"}
        `nearest`: of the first training samples, the one whose linear response is nearest. `previous`: the last solution
        of this object, as in an interactive simulation; then the answers depend on the order of the queries, within the
        tolerance, and a loaded model begins at rest.
    tolerance : float
        Norm of the residual relative to that of the load at which the solve stops.
    n_starts : int
        Training samples kept for `nearest`.
    """

    model_: FullOrderModel
    compliance_: Compliance

    def __init__(
        self,
        start: Literal["nearest", "previous"] = "nearest",
        tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-4,
        n_starts: Annotated[int, Field(ge=1)] = 1000,
    ) -> None:
        self.start = start
        self.tolerance = tolerance
        self.n_starts = n_starts

    @property
    def needs_snapshots(self) -> bool:  # type: ignore[override]
        """Whether solutions are taken from the training samples."""
        return self.start == "nearest"

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        """Factorise the rest-state stiffness and, for `nearest`, sort the training samples by their linear responses."""
        with self._fitting(scene):
            if self.start == "previous":
                self._restore({})
                return self
            # The first samples cover the load regions evenly.
            known = self._checked_snapshots(snapshots)[: self.n_starts]
            model = FullOrderModel(scene)
            linear = model.rest_factor.solve(known.free_forces.T).T
            modes = pod(linear).modes[:, :N_COORDINATES]
            shifts = known.free_displacements - linear
            self._restore(
                {
                    "shifts": shifts,
                    "to_coordinates": model.rest_factor.solve(modes),
                    "coordinates": linear @ modes,
                }
            )
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        out = np.zeros((len(batch), self.scene_.mesh.n_dofs))
        free = self.scene_.free_dofs
        options = NewtonOptions(self.tolerance)
        for row, load in zip(out, batch.reshape(-1, self.scene_.mesh.n_dofs)[:, free], strict=True):
            linear = self.compliance_.solve(load)
            row[free] = self.model_.solve(
                load, linear + self._shift(load, linear), options
            ).displacement
            self._last = linear, row[free] - linear
        return out.reshape(np.shape(forces))

    def _shift(self, load: NDArray[np.float64], linear: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the nearest known solution has beyond its linear response, (n_free,) m; zero if it is not near."""
        if self.start == "previous":
            before, shift = self._last
            near = np.linalg.norm(linear - before) <= NEAR * np.linalg.norm(linear)
        else:
            # The search's comparisons do not count.
            count(multiply_adds=self.to_coordinates_.size)
            coordinates = load @ self.to_coordinates_
            distance, known = self._tree.query(coordinates)
            near, shift = distance <= NEAR * np.linalg.norm(coordinates), self.shifts_[known]
        return shift if near else np.zeros_like(shift)

    def _state(self) -> dict[str, NDArray[Any]]:
        if self.start == "previous":
            return {}
        return {
            "shifts": self.shifts_,
            "to_coordinates": self.to_coordinates_,
            "coordinates": self.coordinates_,
        }

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        n_free = len(self.scene_.free_dofs)
        self._last = np.zeros(n_free), np.zeros(n_free)
        if self.start == "nearest":
            n_known, n_coordinates = state["coordinates"].shape
            shapes = {
                "shifts": (n_known, n_free),
                "to_coordinates": (n_free, n_coordinates),
                "coordinates": (n_known, n_coordinates),
            }
            for name, shape in shapes.items():
                if state[name].shape != shape or not np.isfinite(state[name]).all():
                    raise InvalidInputError(
                        f"`{name}` must be a finite array of shape {shape}; got shape {state[name].shape}."
                    )
            self.shifts_, self.to_coordinates_, self.coordinates_ = (
                np.ascontiguousarray(state[name]) for name in shapes
            )
            self._tree = cKDTree(self.coordinates_)
        self.model_ = FullOrderModel(self.scene_)
        self.compliance_ = Compliance(self.model_)
