"""Galerkin projection on a quadratic manifold that is fitted to the snapshots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mor_bench.model_arrays import take_array
from mor_bench.reduction.curved import QuadraticMap
from mor_bench.reduction.derivative_modes import pairs
from mor_bench.reduction.sizing import validation_folds
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogates.curved_pod import Array, Arrays, CurvedPOD, coordinate_weights

RIDGES = (1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Candidate ridges, relative to the mean square of a scaled product of coordinates."""


@dataclass(eq=False)
class QuadraticManifoldPOD(CurvedPOD):
    """The manifold u = V q + V̄ Σ qᵢqⱼ ξᵢⱼ with V, V̄ and ξ from the snapshots.

    Regularised least squares fits ξ to what the primary modes leave of each snapshot, relative to
    its displacement. Products of coordinates are scaled to unit mean square. Held-out training
    regions choose the ridge. Geelen, Wright, Willcox: Operator inference for non-intrusive model
    reduction with quadratic manifolds, CMAME 403 (2023), equation 14; Barnett, Farhat: Quadratic
    approximation manifold for mitigating the Kolmogorov barrier in nonlinear projection-based model
    order reduction, J. Comput. Phys. 464 (2022). See also `CurvedPOD`, which describes all
    parameters.
    """

    n_latent: Annotated[int, Field(ge=1)] = 10
    n_secondary: Annotated[int, Field(ge=1)] = 100
    static_correction: bool = True
    cubature_tolerance: Annotated[float, Field(ge=0, lt=1)] = 1e-3
    n_cubature_snapshots: Annotated[int, Field(ge=1)] = 300
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8

    def fit_map(
        self, scene: Scene, samples: Snapshots, coordinates: Array, n_latent: int
    ) -> tuple[dict[str, NDArray[Any]], Array]:
        q, rest = coordinates[:, :n_latent], coordinates[:, n_latent:]
        weights, sizes = coordinate_weights(samples), np.sqrt((q**2).mean(axis=0))
        first, second = pairs(n_latent)
        scale = sizes[first] * sizes[second]
        products, targets = weights * q[:, first] * q[:, second] / scale, weights * rest
        errors = np.zeros(len(RIDGES))
        for fitted, held in validation_folds(samples) if len(samples) > 1 else []:
            found = _ridge_solutions(products[fitted], targets[fitted])
            errors += [((products[held] @ x - targets[held]) ** 2).sum() for x in found]
        best = _ridge_solutions(products, targets)[int(errors.argmin())]
        return {"coefficients": best / scale[:, None]}, q

    def take_map(self, model: Arrays, n_latent: int, n_coordinates: int) -> QuadraticMap:
        shape = n_latent * (n_latent + 1) // 2, n_coordinates - n_latent
        return QuadraticMap(n_latent, take_array(model, "coefficients", shape))


def _ridge_solutions(products: Array, targets: Array) -> list[Array]:
    """Return the regularised least-squares solution for each of `RIDGES`."""
    left, values, right = np.linalg.svd(products, full_matrices=False)
    projected, mean = left.T @ targets, float((products**2).sum()) / products.shape[1]
    return [right.T @ ((values / (values**2 + g * mean))[:, None] * projected) for g in RIDGES]
