"""U-Mesh as a surrogate: a 3D U-Net on a regular grid, from nodal forces to nodal displacements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn

from mor_bench.errors import UnsupportedSceneError
from mor_bench.learning.cuda_graphs import volumes_last
from mor_bench.learning.inference import (
    Backend,
    Inference,
    choose_inference,
    inference_or_eager,
)
from mor_bench.learning.training import Training
from mor_bench.learning.training_plan import Loss, Precision, Schedule, TrainingPlan
from mor_bench.mechanics.model import unknown_equations
from mor_bench.scene.grid import grid_map
from mor_bench.scene.scene import Scene
from mor_bench.scene.symmetry import Mirror, mirrors
from mor_bench.surrogates.field_surrogate import Arrays, FieldSurrogate, Input
from mor_bench.surrogates.umesh.axes import inverse, longest_last, turn_kernels, turned_grid
from mor_bench.surrogates.umesh.network import Activation, UNet, draw_weights, empty_network
from mor_bench.surrogates.umesh.onnx_model import UMeshParts, umesh_graph
from mor_bench.surrogates.umesh.padded_grid import PaddedGrid, padded_grid

N_CHOOSING = 32
"""Training samples, evenly spread, used to choose the back end of the predictions."""

SMALLEST_SIZE = 0.1
"""Smallest denominator of relative errors, as a fraction of all samples' root mean square."""


