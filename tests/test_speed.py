"""Single queries on one thread under pytest-benchmark. Times are reported and never asserted; answers are, and ratios of times.

A ratio compares two methods that take turns in one test, so that what else the machine does slows both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
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
from mor_bench.specs import list_suite
from mor_bench.surrogate import Surrogate

CASES: dict[str, tuple[str, dict[str, Any], float]] = {
    # id: method, knobs, bound on the relative l2 error; measured 0, 0.055, 0.055, 0.047 and 0.42; no displacement has 1.
    "full-order solve": ("fem", {}, 1e-7),
    "POD r=10": ("pod", {"n_modes": 10}, 0.08),
    "ECSW r=10": ("hpod", {"n_modes": 10, "cubature_tolerance": 1e-2}, 0.08),
    "PCA regression": ("pca-regression", {"n_input_modes": 5}, 0.07),
    "U-Mesh": (
        "umesh",
        {"channels": 8, "steps": 1, "iterations": 200, "batch_size": 16, "learning_rate": 3e-3},
        0.7,
    ),
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


@dataclass(frozen=True)
class Race:
    """A method of the suite and its baseline.

    `least` bounds the baseline's time over the method's, `within` the relative l2 difference of their answers.
    """

    scene: str
    method: str
    knobs: dict[str, Any]
    baseline: str
    least: float
    within: float
    baseline_knobs: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{_named(self.method, self.knobs)} against {_named(self.baseline, self.baseline_knobs)} on {self.scene}"


def _named(method: str, knobs: dict[str, Any]) -> str:
    return " ".join([method, *(f"{key}={value}" for key, value in knobs.items())])


ECSW = {"n_modes": 10, "cubature_tolerance": 1e-2}
SMALL_UMESH = {
    "channels": 8,
    "steps": 1,
    "iterations": 100,
    "batch_size": 16,
    "learning_rate": 3e-3,
}

RACES = (
    # scene, method, knobs, baseline, least ratio, bound on the difference, knobs of the baseline; measured ratio and difference
    Race("beam-fine", "fem", {}, "fem", 2.0, 1e-6, {"solver": "cholesky"}),  # 8, 1e-9
    Race(
        "beam-fine", "fem", {"solver": "rotated-pcg"}, "fem", 1.4, 1e-6, {"solver": "cholesky"}
    ),  # 4, 1e-9
    Race("beam-fine", "fem-coarse", {"coarsening": 2}, "fem", 3.0, 0.1),  # 15, 0.03
    Race("l-shape", "fem", {}, "fem", 4.0, 1e-6, {"solver": "superlu"}),  # 27, 1e-9
    Race("l-shape", "fem", {}, "fem-jacobi-pcg", 6.0, 1e-6),  # 64, 1e-9
    Race("l-shape", "fem", {}, "fem-pardiso", 1.5, 1e-6),  # 8, 1e-9
    Race(
        "l-shape", "fem-warm", {"start": "nearest", "tolerance": 1e-8}, "fem", 0.3, 1e-6
    ),  # 1.0, 1e-9: no faster, see its limits
    Race("l-shape", "linear-fem", {}, "fem", 8.0, 0.1),  # 57, 0.02
    Race("l-shape", "pod", {"n_modes": 10}, "fem", 2.0, 0.1, {"solver": "cholesky"}),  # 10, 0.006
    Race(
        "beam-fine", "pod-tensor", {"n_modes": 20}, "pod", 100.0, 1e-3, {"n_modes": 20}
    ),  # 220, 7e-15
    Race("beam-fine", "hybrid", {"steps": 1}, "fem", 2.0, 0.05),  # 4, 7e-4
    Race(
        "l-shape", "autoencoder", {"n_latent": 10, "iterations": 300}, "fem", 2.0, 0.05
    ),  # 9, 0.002
    Race(
        "l-shape",
        "local-pod",
        {"n_clusters": 8, "n_modes": 10},
        "fem",
        2.0,
        0.1,
        {"solver": "cholesky"},
    ),  # 8, 8e-4
    Race(
        "l-shape",
        "modal-derivatives",
        {"n_linear": 5, "n_modes": 20},
        "fem",
        2.0,
        0.1,
        {"solver": "cholesky"},
    ),  # 5, 0.001
    Race(
        "l-shape", "quadratic-manifold", {"n_modes": 5}, "pod", 1.3, 0.1, {"n_modes": 10}
    ),  # 2.7, 0.006
    Race("l-shape", "hpod", ECSW, "pod", 8.0, 0.1, {"n_modes": 10}),  # 18, 0.02
    Race(
        "beam-fine",
        "hpod",
        {"n_modes": 20, "cubature_tolerance": 1e-2},
        "pod",
        10.0,
        0.1,
        {"n_modes": 20},
    ),  # 80, 0.005; 22 on a busy machine
    Race("l-shape", "ecm", ECSW, "pod", 2.5, 0.1, {"n_modes": 10}),  # 5, 0.002
    Race(
        "l-shape", "deim", {"n_modes": 10, "n_force_modes": 20}, "pod", 1.2, 0.1, {"n_modes": 10}
    ),  # 2.8, 0.02
    Race("l-shape", "pca-regression", {"n_input_modes": 10}, "fem", 5.0, 0.05),  # 31, 0.002
    Race(
        "l-shape",
        "pca-regression-force",
        {"n_input_modes": 20, "n_output_modes": 20},
        "fem",
        5.0,
        0.95,
    ),  # 54, 0.78 on so few samples
    Race(
        "l-shape", "explicit-dynamics", {"tolerance": 1e-2}, "fem-jacobi-pcg", 0.8, 0.1
    ),  # 2.7, 0.04
    Race("l-shape", "pgd", {"n_terms": 20, "position_degree": 2}, "fem", 3.0, 0.01),  # 19, 0.001
    Race(
        "l-shape", "pgd-force", {"n_terms": 20, "position_degree": 2}, "fem", 5.0, 0.1
    ),  # 18, 0.009
    Race(
        "liver-hex-observed", "gappy-pod", {"n_modes": 20}, "fem", 5.0, 0.2
    ),  # 470 on a busy machine, 0.02
    Race(
        "l-shape", "umesh", SMALL_UMESH, "fem-jacobi-pcg", 5.0, 0.9
    ),  # 66, 0.56 after so short a training
    Race("l-shape", "umesh-small", SMALL_UMESH, "fem-jacobi-pcg", 5.0, 0.9),  # 83, 0.55
    Race(
        "l-shape", "umesh-linear", SMALL_UMESH, "fem-jacobi-pcg", 20.0, 0.05
    ),  # 62, 0.016; linear-fem has 0.02
    Race("l-shape", "pca-ridge", {"n_input_modes": 20}, "fem", 5.0, 0.1),  # 28, 0.02
    Race("l-shape", "pca-kernel-ridge", {}, "fem", 5.0, 0.01),  # 29, 0.001
    Race("l-shape", "pca-gaussian-process", {"n_input_modes": 10}, "fem", 4.0, 0.02),  # 17, 0.002
    Race("l-shape", "pca-random-forest", {"n_trees": 10}, "fem", 5.0, 0.05),  # 37, 0.01
    Race("l-shape", "pca-extra-trees", {"n_trees": 10}, "fem", 5.0, 0.05),  # 33, 0.005
    Race("l-shape", "pca-polynomial-force", {"n_input_modes": 40}, "fem", 5.0, 0.95),
    Race("l-shape", "pod-nn-force", {"iterations": 300}, "fem", 8.0, 0.95),
    Race("l-shape", "sparse-polynomial-force", {}, "fem", 5.0, 0.95),
    Race("l-shape", "pod-nn", {"iterations": 300}, "fem", 8.0, 0.005),  # 24, 8e-4
    Race("l-shape", "pod-nn-derivative", {"iterations": 300}, "fem", 6.0, 0.005),  # 18, 7e-4
    Race("l-shape", "sparse-polynomial", {}, "fem", 9.0, 0.01),  # 28, 0.002
    Race("l-shape", "sparse-polynomial-derivative", {}, "fem", 9.0, 0.005),  # 29, 0.001
    Race(
        "l-shape", "deeponet", {"input": "linear-response", "iterations": 200}, "fem", 1.7, 0.02
    ),  # 5, 0.004
    Race(
        "l-shape", "pod-deeponet", {"input": "linear-response", "iterations": 200}, "fem", 1.2, 0.02
    ),  # 3.6, 0.004
    Race(
        "l-shape",
        "fno",
        {"input": "linear-response", "iterations": 20},
        "fem-jacobi-pcg",
        9.0,
        0.05,
    ),  # 27, 0.016
    Race(
        "l-shape",
        "mesh-graph-net",
        {"input": "linear-response", "iterations": 10},
        "fem-jacobi-pcg",
        4.5,
        0.05,
    ),  # 14, 0.014
)
"""Every method of the suite against its baseline; a new one adds a line."""

N_SAMPLES = 120
"""Samples that methods are fitted to here."""

ROUNDS, ROUND_S, ATTEMPTS = 7, 5e-3, 3
"""Rounds of each side, their least duration, and how often a race is run again; a method that is too slow loses all."""


@pytest.fixture(scope="module")
def fitted(cache: Path) -> Callable[[str, str, dict[str, Any]], Surrogate]:
    """A method on a scene, fitted once for all races."""
    known: dict[tuple[str, str], Surrogate] = {}

    def fit(scene: str, method: str, knobs: dict[str, Any]) -> Surrogate:
        key = scene, _named(method, knobs)
        if key not in known:
            surrogate = mor_bench.load_method(method, **knobs)
            train = (
                mor_bench.load_dataset(scene, limit=N_SAMPLES, cache=cache, workers=1).train
                if surrogate.needs_snapshots
                else None
            )
            known[key] = surrogate.fit(mor_bench.load_scene(scene), train)
        return known[key]

    return fit


def seconds_per_query(method: Surrogate, force: NDArray[np.float64]) -> float:
    queries, start = 0, perf_counter()
    while (elapsed := perf_counter() - start) < ROUND_S or not queries:
        method.predict(force)
        queries += 1
    return elapsed / queries


def ratio_of_times(baseline: Surrogate, method: Surrogate, force: NDArray[np.float64]) -> float:
    """Median seconds of the baseline over those of the method, which take turns."""
    rounds = [
        (seconds_per_query(baseline, force), seconds_per_query(method, force))
        for _ in range(ROUNDS)
    ]
    return median(slow for slow, _ in rounds) / median(fast for _, fast in rounds)


@pytest.mark.parametrize("race", RACES, ids=str)
def test_faster_than_the_baseline(
    race: Race,
    fitted: Callable[[str, str, dict[str, Any]], Surrogate],
    cache: Path,
    benchmark: BenchmarkFixture,
) -> None:
    """At the median load of 64."""
    scene = mor_bench.load_scene(race.scene)
    drawn = draw_loads(scene, 0, 64)
    force = drawn.nodal_forces(scene.patch_weights)[
        int(np.linalg.norm(drawn.vectors, axis=(1, 2)).argsort()[32])
    ]
    if scene.observed_nodes is not None:
        force = mor_bench.load_dataset(
            race.scene, limit=N_SAMPLES, cache=cache, workers=1
        ).test.inputs[0]
    with pinned_threads(1):
        try:
            method = fitted(race.scene, race.method, race.knobs)
            baseline = fitted(race.scene, race.baseline, race.baseline_knobs)
        except (MissingDependencyError, UnsupportedSceneError) as error:
            pytest.skip(str(error))
        expected = baseline.predict(force)
        predicted = benchmark.pedantic(method.predict, (force,), rounds=5, warmup_rounds=1)  # type: ignore[no-untyped-call]
        ratios: list[float] = []
        while max(ratios, default=0.0) < race.least and len(ratios) < ATTEMPTS:
            ratios.append(ratio_of_times(baseline, method, force))
    apart = float(np.linalg.norm(predicted - expected) / np.linalg.norm(expected))
    benchmark.extra_info.update({"ratio": max(ratios), "least": race.least, "apart": apart})
    assert apart <= race.within
    assert max(ratios) >= race.least, f"{race}: {[round(ratio, 2) for ratio in ratios]}"


def test_every_method_has_a_race() -> None:
    assert {name for race in RACES for name in (race.method, race.baseline)} == list_suite(
        "methods"
    ).keys()
