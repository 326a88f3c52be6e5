"""An autoencoder's latent space between the linear response and the nonlinear rest of the displacement."""

from __future__ import annotations

from math import cos, isfinite, pi
from typing import Annotated, Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from torch import Tensor

from mor_bench import counting
from mor_bench.errors import InvalidInputError, MorBenchError
from mor_bench.mechanics.compliance import project
from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.observed import linear_response
from mor_bench.reduction.basis import pod
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

N_OUTPUT_MODES = 40
"""Principal coordinates of the nonlinear rest, between which the autoencoder works."""
N_HIDDEN = 64
"""Units in each of the two hidden layers of encoder, decoder and regression."""
BATCH_SIZE = 64
LEARNING_RATE = 3e-3
WARM_UP = 200
"""Iterations during which the learning rate rises; then it falls to zero along half a cosine."""
SMALLEST = 0.2
"""Errors count relative to the displacement, or to this share of the root mean square displacement where that is larger."""
LATENT_WEIGHT = 0.01
"""Of the squared distance between the encoder's latent coordinates and the regression's in the loss.

At 1 in its place the median error on the coarse beam, with 20 latent coordinates and 5,100 samples, was 0.54 %, not 0.21 %.
"""

LAYERS = ("first", "first_bias", "second", "second_bias", "last")


