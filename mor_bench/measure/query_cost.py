"""The cost of a query as counted work, which does not depend on the machine."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from mor_bench.counting import counted
from mor_bench.errors import SolverError
from mor_bench.surrogate import Surrogate


def cost_of(method: Surrogate, forces: NDArray[np.float64]) -> dict[str, float] | None:
    """Return the mean work per query over some loads, each predicted on its own.

    Parameters
    ----------
    method : Surrogate
        Fitted.
    forces : (n, n_nodes, 3) float64
        Loads, N. One that the method cannot answer counts with the work until its error.

    Returns
    -------
    dict or None
        The fields of `mor_bench.counting.Cost`; None for a method that counts nothing.
    """
    with counted() as cost:
        for force in forces:
            with suppress(SolverError):
                method.predict(force.copy())
    means = {name: total / len(forces) for name, total in asdict(cost).items()}
    return means if any(means.values()) else None
