"""The full-order model on one thread: kernels, a factorisation, a solve, memory and error."""

from __future__ import annotations

from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import mor_bench
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import list_suite

N_DRAWN = 64
"""Loads that are drawn; the one of median size is solved, since iterations grow with the load."""

REFERENCE_TOLERANCE = 1e-11


def median_load(scene: Any) -> Any:
    """Return the median load on the free dofs, (n_free,) N."""
    drawn = draw_loads(scene, 0, N_DRAWN)
    median = int(np.linalg.norm(drawn.vectors.reshape(N_DRAWN, -1), axis=1).argsort()[N_DRAWN // 2])
    return drawn.nodal_forces(scene.patch_weights)[median].ravel()[scene.free_dofs]


class FullOrder:
    """One call of each operation, at the median load or in its deformed state.

    The scenes use different kernels: two sizes of Saint Venant-Kirchhoff in H8, neo-Hookean with
    selective integration, and T4.
    """

    params = ("beam-tiny", "beam-coarse", "beam-nearly-incompressible", "liver-tet")
    param_names = ("dataset",)

    def setup(self, dataset: str) -> None:
        self.pinned = threadpool_limits(1)  # first, since what is skipped is torn down too
        if dataset not in list_suite("datasets"):
            raise NotImplementedError(f"{dataset} is not there")
        try:
            self.solve_once(dataset)
        except (TypeError, AttributeError) as error:
            raise NotImplementedError(
                f"a commit from before this interface of the full-order model: {error}"
            ) from None

    def solve_once(self, dataset: str) -> None:
        scene = mor_bench.load_scene(dataset)
        self.load = median_load(scene)
        self.model = FullOrderModel(scene)
        self.state = self.model.solve(self.load).displacement
        self.tangent = self.model.linearise(self.state)[1]
        self.model.force(self.state)

    def teardown(self, dataset: str) -> None:
        self.pinned.restore_original_limits()

    def time_residual(self, dataset: str) -> None:
        self.model.force(self.state)

    def time_residual_and_tangent(self, dataset: str) -> None:
        self.model.linearise(self.state)

    def time_factor(self, dataset: str) -> None:
        self.model.factor(self.tangent)

    def time_back_solve(self, dataset: str) -> None:
        self.model.rest_factor.solve(self.load)

    def time_solve(self, dataset: str) -> None:
        self.model.solve(self.load)

    def peakmem_solve(self, dataset: str) -> None:
        self.model.solve(self.load)

    def track_iterations(self, dataset: str) -> int:
        return self.model.solve(self.load).iterations

    track_iterations.unit = "iterations"  # type: ignore[attr-defined]

    def track_relative_error(self, dataset: str) -> float:
        """Relative l2 difference from a solution to a residual of `REFERENCE_TOLERANCE`."""
        reference = self.model.solve(
            self.load, options=NewtonOptions(REFERENCE_TOLERANCE)
        ).displacement
        return float(np.linalg.norm(self.state - reference) / np.linalg.norm(reference))

    track_relative_error.unit = "relative l2"  # type: ignore[attr-defined]
