"""Single queries on one thread under pytest-benchmark.

Times are reported and never asserted. Answers and ratios of times are asserted. For a ratio two
methods take turns in one test, and the least time of a query counts for each. Other load slows them
unequally: a neighbour that uses the shared cache took a quarter of its speed from `pod-tensor`,
which reads 2 MB of modes per query, and hardly anything from `pod`, which computes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture

import mor_bench
from mor_bench.errors import MissingDependencyError, UnsupportedSceneError
from mor_bench.machine import pinned_threads
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import Race
from mor_bench.surrogate import Surrogate
from tests.suite_methods import SPECS

CASES: dict[str, tuple[str, dict[str, Any], float]] = {
    # id: method, hyperparameters, bound on the relative l2 error. Zero displacement has error 1.
    # Measured: 0, 0.055, 0.055, 0.047 and 0.42.
    "full-order solve": ("fem", {}, 1e-7),
    "POD r=10": ("pod", {"n_modes": 10}, 0.08),
    "ECSW r=10": ("hpod", {"n_modes": 10, "cubature_tolerance": 1e-2}, 0.08),
    "PCA regression": ("pca-regression-linear", {"n_input_modes": 5}, 0.07),
    "U-Mesh": (
        "umesh",
        {"channels": 8, "steps": 1, "iterations": 200, "batch_size": 16, "learning_rate": 3e-3},
        0.7,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_single_query_is_accurate(case: str, tiny: Dataset, benchmark: BenchmarkFixture) -> None:
    """The load is the test load with the largest displacement, in an unseen load region."""
    name, parameters, bound = CASES[case]
    try:
        method = mor_bench.load_method(name, **parameters)
    except MissingDependencyError as error:
        pytest.skip(str(error))
    hardest = int(np.abs(tiny.test.displacements).max(axis=(1, 2)).argmax())
    reference = tiny.test.displacements[hardest]

    with pinned_threads(1):
        method.fit(tiny.scene, tiny.train)
        predicted = benchmark(method.predict, tiny.test.forces[hardest])

    assert predicted.shape == reference.shape
    assert np.isfinite(predicted).all()
    assert np.linalg.norm(predicted - reference) <= bound * np.linalg.norm(reference)


def _named(method: str, parameters: dict[str, Any]) -> str:
    return " ".join([method, *(f"{key}={value}" for key, value in parameters.items())])


def _race_id(value: str | Race) -> str:
    if isinstance(value, str):
        return value
    method = _named("", value.parameters)
    return f"{method} against {_named(value.baseline, value.baseline_parameters)} on {value.scene}"


RACES = [(name, race) for name, spec in SPECS.items() for race in spec.battery.races]
"""Every method of the suite against its baselines, from the method files.

The ratio of a network to a full-order model depends on the machine: Transolver was 55 times as fast
as `fem-jacobi-pcg` on one and 19 times on another. A bound leaves room for that. A second race
against another network, which depends less on the machine, notices when such a method slows down.
"""

N_SAMPLES = 120
"""Samples that methods are fitted to here."""

ROUNDS, ROUND_S, ATTEMPTS = 7, 5e-3, 10
"""Rounds of each side, least duration of a round in seconds, and attempts to win a race.

A method that is too slow loses every attempt.
"""


@pytest.fixture(scope="module")
def fitted(cache: Path) -> Callable[[str, str, dict[str, Any]], Surrogate]:
    """A method on a scene, fitted once for all timings."""
    known: dict[tuple[str, str], Surrogate] = {}

    def fit(scene: str, method: str, parameters: dict[str, Any]) -> Surrogate:
        key = scene, _named(method, parameters)
        if key not in known:
            surrogate = mor_bench.load_method(method, **parameters)
            train = (
                mor_bench.load_dataset(scene, limit=N_SAMPLES, cache=cache, workers=1).train
                if surrogate.needs_snapshots
                else None
            )
            known[key] = surrogate.fit(mor_bench.load_scene(scene), train)
        return known[key]

    return fit


def least_seconds(method: Surrogate, force: NDArray[np.float64]) -> float:
    """Return the least time of a query within a round."""
    least, end = float("inf"), perf_counter() + ROUND_S
    while (start := perf_counter()) < end or least == float("inf"):
        method.predict(force)
        least = min(least, perf_counter() - start)
    return least


def ratio_of_times(baseline: Surrogate, method: Surrogate, force: NDArray[np.float64]) -> float:
    """Return the ratio of least times, baseline to method, timed in turns."""
    rounds = [(least_seconds(baseline, force), least_seconds(method, force)) for _ in range(ROUNDS)]
    return min(slow for slow, _ in rounds) / min(fast for _, fast in rounds)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "race"), RACES, ids=_race_id)
def test_a_method_is_faster_than_the_baseline(
    name: str,
    race: Race,
    fitted: Callable[[str, str, dict[str, Any]], Surrogate],
    cache: Path,
    benchmark: BenchmarkFixture,
) -> None:
    """Both are timed at the median load of 64."""
    scene = mor_bench.load_scene(race.scene)
    drawn = draw_loads(scene, 0, 64)
    force = drawn.nodal_forces(scene.patch_weights)[
        int(np.linalg.norm(drawn.vectors, axis=(1, 2)).argsort()[32])
    ]
    if scene.observed_nodes is not None:
        force = (
            mor_bench.load_dataset(race.scene, limit=N_SAMPLES, cache=cache, workers=1)
            .test.given[0]
            .query
        )
    with pinned_threads(1):
        try:
            method = fitted(race.scene, name, race.parameters)
            baseline = fitted(race.scene, race.baseline, race.baseline_parameters)
        except (MissingDependencyError, UnsupportedSceneError) as error:
            pytest.skip(str(error))
        expected = baseline.predict(force)
        predicted = benchmark.pedantic(method.predict, (force,), rounds=5, warmup_rounds=1)  # type: ignore[no-untyped-call]
        ratios: list[float] = []
        while max(ratios, default=0.0) < race.least_speedup and len(ratios) < ATTEMPTS:
            ratios.append(ratio_of_times(baseline, method, force))
    apart = float(np.linalg.norm(predicted - expected) / np.linalg.norm(expected))
    print(f"{name}: {max(ratios):.1f} times as fast as {race.baseline}; answers {apart:.2g} apart")
    benchmark.extra_info.update({"ratio": max(ratios), "least": race.least_speedup, "apart": apart})
    assert apart <= race.difference
    assert max(ratios) >= race.least_speedup, f"{name}: {[round(ratio, 2) for ratio in ratios]}"


def test_every_method_is_timed_against_the_baseline() -> None:
    raced = {name for method, race in RACES for name in (method, race.baseline)}
    assert raced == SPECS.keys()
