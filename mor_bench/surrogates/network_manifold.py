"""Base of the manifolds by networks: training, and the map of the trained decoder."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mor_bench.errors import InvalidInputError
from mor_bench.learning.network_map import NetworkMap
from mor_bench.learning.perceptron import Perceptron, evaluate, named, named_shapes, taken
from mor_bench.learning.training import device_of, train
from mor_bench.learning.training_plan import LearningProblem, Loss, TrainingPlan
from mor_bench.model_arrays import take_array
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogates.curved_pod import Array, Arrays, CurvedPOD, coordinate_weights
from mor_bench.surrogates.network_regression import BATCH_SIZE, LEARNING_RATE


class NetworkManifold(CurvedPOD):
    """A `CurvedPOD` whose map c(q) = A q + N(q) - N(0) has a perceptron N.

    The loss is the squared error of the coordinates, relative to the displacement. The last layers
    begin with zeros, so training starts from POD. With static correction, the slope of N at rest is
    subtracted. Small loads then get the linear response.
    """

    n_hidden: int
    iterations: int
    seed: int

    encodes: ClassVar[bool]
    """Whether an encoder gives q, and N changes all coordinates. Otherwise q are the primary
    coordinates, and N changes the secondary ones alone."""

    def fit_map(
        self, scene: Scene, samples: Snapshots, coordinates: Array, n_latent: int
    ) -> tuple[dict[str, NDArray[Any]], Array]:
        if self.training.start_from is not None:
            raise InvalidInputError(
                "`start_from`: the file of a manifold's decoder lacks what its training needs, so "
                "no training can start from it."
            )
        squares = np.maximum((coordinates**2).mean(axis=0), np.finfo(float).tiny)
        sizes = (squares * squares.mean()) ** 0.25  # even on a logarithmic scale, by one half
        scale = float(np.sqrt((coordinates[:, n_latent:] ** 2).sum(axis=1).mean()))
        device, known = device_of(self.training), (coordinates / sizes, coordinates / scale)
        named_data = dict(
            zip(
                ("inputs", "outputs", "weights"), (*known, coordinate_weights(samples)), strict=True
            )
        )
        data = {
            name: torch.from_numpy(array.astype(np.float32)).to(device)
            for name, array in named_data.items()
        }
        generator, n = torch.Generator().manual_seed(self.seed), coordinates.shape[1]
        decoder = Perceptron(n_latent, self.n_hidden, self._n_outputs(n_latent, n), generator)
        networks = [decoder]
        if self.encodes:
            networks.append(Perceptron(n, self.n_hidden, n_latent, generator))
        for network in networks:
            nn.init.zeros_(network.weights[-1])
        both = nn.ModuleList(networks).to(device)
        linear = torch.from_numpy((sizes[:n_latent] / scale).astype(np.float32)).to(device)
        loss = self._loss(networks, data, linear)
        plan = TrainingPlan(self.iterations, BATCH_SIZE, LEARNING_RATE)
        problem = LearningProblem(both, loss, len(coordinates), generator, data, self.parameters)
        done = train(problem, plan, self.training, self.time_limit_s)
        weights, latent = decoder.arrays(), coordinates[:, :n_latent].copy()
        weights[0] /= sizes[:n_latent, None]
        weights[-1] *= scale
        if self.encodes:
            encoder, z = networks[1].arrays(), coordinates / sizes
            shift = evaluate(encoder, z) - evaluate(encoder, np.zeros((1, n)))
            latent += shift * sizes[:n_latent]
        arrays = {"loss_curve": done.loss_curve, **named("decoder", weights)}
        return {**arrays, "iterations": np.array([done.iterations], dtype=np.int32)}, latent

    def _n_outputs(self, n_latent: int, n_coordinates: int) -> int:
        return n_coordinates if self.encodes else n_coordinates - n_latent

    def _loss(self, networks: list[Perceptron], data: dict[str, Tensor], linear: Tensor) -> Loss:
        x, wanted, weights = data["inputs"], data["outputs"], data["weights"]
        decoder, r = networks[0], len(linear)
        nothing, first = torch.zeros_like(x[:1]), wanted.shape[1] - decoder.weights[-1].shape[1]

        def loss(rows: Tensor) -> Tensor:
            z = x[rows, :r]
            if self.encodes:
                z = z + networks[1](x[rows]) - networks[1](nothing)
            found = decoder(z)
            if self.static_correction:
                at_rest, slope = decoder.at_rest()
                found = found - z @ slope
            else:
                at_rest = decoder(nothing[:, :r])
            missing = wanted[rows, first:] - (found - at_rest)
            if first == 0:
                missing = missing - nn.functional.pad(z * linear, (0, wanted.shape[1] - r))
            mean: Tensor = ((missing * weights[rows]) ** 2).sum(dim=1).mean()
            return mean

        return loss

    def take_map(self, model: Arrays, n_latent: int, n_coordinates: int) -> NetworkMap:
        shapes = named_shapes(
            "decoder", n_latent, self.n_hidden, self._n_outputs(n_latent, n_coordinates)
        )
        weights = {name: take_array(model, name, shape) for name, shape in shapes.items()}
        self.loss_curve_ = take_array(model, "loss_curve", (None,))
        self.iterations_ = int(take_array(model, "iterations", (1,), np.int32)[0])
        return NetworkMap(taken(weights, "decoder"), n_coordinates, self.static_correction)
