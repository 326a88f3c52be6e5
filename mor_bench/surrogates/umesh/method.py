"""U-Mesh as a surrogate: a 3D U-Net on a regular grid, from nodal forces to nodal displacements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from torch import Tensor

from mor_bench.counting import count, is_counting
from mor_bench.errors import InvalidInputError
from mor_bench.learning.inference import Backend, choose_inference, inference_or_eager
from mor_bench.learning.training import device_of, train
from mor_bench.learning.training_plan import (
    LearningProblem,
    Precision,
    Schedule,
    TrainingPlan,
)
from mor_bench.mechanics.model import unknown_equations
from mor_bench.mechanics.observed import linear_response
from mor_bench.model_file import fitting_arrays, weights_to_start_from
from mor_bench.scene.grid import grid_map
from mor_bench.scene.scene import Scene
from mor_bench.scene.symmetry import Mirror, mirrors
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.field_network import network_weights
from mor_bench.surrogates.umesh.network import Activation, UNet, empty_network, new_network
from mor_bench.surrogates.umesh.padded_grid import PaddedGrid, padded_grid

if TYPE_CHECKING:
    import onnx

PREDICTION_CHUNK = 128
"""Samples per forward pass, so that a long batch needs 300 MB of activations at 128 channels, not gigabytes."""

N_CHOOSING = 32
"""Training samples, evenly spread, by which the back end of the predictions is chosen."""


SMALLEST_SIZE = 0.1
"""Errors of samples smaller than this, in root mean squares over all samples, count no more than of this size."""


@final
class UMesh(Surrogate):
    """A 3D U-Net from nodal forces to nodal displacements.

    Mendizabal, Márquez-Neila, Cotin, "Simulation of hyperelastic materials in real-time using Deep Learning". Trained with
    the mean squared error over the components of all nodes, and Adam. All is computed in float32 unless `precision` or
    `inference` says otherwise.

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
    normalisation : {"rms", "max", "none"}
        What the network's inputs and answers are divided by: their root mean square over the training samples, nodes and components,
        their largest magnitude, or 1 (N and m).
    input : {"force", "linear-response"}
        What the network is given. With the linear response K₀⁻¹f it answers with the nonlinear rest, u = K₀⁻¹f + network.
    activation : {"relu", "silu"}
        Of the convolutions.
    zero_at_rest : bool
        Take the network's answer to nothing off every answer, in training too: no force then gives no displacement.
    mirrored : bool
        Train on mirror images too, drawn at random, where the scene has planes of symmetry (`mor_bench.scene.symmetry`).
    loss : {"absolute", "relative"}
        The mean squared error, or each sample's part of it divided by the mean square of what is to be answered (or by that of
        `SMALLEST_SIZE` of the root mean square over all samples, where that is larger).
    precision : {"float32", "bfloat16"}
        Of the products in training.
    validation_fraction : float
        Part of the training samples that are held out, to end the training when they gain nothing and keep the best weights.
    seed : int
        Of the initial weights and of the order of the samples.
    inference : str
        What computes the predictions, see `mor_bench.learning.inference`. "packed" differs from "eager" by rounding only.
        "auto": the fastest that is exact enough, by single queries on one thread at the end of the fit; the choice is kept with
        the model, and may be another one after another fit, where two are nearly as fast.

    Attributes
    ----------
    network_ : UNet
    inference_ : Inference
        The network as `predict` calls it.
    grid_ : PaddedGrid
    input_scale_, output_scale_ : float
        By `normalisation`, of what the network is given in training, N or m, and of what it is to answer, m.
    loss_curve_ : (n_intervals,) float64
        Training loss per `LOSS_INTERVAL` iterations, in units of ``output_scale_`` squared.
    validation_curve_ : (n_validations,) float64
        The same of the samples held out, a fiftieth of the iterations apart; empty without any.
    iterations_ : int
        The knob, or what it must be to repeat a training that was sized to seconds.

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
      components. Their largest magnitude, or none, changed little: after 1,500 iterations 1.28e-3 and 1.37e-3 m, where the root mean
      square gave 1.28e-3 to 1.33e-3 with three seeds. No mean is subtracted, so that zero stays zero at padding and supports.
    - Padding voxels carry no loss.

    A mesh that lies in no regular grid gets one (`mor_bench.scene.grid`): the network sees the forces Nᵀ f on the grid and
    answers with the grid's displacements u, and the loss is taken of N u at the nodes. In a scene with observed nodes the input is
    their displacements in the place of the forces, zero elsewhere, or the linear extension of these.

    Other choices changed little. In float32 (one-cycle to 2.5e-3, β₂ = 0.95), 4,000 iterations of batch 32 gave 9.1e-4 m, the
    same with forces scaled down five times more 9.0e-4 m, 2,450 of batch 64, at the same cost, 9.0e-4 m, and 5,000 of batch 32
    8.7e-4 m (1.04e-3 m split by region). Batch 16 and c = 20 were no better. The training error was 7.9e-4 m: these trainings
    are short of iterations, not of samples. bfloat16 autocast saved 8 % of the processor time on one core and a quarter of the
    time on two; a result that depends on the processor's instructions is a higher price.

    The same seed, samples, machine and number of threads give the same weights to the last bit. The network has biases, so
    that no force gives a small displacement; nodes of the supports are set to exactly zero.
    """

    takes_observations = True
    architecture: ClassVar[tuple[str, ...]] = (
        "channels",
        "steps",
        "normalisation",
        "input",
        "activation",
        "zero_at_rest",
    )

    def __init__(
        self,
        channels: Annotated[int, Field(ge=1, le=512)] = 128,
        steps: Annotated[int, Field(ge=1, le=6)] = 3,
        iterations: Annotated[int, Field(ge=1)] = 100_000,
        batch_size: Annotated[int, Field(ge=1)] = 4,
        learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-4,
        schedule: Schedule = "constant",
        second_moment_decay: Annotated[float, Field(gt=0, lt=1)] = 0.999,
        normalisation: Literal["rms", "max", "none"] = "rms",
        input: Literal["force", "linear-response"] = "force",
        activation: Activation = "relu",
        zero_at_rest: bool = False,
        mirrored: bool = False,
        loss: Literal["absolute", "relative"] = "absolute",
        precision: Precision = "float32",
        validation_fraction: Annotated[float, Field(ge=0, le=0.5)] = 0.0,
        seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
        inference: Backend | Literal["auto"] = "packed",
    ) -> None:
        self.channels = channels
        self.steps = steps
        self.iterations = iterations
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.schedule = schedule
        self.second_moment_decay = second_moment_decay
        self.normalisation = normalisation
        self.input = input
        self.activation = activation
        self.zero_at_rest = zero_at_rest
        self.mirrored = mirrored
        self.loss = loss
        self.precision = precision
        self.validation_fraction = validation_fraction
        self.seed = seed
        self.inference = inference

    def supports(self, scene: Scene) -> str | None:
        if self.mirrored and scene.observed_nodes is not None:
            return "the mirror image of a node that is observed need not be"
        return (
            unknown_equations(scene, observed=True)
            if self.input == "linear-response" or self.mirrored
            else None
        )

    def fit(self, scene: Scene, snapshots: Snapshots | None) -> Self:
        with self._fitting(scene):
            samples = self._checked_snapshots(snapshots)
            self._prepare()
            given, wanted = self._given(samples.inputs), samples.displacements
            if self.input == "linear-response":
                wanted = wanted - given
            self.input_scale_, self.output_scale_ = (
                _scale(values, self.normalisation) for values in (given, wanted)
            )
            device = device_of(self.training)
            generator = torch.Generator().manual_seed(self.seed)
            self.network_: UNet = new_network(self.channels, self.steps, generator, self.activation)
            if self.training.start_from is not None:
                self._start_from(self.training.start_from)
            self.network_.to(device)
            inputs = torch.from_numpy((given / self.input_scale_).astype(np.float32)).to(device)
            targets = torch.from_numpy((wanted / self.output_scale_).astype(np.float32)).to(device)
            images = [
                Image.of(mirror, device) for mirror in (mirrors(scene) if self.mirrored else [])
            ]
            zero = torch.zeros_like(inputs[:1])
            weights = self._sample_weights(targets)

            def loss(rows: Tensor) -> Tensor:
                x, y = inputs[rows], targets[rows]
                for image in images if self.network_.training else []:
                    turned = (
                        torch.randint(2, (len(rows), 1, 1), generator=generator).bool().to(device)
                    )
                    x, y = torch.where(turned, image(x), x), torch.where(turned, image(y), y)
                answer = (
                    self._answer(x) - self._answer(zero) if self.zero_at_rest else self._answer(x)
                )
                errors = (answer - y).square().sum(dim=(1, 2))
                return (errors * weights[rows]).sum() * (
                    1.0 / y.numel()
                )  # autocast would round a product of vectors

            plan = TrainingPlan(
                self.iterations,
                self.batch_size,
                self.learning_rate,
                self.schedule,
                self.second_moment_decay,
                precision=self.precision,
                validation_fraction=self.validation_fraction,
            )
            arrays = {"inputs": inputs, "targets": targets}
            problem = LearningProblem(
                self.network_, loss, len(samples), generator, arrays, self.parameters
            )
            done = train(problem, plan, self.training, self.time_limit_s)
            self.network_.cpu()
            self.loss_curve_, self.validation_curve_, self.iterations_ = (
                done.loss_curve,
                done.validation_curve,
                done.iterations,
            )
            self._choose_inference(inputs.cpu(), targets.cpu())
            self._come_to_rest()
        return self

    @torch.inference_mode()
    def predict(self, forces: ArrayLike) -> NDArray[np.float64]:
        checked = self._checked_forces(forces)
        if is_counting():  # the sum walks over the layers
            products = (
                self.network_.multiply_adds(self.grid_.shape)
                + self.grid_.multiply_adds
                + 2 * self.scene_.mesh.n_dofs  # each input and output is scaled
            )
            count(multiply_adds=len(checked) * products)
        given = self._given(checked)
        scaled = torch.from_numpy((given / self.input_scale_).astype(np.float32))
        answers = torch.cat(
            [
                self._answer(chunk, self.inference_)
                for chunk in torch.split(scaled, PREDICTION_CHUNK)
            ]
        ).numpy()
        displacements = (answers - self._at_rest).astype(np.float64) * self.output_scale_
        if self.input == "linear-response":
            displacements += given
        displacements[:, self.scene_.fixed_nodes] = 0.0
        if self.zero_at_rest:
            displacements[~checked.any(axis=(1, 2))] = (
                0.0  # in a batch the network at rest is rounded otherwise
            )
        return displacements.reshape(np.shape(forces))

    def _prepare(self) -> None:
        """What the scene gives, before anything is learned."""
        self.grid_: PaddedGrid = padded_grid(
            grid_map(self.scene_.mesh, self.scene_.spec.grid_nodes), self.steps
        )
        if self.input == "linear-response":
            self.compliance_ = linear_response(self.scene_)

    def _given(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, n_nodes, 3) what the network is given: the forces, N, or displacements of observed nodes, m; or the linear response to them, m."""
        if self.input == "force":
            return forces
        return self.compliance_.respond(
            forces.reshape(len(forces), self.scene_.mesh.n_dofs)
        ).reshape(forces.shape)

    def _answer(self, given: Tensor, network: Callable[[Tensor], Tensor] | None = None) -> Tensor:
        """The network, or what computes it, from nodes to nodes, (n, n_nodes, 3) float32, scaled."""
        return self.grid_.to_nodes((network or self.network_)(self._on_grid(given)).float())

    def _on_grid(self, given: Tensor) -> Tensor:
        forces = self.input == "force" and self.scene_.observed_nodes is None
        return self.grid_.to_grid(given) if forces else self.grid_.displacements_to_grid(given)

    def _sample_weights(self, targets: Tensor) -> Tensor:
        """(n,) what each sample's squared error counts, 1 on average."""
        if self.loss == "absolute":
            return targets.new_ones(len(targets))
        size = targets.square().mean(dim=(1, 2))
        weights = 1.0 / size.clamp(
            min=max(SMALLEST_SIZE**2 * float(size.mean()), torch.finfo(size.dtype).tiny)
        )
        return weights / weights.mean()

    def _come_to_rest(self) -> None:
        """Remember what the network answers to nothing, if that is to be taken off."""
        self._at_rest = np.zeros((1, self.scene_.mesh.n_nodes, 3), dtype=np.float32)
        if self.zero_at_rest:
            with torch.inference_mode():
                self._at_rest = self._answer(
                    torch.zeros(1, self.scene_.mesh.n_nodes, 3), self.inference_
                ).numpy()

    def _choose_inference(self, inputs: Tensor, targets: Tensor) -> None:
        """Set ``inference_``, by training samples where it is to be chosen; both (n_samples, n_nodes, 3), scaled."""
        self.network_.eval()
        if self.inference != "auto":
            self.inference_ = inference_or_eager(self.network_, self.inference)
            return
        rows = torch.linspace(0, len(inputs) - 1, min(N_CHOOSING, len(inputs))).long()
        given, wanted = inputs[rows], targets[rows]

        def errors(network: Callable[[Tensor], Tensor]) -> Tensor:
            at_rest = (
                self._answer(torch.zeros_like(given[:1]), network) if self.zero_at_rest else 0.0
            )
            return self._answer(given, network) - at_rest - wanted

        choice = choose_inference(self.network_, self._on_grid(given), errors)
        self.inference_ = choice.inference
        self.sizes_ = {"inference": choice.inference.backend}
        self.timings_ms_ = choice.milliseconds

    def _start_from(self, path: Path) -> None:
        """Take the weights of a network that was trained on this scene or another; grids of any size share them."""
        shapes = {
            f"network.{name}": tuple(value.shape)
            for name, value in self.network_.state_dict().items()
        }
        self.network_.load_state_dict(
            network_weights(
                fitting_arrays(path, weights_to_start_from(path, self), shapes, np.float32)
            )
        )

    def onnx_model(self) -> onnx.ModelProto:
        from mor_bench.surrogates.umesh.onnx_model import umesh_graph

        with torch.inference_mode():
            at_rest = (
                self._answer(torch.zeros(1, self.scene_.mesh.n_nodes, 3)).numpy()[0]
                if self.zero_at_rest
                else None
            )
        response = self.compliance_ if self.input == "linear-response" else None
        return umesh_graph(
            self.scene_,
            self.grid_,
            self.network_,
            self.input_scale_,
            self.output_scale_,
            at_rest,
            response,
        )

    def _state(self) -> dict[str, NDArray[Any]]:
        weights = {
            f"network.{name}": value.numpy() for name, value in self.network_.state_dict().items()
        }
        scales = np.array([self.input_scale_, self.output_scale_])
        curves = {"loss_curve": self.loss_curve_, "validation_curve": self.validation_curve_}
        return {**weights, "scales": scales, **curves, "iterations": np.array([self.iterations_])}

    def _restore(self, state: dict[str, NDArray[Any]]) -> None:
        network = empty_network(self.channels, self.steps, self.activation)
        expected: dict[str, tuple[tuple[int, ...], type]] = {
            f"network.{name}": (tuple(value.shape), np.float32)
            for name, value in network.state_dict().items()
        }
        expected |= {
            name: (np.shape(state[name])[:1], np.float64)
            for name in ("loss_curve", "validation_curve")
        }
        expected |= {"scales": ((2,), np.float64), "iterations": ((1,), np.int64)}
        for name in sorted(expected.keys() | state.keys()):
            if name not in state or name not in expected:
                raise InvalidInputError(
                    f"the weights do not fit the network: `{name}` is {'missing' if name in expected else 'not expected'}."
                )
            array, (shape, dtype) = state[name], expected[name]
            if array.shape != shape or array.dtype != dtype:
                wanted = f"{np.dtype(dtype)} of shape {shape}"
                raise InvalidInputError(
                    f"the weights do not fit the network: `{name}` must be {wanted}; got {array.dtype} of shape {array.shape}."
                )
            if not np.isfinite(array).all():
                raise InvalidInputError(f"`{name}` must be finite; got NaN or infinity.")
        if not (state["scales"] > 0).all() or not state["iterations"][0] > 0:
            raise InvalidInputError("`scales` and `iterations` must be positive.")
        network.load_state_dict(network_weights(state), assign=True)
        self.network_ = network.eval()
        self.input_scale_, self.output_scale_ = (float(scale) for scale in state["scales"])
        self.loss_curve_, self.validation_curve_ = state["loss_curve"], state["validation_curve"]
        self.iterations_ = int(state["iterations"][0])
        chosen = getattr(self, "sizes_", {}).get("inference", self.inference)
        self.inference_ = inference_or_eager(self.network_, "eager" if chosen == "auto" else chosen)
        self._prepare()
        self._come_to_rest()


@dataclass(frozen=True)
class Image:
    """A mirror image of nodal vectors, on a device."""

    nodes: Tensor
    signs: Tensor

    @classmethod
    def of(cls, mirror: Mirror, device: torch.device) -> Image:
        return cls(
            torch.from_numpy(mirror.nodes).to(device),
            torch.from_numpy(mirror.signs.astype(np.float32)).to(device),
        )

    def __call__(self, vectors: Tensor) -> Tensor:
        """(n, n_nodes, 3) → the same shape."""
        return vectors[:, self.nodes] * self.signs


def _scale(values: NDArray[np.float64], normalisation: str) -> float:
    """What values are divided by, over all samples, nodes and components; 1 where all are zero."""
    if normalisation == "none":
        return 1.0
    return (
        float(
            np.abs(values).max() if normalisation == "max" else np.sqrt(np.mean(np.square(values)))
        )
        or 1.0
    )
