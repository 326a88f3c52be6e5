"""Intervals have their nominal coverage in simulated measurements with a known truth."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.analysis.bootstrap import (
    central_interval,
    cluster_numbers,
    resample_weights,
    student_t,
    weighted_means,
    weighted_medians,
    widen,
    widening,
)
from mor_bench.analysis.latency_intervals import (
    Spread,
    latency_draws,
    latency_intervals,
    spreads_of,
)
from mor_bench.analysis.seeds import error_draws, seed_interval
from tests.verification.interval_coverage import Setting, coverage, coverage_of_seeds


@dataclass(frozen=True)
class Noise:
    """Disturbances of a timing, as relative standard deviations.

    `process`: between new processes (Student's t with 3 degrees of freedom if `heavy`).
    `slow_processes`: share of processes that are slower by 5 to 10 %.
    `query`: between queries; the share `tails` of them has Pareto's tail.
    `drift`: slow change of the machine over all rounds.
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
    """Return the machine's log speed in each round: a wave of random length and phase."""
    time = np.linspace(0, 1, n_processes * n_rounds)
    wave = np.sin(2 * np.pi * (time / generator.uniform(0.3, 3) + generator.random()))
    return np.asarray(noise.drift * generator.random() * wave).reshape(n_processes, n_rounds)


def measure(
    generator: np.random.Generator,
    noise: Noise,
    speed: NDArray[np.float64],
    latency_ms: float = 1.0,
) -> dict[str, NDArray[np.float64]]:
    """Return raw samples of a configuration on a machine, 40 queries per round."""
    n, rounds = speed.shape
    shape = np.asarray(
        generator.standard_t(3, n) / 3**0.5 if noise.heavy else generator.normal(size=n)
    )
    slow = generator.random(n) < noise.slow_processes
    process = noise.process * shape + slow * np.log1p(generator.uniform(0.05, 0.1, n))
    query = noise.query * generator.normal(size=(n, rounds, 40))
    tail = generator.random(query.shape) < noise.tails
    query += tail * np.log1p(generator.pareto(1.5, query.shape))
    turn = 0.003 * generator.normal(size=(n, rounds, 1))
    logs = process[:, None, None] + speed[..., None] + turn + query
    numbers = np.indices(logs.shape)
    return {
        "latency_ms": latency_ms * np.exp(logs).ravel(),
        "process": numbers[0].ravel(),
        "round": numbers[1].ravel(),
    }


@pytest.mark.parametrize(
    ("n_processes", "widest"),
    [
        (3, 1.3),
        *(pytest.param(n, most, marks=pytest.mark.slow) for n, most in ((2, 1.5), (5, 1.25))),
    ],
)
def test_the_median_of_a_repeated_measurement_lies_in_the_interval(
    n_processes: int, widest: float
) -> None:
    generator = np.random.default_rng(4)
    inside, widths = [], []
    for noise in NOISES[:3]:
        for _ in range(25):
            first, again = (
                [measure(generator, noise, speed, latency) for latency in np.geomspace(0.1, 10, 8)]
                for speed in (machine(generator, noise, n_processes) for _ in range(2))
            )
            intervals = latency_intervals({str(i): samples for i, samples in enumerate(first)})
            for (low, high), repeated in zip(intervals.values(), again, strict=True):
                inside.append(low <= np.median(repeated["latency_ms"]) <= high)
                widths.append(high / low)
    assert np.mean(inside) >= 0.93
    assert np.median(widths) < widest


def test_the_interval_of_a_latency_has_the_noise_of_two_measurements() -> None:
    """One process without spread in its samples: only the typical spread and drift remain."""
    low, high = latency_intervals({"a": {"latency_ms": np.ones(9)}})["a"]
    noise = (0.014**2 + 0.02**2) ** 0.5
    df = noise**4 / ((0.014**4 + 0.02**4) / 2)
    assert log(high / low) / 2 == pytest.approx(student_t(0.95, df) * noise * 2**0.5)


def test_pooling_narrows_intervals_and_an_unsteady_configuration_keeps_its_own() -> None:
    generator = np.random.default_rng(5)
    noise, speed = Noise(process=0.01, slow_processes=0, drift=0), np.zeros((3, 4))
    samples = {str(i): measure(generator, noise, speed) for i in range(20)}
    samples["unsteady"] = measure(generator, Noise(process=0.2, slow_processes=0), speed)
    found = latency_intervals(samples)
    alone = latency_intervals({"0": samples["0"]})
    width, wide, alone_width = (
        log(x[1] / x[0]) for x in (found["0"], found["unsteady"], alone["0"])
    )
    assert width < alone_width
    assert wide > 2 * width
    assert latency_intervals({}) == latency_intervals({"a": {}}) == {}


def test_the_analysis_of_variance_separates_common_from_specific_noise() -> None:
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
    assert [found.specific.df, found.common.df] == pytest.approx([29 * 49, 29])
    few = [{name: values[:3] for name, values in one.items()} for one in samples]
    two = spreads_of(few[:2])
    ratios = np.log(few[0]["latency_ms"] / few[1]["latency_ms"])
    assert two.specific.sd == pytest.approx(ratios.std(ddof=1) / 2**0.5)
    one = spreads_of(few[:1])
    total = np.std((common[:, 0] + private[:, 0])[:3], ddof=1)
    assert one.specific.sd == pytest.approx(total)
    assert one.own[0] == pytest.approx(total)
    assert one.common == spreads_of([{"latency_ms": np.ones(5)}]).specific == Spread(0.0, 0.0)
    assert Spread(0.0, 0.0).moderated(0.014) == Spread(0.014, 2.0)


@pytest.mark.parametrize(("n_processes", "widens"), [(3, True), (8, False)])
def test_a_process_that_is_slow_throughout_does_not_widen_the_interval_of_a_median_of_many(
    n_processes: int, widens: bool
) -> None:
    generator = np.random.default_rng(8)
    noise, speed = Noise(process=0.01, slow_processes=0, drift=0), np.zeros((n_processes, 4))
    samples = [measure(generator, noise, speed) for _ in range(10)]
    steady = spreads_of(samples)
    for one in samples[:4]:
        one["latency_ms"][one["process"] == 1] *= 1.3
    disturbed = spreads_of(samples)
    assert (disturbed.specific.sd > 3 * steady.specific.sd) == widens
    assert (disturbed.own[0] > 3 * steady.specific.sd) == widens


def test_draws_of_latencies_share_the_common_part() -> None:
    generator = np.random.default_rng(7)
    speed = 0.1 * generator.normal(size=(5, 1)) + np.zeros((5, 4))
    samples = [measure(generator, Noise(process=0.005, slow_processes=0), speed) for _ in range(8)]
    draws = latency_draws([*samples, None], np.arange(1.0, 10.0), 4000, generator)
    assert draws.shape == (9, 4000)
    assert np.exp(np.median(draws, axis=1)) == pytest.approx(np.arange(1.0, 10.0), rel=0.02)
    alone, ratio = (np.ptp(central_interval(x)) for x in (draws[0], draws[0] - draws[1]))
    assert ratio < 0.3 * alone


def test_resampled_medians_and_means_are_those_of_the_repeated_samples() -> None:
    generator = np.random.default_rng(8)
    values = generator.choice([*generator.random(30), np.inf], 41)
    clusters = cluster_numbers(generator.integers(0, 6, (41, 1)) * 10, 41)
    weights = resample_weights(clusters, 50, generator)
    repeated = [np.repeat(values, column) for column in weights.T]
    assert weighted_medians(values, weights).tolist() == [float(np.median(x)) for x in repeated]
    assert weighted_means(values, weights) == pytest.approx([float(np.mean(x)) for x in repeated])
    for cluster in range(6):
        assert (np.ptp(weights[clusters[:, 0] == cluster], axis=0) == 0).all()
    assert weights.sum(axis=0).min() > 0


def test_without_two_regions_each_sample_is_its_own_cluster() -> None:
    for regions in (None, np.zeros((5, 1), dtype=int), np.zeros((4, 1), dtype=int)):
        assert cluster_numbers(regions, 5).tolist() == [[0], [1], [2], [3], [4]]


def test_a_load_on_the_same_region_in_every_sample_is_no_cluster() -> None:
    pressures = np.tile(np.arange(3), (5, 1))
    assert cluster_numbers(pressures, 5).tolist() == [[0], [1], [2], [3], [4]]
    with_forces = np.column_stack([pressures, [9, 7, 7, 9, 8]])
    assert cluster_numbers(with_forces, 5).tolist() == [[2], [0], [0], [2], [1]]
    errors = np.random.default_rng(0).random(40)
    weights = resample_weights(
        cluster_numbers(np.tile(np.arange(3), (40, 1)), 40), 100, np.random.default_rng(1)
    )
    assert np.ptp(weighted_medians(errors, weights)) > 0.05


def coverage_of_regions(effect: float, k: int, by_region: bool, n_regions: int = 13) -> float:
    """Return the share of simulated test sets whose interval contains the median over all regions.

    Errors vary by region and by sample; each sample has k regions.
    """
    generator = np.random.default_rng(9)
    inside = []
    for _ in range(150):
        regions = np.array([generator.choice(n_regions, k, replace=False) for _ in range(300)])
        means = effect * generator.normal(size=n_regions)
        errors = np.exp(means[regions].sum(axis=1) + 0.3 * generator.normal(size=300))
        clusters = cluster_numbers(regions if by_region else None, 300)
        median, count = float(np.median(errors)), int(clusters.max()) + 1
        draws = weighted_medians(errors, resample_weights(clusters, 200, generator))
        stretched = widen(draws, median, widening(count), (errors.min(), errors.max()))
        low, high = central_interval(stretched)
        inside.append(low <= 1.0 <= high)
    return float(np.mean(inside))


@pytest.mark.parametrize("k", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_resampling_regions_covers_the_truth_and_resampling_samples_does_not(k: int) -> None:
    assert coverage_of_regions(0.3, k, by_region=True) >= 0.9
    assert coverage_of_regions(0.3, k, by_region=False) < 0.7


def test_the_interval_of_a_seed_is_a_t_interval_on_the_logarithm() -> None:
    low, high = seed_interval([1.0, exp(1.0), exp(2.0)])
    half = 4.302653 * (1 + 1 / 3) ** 0.5  # t with two degrees of freedom; deviation 1 about 1
    assert (log(low), log(high)) == pytest.approx((1 - half, 1 + half))
    assert seed_interval([1.0, exp(1.0), exp(2.0), np.inf]) == pytest.approx((low, np.inf))
    assert seed_interval([1.0]) == seed_interval([1.0, np.inf]) == (0.0, np.inf)
    assert coverage_of_seeds(3, 0.2, 2000, np.random.default_rng(0)) == pytest.approx(
        0.95, abs=0.015
    )


@pytest.mark.parametrize(
    "setting", [Setting(3, 13, 0.05, samples=100), Setting(10, 40, 0.3, samples=100)]
)
def test_the_interval_of_a_trained_method_covers_another_training(setting: Setting) -> None:
    assert min(coverage(setting, 100, 200, np.random.default_rng(0))) >= 0.93


def test_draws_of_errors_hold_trainings_and_regions() -> None:
    generator = np.random.default_rng(0)
    errors = np.exp(0.1 * generator.normal(size=(3, 200)))
    weights = resample_weights(cluster_numbers(None, 200), 4000, generator)

    def ends(trainings: NDArray[np.float64]) -> tuple[float, float]:
        draws = error_draws(trainings, weights, 1.0, weighted_medians, generator)
        return central_interval(draws)

    same = errors[[0, 0, 0]]  # seeds without scatter: only the regions vary
    assert ends(same) == pytest.approx(ends(errors[:1]))
    apart = ends(errors[[0, 0, 0]] * np.array([0.5, 1.0, 2.0])[:, None])
    assert apart == pytest.approx(seed_interval([0.5, 1.0, 2.0]), rel=0.15)
    lost = np.full((1, 200), np.inf)
    assert ends(np.concatenate([errors, lost]))[1] == np.inf
    assert ends(lost) == (np.inf, np.inf)


def test_widening_follows_student_and_stays_within_bounds() -> None:
    assert widening(13) == pytest.approx((13 / 12) ** 0.5 * 2.1788 / 1.95996, rel=1e-4)
    assert widening(10_000) == pytest.approx(1, abs=1e-3)
    draws = np.array([0.5, 1.0, 2.0, 0.0, np.inf])
    assert widen(draws, 1.0, 2.0, (0.3, 3.0)).tolist() == [0.3, 1.0, 3.0, 0.0, np.inf]
    assert widen(draws, np.inf, 2.0, (0.3, 3.0)) is draws
    assert central_interval(np.arange(1.0, 1001.0)) == (26, 975)
    assert central_interval(np.append(np.arange(1.0, 971.0), np.full(30, np.inf))) == (26, np.inf)