class Autoencoder(Surrogate):
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

    takes_observations = True

    def __init__(
        self,
        n_latent: Annotated[int, Field(ge=1)] = 20,
        n_input_modes: Annotated[int, Field(ge=1)] = 20,
        iterations: Annotated[int, Field(ge=1)] = 6000,
        seed: Annotated[int, Field(ge=0, lt=2**63)] = 0,
    ) -> None:
        self.n_latent = n_latent
        self.n_input_modes = n_input_modes
        self.iterations = iterations
        self.seed = seed

    def supports(self, scene: Scene) -> str | None:
        return unknown_equations(scene, observed=True)

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            snapshots = self._checked_snapshots(snapshots)
            self.compliance_ = linear_response(scene)
            linear = self.compliance_.respond(snapshots.inputs.reshape(len(snapshots), -1))[:, scene.free_dofs]
            axes = pod(linear, self.n_input_modes).modes
            coordinates = linear @ axes
            # Half way between coordinates of their own size and of equal size, on a logarithmic scale.
            axes = axes / np.sqrt(np.sqrt((coordinates**2).mean(axis=0)) * np.sqrt((coordinates**2).mean()))
            rest = snapshots.free_displacements - linear
            modes = pod(rest).modes[:, :N_OUTPUT_MODES]
            targets = rest @ modes
            scale = float(np.sqrt((targets**2).sum(axis=1).mean()))
            sizes = np.linalg.norm(snapshots.free_displacements, axis=1)
            typical = float(np.sqrt((sizes**2).mean()))
            weights = typical / np.maximum(sizes, SMALLEST * typical)
            inputs, outputs, each = (torch.from_numpy(a.astype(np.float32)) for a in (linear @ axes, targets / scale, weights[:, None]))
            regression, decoder = self._train(inputs, outputs, each)
            state = {"axes": axes, "modes": modes}
            for name, network in (("regression", regression), ("decoder", decoder)):
                state.update({f"{name}.{layer}": weight.detach().numpy().astype(np.float64) for layer, weight in zip(LAYERS, network, strict=True)})
            state["decoder.last"] *= scale
            self._restore(state)
        return self

    def _train(self, inputs: Tensor, outputs: Tensor, weights: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """The weights of regression and decoder."""
        generator = torch.Generator().manual_seed(self.seed)
        n_inputs, n_outputs = inputs.shape[1], outputs.shape[1]
        sizes = (n_outputs, self.n_latent), (self.n_latent, n_outputs), (n_inputs, self.n_latent)
        encoder, decoder, regression = (_new_network(n, m, generator) for n, m in sizes)
        optimiser = torch.optim.Adam([*encoder, *decoder, *regression], lr=LEARNING_RATE)
        nothing = torch.zeros(1, n_inputs)
        for iteration in range(self.iterations):
            falling = 0.5 * (1.0 + cos(pi * iteration / self.iterations))
            optimiser.param_groups[0]["lr"] = LEARNING_RATE * min(1.0, (iteration + 1) / WARM_UP) * falling
            rows = torch.randint(len(inputs), (BATCH_SIZE,), generator=generator)
            wanted, weight = outputs[rows], weights[rows]
            from_load, encoded = _apply(regression, inputs[rows]), _apply(encoder, wanted)
            at_rest = _apply(decoder, _apply(regression, nothing))
            loss = ((from_load - encoded) ** 2).mean() * LATENT_WEIGHT
            for latent in (from_load, encoded):
                loss = loss + (((_apply(decoder, latent) - at_rest - wanted) * weight) ** 2).sum(dim=1).mean()
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
        if not isfinite(float(loss.detach())):
            raise MorBenchError("the training of the autoencoder diverged.")
        return regression, decoder

    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        batch = self._checked_forces(forces).reshape(-1, self.scene_.mesh.n_dofs)
        free = self.scene_.free_dofs
        if counting.running is not None:  # each unit's nonlinearity as one
            networks = sum(weight.size for network in self._networks for weight in network)
            counting.running.add(multiply_adds=len(batch) * (networks + self.modes_.size))
        out = self.compliance_.respond(batch)
        out[:, free] += (self._decoded(project(self._from_forces, batch)) - self._at_rest) @ self.modes_.T
        out[~batch.any(axis=1)] = 0.0  # in a batch the network at rest is rounded otherwise
        return out.reshape(np.shape(forces))

    def _decoded(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        for first, first_bias, second, second_bias, last in self._networks:
            inputs = _silu(_silu(inputs @ first + first_bias) @ second + second_bias) @ last
        return inputs

    def _state(self) -> dict[str, NDArray[Any]]:
        named = zip(("regression", "decoder"), self._networks, strict=True)
        weights = {f"{name}.{layer}": weight for name, network in named for layer, weight in zip(LAYERS, network, strict=True)}
        return {"axes": self.axes_, "modes": self.modes_, **weights}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        state = {name: np.ascontiguousarray(array) for name, array in state.items()}
        n_free, n_inputs, n_outputs = len(self.scene_.free_dofs), state["axes"].shape[1], state["modes"].shape[1]
        shapes: dict[str, tuple[int, ...]] = {"axes": (n_free, n_inputs), "modes": (n_free, n_outputs)}
        for name, n, m in (("regression", n_inputs, self.n_latent), ("decoder", self.n_latent, n_outputs)):
            layers = (n, N_HIDDEN), (N_HIDDEN,), (N_HIDDEN, N_HIDDEN), (N_HIDDEN,), (N_HIDDEN, m)
            shapes |= {f"{name}.{layer}": shape for layer, shape in zip(LAYERS, layers, strict=True)}
        for name, shape in shapes.items():
            if state[name].shape != shape or not np.isfinite(state[name]).all():
                raise InvalidInputError(f"`{name}` must be a finite array of shape {shape}; got shape {state[name].shape}.")
        self.axes_, self.modes_ = state["axes"], state["modes"]
        self._networks = [[state[f"{name}.{layer}"] for layer in LAYERS] for name in ("regression", "decoder")]
        self._at_rest = self._decoded(np.zeros((1, n_inputs)))
        if not hasattr(self, "compliance_"):
            self.compliance_ = linear_response(self.scene_)
        self._from_forces = self.compliance_.to_coordinates(self.axes_)


def _new_network(n_inputs: int, n_outputs: int, generator: torch.Generator) -> list[Tensor]:
    """Weights (inputs, outputs) with variance 1 / inputs, and zero biases, in the order of `LAYERS`."""
    shapes = (n_inputs, N_HIDDEN), (N_HIDDEN,), (N_HIDDEN, N_HIDDEN), (N_HIDDEN,), (N_HIDDEN, n_outputs)
    drawn = [torch.randn(shape, generator=generator) / shape[0] ** 0.5 if len(shape) == 2 else torch.zeros(shape) for shape in shapes]
    return [weight.requires_grad_() for weight in drawn]


def _apply(network: list[Tensor], inputs: Tensor) -> Tensor:
    first, first_bias, second, second_bias, last = network
    silu = torch.nn.functional.silu
    return silu(silu(inputs @ first + first_bias) @ second + second_bias) @ last


def _silu(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """x / (1 + exp(-x)) without overflow."""
    return 0.5 * x * (1.0 + np.tanh(0.5 * x))
