"""Graphs of meshes, and their operations in networks: rows by index, and sums in a fixed order."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mor_bench.scene.mesh import Mesh
from mor_bench.surrogates.field_network import FieldNetwork, add_constants, linear, perceptron

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

Indices = NDArray[np.int64]


def mesh_pairs(mesh: Mesh) -> Indices:
    """Return the edges of a mesh, each once, as (n, 2) node numbers in ascending order."""
    pairs = np.sort(mesh.cells[:, EDGES[mesh.cells.shape[1]]].reshape(-1, 2), axis=1)
    return np.asarray(np.unique(pairs, axis=0))


def columns(index: Indices, n_rows: int) -> tuple[Indices, Indices, tuple[int, ...]]:
    """Arrange entries by the row that each belongs to, in columns of decreasing length.

    Rows are ordered by their number of entries, the largest first. Column k holds entry k of every
    row that has more than k of them.

    Returns
    -------
    entries : (n_entries,) int64
        Entry numbers, one column after another.
    place : (n_rows,) int64
        Place of each row in the order.
    counts : tuple of int
        Entries per column.
    """
    place = inverse(np.argsort(-np.bincount(index, minlength=n_rows), kind="stable"))
    entries = np.argsort(place[index], kind="stable")
    owners = place[index][entries]
    ranks = np.arange(len(index)) - np.searchsorted(owners, owners)
    return (
        entries[np.argsort(ranks, kind="stable")],
        place,
        tuple(np.bincount(ranks).tolist()),
    )


def inverse(order: Indices) -> Indices:
    """Return the inverse of a permutation."""
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return place


class Selection(nn.Module):
    """Rows by index, S, and the sum of entries at each row, Sᵀ; each is the other's gradient.

    Sᵀ adds in a fixed order on any number of threads; the gradients of torch's own indexing add
    atomically on some devices. It adds whole columns of rows, see `columns`.
    """

    index: Tensor
    entries: Tensor
    place: Tensor

    def __init__(self, index: Indices, n_rows: int) -> None:
        super().__init__()
        entries, place, self.counts = columns(index, n_rows)
        self.in_order = bool((entries == np.arange(len(entries))).all())
        self.sorted = bool((place == np.arange(n_rows)).all())
        add_constants(
            self,
            index=torch.from_numpy(np.ascontiguousarray(index)),
            entries=torch.from_numpy(entries),
            place=torch.from_numpy(place),
        )

    def take(self, rows: Tensor) -> Tensor:
        """S r: (n_rows, ...) → (n_entries, ...)."""
        function: Any = _Take
        taken: Tensor = function.apply(rows, self)
        return taken

    def sum(self, values: Tensor) -> Tensor:
        """Sᵀ v: (n_entries, ...) → (n_rows, ...)."""
        function: Any = _Sum
        total: Tensor = function.apply(values, self)
        return total

    def add_up(self, values: Tensor) -> Tensor:
        """Return Sᵀ v without a gradient."""
        total = values.new_zeros(len(self.place), *values.shape[1:])
        start = 0
        for count in self.counts:
            end = start + count
            total[:count] += (
                values[start:end]
                if self.in_order
                else values.index_select(0, self.entries[start:end])
            )
            start = end
        return total if self.sorted else total.index_select(0, self.place)


class _Take(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, selection: Selection) -> Tensor:
        ctx.selection = selection
        return rows.index_select(0, selection.index)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.selection.add_up(gradient), None


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, selection: Selection) -> Tensor:
        ctx.selection = selection
        return selection.add_up(values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient.index_select(0, ctx.selection.index), None


class Graph(nn.Module):
    """A graph with each edge in both directions, as networks use it.

    Its own numbers of the nodes descend with their number of edges. Its edges stand in columns: the
    first edge that arrives at each node, then the second of each node that has two, and so on.

    Parameters
    ----------
    points : (n_nodes, 3) float64
        Positions of the nodes, m.
    pairs : (n, 2) int64
        Node numbers at the ends of each edge, each edge once.

    Attributes
    ----------
    order : (n_nodes,) int64
        Caller's number of each node.
    senders, receivers : Selection
        From nodes to edges, both in the graph's numbers.
    shapes : (n_edges, 4) float32
        Relative position and length of each edge over the mean length.
    length : float
        Mean length of the edges, m; 1 without edges.
    """

    order: Tensor
    shapes: Tensor
    targets: Tensor

    def __init__(self, points: NDArray[np.float64], pairs: Indices) -> None:
        super().__init__()
        n = len(points)
        ends = np.concatenate([pairs, pairs[:, ::-1]])
        order = np.argsort(-np.bincount(ends[:, 1], minlength=n), kind="stable")
        ends = inverse(order)[ends]
        senders, receivers = ends[columns(ends[:, 1], n)[0]].T
        self.senders, self.receivers = Selection(senders, n), Selection(receivers, n)
        relative = points[order[senders]] - points[order[receivers]]
        lengths = np.linalg.norm(relative, axis=1, keepdims=True)
        self.length = float(lengths.mean()) if len(lengths) else 1.0
        shapes = np.hstack([relative, lengths]) / self.length
        add_constants(
            self,
            order=torch.from_numpy(order),
            shapes=torch.from_numpy(shapes.astype(np.float32)),
            # Receivers of the edges that leave each node, in the columns of `senders`.
            targets=self.receivers.index.index_select(0, self.senders.entries),
        )

    @property
    def n_nodes(self) -> int:
        return len(self.order)

    @property
    def n_edges(self) -> int:
        return len(self.shapes)

    def at_edges(self, sent: Tensor, received: Tensor) -> Tensor:
        """(n_nodes, n, c) both → (n_edges, n, c): the sender's row plus the receiver's."""
        return self.senders.take(sent) + self.receivers.take(received)

    def summed_messages(self, sent: Tensor, received: Tensor, constants: Tensor) -> Tensor:
        """Return Σ σ(a_sender + b_receiver + c) over the edges that arrive at each node.

        Parameters
        ----------
        sent, received : (n_nodes, n, width)
            a and b, with n samples.
        constants : (n_edges, width)
            c.
        """
        function: Any = _SummedMessages
        total: Tensor = function.apply(sent, received, constants, self)
        return total


class _SummedMessages(torch.autograd.Function):
    """`Graph.summed_messages`, a column of edges at a time.

    No array holds a row per edge and sample, so the work stays in the processor's cache. The
    backward pass computes the messages again.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, c: Tensor, graph: Graph) -> Tensor:
        ctx.save_for_backward(a, b, c)
        ctx.graph = graph
        total, start = torch.zeros_like(b), 0
        for count in graph.receivers.counts:
            edges = slice(start, start + count)
            messages = a.index_select(0, graph.senders.index[edges])
            messages += b[:count]
            messages += c[edges].unsqueeze(1)
            total[:count] += functional.silu(messages, inplace=True)
            start += count
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        a, b, c = ctx.saved_tensors
        graph, slope = ctx.graph, torch.ops.aten.silu_backward
        to_a, to_b, to_c = torch.zeros_like(a), torch.zeros_like(b), torch.empty_like(c)
        start = 0
        for count in graph.receivers.counts:
            edges = slice(start, start + count)
            arriving = a.index_select(0, graph.senders.index[edges])
            arriving += b[:count]
            arriving += c[edges].unsqueeze(1)
            arriving = slope(gradient[:count], arriving)
            to_b[:count] += arriving
            to_c[edges] = arriving.sum(dim=1)
            targets = graph.targets[edges]
            leaving = b.index_select(0, targets)
            leaving += a[:count]
            leaving += c.index_select(0, graph.senders.entries[edges]).unsqueeze(1)
            to_a[:count] += slope(gradient.index_select(0, targets), leaving)
            start += count
        return to_a, to_b, to_c, None


