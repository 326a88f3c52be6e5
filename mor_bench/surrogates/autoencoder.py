"""An autoencoder's latent space between the linear response and the nonlinear remainder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn

from mor_bench.errors import InvalidInputError
from mor_bench.learning.perceptron import Perceptron, evaluate, named
from mor_bench.learning.training_plan import Loss
from mor_bench.surrogates.coordinate_regression import Array, CoordinateSamples, Input
from mor_bench.surrogates.network_regression import NetworkRegression

N_HIDDEN = 64
"""Units in each of the two hidden layers of encoder, decoder and regression."""

LATENT_WEIGHT = 0.01
"""Weight in the loss of the distance between encoded and regressed latent coordinates."""


class _LinearRest(NetworkRegression):
    """Fixed choices of the autoencoder, which are not hyperparameters."""

    input: Input = "linear-response"
    n_output_modes: int = 40


@dataclass(eq=False)
class Autoencoder(_LinearRest):
    """A latent space of the nonlinear remainder, u = K₀⁻¹f + Φ (D(R(z)) - D(R(0))).

    The encoder E and the decoder D are trained to reproduce the remainder's coordinates
    c = Φᵀ(u - K₀⁻¹f). The regression R maps coordinates z of the linear response to E(c). It is
    trained with D, so that D∘R gives c. The loss is a weighted sum of three squared errors. Only D
    and R are kept. The networks work between principal coordinates, as in Fulton et al.:
    Latent-space dynamics for reduced deformable simulation, Computer Graphics Forum 38 (2019). The
    paper solves equations for the latent coordinates. See also `CoordinateRegression`.

    Parameters
    ----------
    n_latent : int
        Number of latent coordinates.
    n_input_modes : int
        Length of z; capped at the rank of the linear responses with a warning.
    iterations : int
        Adam steps with batches of `BATCH_SIZE` samples.
    seed : int
        Seed of the initial weights and the order of the samples.
    """

    n_latent: Annotated[int, Field(ge=1)] = 20
    n_input_modes: Annotated[int, Field(ge=1)] = 20
    iterations: Annotated[int, Field(ge=1)] = 6000
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    def networks(self, n_inputs: int, n_outputs: int) -> Mapping[str, tuple[int, int, int]]:
        return {
            "regression": (n_inputs, N_HIDDEN, self.n_latent),
            "decoder": (self.n_latent, N_HIDDEN, n_outputs),
        }

    def regress(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        if self.training.start_from is not None:
            raise InvalidInputError(
                "`start_from`: the file of an autoencoder lacks the encoder, so no "
                "training can start from it."
            )
        scale = float(np.sqrt((samples.values**2).sum(axis=1).mean()))
        data = self.on_device(
            {"inputs": samples.z, "outputs": samples.values / scale, "weights": samples.weights}
        )
        generator = torch.Generator().manual_seed(self.seed)
        n_inputs, n_outputs, m = samples.z.shape[1], samples.values.shape[1], self.n_latent
        sizes = (n_outputs, m), (m, n_outputs), (n_inputs, m)
        encoder, decoder, regression = networks = [
            Perceptron(n, N_HIDDEN, to, generator) for n, to in sizes
        ]
        together = nn.ModuleList(networks).to(data["inputs"].device)
        known = self.train(together, _loss(encoder, decoder, regression, data), data, generator)
        to_latent, from_latent = regression.arrays(), decoder.arrays()
        from_latent[-1] *= scale
        return {**known, **named("regression", to_latent), **named("decoder", from_latent)}

    def values(self, z: Array) -> Array:
        return evaluate(self.networks_["decoder"], evaluate(self.networks_["regression"], z))


def _loss(
    encoder: nn.Module, decoder: nn.Module, regression: nn.Module, data: dict[str, Tensor]
) -> Loss:
    nothing = torch.zeros_like(data["inputs"][:1])

    def loss(rows: Tensor) -> Tensor:
        wanted, weight = data["outputs"][rows], data["weights"][rows]
        from_load, encoded = regression(data["inputs"][rows]), encoder(wanted)
        at_rest = decoder(regression(nothing))
        total: Tensor = ((from_load - encoded) ** 2).mean() * LATENT_WEIGHT
        for latent in (from_load, encoded):
            total = total + (((decoder(latent) - at_rest - wanted) * weight) ** 2).sum(dim=1).mean()
        return total

    return loss
