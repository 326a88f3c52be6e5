"""Static correction of reduced methods: their modes, their law, and their answers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.basis import SOLVED, accurate_modes
from mor_bench.reduction.galerkin import CubatureProblem, GalerkinProblem
from mor_bench.reduction.petrov import InterpolatedProblem
from mor_bench.reduction.static_correction import (
    LINEAR_WEIGHT,
    corrected_snapshots,
    predict_corrected,
)
from mor_bench.reduction.tensors import TensorProblem
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogates.cubature_states import softened_if_locked
from mor_bench.surrogates.free_dofs import answer_each

Array = NDArray[np.float64]

CORRECTED_ONLY = "static correction is for loads on a body without contact or sampled parameters"


def lacks_correction(scene: Scene) -> str | None:
    """Return why a scene allows no static correction, or None."""
    return CORRECTED_ONLY if scene.contact or scene.parameter_names else None


def basis_of(
    scene: Scene, samples: Snapshots, n_modes: int, static_correction: bool
) -> tuple[Array, Scene]:
    """Return modes (n_free, r), and the scene whose law the reduced problem has.

    With static correction, the modes are those of the snapshots' nonlinear parts, see
    `corrected_snapshots`, and the law may be softened.
    """
    if not static_correction:
        return accurate_modes(samples.free_displacements, n_modes), scene
    model = FullOrderModel(scene)
    linear = model.rest_factor.solve(samples.free_forces.T).T
    snapshots = corrected_snapshots(samples.free_displacements, linear)
    # The snapshots are smaller than the displacements, and the error of the solver is not.
    modes = accurate_modes(snapshots, n_modes, SOLVED / LINEAR_WEIGHT)
    return modes, softened_if_locked(model, samples, modes)


class Correction:
    """The full-order parts of answers with static correction, see `predict_corrected`."""

    def __init__(self, scene: Scene) -> None:
        self.model = FullOrderModel(scene)
        self.compliance = Compliance(self.model)

    def answer(
        self,
        problem: GalerkinProblem | CubatureProblem | TensorProblem | InterpolatedProblem,
        modes: Array,
        forces: Array,
        tolerance: float,
    ) -> Array:
        """Return displacements (n, n_nodes, 3), m, under forces of the same shape, N."""

        def solve(load: Array) -> Array:
            return predict_corrected(problem, modes, self.model, self.compliance, load, tolerance)

        return answer_each(self.model.scene, forces, solve)
