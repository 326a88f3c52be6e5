"""Transolver: attention among soft slices of the nodes, on any mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from mor_bench.errors import InvalidInputError
from mor_bench.surrogates.field_network import (
    FieldNetwork,
    OperatorSurrogate,
    SampleLoss,
    add_constants,
    linear,
    n_products,
    perceptron,
    scaled_positions,
)
from mor_bench.surrogates.field_surrogate import Array, Arrays, Input

FIRST_TEMPERATURE, LOWEST, HIGHEST = 0.5, 0.1, 5.0
"""Temperature before training, and its limits, as in the authors' code."""

LEAST_WEIGHT = 1e-5
"""Added to the total weight of a slice, so that an empty slice has the token zero."""


class PhysicsAttention(nn.Module):
    """Attention among slices of the nodes, (n, n_nodes, width) → (n, n_nodes, width).

    Every head divides the nodes softly into slices, with weights w that sum to one at a node. The
    token of a slice is the weighted mean of its nodes. Tokens attend to each other, and every node
    gets its weighted sum of the results:

    w_im = softmax_m(aₘ·xᵢ / τ), z_m = Σᵢ w_im vᵢ / Σᵢ w_im,
    z'_m = Σₗ softmax_l(q_m·kₗ / √d) (V z)ₗ, yᵢ = Σ_m w_im z'_m

    So the work grows with the number of nodes, not with its square. The result does not depend on
    the order of the nodes.

    Parameters
    ----------
    width, heads, slices : int
        Features of a node; heads, each with width / heads of them; slices per head.
    """

    def __init__(self, width: int, heads: int, slices: int) -> None:
        super().__init__()
        self.width, self.heads, self.slices = width, heads, slices
        self.assign = linear(width, heads * slices)
        self.value = linear(width, width)
        self.token = linear(width // heads, 3 * (width // heads))
        self.mix = linear(width, width)
        self.temperature = nn.Parameter(torch.full((heads, 1, 1), FIRST_TEMPERATURE))

    def slice_weights(self, nodes: Tensor) -> Tensor:
        """Return w, (n, heads, n_nodes, slices)."""
        scores = self.assign(nodes).unflatten(-1, (self.heads, self.slices))
        scores = scores.transpose(1, 2).contiguous()  # each head's products need one piece
        weights: Tensor = (scores / self.temperature.clamp(LOWEST, HIGHEST)).softmax(dim=-1)
        return weights

    def forward(self, nodes: Tensor) -> Tensor:
        weights = self.slice_weights(nodes)
        values = self.value(nodes).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        totals = weights.sum(dim=2).unsqueeze(-1) + LEAST_WEIGHT
        tokens = weights.transpose(2, 3) @ values / totals  # (n, heads, slices, width / heads)
        queries, keys, contents = self.token(tokens).chunk(3, dim=-1)
        scores = queries @ keys.transpose(2, 3) * keys.shape[-1] ** -0.5
        answers = weights @ (scores.softmax(dim=-1) @ contents)
        mixed: Tensor = self.mix(answers.transpose(1, 2).flatten(2))
        return mixed

    def multiply_adds(self, n_nodes: int) -> int:
        """Return the work for one sample."""
        at_nodes = n_products(nn.ModuleList([self.assign, self.value, self.mix]))
        at_tokens = self.heads * n_products(self.token) + 2 * self.slices * self.width
        return n_nodes * (at_nodes + 2 * self.slices * self.width) + self.slices * at_tokens


class Block(nn.Module):
    """x ← x + attention(norm(x)), then x ← x + perceptron(norm(x))."""

    def __init__(self, width: int, heads: int, slices: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.attention = PhysicsAttention(width, heads, slices)
        self.perceptron = perceptron(width, mlp_ratio * width, width)

    def forward(self, nodes: Tensor) -> Tensor:
        nodes = nodes + self.attention(self.norms[0](nodes))
        changed: Tensor = nodes + self.perceptron(self.norms[1](nodes))
        return changed

    def multiply_adds(self, n_nodes: int) -> int:
        """Return the work for one sample."""
        return self.attention.multiply_adds(n_nodes) + n_nodes * n_products(self.perceptron)


class TransolverNetwork(FieldNetwork):
    """Wu et al., "Transolver: a fast transformer solver for PDEs on general geometries", section 3.

    A perceptron encodes the position and the input of each node. Blocks follow, then a
    normalisation and a linear layer. Nodes exchange information in the slices only: there are no
    edges and no grid. As in the authors' code, the temperature is learned. Unlike there, one linear
    map gives the scores of all slices, instead of two in a row. The activation is SiLU, as in the
    other networks of the suite.

    Parameters
    ----------
    positions : (n_nodes, 3) float32
        Node positions relative to the size of the body.
    width, heads, slices, layers, mlp_ratio : int
    """

    positions: Tensor

    def __init__(
        self, positions: Tensor, width: int, heads: int, slices: int, layers: int, mlp_ratio: int
    ) -> None:
        super().__init__()
        add_constants(self, positions=positions)
        self.encoder = perceptron(6, 2 * width, width)
        self.blocks = nn.ModuleList(Block(width, heads, slices, mlp_ratio) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.decoder = linear(width, 3)

    def encode(self, fields: Tensor) -> Tensor:
        return fields

    def forward(self, features: Tensor) -> Tensor:
        positions = self.positions.expand(len(features), -1, -1)
        nodes = self.encoder(torch.cat([features, positions], dim=-1))
        for block in self.blocks:
            nodes = block(nodes)
        answer: Tensor = self.decoder(self.norm(nodes))
        return answer

    @property
    def multiply_adds(self) -> int:
        n_nodes = len(self.positions)
        ends = n_products(self.encoder) + n_products(self.decoder)
        blocks = (b.multiply_adds(n_nodes) for b in self.blocks if isinstance(b, Block))
        return n_nodes * ends + sum(blocks)


@final
@dataclass(eq=False)
class Transolver(OperatorSurrogate):
    """A transformer on the nodes of any mesh; see `TransolverNetwork` and `PhysicsAttention`.

    Every block carries information over the whole body, so a load at one end acts at the other.
    The weights depend on no mesh: a training can start from those of another body. The mean over a
    slice forgets how many nodes it has, and nodal forces depend on the mesh. So the force alone
    means something else on a finer mesh. The other parameters are those of `FieldSurrogate`.

    Parameters
    ----------
    width : int
        Features of each node, a multiple of `heads`.
    heads : int
        Independent divisions into slices per block.
    slices : int
        Slices per head.
    layers : int
        Blocks, each with its own weights.
    mlp_ratio : int
        Hidden units of the perceptron of a block, relative to `width`.
    loss : {"relative", "absolute"}
        Mean relative L2 error of the samples, or mean squared error.
    """

    input: Input = "force"
    width: Annotated[int, Field(ge=1, le=1024)] = 32
    heads: Annotated[int, Field(ge=1, le=64)] = 2
    slices: Annotated[int, Field(ge=1, le=1024)] = 32
    layers: Annotated[int, Field(ge=1, le=64)] = 1
    mlp_ratio: Annotated[int, Field(ge=1, le=16)] = 2
    loss: SampleLoss = "relative"
    iterations: Annotated[int, Field(ge=1)] = 8000
    batch_size: Annotated[int, Field(ge=1)] = 8
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    architecture: ClassVar = ("input", "width", "heads", "slices", "layers", "mlp_ratio")

    def input_scale(self, values: Array) -> float:
        """Return the largest magnitude; 1 if all are zero.

        Forces act on few nodes, so they are many times their root mean square. Such values would
        hide the position at these nodes, and the normalisations would hide their own size.
        """
        return float(np.abs(values).max()) or 1.0

    def build_network(self, constants: Arrays) -> TransolverNetwork:
        if self.width % self.heads:
            raise InvalidInputError(
                f"`width` of Transolver must be a multiple of `heads`, {self.heads}; "
                f"got {self.width}."
            )
        positions = scaled_positions(self.scene_.mesh)
        sizes = self.width, self.heads, self.slices, self.layers, self.mlp_ratio
        return TransolverNetwork(positions, *sizes)
