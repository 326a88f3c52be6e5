"""Fourier neural operator on the regular grid around a body."""

from __future__ import annotations

from math import prod
from typing import Annotated, ClassVar, final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from mor_bench.scene.grid import grid_map
from mor_bench.surrogates.field_network import (
    Arrays,
    FieldNetwork,
    FieldSurrogate,
    Input,
    SelfInitialised,
    linear,
    n_products,
    perceptron,
)
from mor_bench.surrogates.umesh.padded_grid import PaddedGrid, padded_grid

PADDING = 4
"""A side of n points gets n / PADDING more, rounded up, so that the circular convolutions do not join opposite ends of the body."""


class SpectralConvolution(SelfInitialised):
    """A matrix of channels for each of the lowest wave numbers: (x, y, z, n, c) → (x, y, z, n, c).

    A circular convolution with a smooth real kernel, by a discrete Fourier transform along one axis after another, each a
    product with the few rows that are kept. On grids as small as these that takes a fourth of the time of torch's fast
    transforms with points last, and it adds in the same order on any number of threads.

    Parameters
    ----------
    shape : three ints
        Points per axis.
    modes : int
        Wave numbers per axis, 0 to modes - 1 and their negatives; fewer where an axis has fewer.
    channels : int
    """

    forward_0: Tensor
    forward_1: Tensor
    forward_2: Tensor
    backward_0: Tensor
    backward_1: Tensor
    backward_2: Tensor

    def __init__(self, shape: tuple[int, int, int], modes: int, channels: int) -> None:
        super().__init__()
        self.shape, self.channels = shape, channels
        kept = [wave_numbers(n, modes) for n in shape]
        # Along z half of them are enough: the others are conjugates, since values are real.
        half = kept[2][(2 * kept[2] >= 0) | (2 * kept[2] == -shape[2])]
        kept[2] = np.abs(half)
        for axis, (n, numbers) in enumerate(zip(shape, kept, strict=True)):
            factors = np.exp(-2j * np.pi * np.outer(numbers, np.arange(n)) / n).astype(np.complex64)
            self.register_buffer(f"forward_{axis}", torch.from_numpy(factors), persistent=False)
            back = factors.conj().T / n
            if axis == 2:  # each stands for its conjugate too, where that is another one
                back = back * np.where((2 * numbers) % n == 0, 1.0, 2.0)
            self.register_buffer(
                f"backward_{axis}", torch.from_numpy(back.astype(np.complex64)), persistent=False
            )
        self.counts = (len(kept[0]), len(kept[1]), len(kept[2]))
        self.weight = nn.Parameter(torch.empty(prod(self.counts), channels, channels, 2))

    def initialise(self, generator: torch.Generator) -> None:
        """Mean square 1 / channels for each wave number: what is kept of the signal keeps its size."""
        nn.init.normal_(self.weight, std=(2 * self.channels) ** -0.5, generator=generator)

    def forward(self, values: Tensor) -> Tensor:
        n, c = values.shape[3:]
        (nx, ny, nz), (kx, ky, kz) = self.shape, self.counts
        spectrum = self.forward_0 @ values.reshape(nx, -1).to(torch.complex64)
        spectrum = self.forward_1 @ spectrum.view(kx, ny, -1)
        spectrum = self.forward_2 @ spectrum.view(kx, ky, nz, -1)
        spectrum = spectrum.view(-1, n, c) @ torch.view_as_complex(self.weight)
        spectrum = self.backward_2 @ spectrum.view(kx, ky, kz, -1)
        spectrum = self.backward_1 @ spectrum.view(kx, ky, -1)
        return (self.backward_0 @ spectrum.view(kx, -1)).real.view(nx, ny, nz, n, c)

    @property
    def multiply_adds(self) -> int:
        """For one sample, four for each product of complex numbers."""
        (nx, ny, nz), (kx, ky, kz), c = self.shape, self.counts, self.channels
        transform = kx * nx * ny * nz + kx * ky * ny * nz + kx * ky * kz * nz
        return 4 * (2 * c * transform + kx * ky * kz * c * c)


def wave_numbers(n: int, modes: int) -> NDArray[np.int64]:
    """Those of n points whose absolute value is below `modes`, each once."""
    numbers = np.fft.fftfreq(n, 1.0 / n).round().astype(np.int64)
    return numbers[np.abs(numbers) < modes]


