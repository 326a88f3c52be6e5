"""The order in which U-Mesh's network sees the axes of its grid: the longest comes last.

oneDNN's convolutions work along the last axis, and a short one leaves most of a step unused. The
network treats all axes alike. So a grid and kernels that are turned together give the same answers.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import prod
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.scene.grid import GridMap

Axes = tuple[int, int, int]
"""The axis of the mesh along each axis of the network."""


def longest_last(shape: tuple[int, int, int]) -> Axes:
    """Return the axes by their numbers of points; equal ones keep their order."""
    first, second, last = np.argsort(shape, kind="stable").tolist()
    return first, second, last


def turned_grid(grid: GridMap, axes: Axes) -> GridMap:
    """Return the grid with its axes in another order."""
    points = np.arange(prod(grid.shape)).reshape(grid.shape).transpose(axes)
    x, y, z = points.shape
    return GridMap((x, y, z), sp.csr_array(grid.weights.tocsc()[:, points.ravel()]))


def turned_kernels(weights: Mapping[str, NDArray[Any]], axes: Axes) -> dict[str, NDArray[Any]]:
    """Return weights whose kernels (c, c, x, y, z) have their last axes in another order."""
    order = 0, 1, *(2 + axis for axis in axes)
    return {
        name: np.ascontiguousarray(values.transpose(order)) if values.ndim == 5 else values
        for name, values in weights.items()
    }


def inverse(axes: Axes) -> Axes:
    """Return the order that brings turned axes back."""
    first, second, last = np.argsort(axes).tolist()
    return first, second, last
