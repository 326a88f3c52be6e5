"""The reduced energy of Saint Venant-Kirchhoff for all λ and μ, as a sum of two polynomials.

The energy ½ ∫ λ tr(E)² + 2μ E:E is linear in λ and μ. So its derivatives at any λ and μ follow from
those at (0, 1) and (1, 1): T(λ, μ) = λ T(1, 1) + (μ - λ) T(0, 1), without approximation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.subspace import extent_of
from mor_bench.reduction.tensor_kernels import min_det_f
from mor_bench.reduction.tensors import ReducedTensors, TensorProblem, reduce_energy, sentinels_of
from mor_bench.scene.materials import SaintVenantKirchhoff
from mor_bench.scene.scene import Scene

Array = NDArray[np.float64]

SHEAR, BOTH = "shear_", "both_"
"""Prefixes of the names of arrays: derivatives at λ = 0, μ = 1, and at λ = μ = 1."""


@dataclass(frozen=True)
class LameTensors:
    """Reduced models of Saint Venant-Kirchhoff for any λ and μ.

    Attributes
    ----------
    shear, both : ReducedTensors
        Derivatives at λ = 0, μ = 1 Pa, and at λ = μ = 1 Pa, without springs.
    sentinels, usual : array
        See `TensorProblem`; they do not depend on λ and μ.
    springs : (r, r) float64 or float
        The reduced stiffness of springs, 0 without any.
    extent : float
        See `TensorProblem`.
    """

    shear: ReducedTensors
    both: ReducedTensors
    sentinels: Array
    usual: Array
    springs: Array | float
    extent: float

    @classmethod
    def learned(cls, scene: Scene, modes: Array, samples: Array) -> dict[str, Array]:
        """Return the arrays for modes (n_free, r) and coordinates (n, r) of typical states."""
        model = FullOrderModel(scene)
        # Y = 2 (1 + ν) μ and ν = λ / (2 (λ + μ)).
        materials = {SHEAR: SaintVenantKirchhoff(2.0, 0.0), BOTH: SaintVenantKirchhoff(2.5, 0.25)}
        arrays: dict[str, Array] = {}
        for prefix, material in materials.items():
            model.scene = replace(scene, material=material)
            tensors = reduce_energy(model, modes)
            arrays |= {prefix + name: array for name, array in vars(tensors).items()}
        sentinels = np.ascontiguousarray(sentinels_of(model, modes, samples))
        usual = min((float(min_det_f(sentinels, q)) for q in samples), default=1.0)
        return {**arrays, "sentinels": sentinels, "usual": np.array([usual])}

    @classmethod
    def of_arrays(cls, scene: Scene, modes: Array, arrays: Mapping[str, Array]) -> LameTensors:
        """Restore from `learned`; raise `InvalidInputError` or KeyError on unsuitable arrays."""
        shear, both = (
            ReducedTensors(*(arrays[p + name] for name in ("quadratic", "cubic", "quartic")))
            for p in (SHEAR, BOTH)
        )
        model = FullOrderModel(scene)
        springs = 0.0 if model.springs is None else modes.T @ (model.springs @ modes)
        found = cls(shear, both, arrays["sentinels"], arrays["usual"], springs, extent_of(scene))
        for tensors in (found.shear, found.both):
            found.problem(tensors)
        return found

    def at(self, lame_lambda: float, lame_mu: float) -> TensorProblem:
        """Return the reduced model for λ and μ, Pa."""
        both, shear = vars(self.both), vars(self.shear)
        count(multiply_adds=2 * sum(array.size for array in both.values()))
        return self.problem(
            ReducedTensors(
                **{n: lame_lambda * both[n] + (lame_mu - lame_lambda) * shear[n] for n in both}
            )
        )

    def problem(self, tensors: ReducedTensors) -> TensorProblem:
        """Return the reduced model with these derivatives, and the springs."""
        if not isinstance(self.springs, float):
            tensors = replace(tensors, quadratic=tensors.quadratic + self.springs)
        return TensorProblem(tensors, self.sentinels, self.usual, self.extent)