class FNO(FieldNetwork):
    """Li et al., "Fourier neural operator for parametric partial differential equations", section 4.

    Lifting to channels, layers σ(W v + K v) with a pointwise W and a spectral convolution K, and a pointwise projection. As
    there, the position is part of the input, and the body's grid is padded at its high ends.

    Parameters
    ----------
    grid : PaddedGrid
        Without padding.
    spread : bool
        Whether the input adds up on the grid, as forces do; of displacements each grid point takes the mean of the nodes around it.
    channels, modes, layers : int
    """

    positions: Tensor

    def __init__(
        self, grid: PaddedGrid, spread: bool, channels: int, modes: int, layers: int
    ) -> None:
        super().__init__()
        self.grid = grid
        nx, ny, nz = (n + -(-n // PADDING) for n in grid.shape)
        axes = [torch.linspace(-1.0, 1.0, n) for n in grid.shape]
        self.register_buffer(
            "positions",
            torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).unsqueeze(3),
            persistent=False,
        )
        self.spread = spread
        self.lift = linear(6, channels)
        self.pointwise = nn.ModuleList(linear(channels, channels) for _ in range(layers))
        self.spectral = nn.ModuleList(
            SpectralConvolution((nx, ny, nz), modes, channels) for _ in range(layers)
        )
        self.project = perceptron(channels, 2 * channels, 3)

    def encode(self, fields: Tensor) -> Tensor:
        values = (
            self.grid.to_grid(fields) if self.spread else self.grid.displacements_to_grid(fields)
        )
        return values.permute(0, 2, 3, 4, 1)

    def forward(self, features: Tensor) -> Tensor:
        values = features.permute(1, 2, 3, 0, 4)  # the points first, which the transforms like
        nx, ny, nz, n, _ = values.shape
        values = self.lift(torch.cat([values, self.positions.expand(-1, -1, -1, n, -1)], dim=-1))
        values = functional.pad(
            values,
            [0, 0, 0, 0, *(-(-side // PADDING) * end for side in (nz, ny, nx) for end in (0, 1))],
        )
        for last, (pointwise, spectral) in enumerate(
            zip(self.pointwise, self.spectral, strict=True), start=1 - len(self.pointwise)
        ):
            values = pointwise(values) + spectral(values)
            if last < 0:
                values = functional.gelu(values)
        answers = self.project(values[:nx, :ny, :nz])
        return self.grid.to_nodes(answers.permute(3, 4, 0, 1, 2))

    @property
    def multiply_adds(self) -> int:
        points = prod(self.grid.shape)
        padded = prod(n + -(-n // PADDING) for n in self.grid.shape)
        layers = padded * n_products(self.pointwise) + sum(
            layer.multiply_adds for layer in self.spectral if isinstance(layer, SpectralConvolution)
        )
        return (
            points * (n_products(self.lift) + n_products(self.project))
            + layers
            + self.grid.multiply_adds
        )


@final
class FourierNeuralOperator(FieldSurrogate):
    """A Fourier neural operator on the regular grid around the body; see `FNO`.

    Forces go to the grid as in U-Mesh, with their sum; of displacements each grid point takes the mean. Every layer
    sees the whole grid, coarsely, which a load at one end of a body needs.

    Parameters
    ----------
    input : {"force", "linear-response"}
        What the network is given; see `FieldSurrogate`.
    channels, layers : int
    modes : int
        Wave numbers per axis, 0 to modes - 1 and their negatives; axes with fewer keep what they have.
    iterations : int
        Adam steps; a number, not a time, so that the result does not depend on the load of the machine.
    batch_size, learning_rate, seed
        Samples per step, peak of the one-cycle schedule, and seed of the initial weights and of the order of the samples.
    """

    architecture: ClassVar[tuple[str, ...]] = ("input", "channels", "modes", "layers")

    def __init__(
        self,
        input: Input = "force",
        channels: Annotated[int, Field(ge=1, le=512)] = 20,
        modes: Annotated[int, Field(ge=1)] = 6,
        layers: Annotated[int, Field(ge=1, le=16)] = 4,
        iterations: Annotated[int, Field(ge=1)] = 2000,
        batch_size: Annotated[int, Field(ge=1)] = 32,
        learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3,
        seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
    ) -> None:
        self.input = input
        self.channels = channels
        self.modes = modes
        self.layers = layers
        self.iterations = iterations
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.seed = seed

    def _constants(
        self, inputs: NDArray[np.float64], targets: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float64]]:
        return {}

    def _network(self, constants: Arrays) -> FNO:
        grid = padded_grid(grid_map(self.scene_.mesh, self.scene_.spec.grid_nodes), 0)
        return FNO(
            grid,
            self.input == "force" and self.scene_.observed_nodes is None,
            self.channels,
            self.modes,
            self.layers,
        )
