"""Hybrid: another method's answer as the start of the full-order solve, and few corrections of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Self

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.mechanics.anderson import Anderson
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.method_loading import load_method
from mor_bench.model_file import size_arrays, take_sizes
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

START = "start."
"""Beginning of the names of the arrays that belong to the start's model."""

WORSE = 1.0
"""A residual above this share of the load after the corrections means that they lead nowhere: the solve begins at rest."""


NEAR, SURE = 0.5, 0.7
"""Corrections that are a smaller share of the answer than this, and leave the cells a larger det F at their centres, need no look at all
quadrature points, which takes a sixth of a query on the fine beam."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _least_det_f(u, cell_nodes, gradients):  # type: ignore[no-untyped-def]
    """The smallest det F at the cells' centres; displacements (n_free_nodes + 1, 3), m, end in that of fixed nodes."""
    least, F = np.inf, np.empty((3, 3))
    for k in range(len(cell_nodes)):
        for i in range(3):
            for j in range(3):
                F[i, j] = 1.0 if i == j else 0.0
        for a in range(cell_nodes.shape[1]):
            for i in range(3):
                for j in range(3):
                    F[i, j] += u[cell_nodes[k, a], i] * gradients[k, a, j]
        det = F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1]) - F[0, 1] * (
            F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0]
        )
        least = min(least, det + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0]))
    return least


class Hybrid(Surrogate):
    """The full-order solve from the answer of any other method.

    With a number of steps, u ← u + R K₀⁻¹ Rᵀ (f - f_int(u)) that often, with the stiffness at rest turned with the body
    (see `mor_bench.mechanics.rotated`) and Anderson's acceleration; near the solution the error falls tenfold with each.
    Whether the equilibrium is stable is not asked. With a tolerance instead, the whole solve with all its checks, only begun
    elsewhere.
    An answer with det F <= 0, or one that is no better than none, is dropped for the solve from rest; it is looked at in full
    where it is far from its start or a cell is much deformed.

    Parameters
    ----------
    start : str
        A method of the suite that supports the scene.
    start_parameters : dict
        Knobs of that method that differ from its file's.
    steps : int, optional
        Corrections; without a tolerance 1 by default.
    tolerance : float, optional
        Instead of steps: norm of the residual relative to that of the load at which to stop.
    """

    model_: FullOrderModel

    def __init__(
        self,
        start: str = "pod-tensor",
        start_parameters: dict[str, Any] | None = None,
        steps: Annotated[int, Field(ge=1, le=100)] | None = None,
        tolerance: Annotated[float, Field(gt=0, le=1)] | None = None,
    ) -> None:
        self.start = start
        self.start_parameters = start_parameters
        self.steps = steps
        self.tolerance = tolerance

    @property
    def needs_snapshots(self) -> bool:  # type: ignore[override]
        """Whether the start learns from snapshots."""
        return self._unfitted().needs_snapshots

    def _unfitted(self) -> Surrogate:
        return load_method(self.start, **(self.start_parameters or {}))

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene) or self._unfitted().supports(scene)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        """Fit the start, and factorise the rest-state stiffness."""
        if self.steps is not None and self.tolerance is not None:
            raise InvalidInputError(
                f"`steps` and `tolerance` exclude each other; got {self.steps} and {self.tolerance}."
            )
        with self._fitting(scene):
            start = self._unfitted()
            if start.needs_snapshots:
                self._checked_snapshots(snapshots)
            start.time_limit_s = self.time_limit_s
            self._take(start.fit(_all_outputs(scene), snapshots))
        return self

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces)
        free = self.scene_.free_dofs
        out = np.zeros((len(batch), self.scene_.mesh.n_dofs))
        for row, force in zip(out, batch, strict=True):
            load = force.ravel()[free]
            if load.any():
                row[free] = self._solve(load, self._guess(force))
        return out.reshape(np.shape(forces))

    def _guess(self, force: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """The start's answer on the free dofs, m; None if it has none."""
        try:
            guess = self.start_.predict(force).ravel()[self.scene_.free_dofs]
        except SolverError:
            return None
        return guess if np.isfinite(guess).all() else None

    def _solve(
        self, load: NDArray[np.float64], guess: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        if self.tolerance is not None:
            return self.model_.solve(load, guess, NewtonOptions(self.tolerance)).displacement
        corrected = None if guess is None else self._corrected(load, guess)
        return self.model_.solve(load).displacement if corrected is None else corrected

    def _corrected(
        self, load: NDArray[np.float64], guess: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        inverse, memory, u = self.model_.turned_rest, Anderson(len(guess)), guess
        for _ in range(self.steps or 1):
            residual = load - self.model_.force(u).force
            correction = inverse.solve_many([residual], [inverse.turned(u)])[0]
            u = u + memory.advance(u, correction, residual)
        near = float(np.linalg.norm(u - guess)) <= NEAR * float(np.linalg.norm(u))
        if (
            near
            and _least_det_f(np.append(u, np.zeros(3)).reshape(-1, 3), *inverse.cells[:2]) >= SURE
        ):
            return u
        state = self.model_.force(u)
        better = float(np.linalg.norm(load - state.force)) <= WORSE * float(np.linalg.norm(load))
        return u if better and state.min_det_f > 0 else None

    def _take(self, start: Surrogate) -> None:
        self.start_ = start
        self.model_ = FullOrderModel(self.scene_, "auto")
        _ = self.model_.turned_rest

    def _state(self) -> dict[str, NDArray[Any]]:
        return {
            START + name: array
            for name, array in {
                **self.start_.model_arrays(),
                **size_arrays(getattr(self.start_, "sizes_", {})),
            }.items()
        }

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        start = self._unfitted()
        arrays = {name.removeprefix(START): array for name, array in state.items()}
        sizes = take_sizes(arrays)
        self._take(start.restore(_all_outputs(self.scene_), arrays, sizes))


def _all_outputs(scene: Scene) -> Scene:
    """The scene with displacements wanted everywhere: a start must be whole."""
    if len(scene.output_nodes) == scene.mesh.n_nodes:
        return scene
    return replace(
        scene,
        spec=scene.spec.model_copy(
            update={"needs": scene.spec.needs.model_copy(update={"outputs": "all"})}
        ),
    )