@final
@dataclass(eq=False)
class UMesh(FieldSurrogate):
    """A 3D U-Net from nodal forces to nodal displacements.

    Mendizabal, Márquez-Neila, Cotin, "Simulation of hyperelastic materials in real-time using Deep
    Learning". It is trained with Adam and the mean squared error over the components of all nodes,
    in float32 unless `precision` or `inference` changes that. A mesh without its own regular grid
    gets one (`mor_bench.scene.grid`). The network maps the forces Nᵀ f on the grid to the grid's
    displacements u; the loss is computed from N u at the nodes. Padding voxels have no loss. The
    same seed, samples, machine and number of threads give bit-identical weights.

    The other parameters are those of `FieldSurrogate`.

    Parameters
    ----------
    channels : int
        c, channels of the first level; c·2^k at the bottom. 16 is enough on a processor.
    steps : int
        k, number of times the grid is halved; it is padded at its high end to multiples of 2^k.
    learning_rate : float
        Peak learning rate. Use about 3e-3 with "one-cycle".
    schedule : {"constant", "one-cycle"}
        "one-cycle" rises for a tenth of the iterations, then falls to zero along half a cosine.
        Use it for short trainings.
    second_moment_decay : float
        Adam's β₂, in (0, 1). Use 0.95 to 0.99 for short trainings.
    normalisation : {"rms", "max", "none"}
        Divisor of the network's inputs and answers: their root mean square over training samples,
        nodes and components, their largest magnitude, or 1 (N and m).
    input : {"force", "linear-response"}
        Input of the network. With the linear response K₀⁻¹f it learns the nonlinear remainder,
        u = K₀⁻¹f + network, which gives far smaller errors.
    activation : {"relu", "silu"}
        Activation of the convolutions; the paper uses "relu".
    zero_at_rest : bool
        Subtract the network's answer to no force, also in training, so that no force gives no
        displacement.
    mirrored : bool
        Also train on random mirror images, if the scene has planes of symmetry.
    loss : {"absolute", "relative"}
        Mean squared error, without or with division by each sample's mean square. The divisor
        uses at least `SMALLEST_SIZE` of the root mean square over all samples.
    precision : {"float32", "bfloat16"}
        Precision of the products in training.
    validation_fraction : float
        0 for no early stopping. Otherwise the weights with the lowest loss on the validation
        samples of `training` are kept. Without such samples, this fraction of the training samples,
        in [0, 0.5], is held out at random instead.
    inference : str
        Back end of the predictions, see `mor_bench.learning.inference`. "packed" differs from
        "eager" by rounding only. "auto" chooses the fastest that is accurate enough, timed at the
        end of the fit. If two are nearly as fast, another fit may choose the other.

    Attributes
    ----------
    network_ : UNet
    inference_ : Inference
        The network in the form that `predict` calls.
    grid_ : PaddedGrid
    validation_curve_ : (n_validations,) float64
        Loss of the held-out samples, at intervals of a fiftieth of the iterations; empty if none
        are held out.
    """

    channels: Annotated[int, Field(ge=1, le=512)] = 128
    steps: Annotated[int, Field(ge=1, le=6)] = 3
    iterations: Annotated[int, Field(ge=1)] = 100_000
    batch_size: Annotated[int, Field(ge=1)] = 4
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-4
    schedule: Schedule = "constant"
    second_moment_decay: Annotated[float, Field(gt=0, lt=1)] = 0.999
    normalisation: Literal["rms", "max", "none"] = "rms"
    input: Input = "force"
    activation: Activation = "relu"
    zero_at_rest: bool = False
    mirrored: bool = False
    loss: Literal["absolute", "relative"] = "absolute"
    precision: Precision = "float32"
    validation_fraction: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    inference: Backend | Literal["auto"] = "packed"

    architecture: ClassVar = (
        "channels",
        "steps",
        "normalisation",
        "input",
        "activation",
        "zero_at_rest",
    )
    chunk: ClassVar = 128  # 300 MB of activations at 128 channels
    curves: ClassVar = ("loss_curve", "validation_curve")

    def supports(self, scene: Scene) -> str | None:
        if self.mirrored and scene.observed_nodes is not None:
            return "the mirror image of an observed node need not be observed"
        return unknown_equations(scene) if self.mirrored else super().supports(scene)

    def set_up(self, scene: Scene) -> None:
        super().set_up(scene)
        grid = grid_map(scene.mesh, scene.spec.grid_nodes)
        self.grid_: PaddedGrid = padded_grid(grid, self.steps)

    def scale(self, values: NDArray[np.float64]) -> float:
        if self.normalisation == "none":
            return 1.0
        if self.normalisation == "max":
            return float(np.abs(values).max()) or 1.0
        return super().scale(values)

    def build_network(self, constants: Arrays) -> UNet:
        return empty_network(self.channels, self.steps, self.activation)

    def initialise(self, network: UNet, generator: torch.Generator) -> UNet:
        return draw_weights(network, generator)

    def train_network(
        self,
        network: nn.Module,
        known: Sequence[tuple[Tensor, Tensor]],
        generator: torch.Generator,
    ) -> Training:
        """Train with the longest axis last; packed predictions want the order of the mesh."""
        grid = grid_map(self.scene_.mesh, self.scene_.spec.grid_nodes)
        axes, kept = longest_last(grid.shape), self.grid_
        turn_kernels(network, axes)
        self.grid_ = padded_grid(turned_grid(grid, axes), self.steps)
        done = super().train_network(network, known, generator)
        self.grid_ = kept
        turn_kernels(network, inverse(axes))
        return done

    def training_data(self, network: UNet, inputs: Tensor, targets: Tensor) -> dict[str, Tensor]:
        return {"inputs": inputs, "targets": targets}

    def loss_function(
        self, network: UNet, data: dict[str, Tensor], generator: torch.Generator
    ) -> Loss:
        inputs, targets = data["inputs"], data["targets"]
        if inputs.is_cuda:
            volumes_last(network)
        weights, zero = self._sample_weights(targets), torch.zeros_like(inputs[:1])
        images = [Image(mirror, inputs.device) for mirror in self._mirrors()]

        def loss(rows: Tensor) -> Tensor:
            x, y = inputs[rows], targets[rows]
            for image in images if network.training else []:
                drawn = torch.randint(2, (len(rows), 1, 1), generator=generator)
                turned = drawn.bool().to(inputs.device)
                x, y = torch.where(turned, image(x), x), torch.where(turned, image(y), y)
            answer = self._at_nodes(x, network)
            if self.zero_at_rest:
                answer = answer - self._at_nodes(zero, network)
            errors = (answer - y).square().sum(dim=(1, 2))
            # Not a product of vectors, because autocast would round it.
            return (errors * weights[rows]).sum() * (1.0 / y.numel())

        return loss

    @property
    def repeats(self) -> bool:
        return not self._mirrors()

    def plan(self) -> TrainingPlan:
        return TrainingPlan(
            self.iterations,
            self.batch_size,
            self.learning_rate,
            self.schedule,
            self.second_moment_decay,
            self.precision,
            self.validation_fraction,
        )

    def finish(self, inputs: Tensor, targets: Tensor) -> None:
        """Choose the back end of the predictions, if it is "auto"."""
        if self.inference != "auto":
            return
        network = self.network_.eval()
        rows = torch.linspace(0, len(inputs) - 1, min(N_CHOOSING, len(inputs))).long()
        given, wanted = inputs[rows], targets[rows]
        nothing = torch.zeros_like(given[:1])

        def errors(function: Callable[[Tensor], Tensor]) -> Tensor:
            at_rest = self._at_nodes(nothing, function) if self.zero_at_rest else 0.0
            return self._at_nodes(given, function) - at_rest - wanted

        choice = choose_inference(network, self._on_grid(given), errors)
        self.sizes_ = {"inference": choice.inference.backend}
        self.timings_ms_ = choice.milliseconds

    def precompute(self) -> None:
        self.inference_: Inference = inference_or_eager(self.network_, self.value("inference"))

    def evaluate(self, fields: Tensor) -> Tensor:
        return self._at_nodes(fields, self.inference_)

    def n_products(self) -> int:
        network: Any = self.network_
        return int(network.multiply_adds(self.grid_.shape)) + self.grid_.multiply_adds

    def onnx_model(self) -> Any:
        if self.scene_.frames is not None:
            raise UnsupportedSceneError(
                f"{self.scene_.name}: a graph cannot hold its oblique supports."
            )
        at_rest = None
        if self.zero_at_rest:
            with torch.inference_mode():
                nothing = torch.zeros(1, self.scene_.mesh.n_nodes, 3)
                at_rest = self._at_nodes(nothing, self.network_).numpy()[0]
        scales = (self.input_scale_, self.output_scale_)
        response = self.response_ if self.input == "linear-response" else None
        network: Any = self.network_
        return umesh_graph(UMeshParts(self.scene_, self.grid_, network, scales, at_rest, response))

    def _at_nodes(self, fields: Tensor, network: Callable[[Tensor], Tensor]) -> Tensor:
        """Evaluate a network from nodes to nodes, (n, n_nodes, 3) float32, scaled."""
        return self.grid_.to_nodes(network(self._on_grid(fields)).float())

    def _on_grid(self, fields: Tensor) -> Tensor:
        forces = self.input == "force" and self.scene_.observed_nodes is None
        return self.grid_.to_grid(fields) if forces else self.grid_.displacements_to_grid(fields)

    def _mirrors(self) -> list[Mirror]:
        return mirrors(self.scene_) if self.mirrored else []

    def _sample_weights(self, targets: Tensor) -> Tensor:
        """Return the weight of each sample's squared error, (n,), 1 on average."""
        if self.loss == "absolute":
            return targets.new_ones(len(targets))
        size = targets.square().mean(dim=(1, 2))
        least = max(SMALLEST_SIZE**2 * float(size.mean()), torch.finfo(size.dtype).tiny)
        weights = 1.0 / size.clamp(min=least)
        return weights / weights.mean()


class Image:
    """A mirror image of nodal vectors, on a device."""

    def __init__(self, mirror: Mirror, device: torch.device) -> None:
        self.nodes = torch.from_numpy(mirror.nodes).to(device)
        self.signs = torch.from_numpy(mirror.signs.astype(np.float32)).to(device)

    def __call__(self, vectors: Tensor) -> Tensor:
        """(n, n_nodes, 3) → the same shape."""
        return vectors[:, self.nodes] * self.signs
