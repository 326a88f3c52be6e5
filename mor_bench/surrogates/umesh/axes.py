"""The order in which a training of U-Mesh sees the axes of its grid: the longest comes last.

oneDNN's convolutions work along the last axis, and a short one leaves most of a step unused. The
network treats all axes alike. So a grid and kernels that are turned together give the same answers.
"""

from __future__ import annotations

from math import prod

import numpy as np
import scipy.sparse as sp
from torch import nn

from mor_bench.scene.grid import GridMap

Axes = tuple[int, int, int]
"""The axis of the mesh along each axis of the training."""


def longest_last(shape: tuple[int, int, int]) -> Axes:
    """Return the axes by their numbers of points; equal ones keep their order."""
    first, second, last = np.argsort(shape, kind="stable").tolist()
    return first, second, last


def turned_grid(grid: GridMap, axes: Axes) -> GridMap:
    """Return the grid with its axes in another order."""
    points = np.arange(prod(grid.shape)).reshape(grid.shape).transpose(axes)
    x, y, z = points.shape
    return GridMap((x, y, z), sp.csr_array(grid.weights.tocsc()[:, points.ravel()]))


def turn_kernels(network: nn.Module, axes: Axes) -> None:
    """Put the last three axes of all kernels (c, c, x, y, z) into another order."""
    weights = network.state_dict()
    network.load_state_dict(
        {
            name: values.permute(0, 1, *(2 + axis for axis in axes)).clone()
            if values.ndim == 5
            else values
            for name, values in weights.items()
        }
    )


def inverse(axes: Axes) -> Axes:
    """Return the order that brings turned axes back."""
    first, second, last = np.argsort(axes).tolist()
    return first, second, last
