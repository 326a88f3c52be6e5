"""The cost of a query as counted work, which does not depend on the machine."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict

from mor_bench.counting import counted
from mor_bench.errors import SolverError
from mor_bench.snapshots.given import Given
from mor_bench.surrogate import Surrogate


def cost_of(method: Surrogate, given: Given) -> dict[str, float] | None:
    """Return the mean work per query over some loads, which are predicted one by one.

    Parameters
    ----------
    method : Surrogate
        Fitted.
    given : Forces, ParametricForces or ObservedDisplacements
        With values (n, n_nodes, 3). If the method cannot answer a load, the work until its error
        counts.

    Returns
    -------
    dict or None
        The fields of `mor_bench.counting.Cost`; None for a method that counts nothing.
    """
    with counted() as cost:
        for number in range(len(given)):
            with suppress(SolverError):
                one = given[number]
                method.predict(one.with_values(one.values.copy()).query)
    means = {name: total / len(given) for name, total in asdict(cost).items()}
    return means if any(means.values()) else None
