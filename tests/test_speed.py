"""Single queries under pytest-benchmark, on one thread. Times are reported and never asserted; the answers are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import mor_bench
from mor_bench.errors import MissingDependencyError
from mor_bench.harness.timing import pinned_threads
from mor_bench.snapshots.dataset import Dataset

CASES: dict[str, tuple[str, dict[str, Any], float]] = {
    # id: method, knobs, bound on the relative l2 error; measured 0, 0.055, 0.055, 0.047 and 0.42; no displacement has 1.
    "full-order solve": ("fem", {}, 1e-7),
    "POD r=10": ("pod", {"n_modes": 10}, 0.08),
    "ECSW r=10": ("hpod", {"n_modes": 10, "cubature_tolerance": 1e-2}, 0.08),
    "PCA regression": ("pca-regression", {"n_input_modes": 5}, 0.07),
    "U-Mesh": ("umesh", {"channels": 8, "steps": 1, "iterations": 200, "batch_size": 16, "learning_rate": 3e-3}, 0.7),
}


@pytest.mark.parametrize("case", CASES)
def test_single_query(case: str, tiny: Dataset, benchmark: BenchmarkFixture) -> None:
    """The test load that displaces most, in a load region that training has not seen."""
    name, knobs, bound = CASES[case]
    try:
        method = mor_bench.load_method(name, **knobs)
    except MissingDependencyError as error:
        pytest.skip(str(error))
    hardest = int(np.abs(tiny.test.displacements).max(axis=(1, 2)).argmax())
    reference = tiny.test.displacements[hardest]

    with pinned_threads(1):
        method.fit(tiny.scene, tiny.train)
        predicted = benchmark(method.predict, tiny.test.forces[hardest])

    assert benchmark.disabled or benchmark.stats is not None
    assert predicted.shape == reference.shape
    assert np.isfinite(predicted).all()
    assert np.linalg.norm(predicted - reference) <= bound * np.linalg.norm(reference)
