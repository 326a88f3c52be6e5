"""Static correction: add the part of the linear response that a reduced basis lacks.

A basis of few modes cannot represent the local dent under every load. At small strains, a
back-solve with the stiffness at rest gives the rest. In linear dynamics this is called static
correction, residual flexibility or the mode acceleration method (MacNeal, Computers & Structures 1
(1971) 581-601; Dickens, Nakagawa, Wittbrodt, ibid. 62 (1997) 985-998).

With the correction, the reduced problem gives only the nonlinear part of a displacement. In a
nearly incompressible body this allows a softer volumetric law, see `softened`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import count
from mor_bench.errors import InvertedElementError
from mor_bench.mechanics.compliance import project
from mor_bench.mechanics.linear import Factor
from mor_bench.mechanics.locking import locking_risk
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.reduction.galerkin import CubatureProblem, GalerkinProblem
from mor_bench.reduction.petrov import InterpolatedProblem
from mor_bench.reduction.tensors import TensorProblem
from mor_bench.scene.scene import Scene

LINEAR_WEIGHT = 0.2
"""Weight of the linear responses among the snapshots. The static correction supplies them, but the
basis must be able to rotate and bend them."""

MOST_POISSON = 0.48
"""Largest Poisson's ratio of a reduced problem with static correction, see `softened`."""

SOFTENED = "softened"
"""Array of a fitted model whose reduced problem is that of the softened scene."""


def softened(scene: Scene) -> Scene:
    """Return a scene with a softer volumetric law, for reduced problems with static correction.

    Few modes cannot keep the volume of each cell when they bend. The penalty on these changes then
    stiffens the reduced problem, as it locks cells of low order. Here a body whose cells do not
    lock has a Poisson's ratio of at most `MOST_POISSON` at rest, with the same shear modulus. The
    linear response, to which the answer is added, has the true one. The nonlinear part depends
    little on it, because it keeps the volume with either. A scene that needs no change is returned
    itself.
    """
    material = scene.material
    if material is None or material.poisson_at_rest <= MOST_POISSON or locking_risk(scene):
        return scene
    return replace(scene, material=material.with_poisson(MOST_POISSON))


def model_of(scene: Scene, model: FullOrderModel) -> FullOrderModel:
    """Return a full-order model of a scene: the given one if it is the model of this scene."""
    return model if model.scene is scene else FullOrderModel(scene)


def mark_of(scene: Scene, reduced: Scene) -> dict[str, NDArray[np.float64]]:
    """Return the array that tells `marked_scene` which scene a reduced problem has."""
    return {} if reduced is scene else {SOFTENED: np.ones(1)}


def marked_scene(scene: Scene, arrays: Mapping[str, NDArray[Any]]) -> Scene:
    """Return the scene of the reduced problem of a model with these arrays."""
    return softened(scene) if SOFTENED in arrays else scene


def corrected_snapshots(
    displacements: NDArray[np.float64], linear: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the snapshots (2 n, n_free), m, that span a basis with static correction.

    For each displacement and linear response, both (n, n_free), these are the nonlinear part
    u - K₀⁻¹f and, with a small weight, the linear response.
    """
    both = np.hstack([displacements - linear, LINEAR_WEIGHT * linear])
    return both.reshape(-1, displacements.shape[1])


def static_correction(
    rest_factor: Factor,
    reduced_factor: Factor,
    modes: NDArray[np.float64],
    load: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the linear response minus the reduced one, (K₀⁻¹ - Φ (ΦᵀK₀Φ)⁻¹ Φᵀ) f.

    Added to a reduced solution with the tangent space Φ at rest, it makes the answer to a small
    load exact to first order. It does not rotate with the body and may invert cells, which
    `refuse_inverted` checks.

    Parameters
    ----------
    rest_factor : Factor
        Factor or `Compliance` of the full model's stiffness at rest K₀.
    reduced_factor : Factor
        Factor of ΦᵀK₀Φ.
    modes : (n_free, r) float64, in C order
        Φ.
    load : (n_free,) float64
        f, N.

    Returns
    -------
    (n_free,) float64
        Correction, m.
    """
    count(multiply_adds=modes.size)
    return rest_factor.solve(load) - modes @ reduced_factor.solve(project(modes, load[None])[0])


def predict_corrected(
    problem: GalerkinProblem | CubatureProblem | TensorProblem | InterpolatedProblem,
    modes: NDArray[np.float64],
    model: FullOrderModel,
    rest_factor: Factor,
    load: NDArray[np.float64],
    tolerance: float,
) -> NDArray[np.float64]:
    """Return the reduced equilibrium under a load (n_free,), N, with static correction, m.

    The modes are those of the problem on all free dofs. The factor is that of the model's stiffness
    at rest. Raises `SolverError` if the reduced model has no valid equilibrium, or if its
    correction inverts cells.
    """
    count(multiply_adds=modes.size)
    reduced = project(modes, load[None])[0]
    if isinstance(problem, TensorProblem):
        q = problem.solve(reduced, tolerance)
    elif isinstance(problem, InterpolatedProblem):
        q = problem.solve(reduced, NewtonOptions(tolerance))
    else:
        q = problem.solve(reduced, NewtonOptions(tolerance)).displacement
    u = rest_factor.solve(load) + modes @ (q - problem.rest_factor.solve(reduced))
    refuse_inverted(model, u)
    return u


def refuse_inverted(model: FullOrderModel, u: NDArray[np.float64]) -> None:
    """Raise `InvertedElementError` if displacements u (n_free,), m, invert cells."""
    least = model.assembler.least_det_f(u)
    if not least > 0:
        raise InvertedElementError(
            f"the reduced answer inverts elements: its least det F is {least:.3g}."
        )
