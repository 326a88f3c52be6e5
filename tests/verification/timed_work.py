"""Compare the work of timed queries with the work of the scored loads.

    python -m tests.verification.timed_work beam-coarse [METHOD ... | --all] [--out FILE]

For every configuration it prints the mean counted work per query of the timed loads, relative to
that of the scored test loads. A training is cut to two iterations, because a network's work does
not depend on its weights. It exits with 1 if a ratio differs from one by more than 1 %.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import MissingDependencyError, SpecError, UnsupportedSceneError
from mor_bench.measure.query_cost import cost_of
from mor_bench.measure.timed_loads import TimedLoads
from mor_bench.results.row import label_of
from mor_bench.runs.configurations import CORE_METHODS
from mor_bench.runs.timing_stage import timed_numbers
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.given import given_of
from mor_bench.specs import list_suite, load_dataset_spec, load_method_spec
from mor_bench.surrogate import Surrogate
from tests.verification.trust_record import trust_record

QUERIES = 1000
"""Least number of timed loads, about as many as the timing of a fast method takes."""

MOST_DIFFERENCE = 0.01
"""Largest accepted relative difference of the mean work."""


def timed_loads(dataset: Dataset, n: int, seed: int = 0) -> NDArray[np.float64]:
    """Return the loads of the first n timed queries."""
    test = dataset.test
    loads = TimedLoads(test.given.values[timed_numbers(test.displacements)], seed)
    return np.array([loads.changed(loads.next()) for _ in range(n)])


def work(method: Surrogate, dataset: Dataset, values: NDArray[np.float64]) -> float | None:
    """Return the mean multiply-adds per query; None for a method that counts nothing."""
    cost = cost_of(method, given_of(dataset.scene, values))
    return cost["multiply_adds"] if cost else None


def work_ratio(method: Surrogate, dataset: Dataset, timed: NDArray[np.float64]) -> float | None:
    """Return the mean work on timed loads over that on all scored loads."""
    scored, found = (work(method, dataset, values) for values in (dataset.test.given.values, timed))
    return None if scored is None or found is None else found / scored


def brief(name: str, parameters: Mapping[str, Any]) -> Surrogate:
    """Load a method; if it trains, with two iterations."""
    try:
        return mor_bench.load_method(name, **{**parameters, "iterations": 2})
    except SpecError:
        return mor_bench.load_method(name, **parameters)


def main() -> None:
    """Print the ratio of every configuration, and exit with 1 if one is too far from one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset")
    parser.add_argument("methods", nargs="*", default=CORE_METHODS)
    parser.add_argument("--all", action="store_true", help="every method of the suite")
    parser.add_argument("--out", type=Path, help="JSON file for the differences")
    options = parser.parse_args()
    dataset = load_dataset(load_dataset_spec(options.dataset))
    timed = timed_loads(dataset, max(QUERIES, 2 * len(dataset.test)))
    found: dict[str, float] = {}
    for name in list_suite("methods") if options.all else options.methods:
        for parameters in load_method_spec(name).configurations("quick"):
            try:
                method = brief(name, parameters).fit(dataset.scene, dataset.train)
            except (MissingDependencyError, UnsupportedSceneError) as error:
                print(f"{name}: {error}", flush=True)
                break
            ratio = work_ratio(method, dataset, timed)
            text = "counts nothing" if ratio is None else f"{100 * (ratio - 1):+.2f} %"
            print(f"{label_of(name, parameters)}: {text}", flush=True)
            if ratio is not None:
                found[label_of(name, parameters)] = round(100 * (ratio - 1), 3)
    largest = max((abs(percent) for percent in found.values()), default=0.0)
    record = {
        **trust_record(),
        "dataset": options.dataset,
        "queries": len(timed),
        "largest_difference_percent": largest,
        "difference_percent": found,
    }
    if options.out:
        options.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    if largest > 100 * MOST_DIFFERENCE:
        raise SystemExit(f"the work differs by up to {largest:.2g} %")


if __name__ == "__main__":
    main()
