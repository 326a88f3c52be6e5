"""Nodes of a mesh to and from the padded regular grid that the U-Net sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mor_bench.scene.mesh import Mesh


@dataclass(frozen=True)
class PaddedGrid:
    """A regular grid whose sides are multiples of 2^k, and the place in it of each node of a mesh.

    Values lie channels-last in memory, as `Snapshots` has them: on a box without padding the grid is the nodal array itself.

    Attributes
    ----------
    shape : (int, int, int)
        Points per axis, padding included.
    places : (n_nodes,) int64 tensor
        Place of each node, flattened in C order.
    body : (1, 1, x, y, z) float32 tensor
        1 at nodes of the mesh, 0 at padding.
    """

    shape: tuple[int, int, int]
    places: Tensor
    body: Tensor

    @property
    def n_points(self) -> int:
        return self.body.numel()

    def to_grid(self, nodal: Tensor) -> Tensor:
        """(n, n_nodes, 3) → (n, 3, x, y, z) with zeros at padding, channels-last in memory."""
        flat = nodal.new_zeros(len(nodal), self.n_points, 3)
        flat[:, self.places] = nodal
        return flat.view(-1, *self.shape, 3).permute(0, 4, 1, 2, 3)

    def to_nodes(self, values: Tensor) -> Tensor:
        """(n, 3, x, y, z) → (n, n_nodes, 3)."""
        return values.permute(0, 2, 3, 4, 1).reshape(len(values), self.n_points, 3)[:, self.places]


def padded_grid(mesh: Mesh, steps: int) -> PaddedGrid:
    """The grid of a mesh, padded at the high end of each axis to a multiple of 2^steps.

    Raises
    ------
    ValueError
        If the mesh lies in no regular grid.
    """
    if mesh.grid_shape is None or mesh.grid_index is None:
        raise ValueError("the mesh lies in no regular grid.")
    multiple = 2**steps
    nx, ny, nz = (-(-n // multiple) * multiple for n in mesh.grid_shape)
    places = np.ravel_multi_index(np.unravel_index(mesh.grid_index, mesh.grid_shape), (nx, ny, nz))
    body = np.zeros(nx * ny * nz, dtype=np.float32)
    body[places] = 1.0
    return PaddedGrid((nx, ny, nz), torch.from_numpy(places.astype(np.int64)), torch.from_numpy(body).view(1, 1, nx, ny, nz))
