"""An autoencoder's latent space between the linear response and the nonlinear rest of the displacement."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from torch import Tensor, nn

from mor_bench import counting
from mor_bench.errors import InvalidInputError
from mor_bench.learning.perceptron import Perceptron, checked, evaluate, named
from mor_bench.learning.training import TrainingPlan, device_of, fingerprint_of, train
from mor_bench.mechanics.compliance import project
from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.observed import linear_response
from mor_bench.reduction.basis import pod
from mor_bench.reduction.coordinates import error_weights, input_axes
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate

N_OUTPUT_MODES = 40
"""Principal coordinates of the nonlinear rest, between which the autoencoder works."""
N_HIDDEN = 64
"""Units in each of the two hidden layers of encoder, decoder and regression."""
BATCH_SIZE = 64
LEARNING_RATE = 3e-3
LATENT_WEIGHT = 0.01
"""Of the squared distance between the encoder's latent coordinates and the regression's in the loss.

At 1 in its place the median error on the coarse beam, with 20 latent coordinates and 5,100 samples, was 0.54 %, not 0.21 %.
"""


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

    Attributes
    ----------
    loss_curve_ : (n_intervals,) float64
    iterations_ : int
        Steps that the training took.
    """

    takes_observations = True
    loss_curve_: NDArray[np.float64]
    iterations_: int

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
            axes = input_axes(linear, self.n_input_modes, 0.5)
            rest = snapshots.free_displacements - linear
            modes = pod(rest).modes[:, :N_OUTPUT_MODES]
            targets = rest @ modes
            scale = float(np.sqrt((targets**2).sum(axis=1).mean()))
            device = device_of(self.training)
            arrays = {"inputs": linear @ axes, "outputs": targets / scale, "weights": error_weights(snapshots.free_displacements)[:, None]}
            data = {name: torch.from_numpy(array.astype(np.float32)).to(device) for name, array in arrays.items()}
            generator = torch.Generator().manual_seed(self.seed)
            n_inputs, n_outputs, m = axes.shape[1], modes.shape[1], self.n_latent
            sizes = (n_outputs, m), (m, n_outputs), (n_inputs, m)
            encoder, decoder, regression = networks = [Perceptron(n, N_HIDDEN, to, generator).to(device) for n, to in sizes]
            plan = TrainingPlan(self.iterations, BATCH_SIZE, LEARNING_RATE)
            fingerprint = fingerprint_of(self.parameters, data) if self.training.checkpoint else ""
            loss = _loss(encoder, decoder, regression, data)
            trained = train(nn.ModuleList(networks), loss, len(snapshots), plan, generator, self.training, self.time_limit_s, fingerprint)
            to_latent, from_latent = regression.arrays(), decoder.arrays()
            from_latent[-1] *= scale
            known = {"axes": axes, "modes": modes, "loss_curve": trained.loss_curve, "iterations": np.array([trained.iterations])}
            self._restore({**known, **named("regression", to_latent), **named("decoder", from_latent)})
        return self

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
        for weights in self._networks:
            inputs = evaluate(weights, inputs)
        return inputs

    def _state(self) -> dict[str, NDArray[Any]]:
        regression, decoder = self._networks
        known = {"axes": self.axes_, "modes": self.modes_, "loss_curve": self.loss_curve_, "iterations": np.array([self.iterations_])}
        return {**known, **named("regression", regression), **named("decoder", decoder)}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        # One memory order, fitted or loaded: BLAS rounds differently in another.
        state = {name: np.ascontiguousarray(array) for name, array in state.items()}
        n_free, n_inputs, n_outputs = len(self.scene_.free_dofs), state["axes"].shape[1], state["modes"].shape[1]
        shapes = {"axes": (n_free, n_inputs), "modes": (n_free, n_outputs), "loss_curve": (state["loss_curve"].size,), "iterations": (1,)}
        for name, shape in shapes.items():
            if state[name].shape != shape or not np.isfinite(state[name]).all():
                raise InvalidInputError(f"`{name}` must be a finite array of shape {shape}; got shape {state[name].shape}.")
        self.axes_, self.modes_ = state["axes"], state["modes"]
        self.loss_curve_, self.iterations_ = state["loss_curve"], int(state["iterations"][0])
        regression = checked(state, "regression", n_inputs, N_HIDDEN, self.n_latent)
        self._networks = [regression, checked(state, "decoder", self.n_latent, N_HIDDEN, n_outputs)]
        self._at_rest = self._decoded(np.zeros((1, n_inputs)))
        if not hasattr(self, "compliance_"):
            self.compliance_ = linear_response(self.scene_)
        self._from_forces = self.compliance_.to_coordinates(self.axes_)


def _loss(encoder: nn.Module, decoder: nn.Module, regression: nn.Module, data: dict[str, Tensor]) -> Callable[[Tensor], Tensor]:
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
