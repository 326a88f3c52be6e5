"""Message passing along the edges of the mesh: MeshGraphNets, for quasi-static loads."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.field_network import (
    Arrays,
    FieldNetwork,
    FieldSurrogate,
    Input,
    linear,
    n_products,
    perceptron,
)

EDGES = {
    8: np.array(
        [
            [0, 1],
            [1, 2],
            [2, 3],
            [3, 0],
            [4, 5],
            [5, 6],
            [6, 7],
            [7, 4],
            [0, 4],
            [1, 5],
            [2, 6],
            [3, 7],
        ]
    ),
    4: np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]),
}
"""Node pairs along the edges of a hexahedron and of a tetrahedron, in VTK order."""


class Graph(nn.Module):
    """The edges of a mesh, each once in either direction.

    Attributes
    ----------
    senders, receivers : (n_edges,) int64 tensor
        Nodes at the ends, sorted by receiver, then sender.
    """

    senders: Tensor
    receivers: Tensor
    outgoing: Tensor
    incoming: Tensor

    def __init__(self, mesh: Mesh) -> None:
        super().__init__()
        pairs = np.sort(mesh.cells[:, EDGES[mesh.cells.shape[1]]].reshape(-1, 2), axis=1)
        pairs = np.unique(pairs, axis=0)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        receivers, senders = both[np.lexsort((both[:, 1], both[:, 0]))].T
        for name, array in (
            ("senders", senders),
            ("receivers", receivers),
            ("outgoing", _table(senders, mesh.n_nodes)),
            ("incoming", _table(receivers, mesh.n_nodes)),
        ):
            self.register_buffer(
                name, torch.from_numpy(np.ascontiguousarray(array)), persistent=False
            )

    @property
    def n_edges(self) -> int:
        return len(self.senders)

    def from_senders(self, nodal: Tensor) -> Tensor:
        """(n_nodes, n, c) → (n_edges, n, c): the value of each edge's sender."""
        return _Gather.apply(nodal, self.senders, self.outgoing)  # type: ignore[no-any-return,no-untyped-call]

    def from_receivers(self, nodal: Tensor) -> Tensor:
        """(n_nodes, n, c) → (n_edges, n, c): the value of each edge's receiver."""
        return _Gather.apply(nodal, self.receivers, self.incoming)  # type: ignore[no-any-return,no-untyped-call]

    def to_receivers(self, messages: Tensor) -> Tensor:
        """(n_edges, n, c) → (n_nodes, n, c): the sum over the edges that each node receives."""
        return _SegmentSum.apply(messages, self.receivers, self.incoming)  # type: ignore[no-any-return,no-untyped-call]


def _table(ends: NDArray[np.int64], n_nodes: int) -> NDArray[np.int64]:
    """(n_nodes, largest number of edges) the edges at each node, in ascending order, then n_edges in the place of none."""
    order = np.argsort(ends, kind="stable")
    counts = np.bincount(ends, minlength=n_nodes)
    table = np.full((n_nodes, counts.max()), len(ends))
    table[np.arange(counts.max()) < counts[:, None]] = order
    return table


def _segment_sum(messages: Tensor, table: Tensor) -> Tensor:
    """The sum of the rows of messages (n_edges, ...) that a table names for each node; always added in the same order."""
    with_none = torch.cat([messages, torch.zeros_like(messages[:1])])
    total = with_none.index_select(0, table[:, 0])
    for column in table.T[1:]:
        total += with_none.index_select(0, column)
    return total


class _Gather(torch.autograd.Function):
    """Rows by index. The backward pass of torch's own indexing adds atomically on some devices, this one never."""

    @staticmethod
    def forward(ctx: Any, nodal: Tensor, ends: Tensor, table: Tensor) -> Tensor:
        ctx.table = table
        return nodal.index_select(0, ends)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _segment_sum(gradient, ctx.table), None, None


class _SegmentSum(torch.autograd.Function):
    """The transpose of `_Gather`."""

    @staticmethod
    def forward(ctx: Any, messages: Tensor, ends: Tensor, table: Tensor) -> Tensor:
        ctx.ends = ends
        return _segment_sum(messages, table)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return gradient.index_select(0, ctx.ends), None, None


