"""Tables of single test loads: the worst ones of each method, and those that are hard for all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.report.number_format import DASH, number, percent
from mor_bench.report.page_samples import Sampled, has_error
from mor_bench.report.text_table import TextTable

N_WORST, N_SHARED = 3, 5
"""Number of loads per method, and of loads that are hard for all."""

HARD_SHARE = 0.1
"""Share of the test loads that count as hard for a method: those with its largest errors."""

NUMBERS = "Numbers count the test loads from 0, as in the raw files. "


def hardest_loads(found: Sequence[Sampled], arrays: Mapping[str, NDArray[Any]]) -> list[TextTable]:
    """Build both tables from configurations with raw samples; exact references are left out."""
    compared = [
        item
        for item in found
        if has_error(item.entry)
        and {"relative_l2", "mean_dof_m", "amplitude_m"} <= set(item.arrays)
    ]
    if not compared:
        return []
    return [_worst(compared, arrays), *_shared(compared, arrays)]


def _worst(found: Sequence[Sampled], arrays: Mapping[str, NDArray[Any]]) -> TextTable:
    rows = []
    for item in found:
        errors, relative = item.arrays["mean_dof_m"], item.arrays["relative_l2"]
        largest = np.argsort(-errors, kind="stable")[:N_WORST].tolist()
        for load in dict.fromkeys([*largest, int(np.argmax(relative))]):
            rows.append(
                [
                    item.entry.label,
                    str(load),
                    _known(1e3 * errors[load], number),
                    _known(relative[load], percent),
                    *_load(item, arrays, load),
                ]
            )
    return TextTable(
        "Worst test loads of each method",
        f"{NUMBERS}The largest e, the mean absolute error per degree of freedom, and last the "
        "largest relative error.",
        ["configuration", "test load", "e (mm)", "relative L2 error (%)", *_LOAD],
        rows,
    )


def _shared(found: Sequence[Sampled], arrays: Mapping[str, NDArray[Any]]) -> list[TextTable]:
    relative = np.stack([item.arrays["relative_l2"] for item in found])
    n_methods, n_loads = relative.shape
    if n_methods < 2:
        return []
    order = np.argsort(-relative, axis=1, kind="stable")
    ranks = np.empty_like(order)
    np.put_along_axis(ranks, order, np.arange(n_loads)[None, :].repeat(n_methods, axis=0), axis=1)
    counts = (ranks < ceil(HARD_SHARE * n_loads)).sum(axis=0)
    chosen = np.lexsort((np.median(ranks, axis=0), -counts))[:N_SHARED]
    chosen = chosen[counts[chosen] > n_methods / 2]
    if not len(chosen):
        return []
    rows = [
        [
            str(load),
            f"{counts[load]} of {n_methods}",
            _known(relative[:, load].min(), percent),
            _known(relative[:, load].max(), percent),
            *_load(found[0], arrays, load),
        ]
        for load in chosen.tolist()
    ]
    note = (
        f"{NUMBERS}A load is hard for a configuration if it is in the tenth of the loads with its "
        "largest relative L2 errors. Beside it: the smallest and the largest of these "
        "configurations."
    )
    headings = ["test load", "hard for", "smallest (%)", "largest (%)", *_LOAD]
    return [TextTable("Test loads that are hard for most methods", note, headings, rows)]


def _known(value: float, shown: Callable[[float | None], str]) -> str:
    return shown(value) if np.isfinite(value) else "no prediction"


_LOAD = ("largest u (mm)", "force (N)", "load at (m)")


def _load(item: Sampled, arrays: Mapping[str, NDArray[Any]], load: int) -> list[str]:
    """Return the reference's largest displacement, the total force, and the patches' centres."""
    where, force = DASH, DASH
    if "test_force_n" in arrays:
        force = number(float(arrays["test_force_n"][load]))
    if {"test_regions", "patch_centres"} <= set(arrays):
        centres = arrays["patch_centres"][arrays["test_regions"][load]]
        where = "; ".join(", ".join(f"{x:.3g}" for x in centre) for centre in centres)
    return [number(1e3 * item.arrays["amplitude_m"][load]), force, where]
