"""Projection of the equilibrium on an autoencoder's decoder: Galerkin and least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.reduction.curved import CurvedLoad
from mor_bench.reduction.least_squares import Weighting, solve_least_squares
from mor_bench.scene.scene import Scene
from mor_bench.surrogates.curved_pod import Array, Arrays
from mor_bench.surrogates.network_manifold import NetworkManifold


@dataclass(eq=False)
class LatentGalerkin(NetworkManifold):
    """Galerkin projection on the decoder of an autoencoder between POD coordinates.

    Encoder and decoder are perceptrons with a linear part, q = P c + E(c) - E(0) and
    c = Pᵀq + N(q) - N(0), where P takes the first coordinates. They are trained together, and only
    the decoder is kept. Lee, Carlberg: Model reduction of dynamical systems on nonlinear manifolds
    using deep convolutional autoencoders, J. Comput. Phys. 404 (2020); POD coordinates and cubature
    as in Fulton et al.: Latent-space dynamics for reduced deformable simulation, Computer Graphics
    Forum 38 (2019). See `CurvedPOD` for the other parameters.

    Parameters
    ----------
    n_hidden : int
        Units in each of the two hidden layers of encoder and decoder.
    iterations : int
        Adam steps.
    seed : int
        Seed of the initial weights and the order of the samples.
    """

    n_latent: Annotated[int, Field(ge=1)] = 10
    n_secondary: Annotated[int, Field(ge=1)] = 40
    static_correction: bool = True
    cubature_tolerance: Annotated[float, Field(ge=0, lt=1)] = 1e-3
    n_cubature_snapshots: Annotated[int, Field(ge=1)] = 300
    tolerance: Annotated[float, Field(gt=0, le=1)] = 1e-8
    n_hidden: Annotated[int, Field(ge=1, le=4096)] = 64
    iterations: Annotated[int, Field(ge=1)] = 6000
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    encodes: ClassVar = True


@dataclass(eq=False)
class LatentLSPG(LatentGalerkin):
    """Least-squares Petrov-Galerkin projection on the decoder, see `reduction.least_squares`.

    The cubature matches the forces on all modes of Φ, because the residual in all of them counts.

    Parameters
    ----------
    weighting : {"stiffness", "none"}
        Norm of the residual: with the inverse of ΦᵀK₀Φ, or Euclidean. Keep the default; the other
        one is inaccurate, because soft modes hardly count.
    """

    weighting: Literal["stiffness", "none"] = "stiffness"

    def directions(self, slopes: Array) -> Array:
        return np.eye(len(slopes))

    def prepare(self, scene: Scene, model: Arrays) -> None:
        super().prepare(scene, model)
        sampled, lower = self.curved_.sampled, None
        if self.weighting == "stiffness":
            lower = np.linalg.cholesky(sampled.rest_tangent).astype(np.float64, copy=False)
        self.weighting_ = Weighting(sampled.modes, lower)

    def solve(self, load: CurvedLoad) -> Array:
        options = NewtonOptions(self.tolerance)
        return solve_least_squares(self.curved_, load, self.weighting_, options)