class MeshNetwork(FieldNetwork):
    """A network on the graph of a mesh. A subclass defines `process`, in the graph's numbers."""

    fixed: Tensor

    def __init__(self, mesh: Mesh, fixed_nodes: Indices) -> None:
        super().__init__()
        self.graph = Graph(mesh.points, mesh_pairs(mesh))
        order = self.graph.order.numpy()
        self.to_mesh = Selection(inverse(order), mesh.n_nodes)
        fixed = np.isin(order, fixed_nodes).astype(np.float32)[:, None]
        add_constants(self, fixed=torch.from_numpy(fixed))

    def encode(self, fields: Tensor) -> Tensor:
        return fields.index_select(1, self.graph.order)

    def forward(self, features: Tensor) -> Tensor:
        # Nodes first: the row of a node moves in one piece.
        return self.to_mesh.take(self.process(features.transpose(0, 1))).transpose(0, 1)

    @abstractmethod
    def process(self, values: Tensor) -> Tensor:
        """(n_nodes, n, 3) → (n_nodes, n, 3)."""


class MeshTerm(nn.Module):
    """A linear layer of constants of the mesh, the same for every sample: (n_rows, width)."""

    constants: Tensor

    def __init__(self, constants: Tensor, width: int) -> None:
        super().__init__()
        add_constants(self, constants=constants)
        self.layer = linear(constants.shape[1], width)
        self.known: Tensor | None = None

    def precompute(self) -> None:
        self.known = self.layer(self.constants)

    def forward(self) -> Tensor:
        term: Tensor = self.layer(self.constants) if self.known is None else self.known
        return term


def normed(*widths: int) -> nn.Sequential:
    """Return a perceptron that ends with a layer norm."""
    return nn.Sequential(*perceptron(*widths), nn.LayerNorm(widths[-1]))
