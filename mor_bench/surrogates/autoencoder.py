"""An autoencoder's latent space between the linear response and the nonlinear rest of the displacement."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn

from mor_bench.errors import InvalidInputError
from mor_bench.learning.perceptron import Perceptron, evaluate, named
from mor_bench.surrogates.coordinate_regression import CoordinateSamples
from mor_bench.surrogates.network_regression import NetworkRegression

N_HIDDEN = 64
"""Units in each of the two hidden layers of encoder, decoder and regression."""
LATENT_WEIGHT = 0.01
"""Of the squared distance between the encoder's latent coordinates and the regression's in the loss.

At 1 in its place the median error on the coarse beam, with 20 latent coordinates and 5,100 samples, was 0.54 %, not 0.21 %.
"""


class Autoencoder(NetworkRegression):
    """A latent space of the nonlinear rest, u = K₀⁻¹f + Φ (D(R(z)) - D(R(0))), entered from the linear response.

    The encoder E and the decoder D are trained to reproduce the rest's coordinates c = Φᵀ(u - K₀⁻¹f), the regression R to
    find E(c) from coordinates z of the linear response, and D∘R to find c: a sum of three squared errors. Only D and R are
    kept. As in Fulton et al.: Latent-space dynamics for reduced deformable simulation, Computer Graphics Forum 38 (2019), the
    networks work between principal coordinates; there the latent coordinates are found by solving the equations, here by R.
    No load gives exactly no displacement. In a scene with observed nodes the linear extension of their displacements takes
    the place of the linear response.

    Galerkin projection on the decoder's manifold was tried first and left out: with 5 latent coordinates (60 POD coordinates
    of the whole displacement, 4,000 iterations, one hidden layer) it erred by a median of 9.2 % on the coarse beam and 1.3 %
    on the L, against 9.6 % and 2.1 % of POD with 5 modes, at 1.5 to 4 times the cost; `quadratic-manifold` with 5 modes
    erred by 0.13 % and 0.03 %. The encoder gains nothing: D∘R trained without it erred by 0.17 % instead of 0.21 % on the
    coarse beam, with 20 latent coordinates and 5,100 samples.

    Parameters
    ----------
    n_latent : int
        Latent coordinates.
    n_input_modes : int
        Length of z; capped at the rank of the linear responses with a warning.
    iterations : int
        Adam steps of batches of `BATCH_SIZE` samples.
    seed : int
        Of the initial weights and of the order of the samples.
    """

    input = "linear-response"
    n_output_modes = 40

    def __init__(
        self,
        n_latent: Annotated[int, Field(ge=1)] = 20,
        n_input_modes: Annotated[int, Field(ge=1)] = 20,
        iterations: Annotated[int, Field(ge=1)] = 6000,
        seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
    ) -> None:
        self.n_latent = n_latent
        self.n_input_modes = n_input_modes
        self.iterations = iterations
        self.seed = seed

    def _sizes(self, n_inputs: int, n_outputs: int) -> Mapping[str, tuple[int, int, int]]:
        return {
            "regression": (n_inputs, N_HIDDEN, self.n_latent),
            "decoder": (self.n_latent, N_HIDDEN, n_outputs),
        }

    def _learn(self, samples: CoordinateSamples) -> dict[str, NDArray[Any]]:
        if self.training.start_from is not None:
            raise InvalidInputError(
                "`start_from`: an autoencoder's file lacks its encoder, so that no training can start from it."
            )
        scale = float(np.sqrt((samples.values**2).sum(axis=1).mean()))
        data = self._on_device(
            {"inputs": samples.z, "outputs": samples.values / scale, "weights": samples.weights}
        )
        generator = torch.Generator().manual_seed(self.seed)
        n_inputs, n_outputs, m = samples.z.shape[1], samples.values.shape[1], self.n_latent
        sizes = (n_outputs, m), (m, n_outputs), (n_inputs, m)
        encoder, decoder, regression = networks = [
            Perceptron(n, N_HIDDEN, to, generator) for n, to in sizes
        ]
        together = nn.ModuleList(networks).to(data["inputs"].device)
        known = self._trained(together, _loss(encoder, decoder, regression, data), data, generator)
        to_latent, from_latent = regression.arrays(), decoder.arrays()
        from_latent[-1] *= scale
        return {**known, **named("regression", to_latent), **named("decoder", from_latent)}

    def _values(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        return evaluate(self._networks["decoder"], evaluate(self._networks["regression"], z))


def _loss(
    encoder: nn.Module, decoder: nn.Module, regression: nn.Module, data: dict[str, Tensor]
) -> Callable[[Tensor], Tensor]:
    """The sum of the three squared errors."""
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
