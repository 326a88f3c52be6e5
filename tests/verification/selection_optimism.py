"""Measure how optimistic a selection is that uses the samples by which it is then judged.

    python -m tests.verification.selection_optimism STORED_RUN [--splits N] [--out FILE]

The load regions of the test set are divided into random halves. For each method and target error,
the fastest configuration that meets the target is selected in three ways:

- test: by its median error on the first half;
- validation: by its median error on the validation part, as time at error does;
- bound: by the 95 % upper bound of that error, as the verdict does.

The first half then reports the error of the selected configuration, and the second half checks it.
Each pair of halves is used in both orders.
`missed` is the share of selections that miss the target on the second half. `ratio` is the error on
the second half over the reported one: its geometric mean and its 90th percentile. Without optimism
the mean is 1.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.analyse import N_RESAMPLES
from mor_bench.analysis.bootstrap import cluster_numbers
from mor_bench.analysis.draws import VALIDATION, draws_of, headlines
from mor_bench.analysis.frontier import (
    EXACT,
    TARGET_ERRORS,
    is_point,
    median_latency_ms,
    selecting_error,
)
from mor_bench.report.entries import entries_of, told_by_method
from mor_bench.results.comparison import Comparison
from tests.published.compact import StoredRun

WAYS = ("test", "validation", "bound")


@dataclass(frozen=True)
class Sweep:
    """The configurations of a method, fastest first.

    Attributes
    ----------
    errors : (n_configurations, n_test) float64
        Relative L2 errors.
    held_out : dict
        By way of selection: the (n_configurations,) errors that select; empty without validation.
    """

    method: str
    errors: NDArray[np.float64]
    held_out: dict[str, NDArray[np.float64]]


def halves(
    regions: NDArray[np.int64] | None, n_samples: int, n_splits: int, seed: int = 0
) -> NDArray[np.bool_]:
    """Mark the test samples of the first half, (2 n_splits, n_samples), in both orders.

    A sample with several regions belongs to the half of its first one.
    """
    first = cluster_numbers(regions, n_samples)[:, 0]
    names = np.unique(first)
    generator = np.random.default_rng(seed)
    chosen = [generator.permutation(names)[: len(names) // 2] for _ in range(n_splits)]
    marked = np.array([np.isin(first, names) for names in chosen])
    return np.concatenate([marked, ~marked])


def optimism(
    sweep: Sweep, first: NDArray[np.bool_], targets: Iterable[float] = TARGET_ERRORS
) -> dict[str, Any]:
    """Return the figures of each way of selection, over all splits and targets.

    `n` counts the selections: a split and a target for which a configuration qualifies.
    """
    reported, checked = (
        np.array([np.median(sweep.errors[:, part], axis=1) for part in parts])
        for parts in (first, ~first)
    )
    found: dict[str, Any] = {}
    for way in WAYS:
        if way != "test" and way not in sweep.held_out:
            continue
        pairs = []
        for target in targets:
            selects = reported if way == "test" else np.tile(sweep.held_out[way], (len(first), 1))
            meets = selects <= target
            splits = np.flatnonzero(meets.any(axis=1))
            chosen = meets.argmax(axis=1)[splits]
            pairs += [
                (target, said, true)
                for said, true in zip(
                    reported[splits, chosen], checked[splits, chosen], strict=True
                )
            ]
        found[way] = _figures(pairs)
    return found


def _figures(pairs: Sequence[tuple[float, float, float]]) -> dict[str, Any]:
    if not pairs:
        return {"n": 0}
    target, said, true = np.array(pairs).T
    logs = np.log(np.maximum(true, EXACT) / np.maximum(said, EXACT))
    logs = logs[np.isfinite(logs)]
    return {
        "n": len(target),
        "missed": float(np.mean(true > target)),
        "ratio": float(np.exp(logs.mean())) if len(logs) else None,
        "ratio_p90": float(np.exp(np.quantile(logs, 0.9))) if len(logs) else None,
    }


def sweeps_of(comparison: Comparison, dataset: str) -> list[Sweep]:
    """Read the sweeps of the methods with two or more timed configurations."""
    rows = [row for row in comparison.rows if row.dataset == dataset and is_point(row)]
    draws = draws_of(comparison, dataset, N_RESAMPLES, np.random.default_rng(0))
    bounds = {row.label: headlines(row, draws).get(VALIDATION, {}).get("high") for row in rows}
    out = []
    for method in dict.fromkeys(row.method for row in rows):
        mine = sorted((row for row in rows if row.method == method), key=median_latency_ms)
        if len(mine) < 2:
            continue
        errors = np.array([comparison.samples(row)["relative_l2"] for row in mine])
        held_out = {}
        if all(row.validation for row in mine):
            highs = [bounds[row.label] for row in mine]
            held_out = {
                "validation": np.array([selecting_error(row) for row in mine]),
                "bound": np.array([np.inf if high is None else high for high in highs]),
            }
        out.append(Sweep(method, errors, held_out))
    return out


def measure(comparison: Comparison, n_splits: int) -> list[dict[str, Any]]:
    """Measure every method on every dataset of a comparison."""
    records = []
    for dataset in dict.fromkeys(row.dataset for row in comparison.rows):
        regions = comparison.dataset_arrays(dataset).get("test_regions")
        told = told_by_method(entries_of(comparison, dataset))
        for sweep in sweeps_of(comparison, dataset):
            first = halves(regions, sweep.errors.shape[1], n_splits)
            found = optimism(sweep, first)
            record = {"dataset": dataset, "method": sweep.method, "told": told.get(sweep.method)}
            records.append({**record, **found})
    return records


def main() -> None:
    """Print a line per method and way of selection."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("run", type=Path, help="folder of a stored run")
    parser.add_argument("--splits", type=int, default=400, help="number of random halves")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args()
    records = measure(StoredRun.read(options.run), options.splits)
    print(f"{'method':<28} {'selected by':<12} {'n':>6} {'missed':>8} {'ratio':>6} {'p90':>6}")
    for record in records:
        for way in WAYS:
            found = record.get(way, {"n": 0})
            if found["n"]:
                figures = f"{100 * found['missed']:>6.1f} % {found['ratio']:>6.3g}"
                line = f"{found['n']:>6} {figures} {found['ratio_p90']:>6.3g}"
                print(f"{record['method']:<28} {way:<12} {line}")
    if options.out:
        content = {"run": str(options.run), "splits": options.splits, "methods": records}
        options.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
