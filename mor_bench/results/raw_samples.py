"""Checks of the raw arrays beside the rows of a run: types, shapes and ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import StoreError

Arrays = Mapping[str, NDArray[Any]]

FARTHEST = 1e30
"""Largest coordinate, displacement or force."""

MOST_NUMBER = 10**9
"""Largest number of a process, a round, a region or a node."""


@dataclass(frozen=True)
class Allowed:
    """What an array may be.

    Attributes
    ----------
    kind : {"real", "whole"}
        Real numbers, or whole ones.
    shape : tuple of str or int
        Names of lengths, which must be the same in all arrays of a file, or lengths.
    low, high : float
        Least and largest value; NaN passes, unless `finite`.
    finite : bool
        Whether every value must be finite.
    """

    kind: Literal["real", "whole"]
    shape: tuple[str | int, ...]
    low: float = -inf
    high: float = inf
    finite: bool = False


_ERRORS = Allowed("real", ("test",), 0.0)
_NODES = Allowed("real", ("nodes", 3), -FARTHEST, FARTHEST, finite=True)
_PREDICTION = Allowed("real", ("nodes", 3))  # a broken method may answer anything
_NUMBERS = Allowed("whole", ("queries",), 0.0)
_CURVE = Allowed("real", ("any",))

OF_ROWS = {
    "latency_ms": Allowed("real", ("queries",), 1e-9, finite=True),
    "process": _NUMBERS,
    "round": _NUMBERS,
    **dict.fromkeys(("mean_dof_m", "relative_l2", "max_nodal_m", "amplitude_m"), _ERRORS),
    "validation_relative_l2": Allowed("real", ("validation",), 0.0),
    "seeds_mean_dof_m": Allowed("real", ("seeds", "test"), 0.0),
    "seeds_relative_l2": Allowed("real", ("seeds", "test"), 0.0),
    "seeds_validation_relative_l2": Allowed("real", ("seeds", "validation"), 0.0),
    **{f"{sample}_prediction": _PREDICTION for sample in ("worst", "middle")},
    **{
        f"{sample}_{part}": _NODES
        for sample in ("worst", "middle")
        for part in ("reference", "forces")
    },
    "loss_curve": _CURVE,
    "validation_curve": _CURVE,
}
"""The arrays of a row that conclusions and pictures use. Others may exist."""

OF_DATASETS = {
    "singular_values": Allowed("real", ("any",), 0.0, finite=True),
    "snapshots_norm": Allowed("real", (), 0.0, finite=True),
    "points": Allowed("real", ("nodes", 3), -FARTHEST, FARTHEST, finite=True),
    "cells": Allowed("whole", ("cells", "corners"), 0.0),
    "patch_centres": Allowed("real", ("patches", 3), -FARTHEST, FARTHEST, finite=True),
    "test_regions": Allowed("whole", ("test", "regions"), 0.0),
    "validation_regions": Allowed("whole", ("validation", "validation regions"), 0.0),
    "n_refused": Allowed("whole", (), 0.0),
    "test_force_n": Allowed("real", ("test",), 0.0, finite=True),
}
"""The arrays of a dataset."""


def check_arrays(
    path: Path, arrays: Arrays, allowed: Mapping[str, Allowed], lengths: Mapping[str, int]
) -> None:
    """Check the arrays of a file.

    Parameters
    ----------
    path : Path
        The file, for errors.
    arrays : dict of arrays
    allowed : dict of Allowed
        By the names of arrays; others are not checked.
    lengths : dict of int
        Known lengths, by their names in `Allowed.shape`.

    Raises
    ------
    StoreError
        Names the first array that is not as it must be.
    """
    known = dict(lengths)
    for name, must in allowed.items():
        if name in arrays:
            problem = _problem(arrays[name], must, known)
            if problem:
                raise StoreError(f"{path}: `{name}` must {problem}.")
    limits = [("cells", "nodes"), ("test_regions", "patches"), ("validation_regions", "patches")]
    for name, length in limits:
        if name in arrays and length in known and arrays[name].size:
            most = int(arrays[name].max())
            if name in allowed and most >= known[length]:
                raise StoreError(
                    f"{path}: `{name}` must be less than {known[length]}, the number of {length}; "
                    f"got {most}."
                )


def _problem(array: NDArray[Any], must: Allowed, known: dict[str, int]) -> str:
    """Say what an array must be that it is not; empty if it is right. Adds new lengths."""
    kinds = "iu" if must.kind == "whole" else "fiu"
    if array.dtype.kind not in kinds:
        return f"hold {must.kind} numbers; got {array.dtype}"
    if array.ndim != len(must.shape):
        return f"have {len(must.shape)} dimensions; got the shape {array.shape}"
    for length, n in zip(must.shape, array.shape, strict=True):
        expected = n if length == "any" else known.setdefault(str(length), n)
        expected = length if isinstance(length, int) else expected
        if n != expected:
            return f"have the length {expected} ({length}); got the shape {array.shape}"
    if must.finite and not np.isfinite(array).all():
        return "be finite"
    if (array < must.low).any() or (array > must.high).any():
        return f"lie in [{must.low:g}, {must.high:g}]"
    if must.kind == "whole" and array.size and int(array.max()) > MOST_NUMBER:
        return f"be at most {MOST_NUMBER:,}"
    return ""
