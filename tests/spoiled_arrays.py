"""Changes that make the arrays of an imported dataset invalid, or just smaller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.scene.mesh import box_mesh

Arrays = dict[str, NDArray[Any]]


def without(*names: str) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {name: array for name, array in arrays.items() if name not in names}


def with_(**changed: Callable[[NDArray[Any]], Any]) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {
        **arrays,
        **{name: np.asarray(change(arrays[name].copy())) for name, change in changed.items()},
    }


def put(*index: Any, value: float) -> Callable[[NDArray[Any]], NDArray[Any]]:
    def change(array: NDArray[Any]) -> NDArray[Any]:
        array[index] = value
        return array

    return change


def first(n: int) -> Callable[[Arrays], Arrays]:
    """Keep the first samples only."""
    by_sample = ("forces", "displacements", "regions")
    return lambda arrays: {k: v[:n] if k in by_sample else v for k, v in arrays.items()}


def hinged(arrays: Arrays) -> Arrays:
    """Use two blocks of a cube that share only an edge."""
    cube = box_mesh((2.0, 2.0, 1.0), (2, 2, 1))
    used, cells = np.unique(cube.cells[[0, 3]], return_inverse=True)
    shared = {name: arrays[name][:, : len(used)] for name in ("forces", "displacements")}
    return {"points": cube.points[used], "cells": cells.reshape(2, 8), **shared}


def doubled(rows: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([rows[:1], rows[:1], rows[2:]])
