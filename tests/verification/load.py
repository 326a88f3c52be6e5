"""Ask fitted methods for very many predictions: flat memory, and the same answers to the last bit.

    python -m tests.verification.load --predictions 1000000

asks each default method on beam-tiny for a million single predictions. Every hundredth part of
them the answers to some fixed loads are compared with those at the start, and the resident memory
is read. Growth counts from the first tenth on, since libraries fill caches at first.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
import psutil
from threadpoolctl import threadpool_limits

import mor_bench
from mor_bench.errors import MissingDependencyError, SolverError
from mor_bench.runs.configurations import CORE_METHODS
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.surrogate import Surrogate

PARTS, FIXED = 100, 5
"""Number of checks, and number of loads whose answers are compared."""

MOST_GROWTH_BYTES = 5e6
"""Largest growth of the resident memory after the first tenth of the predictions."""

BRIEF = {"umesh": {"iterations": 20}, "umesh-linear": {"iterations": 20}}
"""Parameters of trained methods: short trainings, whose predictions cost the same."""


@dataclass(frozen=True)
class Load:
    """Result of many predictions of a method.

    Attributes
    ----------
    growth_bytes : float
        Growth of the resident memory after the first tenth.
    drifted : int
        Number of checks whose answers differed from those at the start.
    seconds : float
    """

    growth_bytes: float
    drifted: int
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether memory is flat and no answer has changed."""
        return self.drifted == 0 and self.growth_bytes <= MOST_GROWTH_BYTES


def predict_often(method: Surrogate, data: Dataset, n: int) -> Load:
    """Make single predictions of random loads, with checks in between."""
    draw, forces = np.random.default_rng(0), data.test.forces
    fixed = forces[:: max(1, len(forces) // FIXED)][:FIXED]
    before = [method.predict(force) for force in fixed]
    process, memory, drifted = psutil.Process(), [], 0
    begun = perf_counter()
    for _ in range(PARTS):
        for _ in range(n // PARTS):
            force = forces[draw.integers(len(forces))] * draw.uniform(0.5, 1.0)
            try:
                method.predict(force)
            except SolverError:
                continue
        drifted += any(
            not np.array_equal(method.predict(force), answer)
            for force, answer in zip(fixed, before, strict=True)
        )
        memory.append(process.memory_info().rss)
    growth = float(max(memory[PARTS // 10 :]) - memory[PARTS // 10])
    return Load(growth, drifted, perf_counter() - begun)


def loaded(name: str, data: Dataset) -> Surrogate:
    """Fit a default method."""
    spec = mor_bench.load_method(name).parameters
    brief = {key: value for key, value in BRIEF.get(name, {}).items() if key in spec}
    return mor_bench.load_method(name, **brief).fit(data.scene, data.train)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line per method; exit with 1 if any grew or drifted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--predictions", type=int, default=1_000_000)
    parser.add_argument("--methods", nargs="*", default=list(CORE_METHODS))
    parser.add_argument("--cache", type=Path, default=None)
    given = parser.parse_args(arguments)
    failed = False
    with threadpool_limits(1):
        data = load_dataset("beam-tiny", cache=given.cache)
        for name in given.methods:
            try:
                found = predict_often(loaded(name, data), data, given.predictions)
            except MissingDependencyError as error:
                print(f"{name}: {error}")
                continue
            failed |= not found.ok
            print(
                f"{name}: {given.predictions:,} predictions in {found.seconds:,.0f} s, memory "
                f"{found.growth_bytes / 1e6:+.1f} MB, {found.drifted} drifts",
                flush=True,
            )
    sys.exit(failed)


if __name__ == "__main__":
    main()
