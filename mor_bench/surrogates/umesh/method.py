"""U-Mesh as a surrogate: a 3D U-Net on a regular grid, from nodal forces to nodal displacements."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self, final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from mor_bench import counting
from mor_bench.errors import InvalidInputError
from mor_bench.scene.grid import grid_map
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.umesh.grid import PaddedGrid, padded_grid
from mor_bench.surrogates.umesh.network import UNet, empty_network, new_network
from mor_bench.surrogates.umesh.training import TrainingPlan, train

PREDICTION_CHUNK = 128
"""Samples per forward pass, so that a long batch needs 300 MB of activations at 128 channels, not gigabytes."""


@final
class UMesh(Surrogate):
    """A 3D U-Net from nodal forces to nodal displacements.

    Mendizabal, Márquez-Neila, Cotin, "Simulation of hyperelastic materials in real-time using Deep Learning". Trained with
    the mean squared error over the components of all nodes, and Adam. All is computed in float32.

    Parameters
    ----------
    channels : int
        c, channels of the first level; c·2^k at the bottom.
    steps : int
        k, how often the grid is halved; the grid is padded at its high end to multiples of 2^k.
    iterations : int
        Adam steps. A number, not a time, so that the result does not depend on the load of the machine.
    batch_size : int
        Samples per step; at most all there are.
    learning_rate : float
        Peak learning rate.
    schedule : {"constant", "one-cycle"}
        "one-cycle" rises for the first tenth of the iterations and then falls to zero along half a cosine.
    second_moment_decay : float
        Adam's β₂.
    seed : int
        Of the initial weights and of the order of the samples.

    Attributes
    ----------
    network_ : UNet
    grid_ : PaddedGrid
    force_scale_, displacement_scale_ : float
        Root mean square of the training forces, N, and displacements, m.
    loss_curve_ : (n_intervals,) float64
        Training loss per `LOSS_INTERVAL` iterations, in units of ``displacement_scale_`` squared.

    Notes
    -----
    The paper gives the network, the loss, Adam, batch 4 and 100,000 iterations. What it leaves open, and the choice here,
    with the mean absolute error per dof on the test part of the coarse beam (split by sample, c = 16, k = 2, batch 32,
    one-cycle to 3e-3, β₂ = 0.999, 2,800 iterations with hidden layers in bfloat16; one training each):

    - Learning rate and schedule: constant, 1e-4, by default: the paper's selected network (c = 128, k = 3, batch 4) began with
      a loss eight times higher at 1e-3, and both were level after 20 iterations. For short trainings, one-cycle; peaks of
      1.5e-3 and 3e-3 gave 1.17e-3 and 1.19e-3 m; with β₂ = 0.99, 3e-3 and 1e-2 gave 1.03e-3 and 1.40e-3 m.
    - β₂: Adam's own 0.999 by default. 0.999, 0.99 and 0.95 gave 1.19e-3, 1.03e-3 and 1.01e-3 m: short trainings
      gain from a short memory.
    - Initial weights: He-normal, biases zero; torch's default gave 1.48e-3 m, He's 1.19e-3 m.
    - Normalisation: forces and displacements are divided by their root mean square over the training samples, all nodes and
      components. No mean is subtracted, so that zero stays zero at padding and supports.
    - Padding voxels carry no loss.

    A mesh that lies in no regular grid gets one (`mor_bench.scene.grid`): the network sees the forces Nᵀ f on the grid and
    answers with the grid's displacements u, and the loss is taken of N u at the nodes. In a scene with observed nodes the input is
    their displacements in the place of the forces, zero elsewhere.

    Other choices changed little. In float32 (one-cycle to 2.5e-3, β₂ = 0.95), 4,000 iterations of batch 32 gave 9.1e-4 m, the
    same with forces scaled down five times more 9.0e-4 m, 2,450 of batch 64, at the same cost, 9.0e-4 m, and 5,000 of batch 32
    8.7e-4 m (1.04e-3 m split by region). Batch 16 and c = 20 were no better. The training error was 7.9e-4 m: these trainings
    are short of iterations, not of samples. bfloat16 autocast saved 8 % of the processor time on one core and a quarter of the
    time on two; a result that depends on the processor's instructions is a higher price.

    The same seed, samples, machine and number of threads give the same weights to the last bit. The network has biases, so
    that no force gives a small displacement; nodes of the supports are set to exactly zero.
    """

    takes_observations = True

    def __init__(
        self,
        channels: Annotated[int, Field(ge=1, le=512)] = 128,
        steps: Annotated[int, Field(ge=1, le=6)] = 3,
        iterations: Annotated[int, Field(ge=1)] = 100_000,
        batch_size: Annotated[int, Field(ge=1)] = 4,
        learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-4,
        schedule: Literal["constant", "one-cycle"] = "constant",
        second_moment_decay: Annotated[float, Field(gt=0, lt=1)] = 0.999,
        seed: Annotated[int, Field(ge=0, lt=2**63)] = 0,
    ) -> None:
        self.channels = channels
        self.steps = steps
        self.iterations = iterations
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.schedule = schedule
        self.second_moment_decay = second_moment_decay
        self.seed = seed

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            samples = self._checked_snapshots(snapshots)
            self.grid_: PaddedGrid = self._padded_grid()
            forces = torch.from_numpy(samples.inputs.astype(np.float32))
            displacements = torch.from_numpy(samples.displacements.astype(np.float32))
            self.force_scale_ = _rms(samples.inputs)
            self.displacement_scale_ = _rms(samples.displacements)
            generator = torch.Generator().manual_seed(self.seed)
            self.network_: UNet = new_network(self.channels, self.steps, generator)
            plan = TrainingPlan(self.iterations, self.batch_size, self.learning_rate, self.schedule, self.second_moment_decay)
            self.loss_curve_: NDArray[np.float64] = train(
                self.network_,
                self.grid_,
                self.grid_.to_grid(forces / self.force_scale_),
                displacements / self.displacement_scale_,
                plan,
                generator,
                self.time_limit_s,
            )
            self.network_.eval()
        return self

    @torch.inference_mode()
    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        checked = self._checked_forces(forces)
        if counting.running is not None:  # with one scaling of each input and each output
            products = self.network_.multiply_adds(self.grid_.shape) + self.grid_.multiply_adds + 2 * self.scene_.mesh.n_dofs
            counting.running.add(multiply_adds=len(checked) * products)
        scaled = torch.from_numpy((checked / self.force_scale_).astype(np.float32))
        answers = [self.grid_.to_nodes(self.network_(self.grid_.to_grid(chunk))) for chunk in torch.split(scaled, PREDICTION_CHUNK)]
        displacements = torch.cat(answers).numpy().astype(np.float64) * self.displacement_scale_
        displacements[:, self.scene_.fixed_nodes] = 0.0
        return displacements.reshape(np.shape(forces))

    def _padded_grid(self) -> PaddedGrid:
        """The scene's grid, of the shape that its file asks for."""
        return padded_grid(grid_map(self.scene_.mesh, self.scene_.spec.grid_nodes), self.steps)

    def _state(self) -> dict[str, NDArray[Any]]:
        weights = {f"network.{name}": value.numpy() for name, value in self.network_.state_dict().items()}
        scales = np.array([self.force_scale_, self.displacement_scale_])
        return {**weights, "scales": scales, "loss_curve": self.loss_curve_}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        for name, array in state.items():
            if not np.isfinite(array).all():
                raise InvalidInputError(f"`{name}` must be finite; got NaN or infinity.")
        self.grid_ = self._padded_grid()
        self.force_scale_, self.displacement_scale_ = (float(scale) for scale in state["scales"])
        self.loss_curve_ = state["loss_curve"]
        weights = {name.removeprefix("network."): torch.from_numpy(array) for name, array in state.items() if name.startswith("network.")}
        network = empty_network(self.channels, self.steps)
        try:
            network.load_state_dict(weights, assign=True)
        except RuntimeError as error:
            raise ValueError(f"the weights do not fit the network: {error}") from None
        self.network_ = network.eval()


def _rms(values: NDArray[np.float64]) -> float:
    """Root of the mean square over all samples, nodes and components; 1 where all are zero."""
    return float(np.sqrt(np.mean(np.square(values)))) or 1.0
