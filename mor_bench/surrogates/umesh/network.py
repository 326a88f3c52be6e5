"""The 3D U-Net of U-Mesh: convolutions, max-pooling and skips, without normalisation layers."""

from __future__ import annotations

from contextlib import nullcontext
from itertools import pairwise
from math import prod
from typing import Literal

import torch
from torch import Tensor, nn

Activation = Literal["relu", "silu"]


class DoubleConvolution(nn.Sequential):
    """Two padded 3×3×3 convolutions, each with a nonlinearity, on (n, channels, x, y, z)."""

    def __init__(self, c_in: int, c_out: int, activation: Activation) -> None:
        nonlinearity = {"relu": nn.ReLU, "silu": nn.SiLU}[activation]
        super().__init__(
            nn.Conv3d(c_in, c_out, 3, padding=1),
            nonlinearity(inplace=True),
            nn.Conv3d(c_out, c_out, 3, padding=1),
            nonlinearity(inplace=True),
        )

    def forward(self, x: Tensor) -> Tensor:
        # If the first side is 2, oneDNN's bfloat16 gradient of the weights reads unset memory.
        in_full = torch.is_autocast_enabled("cpu") and x.shape[2] == 2
        with torch.autocast("cpu", enabled=False) if in_full else nullcontext():
            for layer in self:
                x = layer(x.float() if in_full else x)
        return x


def _n_weights(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters() if parameter.dim() > 1)


class UNet(nn.Module):
    """3D U-Net from 3 force components to 3 displacement components per grid point.

    Mendizabal, Márquez-Neila, Cotin, "Simulation of hyperelastic materials in real-time using Deep
    Learning", section "U-Net architecture". The paper's feature space size is c·2^k, the number of
    channels at the bottom.

    Parameters
    ----------
    channels : int
        c, channels of the first level; each level down has twice as many.
    steps : int
        k, number of times the grid is halved. Every side of the grid must be a multiple of 2^k.
    activation : {"relu", "silu"}
        The paper uses ReLU. SiLU is smooth, as the displacement is.
    """

    def __init__(self, channels: int, steps: int, activation: Activation = "relu") -> None:
        super().__init__()
        widths = [channels * 2**level for level in range(steps + 1)]
        levels = list(pairwise(widths))
        self.encoder = nn.ModuleList(
            DoubleConvolution(c_in, c_out, activation)
            for c_in, c_out in zip([3, *widths[:-2]], widths[:-1], strict=True)
        )
        self.pool = nn.MaxPool3d(2)
        self.bottom = DoubleConvolution(widths[-2], widths[-1], activation)
        self.up = nn.ModuleList(
            nn.ConvTranspose3d(below, here, 2, stride=2) for here, below in reversed(levels)
        )
        self.decoder = nn.ModuleList(
            DoubleConvolution(2 * here, here, activation) for here, _ in reversed(levels)
        )
        self.head = nn.Conv3d(channels, 3, 1)

    def multiply_adds(self, shape: tuple[int, int, int]) -> int:
        """Return the work for one sample on a grid of this shape, zero padding included."""
        points: list[int] = [prod(shape) // 8**level for level in range(len(self.up) + 1)]
        total = points[0] * _n_weights(self.head)
        for block, n in zip([*self.encoder, self.bottom], points, strict=True):
            total += n * _n_weights(block)
        for up, decode, n in zip(self.up, self.decoder, reversed(points[:-1]), strict=True):
            # Each coarse point gives 2 x 2 x 2 points, each by one matrix of the transposed layer.
            total += n // 8 * _n_weights(up) + n * _n_weights(decode)
        return total

    def forward(self, x: Tensor) -> Tensor:
        """(n, 3, x, y, z) → (n, 3, x, y, z)."""
        skips = []
        for encode in self.encoder:
            x = encode(x)  # (n, c 2^i, x / 2^i, y / 2^i, z / 2^i)
            skips.append(x)
            x = self.pool(x)
        x = self.bottom(x)
        for up, decode, skip in zip(self.up, self.decoder, reversed(skips), strict=True):
            x = decode(torch.cat([skip, up(x)], dim=1))
        output: Tensor = self.head(x)
        return output


def empty_network(channels: int, steps: int, activation: Activation = "relu") -> UNet:
    """Return a U-Net with unset weights on torch's "meta" device; no random number is drawn."""
    with torch.device("meta"):
        return UNet(channels, steps, activation)


def draw_weights(network: UNet, generator: torch.Generator) -> UNet:
    """Set He-normal weights and zero biases in a network of `empty_network`.

    They are drawn from the given generator only. The paper does not specify the initialisation.
    """
    network.to_empty(device="cpu")
    for layer in network.modules():
        if isinstance(layer, nn.Conv3d | nn.ConvTranspose3d):
            kind: Literal["linear", "relu"] = "linear" if layer is network.head else "relu"
            nn.init.kaiming_normal_(layer.weight, nonlinearity=kind, generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return network


def new_network(
    channels: int, steps: int, generator: torch.Generator, activation: Activation = "relu"
) -> UNet:
    """Return a U-Net with the weights of `draw_weights`."""
    return draw_weights(empty_network(channels, steps, activation), generator)
