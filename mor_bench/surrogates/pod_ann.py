"""POD augmented by an artificial neural network for the coordinates of the secondary modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import Field

from mor_bench.surrogates.network_manifold import NetworkManifold


@dataclass(eq=False)
class PODANN(NetworkManifold):
    """The manifold u = V q + V̄ (N(q) - N(0)); q are the primary POD coordinates.

    Barnett, Farhat, Maday: Neural-network-augmented projection-based model order reduction for
    mitigating the Kolmogorov barrier to reducibility, J. Comput. Phys. 492 (2023), equation 13. See
    `CurvedPOD` for the other parameters.

    Parameters
    ----------
    n_hidden : int
        Units in each of the two hidden layers.
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

    encodes: ClassVar = False
