"""The content of comparison.json: every conclusion of a comparison, with its uncertainty."""

from __future__ import annotations

from typing import Any

import numpy as np

from mor_bench.analysis.bootstrap import LEVEL
from mor_bench.analysis.break_even import break_even
from mor_bench.analysis.caveats import hidden, regimes, tuning
from mor_bench.analysis.draws import draws_of, headlines
from mor_bench.analysis.frontier import compare
from mor_bench.analysis.pairs import add_intervals
from mor_bench.analysis.performance_profile import profile
from mor_bench.analysis.selection import decide
from mor_bench.analysis.verdict import Requirements, Verdict, needs_of
from mor_bench.results.comparison import Comparison

N_RESAMPLES = 2000


def analyse(
    comparison: Comparison, *, n_resamples: int = N_RESAMPLES, seed: int = 0
) -> dict[str, Any]:
    """Draw all conclusions from the rows and raw samples of a comparison.

    All intervals have a level of 95 %. Errors are resampled by a bootstrap over the load regions of
    the test set, and over training seeds if there are several. All methods share the resamples.
    Intervals of latencies come from the spread between fresh processes; effects that all
    configurations share cancel in ratios. Nothing is corrected for the number of comparisons. The
    level is meant to be at least 95 %: equal methods were called different in fewer than one of
    twenty pairs, see `tests.verification.timing_trust`.

    Parameters
    ----------
    comparison : Comparison
    n_resamples, seed : int
        Number of resamples of the bootstrap, and its seed.

    Returns
    -------
    dict
        `verdicts`: `mor_bench.analysis.verdict.Verdict.summary` of each dataset.
        `rows`: value, low and high of the main figures of each configuration, and `error_bound`,
        the error that selects it.
        `time_at_error`, `error_at_time`: records of `mor_bench.analysis.frontier.compare` with
        `low` and `high`, which are None where not reached.
        `pairwise`: for each ordered pair of methods and error, the ratio of their times and the
        verdict on the first.
        `break_even`, `profile`, `hidden`, `regimes`, `tuning`: see the functions of these names.
        `clusters`: the resampled units of each dataset's bootstrap, and their number.
        `timing`: the processes of each dataset, and two relative standard deviations: one specific
        to each configuration, one common to all. None if there is only one process.
    """
    analysis: dict[str, Any] = {
        "settings": {"n_resamples": n_resamples, "seed": seed, "level": LEVEL},
        **{name: [] for name in ("time_at_error", "error_at_time", "rows", "pairwise")},
        **{name: [] for name in ("break_even", "hidden", "clusters", "timing")},
        "verdicts": [],
    }
    for dataset in dict.fromkeys(row.dataset for row in comparison.rows):
        draws = draws_of(comparison, dataset, n_resamples, np.random.default_rng(seed))
        rows = [row for row in comparison.rows if row.dataset == dataset]
        targets = compare(rows, draws.error_bounds)
        analysis["rows"] += [headlines(row, draws) for row in rows if row.status == "ok"]
        requirements = needs_of(comparison, dataset)
        analysis["verdicts"].append(decide(comparison, dataset, requirements, draws).summary())
        analysis["pairwise"] += add_intervals(targets, draws, requirements.error)
        for kind, records in targets.items():
            analysis[kind] += records
        analysis["break_even"] += break_even(rows, targets["time_at_error"], draws.error_bounds)
        analysis["hidden"] += hidden(comparison.rows, dataset, draws.intervals)
        for name, facts in (("clusters", draws.clusters), ("timing", draws.timing)):
            analysis[name] += [{"dataset": dataset, **facts}] if facts else []
    analysis["profile"] = profile(analysis["time_at_error"])
    analysis["regimes"] = regimes(comparison)
    analysis["tuning"] = tuning(comparison)
    return analysis


def verdict_on(comparison: Comparison, dataset: str, requirements: Requirements) -> Verdict:
    """Reach the verdict on one dataset, with the resamples of `analyse`."""
    draws = draws_of(comparison, dataset, N_RESAMPLES, np.random.default_rng(0))
    return decide(comparison, dataset, requirements, draws)
