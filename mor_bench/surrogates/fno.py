"""Fourier neural operator on the regular grid around a body."""

from __future__ import annotations

from dataclasses import dataclass
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
    FieldNetwork,
    OperatorSurrogate,
    SampleLoss,
    SelfInitialised,
    add_constants,
    linear,
    n_products,
    perceptron,
)
from mor_bench.surrogates.field_surrogate import Arrays, Input
from mor_bench.surrogates.umesh.padded_grid import PaddedGrid, padded_grid

PADDING = 4
"""A side of n points gets n / PADDING more, rounded up.

The padding keeps the circular convolutions from joining opposite ends of the body.
"""


class SpectralConvolution(SelfInitialised):
    """A channel matrix for each of the lowest wave numbers: (x, y, z, n, c) → (x, y, z, n, c).

    It is a circular convolution with a smooth real kernel. The discrete Fourier transforms are
    products with a few rows, one axis after another. On these small grids, the products take a
    quarter of the time of torch's fast transforms. Their order of summation does not depend on the
    number of threads.

    Parameters
    ----------
    shape : three ints
        Points per axis.
    modes : int
        Wave numbers per axis, 0 to modes - 1 and their negatives; axes with fewer keep all.
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
        # Values are real, so half of the wave numbers along z are enough: the rest are conjugates.
        half = kept[2][(2 * kept[2] >= 0) | (2 * kept[2] == -shape[2])]
        kept[2] = np.abs(half)
        for axis, (n, numbers) in enumerate(zip(shape, kept, strict=True)):
            factors = np.exp(-2j * np.pi * np.outer(numbers, np.arange(n)) / n).astype(np.complex64)
            back = factors.conj().T / n
            if axis == 2:  # each also counts for its conjugate, unless it is its own conjugate
                back = back * np.where((2 * numbers) % n == 0, 1.0, 2.0)
            add_constants(
                self,
                **{
                    f"forward_{axis}": torch.from_numpy(factors),
                    f"backward_{axis}": torch.from_numpy(back.astype(np.complex64)),
                },
            )
        self.counts = (len(kept[0]), len(kept[1]), len(kept[2]))
        self.weight = nn.Parameter(torch.empty(prod(self.counts), channels, channels, 2))

    def initialise(self, generator: torch.Generator) -> None:
        """Draw weights with mean square 1 / channels, which preserves the size of the signal."""
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
        """Work for one sample; a complex product counts as four."""
        (nx, ny, nz), (kx, ky, kz), c = self.shape, self.counts, self.channels
        transform = kx * nx * ny * nz + kx * ky * ny * nz + kx * ky * kz * nz
        return 4 * (2 * c * transform + kx * ky * kz * c * c)


def wave_numbers(n: int, modes: int) -> NDArray[np.int64]:
    """Return the wave numbers of n points with an absolute value below `modes`, each once."""
    numbers = np.fft.fftfreq(n, 1.0 / n).round().astype(np.int64)
    return numbers[np.abs(numbers) < modes]


class FNO(FieldNetwork):
    """Li et al., "Fourier neural operator for parametric partial differential equations", sec. 4.

    The network lifts the input to channels, applies layers σ(W v + K v) with a pointwise W and a
    spectral convolution K, and projects pointwise. As in the paper, the position is part of the
    input, and the grid is padded at its high ends.

    Parameters
    ----------
    grid : PaddedGrid
        Grid without padding.
    spread : bool
        Whether the input adds up on the grid, as forces do. Otherwise the value at each grid point
        is the mean of the nodes around it.
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
        positions = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).unsqueeze(3)
        add_constants(self, positions=positions)
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
        values = features.permute(1, 2, 3, 0, 4)  # the transforms need points first
        nx, ny, nz, n, _ = values.shape
        values = self.lift(torch.cat([values, self.positions.expand(-1, -1, -1, n, -1)], dim=-1))
        ends = [(0, -(-side // PADDING)) for side in (nz, ny, nx)]
        values = functional.pad(values, [0, 0, 0, 0, *(n for end in ends for n in end)])
        layers = zip(self.pointwise, self.spectral, strict=True)
        for number, (pointwise, spectral) in enumerate(layers, start=1):
            values = pointwise(values) + spectral(values)
            if number < len(self.pointwise):
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
@dataclass(eq=False)
class FourierNeuralOperator(OperatorSurrogate):
    """A Fourier neural operator on the regular grid around the body; see `FNO`.

    Forces are spread over the grid as in U-Mesh; displacements are averaged. Every layer covers the
    whole grid at low resolution, so a load at one end of a body acts everywhere. The other
    parameters are those of `FieldSurrogate`.

    Parameters
    ----------
    channels, layers : int
        Channels and number of layers.
    modes : int
        Wave numbers per axis, 0 to modes - 1 and their negatives; axes with fewer keep all.
    loss : {"relative", "absolute"}
        Mean relative L2 error of the samples, or mean squared error.
    """

    input: Input = "force"
    channels: Annotated[int, Field(ge=1, le=512)] = 20
    modes: Annotated[int, Field(ge=1)] = 6
    layers: Annotated[int, Field(ge=1, le=16)] = 4
    loss: SampleLoss = "relative"
    iterations: Annotated[int, Field(ge=1)] = 2000
    batch_size: Annotated[int, Field(ge=1)] = 32
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    architecture: ClassVar = ("input", "channels", "modes", "layers")

    def build_network(self, constants: Arrays) -> FNO:
        scene = self.scene_
        grid = padded_grid(grid_map(scene.mesh, scene.spec.grid_nodes), 0)
        spread = self.input == "force" and scene.observed_nodes is None
        return FNO(grid, spread, self.channels, self.modes, self.layers)
