"""The middle and the two worst test loads of a configuration, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.report.number_format import number, percent

NEEDED = {"relative_l2", "max_nodal_m", "amplitude_m"}
"""Names of the raw samples that the sentences need."""


def worst_cases(arrays: Mapping[str, NDArray[Any]]) -> list[str]:
    """Describe the middle load, and those with the largest relative and absolute errors.

    The two worst loads often differ: relative errors are large where a body hardly moves.
    Empty without raw samples, or if a load has no prediction.
    """
    if not set(arrays) >= NEEDED:
        return []
    relative, nodal, moved = (
        np.asarray(arrays[name], dtype=float)
        for name in ("relative_l2", "max_nodal_m", "amplitude_m")
    )
    if not len(relative) or not np.isfinite([relative, nodal, moved]).all():
        return []
    i, j = int(np.argmax(relative)), int(np.argmax(nodal))
    small = "a small load, " if moved[i] < np.median(moved) / 2 else ""
    return [
        f"Middle (medians): {percent(float(np.median(relative)))} %, "
        f"{_mm(np.median(nodal))} at the worst node, moves {_mm(np.median(moved))}.",
        f"Worst relative: {percent(float(relative[i]))} % ({small}moves {_mm(moved[i])}).",
        f"Worst absolute: {_mm(nodal[j])} at a node ({percent(float(relative[j]))} %, "
        f"moves {_mm(moved[j])}).",
    ]


def _mm(length_m: np.floating[Any] | float) -> str:
    return f"{number(1e3 * float(length_m))} mm"
