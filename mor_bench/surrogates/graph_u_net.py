"""A U-shaped graph network: message passing on the mesh and on coarser graphs of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.field_network import (
    OperatorSurrogate,
    SampleLoss,
    add_constants,
    linear,
    n_products,
    perceptron,
    scaled_positions,
)
from mor_bench.surrogates.field_surrogate import Arrays, Input
from mor_bench.surrogates.graph_coarsening import GraphLevel
from mor_bench.surrogates.graph_layers import (
    Graph,
    Indices,
    MeshNetwork,
    MeshTerm,
    Selection,
    inverse,
)

WIDEST = 4
"""Largest width of a coarse level over that of the mesh. Each level doubles it up to there."""

UPDATE = 0.3
"""Factor of each update of nodes, so that the features do not grow from step to step.

There is no layer norm, as in U-Mesh, because the size of a load matters.
"""


class Exchange(nn.Module):
    """One step of message passing: v ← v + s g(v, Σ σ(A v_sender + B v_receiver + C r) / m).

    r is the relative position and length of an edge, g is a perceptron, m is the mean number of
    edges per node, and s is `UPDATE`. Edges keep no state between steps, as in the network of Cao
    et al. Messages have one hidden layer. The layer after it is part of g, because it is the same
    for all edges.
    """

    def __init__(self, graph: Graph, width: int) -> None:
        super().__init__()
        self.graph = graph
        self.sender, self.receiver = linear(width, width), linear(width, width)
        self.shape = MeshTerm(graph.shapes, width)
        self.node = perceptron(2 * width, width, width)

    def forward(self, nodes: Tensor) -> Tensor:
        """(n_nodes, n, width) → the same shape, with n samples."""
        arrived = self.graph.summed_messages(self.sender(nodes), self.receiver(nodes), self.shape())
        arrived = arrived * (self.graph.n_nodes / max(self.graph.n_edges, 1))
        answer: Tensor = nodes + UPDATE * self.node(torch.cat([nodes, arrived], dim=-1))
        return answer

    @property
    def multiply_adds(self) -> int:
        layers = nn.ModuleList([self.sender, self.receiver, self.node])
        return self.graph.n_nodes * n_products(layers)


class Grouping(nn.Module):
    """The groups of a graph's nodes, which are the nodes of a coarser graph.

    Parameters
    ----------
    levels : two GraphLevel
        The finer and the coarser level.
    graphs : two Graph
        Their graphs.
    groups : (n_nodes,) int64
        Number of each node's group, in the numbers of the levels.

    Attributes
    ----------
    members : Selection
        From groups to their nodes, in the numbers of the graphs.
    offsets : (n_nodes, 3) float32
        Position of each node relative to its group, over the mean length of the finer edges.
    """

    shares: Tensor
    offsets: Tensor

    def __init__(
        self, levels: tuple[GraphLevel, GraphLevel], graphs: tuple[Graph, Graph], groups: Indices
    ) -> None:
        super().__init__()
        order, coarse_order = (graph.order.numpy() for graph in graphs)
        self.n_nodes, self.n_groups = len(order), len(coarse_order)
        owners = groups[order]
        offsets = (levels[0].points[order] - levels[1].points[owners]) / graphs[0].length
        shares = 1.0 / np.bincount(groups)[coarse_order]
        self.members = Selection(inverse(coarse_order)[owners], self.n_groups)
        add_constants(
            self,
            shares=torch.from_numpy(shares.astype(np.float32)).view(-1, 1, 1),
            offsets=torch.from_numpy(offsets.astype(np.float32)),
        )

    def means(self, nodes: Tensor) -> Tensor:
        """(n_nodes, n, c) → (n_groups, n, c)."""
        return self.members.sum(nodes) * self.shares


class Pool(nn.Module):
    """Features of groups, P · mean of σ(A v + C r) over their nodes, with r from `Grouping`."""

    def __init__(self, grouping: Grouping, fine: int, coarse: int) -> None:
        super().__init__()
        self.grouping = grouping
        self.node, self.out = linear(fine, coarse), linear(coarse, coarse)
        self.shape = MeshTerm(grouping.offsets, coarse)

    def forward(self, nodes: Tensor) -> Tensor:
        """(n_nodes, n, fine) → (n_groups, n, coarse)."""
        hidden = functional.silu(self.node(nodes) + self.shape().unsqueeze(1))
        pooled: Tensor = self.out(self.grouping.means(hidden))
        return pooled

    @property
    def multiply_adds(self) -> int:
        at_nodes = self.grouping.n_nodes * n_products(self.node)
        return at_nodes + self.grouping.n_groups * n_products(self.out)


class Unpool(nn.Module):
    """Back to the nodes: v ← v + s N σ(A v + B v_group + C r), with s = `UPDATE`."""

    def __init__(self, grouping: Grouping, fine: int, coarse: int) -> None:
        super().__init__()
        self.grouping = grouping
        self.node, self.group = linear(fine, fine), linear(coarse, fine)
        self.shape = MeshTerm(grouping.offsets, fine)
        self.out = linear(fine, fine)

    def forward(self, nodes: Tensor, groups: Tensor) -> Tensor:
        """(n_nodes, n, fine) and (n_groups, n, coarse) → (n_nodes, n, fine)."""
        below = self.grouping.members.take(self.group(groups))
        hidden = functional.silu(self.node(nodes) + below + self.shape().unsqueeze(1))
        answer: Tensor = nodes + UPDATE * self.out(hidden)
        return answer

    @property
    def multiply_adds(self) -> int:
        at_nodes = self.grouping.n_nodes * n_products(nn.ModuleList([self.node, self.out]))
        return at_nodes + self.grouping.n_groups * n_products(self.group)


class GraphUNet(MeshNetwork):
    """Message passing on the way down to coarser graphs and back up, with skips between them.

    Deshpande, Bordas, Lengiewicz, "MAgNET: a graph U-Net architecture for mesh-based simulations".
    Groups of nodes that are connected with each other are the nodes of the next graph. As in a
    convolutional U-Net, information crosses the body in few steps. The paper's layers have weights
    for each edge. Here all edges share them, as in Cao et al., "Efficient learning of mesh-based
    physical simulation with bi-stride multi-scale graph neural network". The position in the
    bounding box is an input instead.

    Parameters
    ----------
    mesh : Mesh
    fixed_nodes : (n,) int64
    width : int
        Features of the nodes of the mesh; see `WIDEST`.
    levels : int
        Number of coarser graphs. If a graph has one node left, so have the following ones.
    steps : int
        Steps of message passing per graph, on the way down and on the way up.
    """

    def __init__(
        self, mesh: Mesh, fixed_nodes: Indices, width: int, levels: int, steps: int
    ) -> None:
        super().__init__(mesh, fixed_nodes)
        widths = [width * min(2**level, WIDEST) for level in range(levels + 1)]
        graphs, groupings = self._coarsened(mesh, levels)
        places = torch.cat([self.fixed, scaled_positions(mesh)[self.graph.order]], dim=1)
        self.field, self.place = linear(3, width), MeshTerm(places, width)
        self.encoder = linear(width, width)
        self.down, self.up = (
            nn.ModuleList(
                nn.Sequential(*(Exchange(graph, wide) for _ in range(steps)))
                for graph, wide in zip(graphs, widths, strict=True)
            )
            for _ in range(2)
        )
        pairs = list(zip(groupings, widths[:-1], widths[1:], strict=True))
        self.pools = nn.ModuleList(Pool(*pair) for pair in pairs)
        self.unpools = nn.ModuleList(Unpool(*pair) for pair in pairs)
        self.decoder = perceptron(width, width, 3)

    def _coarsened(self, mesh: Mesh, levels: int) -> tuple[list[Graph], list[Grouping]]:
        graphs, groupings = [self.graph], []
        level = GraphLevel.of(mesh)
        for _ in range(levels):
            groups = level.groups()
            below = level.coarser(groups)
            graphs.append(Graph(below.points, below.pairs))
            groupings.append(Grouping((level, below), (graphs[-2], graphs[-1]), groups))
            level = below
        return graphs, groupings

    def precompute(self) -> None:
        for module in self.modules():
            if isinstance(module, MeshTerm):
                module.precompute()

    def process(self, values: Tensor) -> Tensor:
        hidden = functional.silu(self.field(values) + self.place().unsqueeze(1))
        nodes, skips = self.encoder(hidden), []
        for down, pool in zip(self.down, self.pools, strict=False):
            nodes = down(nodes)
            skips.append(nodes)
            nodes = pool(nodes)
        nodes = self.up[-1](self.down[-1](nodes))
        ways = list(zip(self.unpools, self.up, skips, strict=False))
        for unpool, up, skip in reversed(ways):
            nodes = up(unpool(skip, nodes))
        answer: Tensor = self.decoder(nodes)
        return answer

    @property
    def multiply_adds(self) -> int:
        ends = n_products(nn.ModuleList([self.field, self.encoder, self.decoder]))
        parts: Any = (m for m in self.modules() if isinstance(m, Exchange | Pool | Unpool))
        return self.graph.n_nodes * ends + sum(int(part.multiply_adds) for part in parts)


@final
@dataclass(eq=False)
class MultiScaleGraphNet(OperatorSurrogate):
    """Message passing on the mesh and on coarser graphs of it; see `GraphUNet`.

    Each coarser graph joins the nodes of a cell, so it has up to eight times fewer nodes on
    hexahedra. With enough levels, all nodes are within few steps of each other. Then a load at one
    end of the body acts everywhere. The other parameters are those of `FieldSurrogate`.

    Parameters
    ----------
    width : int
        Features of the nodes of the mesh; up to `WIDEST` times as many on coarser graphs.
    levels : int
        Number of coarser graphs.
    steps : int
        Steps of message passing per graph, on the way down and on the way up.
    loss : {"relative", "absolute"}
        Mean relative L2 error of the samples, or mean squared error.
    """

    input: Input = "force"
    width: Annotated[int, Field(ge=1, le=512)] = 32
    levels: Annotated[int, Field(ge=1, le=8)] = 3
    steps: Annotated[int, Field(ge=1, le=16)] = 2
    loss: SampleLoss = "relative"
    iterations: Annotated[int, Field(ge=1)] = 2000
    batch_size: Annotated[int, Field(ge=1)] = 16
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    architecture: ClassVar = ("input", "width", "levels", "steps")

    def build_network(self, constants: Arrays) -> GraphUNet:
        scene = self.scene_
        return GraphUNet(scene.mesh, scene.fixed_nodes, self.width, self.levels, self.steps)
