"""The limit of displacements on refined meshes, and what is known of a mesh's distance from it."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, log2
from typing import Any

import numpy as np
from numpy.typing import NDArray

PLAUSIBLE_ORDERS = (0.5, 3.0)
"""Range of orders of convergence that allows extrapolation of a limit.

Linear elements have at most 2, and less at a clamped edge.
"""


def limit_of(
    displacements: list[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], float | None, str]:
    """Estimate the limit of displacements on meshes whose cell size is halved repeatedly.

    Parameters
    ----------
    displacements : list of (n_nodes, 3) float64
        Displacements at the same nodes, m, coarsest mesh first; at least two.

    Returns
    -------
    limit : (n_nodes, 3) float64
        Richardson's extrapolation. With fewer than three meshes, or an order outside
        `PLAUSIBLE_ORDERS`, it is the last of the list.
    order : float or None
        Order of convergence of the last three.
    kind : {"extrapolated", "finest"}
    """
    finest = displacements[-1]
    if len(displacements) < 3:
        return finest, None, "finest"
    before, last = (
        float(np.linalg.norm(b - a))
        for a, b in zip(displacements[-3:-1], displacements[-2:], strict=True)
    )
    order = log2(before / last) if before > 0 and last > 0 else inf
    if not PLAUSIBLE_ORDERS[0] <= order <= PLAUSIBLE_ORDERS[1]:
        return finest, order if np.isfinite(order) else None, "finest"
    return finest + (finest - displacements[-2]) / (2**order - 1), order, "extrapolated"


def known_error(record: Mapping[str, Any] | None) -> tuple[float | None, float | None, bool]:
    """Return what a record of `refine` tells about a mesh.

    Returns
    -------
    error_m, relative_l2 : float or None
        `error_m` and `relative_l2_median` of the record. None if there is no record, or if the
        displacements of most loads change more with every refinement: then no limit is known.
    at_least : bool
        Whether most loads have no extrapolated limit. The distance from the finest mesh is then
        smaller than the error.
    """
    if record is None:
        return None, None, False
    loads = [load for load in record["loads"] if load["error_m"] is not None]
    grows = sum(load["order"] is not None and load["order"] <= 0 for load in loads)
    if 2 * grows > len(loads):
        return None, None, False
    unknown = sum(load["limit"] == "finest" for load in loads)
    return record["error_m"], record["relative_l2_median"], 2 * unknown > len(loads)
