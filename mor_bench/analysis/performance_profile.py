"""Performance profile: how many problems each method solves within a factor of the fastest.

Source: Dolan, Moré 2002, Benchmarking optimization software with performance profiles. A profile
shows the fastest method and the one that solves most problems. The order of the others depends on
which methods take part (Gould, Scott 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def profile(at_error: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Compute the performance profile. A problem is a dataset at an error.

    Problems that no method solves are left out and counted.

    Parameters
    ----------
    at_error : sequence of dict
        Records of time at error.

    Returns
    -------
    dict
        `problems`: (dataset, error) of each; `n_unsolved`; `n_datasets`; `factors`: by method, the
        factor of each problem, None where not solved.
    """
    times: dict[tuple[str, float], dict[str, float]] = {}
    for record in at_error:
        solved = times.setdefault((record["dataset"], record["target_rel_l2_median"]), {})
        if record["latency_ms"] is not None:
            solved[record["method"]] = record["latency_ms"]
    solvable = {problem: solved for problem, solved in times.items() if solved}
    methods = dict.fromkeys(record["method"] for record in at_error)
    return {
        "problems": [list(problem) for problem in solvable],
        "n_unsolved": len(times) - len(solvable),
        "n_datasets": len({dataset for dataset, _ in times}),
        "factors": {
            method: [
                solved[method] / min(solved.values()) if method in solved else None
                for solved in solvable.values()
            ]
            for method in methods
        },
    }


def share_within(factors: Sequence[float | None], tau: float) -> float:
    """Share of problems that a method solves within a factor of the fastest."""
    solved = sum(factor is not None and factor <= tau for factor in factors)
    return solved / len(factors) if factors else 0.0
