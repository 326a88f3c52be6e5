"""The middle and the worst test loads of a configuration, in words.

"Worst" has three meanings, and the loads often differ: the largest relative error, which is large
where a body hardly moves; the largest error in mm at a node; and the largest mean error e, by which
a run stores the load that the bodies show. Each text says which of them it means.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.selection_text import ERROR
from mor_bench.report.number_format import number, percent

NEEDED = {"relative_l2", "max_nodal_m", "amplitude_m"}
"""Names of the raw samples that the sentences need."""

LOAD_OF_KIND = {
    "worst": "the test load with its largest mean error e",
    "middle": "the test load with the median deformation",
}
"""What the stored samples are, by their kind."""


def worst_cases(arrays: Mapping[str, NDArray[Any]]) -> list[str]:
    """Describe the middle load, and those with the largest relative, nodal and mean errors.

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
    said = [
        f"Medians of the test loads: {ERROR} {percent(float(np.median(relative)))} %, "
        f"largest error at a node {_mm(np.median(nodal))}, "
        f"largest displacement {_mm(np.median(moved))}.",
        f"Largest {ERROR} of all test loads: {percent(float(relative[i]))} % "
        f"({small}test load {i}, largest displacement {_mm(moved[i])}).",
        f"Largest error in mm: {_mm(nodal[j])} at a node (test load {j}, "
        f"{percent(float(relative[j]))} %, largest displacement {_mm(moved[j])}).",
    ]
    if "mean_dof_m" in arrays:
        k = int(np.argmax(arrays["mean_dof_m"]))
        others = {
            i: "the one with the largest relative error",
            j: "the one with the largest error in mm",
        }
        figures = f"test load {k} ({_mm(nodal[k])} at a node, {percent(float(relative[k]))} %)"
        said.append(f"Largest mean error e, drawn under Deformed bodies: {others.get(k, figures)}.")
    return said


def _mm(length_m: np.floating[Any] | float) -> str:
    return f"{number(1e3 * float(length_m))} mm"
