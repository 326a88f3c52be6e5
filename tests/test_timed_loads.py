"""Timed loads: each test load once per order, none twice, and the work of the scored loads."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.measure.timed_loads import CLASSES, MOST_CHANGE, TimedLoads
from mor_bench.runs import timing_stage
from mor_bench.runs.timing_stage import timed_numbers
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.specs import list_suite, load_dataset_spec
from tests.published.stored import content_of
from tests.verification.timed_work import MOST_DIFFERENCE, timed_loads, work_ratio

N = 100
VALUES = np.arange(1.0, N + 1)[:, None, None] * np.ones((1, 2, 3))


def test_every_order_takes_each_load_once_and_no_load_repeats() -> None:
    loads = TimedLoads(VALUES, 0)
    numbers = [loads.next() for _ in range(3 * N)]
    for start in range(0, 3 * N, N):
        assert sorted(numbers[start : start + N]) == list(range(N))
    assert numbers[:N] != numbers[N : 2 * N]
    values = np.array([loads.changed(number) for number in numbers])
    assert len(np.unique(values[:, 0, 0])) == 3 * N
    factors = (values / VALUES[numbers])[:, 0, 0]
    assert 1 - MOST_CHANGE <= factors.min() < factors.max() <= 1 + MOST_CHANGE
    assert factors.mean() == pytest.approx(1.0, abs=4 * MOST_CHANGE / (3 * 3 * N) ** 0.5)
    batch = loads.changed(np.array([0, 5, 5]))
    assert batch.shape == (3, 2, 3)
    assert batch[1, 0, 0] != batch[2, 0, 0]


def test_the_sizes_of_loads_are_spread_evenly_over_an_order() -> None:
    loads = TimedLoads(VALUES, 1)
    numbers = np.array([loads.next() for _ in range(N)])
    for some in np.array_split(numbers // (N // CLASSES), N // CLASSES):
        assert len(np.unique(some)) >= 0.7 * CLASSES  # random: 64 %; one of each class: 100 %
    few = TimedLoads(VALUES[:3], 0)
    assert sorted(few.next() for _ in range(3)) == [0, 1, 2]


def test_a_load_is_asked_as_it_is_only_once() -> None:
    loads = TimedLoads(VALUES, 0)
    first = loads.unchanged(7, 1.0)
    assert first is not None
    assert (first == VALUES[7]).all()
    assert loads.unchanged(7, 1.0) is None
    assert loads.unchanged(8, 0.0) is None


def test_the_timed_loads_of_a_large_test_set_have_all_sizes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sizes = np.random.default_rng(0).permutation(1000) + 1.0
    references = sizes[:, None, None] * np.ones((1, 4, 3))
    assert (sizes[timed_numbers(references)] == np.arange(1.0, 1001)).all()
    monkeypatch.setattr(timing_stage, "MOST_QUERY_BYTES", 400 * references[0].nbytes)
    some = timed_numbers(references)
    assert len(some) == len(set(some)) == 400
    assert sizes[some].mean() == pytest.approx(sizes.mean(), rel=0.002)
    monkeypatch.setattr(timing_stage, "MOST_QUERY_BYTES", 0)
    assert len(timed_numbers(references)) == timing_stage.LEAST_LOADS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("fem", {"tolerance": 1e-2}),
        ("fem", {"tolerance": 1e-8}),
        ("pod", {"n_modes": 10}),
        ("pod-tensor", {"n_modes": 10}),
        ("hpod", {"n_modes": 10}),
    ],
)
def test_timed_queries_have_the_work_of_the_scored_loads(
    name: str, parameters: dict[str, Any]
) -> None:
    dataset = load_dataset(load_dataset_spec("beam-tiny"))
    method = mor_bench.load_method(name, **parameters).fit(dataset.scene, dataset.train)
    ratio = work_ratio(method, dataset, timed_loads(dataset, 10 * len(dataset.test)))
    assert ratio == pytest.approx(1.0, abs=MOST_DIFFERENCE)


def test_the_stored_counts_of_work_name_every_method_that_needs_no_observations() -> None:
    found = content_of("reports/trust/timed_work_tiny.json")["difference_percent"]
    names = {label.partition(" [")[0] for label in found}
    assert names == set(list_suite("methods")) - {"gappy-pod"}
