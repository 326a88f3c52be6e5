"""Message passing along the edges of the mesh: MeshGraphNets, for quasi-static loads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.field_network import (
    FieldNetwork,
    OperatorSurrogate,
    add_constants,
    linear,
    n_products,
    perceptron,
)
from mor_bench.surrogates.field_surrogate import Arrays, Input

HEXAHEDRON = "01 12 23 30 45 56 67 74 04 15 26 37"
TETRAHEDRON = "01 02 03 12 13 23"
QUADRATIC = "04 41 15 52 26 60 07 73 18 83 29 93 45 56 46 47 78 48 58 89 59 67 79 69"
EDGES = {
    n: np.array([[int(node) for node in edge] for edge in edges.split()])
    for n, edges in ((8, HEXAHEDRON), (4, TETRAHEDRON), (10, QUADRATIC))
}
"""Node pairs along the edges of a hexahedron and of tetrahedra, in VTK order.

Each face of a tetrahedron with ten nodes counts as four triangles.
"""


class Graph(nn.Module):
    """The edges of a mesh, each once in either direction.

    `senders` and `receivers` (n_edges,) int64 are the nodes at the ends, sorted by receiver, then
    sender.
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
        arrays = {
            "senders": senders,
            "receivers": receivers,
            "outgoing": _table(senders, mesh.n_nodes),
            "incoming": _table(receivers, mesh.n_nodes),
        }
        add_constants(
            self, **{k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items()}
        )

    @property
    def n_edges(self) -> int:
        return len(self.senders)

    def from_senders(self, nodal: Tensor) -> Tensor:
        """(n_nodes, n, c) → (n_edges, n, c): the value of each edge's sender."""
        return _gather(nodal, self.senders, self.outgoing)

    def from_receivers(self, nodal: Tensor) -> Tensor:
        """(n_nodes, n, c) → (n_edges, n, c): the value of each edge's receiver."""
        return _gather(nodal, self.receivers, self.incoming)

    def to_receivers(self, messages: Tensor) -> Tensor:
        """(n_edges, n, c) → (n_nodes, n, c): the sum over the edges that arrive at each node."""
        summed: Any = _SegmentSum
        total: Tensor = summed.apply(messages, self.receivers, self.incoming)
        return total


def _table(ends: NDArray[np.int64], n_nodes: int) -> NDArray[np.int64]:
    """Return the edges at each node in ascending order, (n_nodes, most), padded with n_edges."""
    order = np.argsort(ends, kind="stable")
    counts = np.bincount(ends, minlength=n_nodes)
    table = np.full((n_nodes, counts.max()), len(ends))
    table[np.arange(counts.max()) < counts[:, None]] = order
    return table


def _segment_sum(messages: Tensor, table: Tensor) -> Tensor:
    """Sum the rows of messages (n_edges, ...) at each node, always in the same order."""
    with_none = torch.cat([messages, torch.zeros_like(messages[:1])])
    total = with_none.index_select(0, table[:, 0])
    for column in table.T[1:]:
        total += with_none.index_select(0, column)
    return total


class _Gather(torch.autograd.Function):
    """Rows by index, with a backward pass in a fixed order; torch's own adds atomically."""

    @staticmethod
    def forward(ctx: Any, nodal: Tensor, ends: Tensor, table: Tensor) -> Tensor:
        ctx.table = table
        return nodal.index_select(0, ends)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _segment_sum(gradient, ctx.table), None, None


def _gather(nodal: Tensor, ends: Tensor, table: Tensor) -> Tensor:
    function: Any = _Gather
    gathered: Tensor = function.apply(nodal, ends, table)
    return gathered


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
    """One step: e ← e + f(e, v_sender, v_receiver), v ← v + g(v, Σ e), with perceptrons f and g.

    The first layer of f is three products. The products with node values are computed at the nodes,
    because there are about five times as many edges.
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
        """Return the work for one sample."""
        at_edges = n_products(nn.ModuleList([self.edge, self.message]))
        at_nodes = n_products(nn.ModuleList([self.sender, self.receiver, self.node]))
        return n_edges * at_edges + n_nodes * at_nodes


class GraphNetwork(FieldNetwork):
    """Pfaff et al., "Learning mesh-based simulation with graph networks", section 3.

    Encode, process, decode. Node features are the input and a flag for fixed nodes; edge features
    are the relative position and the length. Each step carries information one edge further.
    """

    fixed: Tensor
    shapes: Tensor

    def __init__(self, mesh: Mesh, fixed_nodes: NDArray[np.int64], width: int, steps: int) -> None:
        super().__init__()
        self.graph = Graph(mesh)
        fixed = torch.zeros(mesh.n_nodes, 1)
        fixed[torch.from_numpy(fixed_nodes)] = 1.0
        points = torch.from_numpy(mesh.points.astype(np.float32))
        relative = points[self.graph.senders] - points[self.graph.receivers]
        length = relative.norm(dim=1, keepdim=True)
        shapes = torch.cat([relative, length], dim=1) / length.mean()
        add_constants(self, fixed=fixed, shapes=shapes)
        self.node_encoder = perceptron(4, width, width)
        self.edge_encoder = perceptron(4, width, width)
        self.steps = nn.ModuleList(MessagePassing(width) for _ in range(steps))
        self.decoder = perceptron(width, width, 3)
        self.encoded: Tensor | None = None

    def encode(self, fields: Tensor) -> Tensor:
        return fields

    def precompute(self) -> None:
        self.encoded = self.edge_encoder(self.shapes).unsqueeze(1)

    def forward(self, features: Tensor) -> Tensor:
        features = features.transpose(0, 1)  # nodes first: a node's row moves in one piece
        edges = self.encoded
        if edges is None:
            edges = self.edge_encoder(self.shapes).unsqueeze(1)
        fixed = self.fixed.unsqueeze(1).expand(-1, features.shape[1], -1)
        nodes = self.node_encoder(torch.cat([features, fixed], dim=-1))
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
        Features of nodes and edges, and units of the hidden layer of each perceptron.
    steps : int
        Message-passing steps, each with its own weights.
    """

    input: Input = "force"
    width: Annotated[int, Field(ge=1, le=1024)] = 32
    steps: Annotated[int, Field(ge=1, le=64)] = 6
    iterations: Annotated[int, Field(ge=1)] = 1000
    batch_size: Annotated[int, Field(ge=1)] = 8
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    architecture: ClassVar = ("input", "width", "steps")

    def build_network(self, constants: Arrays) -> GraphNetwork:
        return GraphNetwork(self.scene_.mesh, self.scene_.fixed_nodes, self.width, self.steps)
