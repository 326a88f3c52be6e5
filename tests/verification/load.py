"""Ask fitted methods for very many predictions: flat memory, and the same answers to the last bit.

    python -m tests.verification.load --predictions 1000000

asks each default method on beam-tiny for a million single predictions. Every hundredth part of
them the answers to some fixed loads are compared with those at the start, and the resident memory
is read. Growth counts from the first tenth on, since libraries fill caches at first.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from time import perf_counter

import numpy as np
import psutil
from threadpoolctl import threadpool_limits

import mor_bench
from mor_bench.errors import MissingDependencyError, SolverError
from mor_bench.runs.configurations import CORE_METHODS
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.specs import load_method_spec
from mor_bench.surrogate import Surrogate

PREDICTIONS = 1_000_000
"""Predictions of each method; a prediction every 30 ms would take 8 hours."""

PARTS, FIXED = 100, 5
"""Number of checks, and number of loads whose answers are compared."""

MOST_GROWTH_BYTES = 5e6
"""Largest growth of the resident memory after the first tenth of the predictions."""

ITERATIONS = 20
"""Iterations of trainings: the predictions of a network cost the same after a long one."""


@dataclass(frozen=True)
class Load:
    """Result of many predictions of a method.

    Attributes
    ----------
    n : int
        Number of predictions.
    growth_bytes : float
        Growth of the resident memory after the first tenth.
    drifted : int
        Number of checks whose answers differed from those at the start.
    refused : int
        Number of loads without an answer, because the solver found no equilibrium.
    seconds : float
    """

    n: int
    growth_bytes: float
    drifted: int
    refused: int
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether memory is flat and no answer has changed."""
        return self.drifted == 0 and self.growth_bytes <= MOST_GROWTH_BYTES


def predict_often(method: Surrogate, data: Dataset, n: int, limit_s: float = inf) -> Load:
    """Make single predictions of random loads until a time limit, with checks in between."""
    draw, forces = np.random.default_rng(0), data.test.forces
    fixed = forces[:: max(1, len(forces) // FIXED)][:FIXED]
    before = [method.predict(force) for force in fixed]
    process, memory, drifted, refused = psutil.Process(), [], 0, 0
    begun = perf_counter()
    for _ in range(PARTS):
        for _ in range(n // PARTS):
            force = forces[draw.integers(len(forces))] * draw.uniform(0.5, 1.0)
            try:
                method.predict(force)
            except SolverError:
                refused += 1
        drifted += any(
            not np.array_equal(method.predict(force), answer)
            for force, answer in zip(fixed, before, strict=True)
        )
        memory.append(process.memory_info().rss)
        if perf_counter() - begun > limit_s:
            break
    settled = memory[len(memory) // 10 :]
    growth = float(max(settled) - settled[0])
    n_asked = n // PARTS * len(memory)
    return Load(n_asked, growth, drifted, refused, perf_counter() - begun)


def loaded(name: str, data: Dataset) -> Surrogate:
    """Fit a default method: a network in the size of the quick profile, with a short training."""
    quick = load_method_spec(name).configurations("quick")[0]
    brief = {**quick, "iterations": ITERATIONS} if "iterations" in quick else {}
    return mor_bench.load_method(name, **brief).fit(data.scene, data.train)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line per method; exit with 1 if any grew, drifted or could not be asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--predictions", type=int, default=PREDICTIONS)
    parser.add_argument("--seconds", type=float, default=inf, help="time limit of each method")
    parser.add_argument("--methods", nargs="*", default=list(CORE_METHODS))
    parser.add_argument("--cache", type=Path, default=None)
    parser.add_argument("--json", type=Path, help="file to write the results to")
    given = parser.parse_args(arguments)
    failed, rows = False, []
    data = load_dataset("beam-tiny", cache=given.cache)
    for name in given.methods:
        try:
            method = loaded(name, data)
        except MissingDependencyError as error:
            print(f"{name}: {error}")
            failed = True
            continue
        with threadpool_limits(1):  # only now, since it does not reach libraries loaded later
            found = predict_often(method, data, given.predictions, given.seconds)
        failed |= not found.ok
        rows.append({"method": name, **asdict(found)})
        print(
            f"{name}: {found.n:,} predictions in {found.seconds:,.0f} s, memory "
            f"{found.growth_bytes / 1e6:+.1f} MB, {found.drifted} drifts, "
            f"{found.refused:,} without an answer",
            flush=True,
        )
    if given.json:
        given.json.write_text(json.dumps({"methods": rows}, indent=1) + "\n")
    sys.exit(failed)


if __name__ == "__main__":
    main()
