"""Hybrid: the answer of another method, corrected by steps of the full-order solve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.errors import InvalidInputError, SolverError, SpecError
from mor_bench.mechanics.anderson import Anderson
from mor_bench.mechanics.model import FullOrderModel, unknown_equations
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.method_loading import load_method
from mor_bench.model_file import size_arrays, take_sizes
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.specs import list_suite, load_method_spec
from mor_bench.surrogate import Surrogate

Array = NDArray[np.float64]

START = "start."
"""Prefix of the names of the starting method's arrays."""

WORSE = 1.0
"""Largest residual after the corrections, as a fraction of the load. Above it, the solve starts
at rest."""

NEAR, SURE = 0.5, 0.7
"""Limits for skipping the check of det F at all quadrature points: largest correction, as a
fraction of the answer, and smallest det F at the cells' centres."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _least_det_f(u, cell_nodes, gradients):  # type: ignore[no-untyped-def]
    """Return the smallest det F at the cells' centres.

    The last row of u (n_free_nodes + 1, 3), m, is the displacement of fixed nodes.
    """
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


@dataclass(eq=False)
class Hybrid(Surrogate):
    """The full-order solve from the answer of any other method.

    With `steps`, it repeats u ← u + R K₀⁻¹ Rᵀ (f - f_int(u)) under Anderson acceleration. R rotates
    the stiffness at rest K₀ with the body (see `mor_bench.mechanics.rotated`). Near the solution
    each step divides the error by about ten; stability is not checked. With `tolerance` instead,
    the whole solve with all its checks starts at the answer. If the answer has det F <= 0, or is no
    better than zero, the solve starts at rest.

    Parameters
    ----------
    start : str
        A method of the suite that supports the scene.
    start_parameters : dict
        Hyperparameters of that method that differ from its file.
    steps : int, optional
        Corrections, 1 to 100; 1 by default if there is no tolerance.
    tolerance : float, optional
        Largest norm of the final residual relative to that of the load, in (0, 1]. Replaces steps.
    """

    start: str = "pod-tensor"
    start_parameters: dict[str, Any] | None = None
    steps: Annotated[int, Field(ge=1, le=100)] | None = None
    tolerance: Annotated[float, Field(gt=0, le=1)] | None = None

    @property
    def needs_snapshots(self) -> bool:  # type: ignore[override]
        """True if the starting method learns from snapshots."""
        return self.unfitted_start().needs_snapshots

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene) or self.unfitted_start().supports(scene)

    def learn(self, scene: Scene, samples: Snapshots) -> dict[str, NDArray[Any]]:
        if self.steps is not None and self.tolerance is not None:
            raise InvalidInputError(
                f"`steps` and `tolerance` cannot be used together; got {self.steps} and "
                f"{self.tolerance}."
            )
        self.start_ = self.unfitted_start()
        self.start_.time_limit_s = self.time_limit_s
        self.start_.fit(_all_outputs(scene), samples)
        arrays = {**self.start_.arrays_, **size_arrays(self.start_.sizes_)}
        return {START + name: array for name, array in arrays.items()}

    def prepare(self, scene: Scene, model: Mapping[str, NDArray[Any]]) -> None:
        if not hasattr(self, "start_"):  # the model was loaded, not fitted
            arrays = {name.removeprefix(START): array for name, array in model.items()}
            sizes = take_sizes(arrays)
            self.start_ = self.unfitted_start().restore(_all_outputs(scene), arrays, sizes)
        self.model_ = FullOrderModel(scene, "auto")
        self.model_.prepare()

    def answer(self, forces: Array) -> Array:
        scene = self.scene_
        loads = scene.at_free_dofs(forces.reshape(len(forces), scene.mesh.n_dofs))
        out = np.zeros(loads.shape)
        for row, load, force in zip(out, loads, forces, strict=True):
            if load.any():
                row[:] = self._solve(load, self._guess(force))
        return scene.at_all_dofs(out).reshape(forces.shape)

    def unfitted_start(self) -> Surrogate:
        own = load_method_spec(list_suite("methods")[self.start]) if self._is_named() else None
        if own is None or not own.surrogate.startswith("mor_bench."):
            raise SpecError(
                f"`start` must be the name of a method of mor-bench; got {self.start[:100]!r}."
            )
        return load_method(self.start, **(self.start_parameters or {}))

    def _is_named(self) -> bool:
        """Return whether `start` is a name of the suite: a file of a model must not name others."""
        return self.start in list_suite("methods")

    def _guess(self, force: Array) -> Array | None:
        """Return the starting method's answer on the free dofs, m; None if it has none."""
        try:
            guess = self.scene_.at_free_dofs(self.start_.predict(force).reshape(1, -1))[0]
        except SolverError:
            return None
        return guess if np.isfinite(guess).all() else None

    def _solve(self, load: Array, guess: Array | None) -> Array:
        if self.tolerance is not None:
            return self.model_.solve(load, guess, NewtonOptions(self.tolerance)).displacement
        corrected = None if guess is None else self._corrected(load, guess)
        return self.model_.solve(load).displacement if corrected is None else corrected

    def _corrected(self, load: Array, guess: Array) -> Array | None:
        inverse, memory, u = self.model_.turned_rest, Anderson(len(guess)), guess
        for _ in range(self.steps or 1):
            residual = load - self.model_.force(u).force
            correction = inverse.solve_many([residual], [inverse.turned(u)])[0]
            u = u + memory.advance(u, correction)
        near = float(np.linalg.norm(u - guess)) <= NEAR * float(np.linalg.norm(u))
        if near and _least_det_f(inverse.at_nodes(u), *inverse.cells[:2]) >= SURE:
            return u
        state = self.model_.force(u)
        better = float(np.linalg.norm(load - state.force)) <= WORSE * float(np.linalg.norm(load))
        return u if better and state.min_det_f > 0 else None


def _all_outputs(scene: Scene) -> Scene:
    """Return the scene with outputs at all nodes, because a starting answer must be complete."""
    if len(scene.output_nodes) == scene.mesh.n_nodes:
        return scene
    return replace(
        scene,
        spec=scene.spec.model_copy(
            update={"needs": scene.spec.needs.model_copy(update={"outputs": "all"})}
        ),
    )
