"""Derivatives of reduced coordinates with respect to the load, at known solutions."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, SolverError
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.patch_loads import PatchLoads

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives along the d = 3k force components on a sample's own k patches.

    They are multiplied by the largest force of all samples.

    Attributes
    ----------
    inputs : (n_samples, d, n_axes) float64
        Derivatives of coordinates of the linear response, AᵀK₀⁻¹B, or of the force, AᵀB.
    outputs : (n_samples, d, n_modes) float64
        Derivatives of coordinates of the nonlinear part, Φᵀ(K(u)⁻¹ - K₀⁻¹)B, or of the whole
        displacement, ΦᵀK(u)⁻¹B.
    """

    inputs: Array
    outputs: Array


def sensitivities(
    model: FullOrderModel, snapshots: Snapshots, axes: Array, modes: Array, of_force: bool = False
) -> Sensitivities:
    """Differentiate f(u) = B t at the snapshots: du/dt = K(u)⁻¹ B.

    Each sample takes one factorisation and 3k back-solves. B are unit forces on its own patches.

    Parameters
    ----------
    model : FullOrderModel
    snapshots : Snapshots
        Equilibria of patch loads.
    axes : (n_free, n_axes) float64
    modes : (n_free, n_modes) float64
    of_force : bool
        Whether inputs are coordinates of the force, and outputs those of the whole displacement.

    Returns
    -------
    Sensitivities
        Zero, with a warning, where K(u) is not positive definite; zeros fit any linear map.

    Raises
    ------
    InvalidInputError
        If the loads are not forces on patches.
    SolverError
        If no tangent is positive definite.
    """
    loads, scene = snapshots.loads, snapshots.scene
    if not isinstance(loads, PatchLoads):
        raise InvalidInputError("derivatives along the load need snapshots of patch forces.")
    n, k = loads.patches.shape
    inputs, outputs = np.zeros((n, 3 * k, axes.shape[1])), np.zeros((n, 3 * k, modes.shape[1]))
    at_rest = _RestResponses(model, axes, modes, of_force)
    largest, scales = float(np.linalg.norm(loads.vectors, axis=2).max()), scene.patch_scales
    n_failed = 0
    for i, patches in enumerate(loads.patches):
        units = [_unit_forces(scene, patch, largest * scales[patch]) for patch in patches]
        known = [at_rest.of(patch, unit) for patch, unit in zip(patches, units, strict=True)]
        try:
            factor = model.factor(model.linearise(snapshots.free_displacements[i])[1])
            moved = factor.solve(np.concatenate(units).T).T
        except (NotPositiveDefiniteError, SolverError):
            n_failed += 1
            continue
        inputs[i] = np.concatenate([given for given, _ in known])
        outputs[i] = moved @ modes - np.concatenate([linear for _, linear in known])
    if n_failed == n:
        raise SolverError(
            f"{scene.name}: the tangent is not positive definite at any of the {n} training "
            "samples."
        )
    if n_failed:
        warnings.warn(
            f"{scene.name}: the tangent is not positive definite at {n_failed} of {n} training "
            "samples; their derivatives are left out.",
            stacklevel=3,
        )
    return Sensitivities(inputs, outputs)


def _unit_forces(scene: Scene, patch: int, size_n: float) -> Array:
    """Return forces (3, n_free), N, of one size along each axis on a patch."""
    on_nodes = scene.patch_weights[[patch]].toarray()[0]
    unit: Array = (size_n * np.einsum("n,ab->anb", on_nodes, np.eye(3))).reshape(3, -1)
    return scene.at_free_dofs(unit)


class _RestResponses:
    """Inputs, and the linear part of outputs, of each patch's unit forces, computed once."""

    def __init__(self, model: FullOrderModel, axes: Array, modes: Array, of_force: bool) -> None:
        self._model, self._axes, self._modes, self._of_force = model, axes, modes, of_force
        self._known: dict[int, tuple[Array, Array]] = {}

    def of(self, patch: int, unit: Array) -> tuple[Array, Array]:
        if patch not in self._known:
            response = self._model.rest_factor.solve(unit.T).T
            if self._of_force:
                self._known[patch] = unit @ self._axes, np.zeros((3, self._modes.shape[1]))
            else:
                self._known[patch] = response @ self._axes, response @ self._modes
        return self._known[patch]
