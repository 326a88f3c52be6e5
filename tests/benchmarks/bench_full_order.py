"""The full-order model on one thread: its kernels, a factorisation, and a whole solve."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np

import mor_bench
from mor_bench.harness.timing import pinned_threads
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.snapshots.sampling import draw_loads

N_DRAWN = 64
"""Loads that are drawn; the one of median size is solved, since iterations grow with the load."""


class FullOrder:
    """One call each, from rest, at the median load and the deformed state that it leads to."""

    params = ("beam-tiny", "beam-coarse")
    param_names = ("dataset",)

    def setup(self, dataset: str) -> None:
        self.pinned = ExitStack()
        self.pinned.enter_context(pinned_threads(1))
        scene = mor_bench.load_scene(dataset)
        drawn = draw_loads(scene, 0, N_DRAWN)
        median = int(np.linalg.norm(drawn.vectors, axis=(1, 2)).argsort()[N_DRAWN // 2])
        self.load = drawn.nodal_forces(scene.patch_weights)[median].ravel()[scene.free_dofs]
        self.model = FullOrderModel(scene)
        self.state = self.model.solve(self.load).displacement
        self.tangent = self.model.linearise(self.state)[1]
        self.model.force(self.state)

    def teardown(self, dataset: str) -> None:
        self.pinned.close()

    def time_residual(self, dataset: str) -> None:
        self.model.force(self.state)

    def time_residual_and_tangent(self, dataset: str) -> None:
        self.model.linearise(self.state)

    def time_factor(self, dataset: str) -> None:
        self.model.factor(self.tangent)

    def time_solve(self, dataset: str) -> None:
        self.model.solve(self.load)
