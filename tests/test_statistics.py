"""Intervals that hold what they promise: simulated measurements, of which the truth is known."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.analysis.intervals import (
    TYPICAL_SPREAD,
    Spread,
    clusters_of,
    compare_latency,
    intervals_of,
    latency_draws,
    latency_interval,
    quantiles,
    resample_weights,
    spreads_of,
    student_t,
    weighted_means,
    weighted_medians,
    widened,
    widening,
)
from mor_bench.errors import InvalidInputError


@dataclass(frozen=True)
class Noise:
    """What disturbs a timing; relative standard deviations.

    `process` between fresh processes (of Student's t with 3 degrees of freedom if `heavy`), `slow_processes` the share of
    processes that are slower by 5 to 10 %, `query` between queries of which the share `tails` has Pareto's tail, `drift`
    the slow change of the machine over all rounds.
    """

    process: float = 0.015
    slow_processes: float = 0.05
    query: float = 0.05
    tails: float = 0.05
    drift: float = 0.05
    heavy: bool = False


NOISES = (
    Noise(),
    Noise(process=0.01, query=0.1, tails=0.1),
    Noise(process=0.02, slow_processes=0.0),
    Noise(process=0.01, heavy=True, drift=0.2),
)


def machine(
    generator: np.random.Generator, noise: Noise, n_processes: int = 5, n_rounds: int = 5
) -> NDArray[np.float64]:
    """(n_processes, n_rounds) log speed of the machine at the time of each round: a wave of random length and phase."""
    time = np.linspace(0, 1, n_processes * n_rounds)
    wave = np.sin(2 * np.pi * (time / generator.uniform(0.3, 3) + generator.random()))
    return np.asarray(noise.drift * generator.random() * wave).reshape(n_processes, n_rounds)


def measure(
    generator: np.random.Generator,
    noise: Noise,
    speed: NDArray[np.float64],
    latency_ms: float = 1.0,
    n_queries: int = 40,
) -> dict[str, NDArray[np.float64]]:
    """Simulated raw samples of a configuration on a machine."""
    n, rounds = speed.shape
    shape = np.asarray(
        generator.standard_t(3, n) / 3**0.5 if noise.heavy else generator.normal(size=n)
    )
    process = noise.process * shape + np.where(
        generator.random(n) < noise.slow_processes, np.log1p(generator.uniform(0.05, 0.1, n)), 0
    )
    query = noise.query * generator.normal(size=(n, rounds, n_queries))
    query += np.where(
        generator.random(query.shape) < noise.tails, np.log1p(generator.pareto(1.5, query.shape)), 0
    )
    logs = (
        process[:, None, None]
        + speed[..., None]
        + 0.003 * generator.normal(size=(n, rounds, 1))
        + query
    )
    numbers = np.indices(logs.shape)
    return {
        "latency_ms": latency_ms * np.exp(logs).ravel(),
        "process": numbers[0].ravel(),
        "round": numbers[1].ravel(),
    }


def verdicts(noise: Noise, slow_down: float, n: int, seed: int) -> list[str]:
    """Of n comparisons of a configuration with the same one, slowed down by a factor, on the same machine."""
    generator = np.random.default_rng(seed)
    found = []
    for _ in range(n):
        speed = machine(generator, noise)
        a, b = measure(generator, noise, speed), measure(generator, noise, speed, slow_down)
        found.append(compare_latency(b, a)["verdict"])
    return found


@pytest.mark.parametrize(
    "noise", NOISES, ids=lambda noise: f"{noise.process}-{'heavy' if noise.heavy else 'normal'}"
)
def test_identical_code_is_seldom_called_different_and_ten_percent_are_found(noise: Noise) -> None:
    same, slower = verdicts(noise, 1.0, 100, 0), verdicts(noise, 1.1, 100, 1)
    assert same.count("undecided") >= 95
    assert slower.count("slower") >= 95
    assert "faster" not in slower


def test_what_slows_both_cancels_and_a_ratio_is_found() -> None:
    generator = np.random.default_rng(2)
    speed = machine(generator, Noise(drift=2.0))
    a, b = (measure(generator, Noise(slow_processes=0), speed, latency) for latency in (3.0, 1.5))
    found = compare_latency(a, b)
    assert found["low"] < 2.0 < found["high"]
    assert found["high"] / found["low"] < 1.2
    assert found["verdict"] == "slower"
    back = compare_latency(b, a)
    assert back["verdict"] == "faster"
    assert back["ratio"] == pytest.approx(1 / found["ratio"])
    assert found["n_processes"] == 5


def test_few_processes_are_told_from_many() -> None:
    generator = np.random.default_rng(3)
    quiet = Noise(process=0.0, slow_processes=0, query=0.01, tails=0)
    widths = []
    for n in (1, 2, 5, 20):
        found = compare_latency(*(measure(generator, quiet, np.zeros((n, 3))) for _ in range(2)))
        widths.append(log(found["high"] / found["low"]))
    assert widths == sorted(widths, reverse=True)
    assert widths[0] == pytest.approx(2 * student_t(0.98, 2) * TYPICAL_SPREAD * 2**0.5)
    plain = {
        "latency_ms": np.ones(20)
    }  # without the numbers of its process and round it is one process
    assert compare_latency(plain, plain)["n_processes"] == 1
    with pytest.raises(InvalidInputError, match="in common"):
        compare_latency(plain, {**plain, "process": np.full(20, 7)})


@pytest.mark.parametrize("n_processes", [2, 3, 5])
def test_a_repeated_measurement_falls_into_the_interval(n_processes: int) -> None:
    generator = np.random.default_rng(4)
    latencies = np.geomspace(0.1, 10, 8)
    inside, widths = [], []
    for noise in NOISES[:3]:
        for _ in range(25):
            first, again = (
                {
                    str(i): measure(generator, noise, speed, latency)
                    for i, latency in enumerate(latencies)
                }
                for speed in (
                    machine(generator, noise, n_processes),
                    machine(generator, noise, n_processes),
                )
            )
            for label, (low, high) in intervals_of(first).items():
                inside.append(low <= np.median(again[label]["latency_ms"]) <= high)
                widths.append(high / low)
    assert np.mean(inside) >= 0.93
    assert np.median(widths) < {2: 1.5, 3: 1.3, 5: 1.25}[n_processes]


def test_pooling_narrows_what_two_processes_know_and_an_unsteady_one_keeps_its_own() -> None:
    generator = np.random.default_rng(5)
    noise, speed = Noise(process=0.01, slow_processes=0, drift=0), np.zeros((3, 4))
    samples = {str(i): measure(generator, noise, speed) for i in range(20)}
    samples["unsteady"] = measure(generator, Noise(process=0.2, slow_processes=0), speed)
    found = intervals_of(samples)
    alone = latency_interval(samples["0"])
    assert found["0"][1] / found["0"][0] < alone[1] / alone[0]
    assert log(found["unsteady"][1] / found["unsteady"][0]) > 2 * log(found["0"][1] / found["0"][0])
    assert intervals_of({}) == intervals_of({"a": {}}) == {}


def test_the_analysis_of_variance_finds_its_parts() -> None:
    generator = np.random.default_rng(6)
    common, private = generator.normal(0, 0.04, (30, 1)), generator.normal(0, 0.01, (30, 50))
    samples = [
        {
            "latency_ms": np.exp(common[:, 0] + private[:, i]),
            "process": np.arange(30),
            "round": np.zeros(30, dtype=int),
        }
        for i in range(50)
    ]
    found = spreads_of(samples)
    assert found.specific.sd == pytest.approx(0.01, rel=0.1)
    assert found.common.sd == pytest.approx(np.std(common, ddof=1), rel=0.02)
    assert found.specific.df == pytest.approx(29 * 49)
    assert found.common.df == 29
    two = spreads_of(samples[:2])
    ratios = np.log(samples[0]["latency_ms"] / samples[1]["latency_ms"])
    assert two.specific.sd == pytest.approx(ratios.std(ddof=1) / 2**0.5)
    assert two.specific.df == pytest.approx(29)
    one = spreads_of(samples[:1])
    assert (
        one.specific.sd == one.own[0] == pytest.approx(np.std(common[:, 0] + private[:, 0], ddof=1))
    )
    assert one.common == spreads_of([{"latency_ms": np.ones(5)}]).specific == Spread(0.0, 0.0)
    assert Spread(0.0, 0.0).moderated(0.014) == Spread(0.014, 2.0)


def test_draws_of_latencies_share_what_is_common() -> None:
    generator = np.random.default_rng(7)
    speed = 0.1 * generator.normal(size=(5, 1)) + np.zeros((5, 4))
    samples = [measure(generator, Noise(process=0.005, slow_processes=0), speed) for _ in range(8)]
    draws = latency_draws([*samples, None], np.arange(1.0, 10.0), 4000, generator)
    assert draws.shape == (9, 4000)
    assert np.exp(np.median(draws, axis=1)) == pytest.approx(np.arange(1.0, 10.0), rel=0.02)
    alone, ratio = np.subtract(*quantiles(draws[0])), np.subtract(*quantiles(draws[0] - draws[1]))
    assert abs(ratio) < 0.3 * abs(alone)


def test_resampled_medians_and_means_are_those_of_the_repeated_samples() -> None:
    generator = np.random.default_rng(8)
    values = generator.choice([*generator.random(30), np.inf], 41)
    clusters = clusters_of(generator.integers(0, 6, (41, 1)) * 10, 41)
    weights = resample_weights(clusters, 50, generator)
    repeated = [np.repeat(values, column) for column in weights.T]
    assert weighted_medians(values, weights).tolist() == [
        float(np.median(sample)) for sample in repeated
    ]
    assert weighted_means(values, weights) == pytest.approx(
        [float(np.mean(sample)) for sample in repeated]
    )
    for cluster in range(6):
        assert (np.ptp(weights[clusters[:, 0] == cluster], axis=0) == 0).all()
    assert weights.sum(axis=0).min() > 0


def test_without_two_regions_each_sample_is_its_own_cluster() -> None:
    for regions in (None, np.zeros((5, 1), dtype=int), np.zeros((4, 1), dtype=int)):
        assert clusters_of(regions, 5).tolist() == [[0], [1], [2], [3], [4]]


def coverage(effect: float, k: int, by_region: bool, n_regions: int = 13) -> float:
    """Share of simulated test sets whose 95 % interval holds the median over all regions; errors vary by region and by sample."""
    generator = np.random.default_rng(9)
    inside = []
    for _ in range(150):
        regions = np.array([generator.choice(n_regions, k, replace=False) for _ in range(300)])
        means = effect * generator.normal(size=n_regions)
        errors = np.exp(means[regions].sum(axis=1) + 0.3 * generator.normal(size=300))
        clusters = clusters_of(regions, 300) if by_region else np.arange(300)[:, None]
        median, count = float(np.median(errors)), int(clusters.max()) + 1
        draws = weighted_medians(errors, resample_weights(clusters, 200, generator))
        low, high = quantiles(widened(draws, median, widening(count), (errors.min(), errors.max())))
        inside.append(low <= 1.0 <= high)
    return float(np.mean(inside))


@pytest.mark.parametrize("k", [1, 3])
def test_regions_not_samples_are_resampled(k: int) -> None:
    assert coverage(0.3, k, by_region=True) >= 0.9
    assert (
        coverage(0.3, k, by_region=False) < 0.7
    )  # what a bootstrap of the samples would have promised


def test_widening_is_that_of_student_and_stays_within_bounds() -> None:
    assert widening(13) == pytest.approx((13 / 12) ** 0.5 * 2.1788 / 1.95996, rel=1e-4)
    assert widening(10_000) == pytest.approx(1, abs=1e-3)
    draws = np.array([0.5, 1.0, 2.0, 0.0, np.inf])
    assert widened(draws, 1.0, 2.0, (0.3, 3.0)).tolist() == [0.3, 1.0, 3.0, 0.0, np.inf]
    assert widened(draws, np.inf, 2.0, (0.3, 3.0)) is draws
    assert quantiles(np.arange(1.0, 1001.0)) == (26, 975)
    assert quantiles(np.append(np.arange(1.0, 971.0), np.full(30, np.inf))) == (26, np.inf)
