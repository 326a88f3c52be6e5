"""Bases without snapshots: linear responses to a scene's loads, and their modal derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.basis import pod
from mor_bench.reduction.static_correction import LINEAR_WEIGHT
from mor_bench.scene.scene import Scene
from mor_bench.specs.load_ranges import largest_of

DIFFERENCE = 1e-3
"""Largest displacement of the finite differences, relative to the body.

The truncation error grows with its square, and round-off with its inverse square.
"""


@dataclass(frozen=True)
class LinearModes:
    """Principal linear responses to a scene's loads.

    Attributes
    ----------
    modes : (n_free, r) float64
        Orthonormal.
    amplitudes_m : (r,) float64
        Root mean square coordinates under forces of the largest magnitude in all directions on all
        patches.
    """

    modes: NDArray[np.float64]
    amplitudes_m: NDArray[np.float64]


def patch_forces(scene: Scene) -> NDArray[np.float64]:
    """Return forces of 1 N along each axis on each patch, on the free dofs, (3 n_patches, n_free).

    All patches along x come first. Patches with smaller loads than others get less, in proportion.
    """
    on_nodes = scene.patch_weights.toarray() * scene.patch_scales[:, None]
    forces = np.zeros((3, *on_nodes.shape, 3))
    for axis in range(3):
        forces[axis, :, :, axis] = on_nodes
    return scene.at_free_dofs(forces.reshape(3 * len(on_nodes), -1))


def patch_responses(scene: Scene, model: FullOrderModel) -> NDArray[np.float64]:
    """Return linear responses (3 n_patches, n_free), m, to the forces of `patch_forces`."""
    return model.rest_factor.solve(patch_forces(scene).T).T


def linear_modes(scene: Scene, model: FullOrderModel, n_modes: int | None = None) -> LinearModes:
    """Return leading modes of the linear responses to a force along each axis on each patch.

    The number is capped at the rank of the responses with a warning; it is the rank by default.
    """
    responses = patch_responses(scene, model)
    basis = pod(responses, n_modes)
    # A random direction has a mean square of 1/3 along each axis.
    size = largest_of(scene.generated.load_plan.magnitude) / np.sqrt(len(responses))
    return LinearModes(basis.modes, size * basis.singular_values[: basis.modes.shape[1]])


def pairs(r: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and second numbers of all pairs i <= j < r."""
    first, second = np.triu_indices(r)
    return first.astype(np.int64), second.astype(np.int64)


def modal_derivatives(model: FullOrderModel, modes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return static modal derivatives at rest, (n_free, r (r + 1) / 2) for `pairs`.

    ψᵢⱼ = -K₀⁻¹ (∂K/∂qⱼ) φᵢ = -K₀⁻¹ f″[φᵢ, φⱼ]. Idelsohn, Cardona: A reduction method for nonlinear
    structural dynamic analysis, CMAME 49 (1985); Barbič, James: Real-time subspace integration for
    St. Venant-Kirchhoff deformable models, SIGGRAPH 2005, equation 14. They are symmetric in i and
    j, because f″ is the third derivative of an energy.

    The second derivative follows from forces. The even part e(x) = (f(x) + f(-x)) / 2 is
    f″[x, x] / 2 plus terms of fourth order, so f″[a, b] = e(a + b) - e(a) - e(b). The force of
    Saint Venant-Kirchhoff is cubic and has no such terms: there the formula is exact. For other
    laws the relative error is of the order of the squared strain of the step.
    """
    scales = DIFFERENCE * model.extent / np.abs(modes).max(axis=0)
    steps = (modes * scales).T

    def even(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return 0.5 * (model.force(x).force + model.force(-x).force)

    own = [even(step) for step in steps]
    products = [
        (2.0 * own[i] if i == j else even(steps[i] + steps[j]) - own[i] - own[j])
        / (scales[i] * scales[j])
        for i, j in zip(*pairs(modes.shape[1]), strict=True)
    ]
    return -model.rest_factor.solve(np.array(products).T)


def derivative_basis(
    scene: Scene, model: FullOrderModel, n_linear: int, n_modes: int
) -> NDArray[np.float64]:
    """Return an orthonormal basis of linear modes and modal derivatives, (n_free, n_modes).

    The derivatives are those of the first n_linear modes. All enter one singular value
    decomposition, scaled as in the second-order expansion u = Σ qᵢφᵢ + ½ Σ qᵢqⱼψᵢⱼ. The coordinates
    there have their root mean square. Static correction supplies the linear part, so the linear
    modes have the weight `LINEAR_WEIGHT`.
    """
    linear = linear_modes(scene, model)
    n_linear = min(n_linear, linear.modes.shape[1])
    first, second = pairs(n_linear)
    amplitudes, halves = linear.amplitudes_m, np.where(first == second, 0.5, 1.0)
    bent = modal_derivatives(model, linear.modes[:, :n_linear]) * (
        halves * amplitudes[first] * amplitudes[second]
    )
    straight = LINEAR_WEIGHT * (linear.modes * amplitudes).T[: max(n_linear, n_modes)]
    return pod(np.vstack([straight, bent.T]), n_modes).modes