class MessagePassing(nn.Module):
    """One step: e ← e + f(e, v_sender, v_receiver), v ← v + g(v, Σ e), with two-layer perceptrons f and g.

    The first layer of f is three products, of which those with node values are taken at the nodes: there are about a fifth
    as many of them as of edges.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.edge, self.sender, self.receiver = (linear(width, width) for _ in range(3))
        self.message = linear(width, width)
        self.node = perceptron(2 * width, width, width)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))

    def forward(self, edges: Tensor, nodes: Tensor, graph: Graph) -> tuple[Tensor, Tensor]:
        """(n_edges, n or 1, width) and (n_nodes, n, width) → both, with n samples."""
        hidden = (
            self.edge(edges)
            + graph.from_senders(self.sender(nodes))
            + graph.from_receivers(self.receiver(nodes))
        )
        edges = edges + self.norms[0](self.message(functional.silu(hidden)))
        nodes = nodes + self.norms[1](
            self.node(torch.cat([nodes, graph.to_receivers(edges)], dim=-1))
        )
        return edges, nodes

    def multiply_adds(self, n_edges: int, n_nodes: int) -> int:
        """For one sample."""
        return n_edges * n_products(
            nn.ModuleList([self.edge, self.message])
        ) + n_nodes * n_products(nn.ModuleList([self.sender, self.receiver, self.node]))


class GraphNetwork(FieldNetwork):
    """Encode, process, decode: Pfaff et al., "Learning mesh-based simulation with graph networks", section 3.

    Node features are the input and whether the node is fixed, edge features the relative position and the length. After each
    step a node knows of nodes one edge further away, and of no others.
    """

    fixed: Tensor
    shapes: Tensor

    def __init__(self, mesh: Mesh, fixed_nodes: NDArray[np.int64], width: int, steps: int) -> None:
        super().__init__()
        self.graph = Graph(mesh)
        fixed = torch.zeros(mesh.n_nodes, 1)
        fixed[torch.from_numpy(fixed_nodes)] = 1.0
        self.register_buffer("fixed", fixed, persistent=False)
        points = torch.from_numpy(mesh.points.astype(np.float32))
        relative = points[self.graph.senders] - points[self.graph.receivers]
        length = relative.norm(dim=1, keepdim=True)
        self.register_buffer(
            "shapes", torch.cat([relative, length], dim=1) / length.mean(), persistent=False
        )
        self.node_encoder = perceptron(4, width, width)
        self.edge_encoder = perceptron(4, width, width)
        self.steps = nn.ModuleList(MessagePassing(width) for _ in range(steps))
        self.decoder = perceptron(width, width, 3)
        self.encoded: Tensor | None = None

    def encode(self, fields: Tensor) -> Tensor:
        return fields

    def prepare(self) -> None:
        self.encoded = self.edge_encoder(self.shapes).unsqueeze(1)

    def forward(self, features: Tensor) -> Tensor:
        features = features.transpose(
            0, 1
        )  # the nodes first: a node's row of all samples is moved in one piece
        edges = (
            self.edge_encoder(self.shapes).unsqueeze(1) if self.encoded is None else self.encoded
        )
        nodes = self.node_encoder(
            torch.cat([features, self.fixed.unsqueeze(1).expand(-1, features.shape[1], -1)], dim=-1)
        )
        for step in self.steps:
            edges, nodes = step(edges, nodes, self.graph)
        answer: Tensor = self.decoder(nodes)
        return answer.transpose(0, 1)

    @property
    def multiply_adds(self) -> int:
        n_nodes, n_edges = len(self.fixed), self.graph.n_edges
        steps = sum(
            step.multiply_adds(n_edges, n_nodes)
            for step in self.steps
            if isinstance(step, MessagePassing)
        )
        return n_nodes * (n_products(self.node_encoder) + n_products(self.decoder)) + steps


@final
class MeshGraphNet(FieldSurrogate):
    """Message passing along the edges of the mesh; see `GraphNetwork`.

    Without time: the paper's network adds one step's velocity, this one answers with the displacement under a load. A node
    sees as many edges far as there are steps. From the force alone it can therefore not know of loads, or of supports, that
    lie further away, and a cantilever's tip hangs on both; the linear response carries that over the whole body. Nodes know
    no position, only those of their neighbours relative to them.

    Parameters
    ----------
    input : {"force", "linear-response"}
        What the network is given; see `FieldSurrogate`.
    width : int
        Of the features of nodes and edges, and of the one hidden layer of each perceptron.
    steps : int
        Message-passing steps, each with weights of its own.
    iterations : int
        Adam steps; a number, not a time, so that the result does not depend on the load of the machine.
    batch_size, learning_rate, seed
        Samples per step, peak of the one-cycle schedule, and seed of the initial weights and of the order of the samples.
    """

    architecture: ClassVar[tuple[str, ...]] = ("input", "width", "steps")

    def __init__(
        self,
        input: Input = "force",
        width: Annotated[int, Field(ge=1, le=1024)] = 32,
        steps: Annotated[int, Field(ge=1, le=64)] = 6,
        iterations: Annotated[int, Field(ge=1)] = 1000,
        batch_size: Annotated[int, Field(ge=1)] = 8,
        learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3,
        seed: Annotated[int, Field(ge=0, lt=2**32)] = 0,
    ) -> None:
        self.input = input
        self.width = width
        self.steps = steps
        self.iterations = iterations
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.seed = seed

    def _constants(
        self, inputs: NDArray[np.float64], targets: NDArray[np.float64]
    ) -> dict[str, NDArray[np.float64]]:
        return {}

    def _network(self, constants: Arrays) -> GraphNetwork:
        return GraphNetwork(self.scene_.mesh, self.scene_.fixed_nodes, self.width, self.steps)
