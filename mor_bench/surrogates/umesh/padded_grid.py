"""Map between the nodes of a mesh and the padded regular grid of the U-Net."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from mor_bench.scene.grid import GridMap

SMALLEST_SHARE = 1e-3
"""Smallest sum of weights at a grid point for a full mean; below it, means fade to zero."""


@dataclass(frozen=True)
class PaddedGrid:
    """A regular grid whose sides are multiples of 2^k, and its map from and to mesh nodes.

    Values are channels-last in memory, as in `Snapshots`. On a box without padding, the grid is the
    nodal array itself.

    Attributes
    ----------
    grid : GridMap
        The grid with its padding; weights in float32.
    places : (n_nodes,) int64 tensor or None
        The grid point of each node, if every node has its own. Then values are moved, which takes a
        quarter of the time of a sparse product.
    """

    grid: GridMap
    places: Tensor | None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Points per axis, padding included."""
        return self.grid.shape

    @property
    def multiply_adds(self) -> int:
        """Work of `to_grid` and `to_nodes` for one sample; none if values are only moved."""
        return 0 if self.places is not None else 6 * int(self.grid.weights.nnz)

    def to_grid(self, forces: Tensor) -> Tensor:
        """Nᵀ f: (n, n_nodes, 3) → (n, 3, x, y, z), zeros at padding, channels-last in memory."""
        n_points = self.grid.weights.shape[1]
        if forces.is_cuda:
            flat = self._on_cuda[1](forces)
        elif self.places is None:
            flat = torch.from_numpy(self.grid.forces_to_grid(forces.numpy()))
        else:
            flat = forces.new_zeros(len(forces), n_points, 3).index_copy_(1, self.places, forces)
        return flat.view(-1, *self.shape, 3).permute(0, 4, 1, 2, 3)

    def displacements_to_grid(self, displacements: Tensor) -> Tensor:
        """(n, n_nodes, 3) → (n, 3, x, y, z): means of the nodes around each grid point.

        The means are weighted by N; padding holds zeros. If each node has its own grid point, the
        values are moved.
        """
        if self.places is not None:
            return self.to_grid(displacements)
        shares = self._on_cuda[2] if displacements.is_cuda else self.shares
        return self.to_grid(displacements) / shares

    @cached_property
    def _on_cuda(self) -> tuple[_Rows, _Rows, Tensor]:
        """N, its transpose and `shares` on the graphics processor."""
        transposed = sp.csr_array(self.grid.weights.T)
        return _Rows.of(self.grid.weights), _Rows.of(transposed), self.shares.to("cuda")

    @cached_property
    def shares(self) -> Tensor:
        """Sums of N over the nodes, (1, 1, x, y, z)."""
        sums = np.maximum(self.grid.weights.sum(axis=0), SMALLEST_SHARE).astype(np.float32)
        return torch.from_numpy(sums).view(1, 1, *self.shape)

    def to_nodes(self, values: Tensor) -> Tensor:
        """N u: (n, 3, x, y, z) → (n, n_nodes, 3), differentiable."""
        nodal: Tensor = _ToNodes.apply(values, self)  # type: ignore[no-untyped-call]
        return nodal


@dataclass(frozen=True)
class _Rows:
    """A sparse matrix with as many entries in every row, for products on a graphics processor.

    Its products add in a fixed order. A recorded step can hold them, which it cannot do with a
    product of SciPy.

    Attributes
    ----------
    columns : (n_rows, n_entries) int64 tensor
    weights : (n_rows, n_entries, 1) float32 tensor
        Zero in the entries that fill a row.
    """

    columns: Tensor
    weights: Tensor

    @classmethod
    def of(cls, matrix: sp.csr_array) -> _Rows:
        lengths = np.diff(matrix.indptr)
        width = int(lengths.max())
        columns = np.zeros((len(lengths), width), dtype=np.int64)
        weights = np.zeros((len(lengths), width, 1), dtype=np.float32)
        rows = np.repeat(np.arange(len(lengths)), lengths)
        entries = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], lengths)
        columns[rows, entries], weights[rows, entries, 0] = matrix.indices, matrix.data
        return cls(torch.from_numpy(columns).to("cuda"), torch.from_numpy(weights).to("cuda"))

    def __call__(self, values: Tensor) -> Tensor:
        """(n, n_columns, 3) → (n, n_rows, 3)."""
        return (values[:, self.columns] * self.weights).sum(dim=2)


class _ToNodes(torch.autograd.Function):
    """N u, with the gradient Nᵀ g.

    Both add in a fixed order on any number of threads. The backward pass of torch's indexing adds
    atomically.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, padded: PaddedGrid) -> Tensor:
        ctx.padded = padded
        flat = (
            values.detach()
            .permute(0, 2, 3, 4, 1)
            .reshape(len(values), padded.grid.weights.shape[1], 3)
        )
        if flat.is_cuda:
            return padded._on_cuda[0](flat)
        if padded.places is None:
            return torch.from_numpy(padded.grid.displacements_to_nodes(flat.numpy()))
        return flat.index_select(1, padded.places)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.padded.to_grid(gradient), None


def padded_grid(grid: GridMap, steps: int) -> PaddedGrid:
    """Pad a grid at the high end of each axis to a multiple of 2^steps."""
    multiple = 2**steps
    nx, ny, nz = (-(-n // multiple) * multiple for n in grid.shape)
    entries = grid.weights.astype(np.float32).tocoo()
    columns = np.ravel_multi_index(np.unravel_index(entries.col, grid.shape), (nx, ny, nz))
    weights = sp.csr_array(
        (entries.data, (entries.row, columns)), shape=(entries.shape[0], nx * ny * nz)
    )
    on_points = (
        (np.diff(weights.indptr) == 1).all()
        and (weights.data == 1).all()
        and len(np.unique(columns)) == len(columns)
    )
    return PaddedGrid(
        GridMap((nx, ny, nz), weights),
        torch.from_numpy(weights.indices.astype(np.int64)) if on_points else None,
    )
