"""Message passing along the edges of the mesh: MeshGraphNets, for quasi-static loads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, final

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.field_network import (
    OperatorSurrogate,
    SampleLoss,
    linear,
    n_products,
    perceptron,
)
from mor_bench.surrogates.field_surrogate import Arrays, Input
from mor_bench.surrogates.graph_layers import Graph, Indices, MeshNetwork, normed


class MessagePassing(nn.Module):
    """One step: e ← e + f(e, v_sender, v_receiver), v ← v + g(v, Σ e), with perceptrons f and g.

    Both end with a layer norm. The first layer of f is three products. The products with node
    values are computed at the nodes, because there are about five times as many edges.
    """

    def __init__(self, width: int, hidden_layers: int) -> None:
        super().__init__()
        hidden = [width] * hidden_layers
        self.edge, self.sender, self.receiver = (linear(width, width) for _ in range(3))
        self.message = normed(*hidden, width)
        self.node = normed(2 * width, *hidden, width)

    def forward(self, edges: Tensor, nodes: Tensor, graph: Graph) -> tuple[Tensor, Tensor]:
        """(n_edges, n or 1, width) and (n_nodes, n, width) → both, with n samples."""
        ends = graph.at_edges(self.sender(nodes), self.receiver(nodes))
        edges = edges + self.message(functional.silu(self.edge(edges) + ends))
        arrived = graph.receivers.sum(edges)
        return edges, nodes + self.node(torch.cat([nodes, arrived], dim=-1))

    def multiply_adds(self, graph: Graph) -> int:
        """Return the work for one sample."""
        at_edges = n_products(nn.ModuleList([self.edge, self.message]))
        at_nodes = n_products(nn.ModuleList([self.sender, self.receiver, self.node]))
        return graph.n_edges * at_edges + graph.n_nodes * at_nodes


class GraphNetwork(MeshNetwork):
    """Pfaff et al., "Learning mesh-based simulation with graph networks", section 3.

    Encode, process, decode. Node features are the input and a flag for fixed nodes; edge features
    are the relative position and the length. Each step carries information one edge further. All
    perceptrons but the decoder end with a layer norm. Their activation is SiLU instead of ReLU,
    because displacements are smooth.
    """

    def __init__(
        self, mesh: Mesh, fixed_nodes: Indices, width: int, steps: int, hidden_layers: int
    ) -> None:
        super().__init__(mesh, fixed_nodes)
        hidden = [width] * hidden_layers
        self.node_encoder = normed(4, *hidden, width)
        self.edge_encoder = normed(4, *hidden, width)
        self.steps = nn.ModuleList(MessagePassing(width, hidden_layers) for _ in range(steps))
        self.decoder = perceptron(width, *hidden, 3)
        self.encoded: Tensor | None = None

    def precompute(self) -> None:
        self.encoded = self.edge_encoder(self.graph.shapes).unsqueeze(1)

    def process(self, values: Tensor) -> Tensor:
        edges = self.encoded
        if edges is None:
            edges = self.edge_encoder(self.graph.shapes).unsqueeze(1)
        fixed = self.fixed.unsqueeze(1).expand(-1, values.shape[1], -1)
        nodes = self.node_encoder(torch.cat([values, fixed], dim=-1))
        for step in self.steps:
            edges, nodes = step(edges, nodes, self.graph)
        answer: Tensor = self.decoder(nodes)
        return answer

    @property
    def multiply_adds(self) -> int:
        steps = sum(
            step.multiply_adds(self.graph)
            for step in self.steps
            if isinstance(step, MessagePassing)
        )
        ends = n_products(self.node_encoder) + n_products(self.decoder)
        return self.graph.n_nodes * ends + steps


@final
@dataclass(eq=False)
class MeshGraphNet(OperatorSurrogate):
    """Message passing along the edges of the mesh; see `GraphNetwork`.

    The paper's network adds the velocity of one time step; this one answers with the displacement
    under a load. Information at a node comes from as many edges away as there are steps. So with
    the force alone, a node has no information about more distant loads or supports. The linear
    response carries their effect over the whole body. Nodes use only relative positions of
    neighbours. The other parameters are those of `FieldSurrogate`.

    Parameters
    ----------
    width : int
        Features of nodes and edges, and units of the hidden layers of each perceptron. The paper
        uses 128.
    steps : int
        Message-passing steps, each with its own weights. The paper uses 15.
    hidden_layers : int
        Hidden layers of each perceptron. The paper uses 2.
    loss : {"relative", "absolute"}
        Mean relative L2 error of the samples, or mean squared error.
    """

    input: Input = "force"
    width: Annotated[int, Field(ge=1, le=1024)] = 128
    steps: Annotated[int, Field(ge=1, le=64)] = 15
    hidden_layers: Annotated[int, Field(ge=1, le=4)] = 2
    loss: SampleLoss = "relative"
    iterations: Annotated[int, Field(ge=1)] = 1000
    batch_size: Annotated[int, Field(ge=1)] = 8
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    architecture: ClassVar = ("input", "width", "steps", "hidden_layers")

    def build_network(self, constants: Arrays) -> GraphNetwork:
        scene = self.scene_
        return GraphNetwork(
            scene.mesh, scene.fixed_nodes, self.width, self.steps, self.hidden_layers
        )
