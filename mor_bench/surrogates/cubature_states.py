"""Training states of hyper-reduction: projected snapshots, or equilibria in the modes' span."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from mor_bench.errors import SolverError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.mechanics.parametric import ParametricModel
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.static_correction import softened
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots

Array = NDArray[np.float64]

States = Callable[[], Iterator[tuple[FullOrderModel, Array]]]
"""Yields the bodies of training states, and the coordinates (n, r) of the states of each."""

Matching = Literal["force", "energy", "as-needed"]

FAR = 10.0
"""Median residual of the projected snapshots, relative to the load, that counts as far.

With 10 and 20 modes, it is below 6 on beams with ν = 0.4, and above 40 with ν = 0.499.
"""
LOCKED = 1.0
"""The same residual above which modes with static correction need a softer volumetric law.

With 10 to 80 modes, it is above 1.4 on a beam and a liver with ν = 0.49 and 0.499. On an artery
under pressure, three modes keep the volume, and it is below 0.03.
"""
N_JUDGED = 100
"""Largest number of snapshots that decide about this law."""

TOLERANCE = 1e-4
"""Tolerance of the training equilibria; their cubature errs more."""


def training_rows(displacements: Array, n_snapshots: int) -> NDArray[np.int64]:
    """Return at most ``n_snapshots`` rows, spread evenly over the nonzero snapshots."""
    moved = np.flatnonzero(displacements.any(axis=1))
    chosen = np.unique(np.linspace(0, len(moved) - 1, n_snapshots).astype(int))
    return np.asarray(moved[chosen])


def projected_states(scene: Scene, samples: Snapshots, modes: Array, n_snapshots: int) -> States:
    """Return projected snapshots; those of a parametric scene have a body each."""
    displacements = samples.free_displacements
    rows = training_rows(displacements, n_snapshots)
    q = displacements[rows] @ modes
    if not scene.parameter_names:
        model = FullOrderModel(scene)
        return lambda: iter([(model, q)])
    models = ParametricModel(scene)

    def states() -> Iterator[tuple[FullOrderModel, Array]]:
        for number, row in zip(rows, q, strict=True):
            body, _ = models.bodies.shared(samples.parameters[number])
            yield models.model_of(body), row[None]

    return states


def are_far(states: States, loads: Array, modes: Array) -> bool:
    """Return whether projected snapshots are far from equilibrium under their loads (n, n_free).

    A part of the displacement outside of the span hardly changes the displacement. In a nearly
    incompressible body, it changes the volume of cells, and the forces by orders of magnitude.
    """
    return _residual(states, loads, modes) > FAR


def softened_if_locked(model: FullOrderModel, samples: Snapshots, modes: Array) -> Scene:
    """Return the softened scene if the modes do not keep the volume, see `are_far`.

    If they do, as those of a tube under pressure, the scene's own law errs less. The scene is then
    returned as it is.
    """
    scene, displacements = model.scene, samples.free_displacements
    soft = softened(scene)
    if soft is scene or not displacements.any():
        return scene
    rows = training_rows(displacements, N_JUDGED)
    q, loads = displacements[rows] @ modes, samples.free_forces[rows]
    return soft if _residual(lambda: iter([(model, q)]), loads, modes) > LOCKED else scene


def _residual(states: States, loads: Array, modes: Array) -> float:
    """Return the median residual relative to the load; 0 if no load acts on the modes."""
    q, models = _joined(states)
    reduced = loads @ modes
    sizes = np.linalg.norm(reduced, axis=1)
    residuals = [
        float(np.linalg.norm(modes.T @ model.force(modes @ own).force - load)) / size
        for model, own, load, size in zip(models, q, reduced, sizes, strict=True)
        if size > 0
    ]
    return float(np.median(residuals)) if residuals else 0.0


def equilibria(states: States, loads: Array, modes: Array) -> States:
    """Return the equilibria Φᵀf_int(Φq) = Φᵀf in the place of projected snapshots.

    A state whose load has no equilibrium stays as it is. ``loads`` (n, n_free) are those of the
    states, N.
    """
    q, models = _joined(states)
    found, options = q.copy(), NewtonOptions(TOLERANCE)
    problem, of = None, None
    for row, model, load in zip(found, models, loads @ modes, strict=True):
        if problem is None or model is not of:
            problem, of = GalerkinProblem(model.assembler, modes), model
        try:
            row[:] = solve_equilibrium(problem, load, options=options).displacement
        except SolverError:
            continue

    def solved() -> Iterator[tuple[FullOrderModel, Array]]:
        begin = 0
        for model, own in states():
            yield model, found[begin : begin + len(own)]
            begin += len(own)

    return solved


def in_energy(states: States, modes: Array) -> tuple[States, Array]:
    """Return states and modes Ψ in coordinates in which the stiffness at rest is the identity.

    With ΦᵀK₀Φ = LLᵀ, they are Ψ = ΦL⁻ᵀ and Lᵀq. The size of a reduced force in them is the energy
    norm of the displacement that it causes. So a cubature that matches forces to a tolerance there
    bounds the error of displacements, and soft directions count as much as stiff ones.
    """
    model = next(states())[0]
    lower = np.linalg.cholesky(GalerkinProblem(model.assembler, modes).rest_tangent)
    scaled = np.ascontiguousarray(solve_triangular(lower, modes.T, lower=True).T)
    return lambda: ((model, q @ lower) for model, q in states()), scaled


def _joined(states: States) -> tuple[Array, list[FullOrderModel]]:
    """Return coordinates (n, r), and the body of each state."""
    both = list(states())
    return np.concatenate([q for _, q in both]), [model for model, q in both for _ in q]
