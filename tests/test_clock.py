"""Timing: what is kept, what is called unstable, and what a method that fails meanwhile costs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mor_bench.measure.error_metrics import sample_errors
from mor_bench.measure.latency import (
    LEAST_QUERIES,
    LEAST_TURN_S,
    MOST_TURN_S,
    PROTOCOLS,
    Protocol,
    Queries,
    TimedMethod,
    groups_that_fit,
    measure_latencies,
    probe_s,
)
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.measure.timing import (
    BATCHES,
    Timing,
    check_answers,
    timing_summary,
    why_unstable,
)
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess
from mor_bench.snapshots.dataset import Dataset
from tests.third_party import Slowed


def timing(latencies: list[float], others: float = 0.0, own: float = 1.0) -> Timing:
    """Two processes of five rounds with 20 queries each, of given medians."""
    times = np.repeat(np.resize(latencies, 10), 20).tolist()
    where = np.repeat(np.arange(10), 20)
    return Timing(
        times,
        [0.01] * 200,
        (where // 5).tolist(),
        (where % 5).tolist(),
        [2.0] * 20,
        dict.fromkeys(map(str, BATCHES), 100.0),
        10**8,
        [(0.1, 0.1 * own, 0.1 * others)] * 10,
    )


def test_a_quiet_timing_is_stable_and_a_disturbed_one_is_not() -> None:
    assert why_unstable(timing([1.0, 1.01]), 1) == []
    assert why_unstable(timing([1.0], others=1.0), 1) == [
        "other processes used about 1.0 cores meanwhile"
    ]
    assert why_unstable(timing([1.0], own=0.5), 1) == ["its process had 50% of a core"]
    assert why_unstable(timing([1.0], own=0.5), 2) == []
    assert why_unstable(timing([1.0], own=1.9), 1) == ["it used 1.9 cores though pinned to one"]
    assert any("10 rounds spread" in reason for reason in why_unstable(timing([1.0, 1.5]), 1))
    assert (
        why_unstable(timing([1.0] * 5 + [1.5] * 5), 1)[-1] == "medians of 2 processes spread by 20%"
    )


def test_a_summary_says_all_of_it() -> None:
    latency = timing_summary(timing([1.0, 1.01]), (0.9, 1.1), 1)["latency_ms"]
    assert latency["low"] < latency["median"] < latency["high"]
    assert (latency["n_queries"], latency["n_processes"], latency["stable"], latency["gc"]) == (
        200,
        2,
        True,
        pytest.approx(0.01),
    )


def test_a_timing_comes_back_from_its_arrays() -> None:
    kept = timing([1.0, 2.0])
    kept.throughput["512"] = None
    kept.checked = [(3, 0.1)]
    kept.probe_s = 0.5
    again = Timing.from_arrays(kept.arrays)
    assert replace(again, checked=kept.checked) == kept
    assert again.holds(0.51)
    assert not again.holds(0.6)


def test_the_probe_takes_a_moment() -> None:
    assert 1e-5 < probe_s() < 5.0


def test_groups_fit_into_memory() -> None:
    from psutil import virtual_memory

    half = 0.5 * virtual_memory().available
    openers = {
        name: TimedMethod(lambda fork_server: pytest.fail("not opened"), size * half)
        for name, size in (("a", 0.3), ("b", 0.3), ("c", 0.9), ("d", 5.0))
    }
    assert groups_that_fit(openers) == [["a", "b"], ["c"], ["d"]]


def opened(
    tiny: Dataset,
    surrogate: str,
    parameters: dict[str, object],
    folder: Path,
    fork_server: ForkServer | None,
) -> SandboxedProcess:
    worker = SandboxedProcess(MethodSession, fork_server=fork_server, scene=tiny.scene)
    worker.ask(
        "fit",
        60.0,
        request=FitRequest(surrogate, parameters, folder, folder / "model.safetensors", 1, 60.0),
    )
    return worker


def test_configurations_are_timed_in_turn_and_fail_alone(tiny: Dataset, tmp_path: Path) -> None:
    def dead(fork_server: ForkServer | None) -> SandboxedProcess:
        raise MethodFailedError("it does not open")

    queries = Queries(tiny.test.forces, tiny.test.displacements, tiny.scene.output_nodes, tmp_path)
    openers = {
        "plain": TimedMethod(partial(opened, tiny, "tests.third_party:Slowed", {}, tmp_path), 1e8),
        "slow": TimedMethod(
            partial(opened, tiny, "tests.third_party:Slowed", {"part": 4.0}, tmp_path), 1e8
        ),
        "broken": TimedMethod(
            partial(opened, tiny, "tests.third_party:Broken", {"how": "crash"}, tmp_path), 1e8
        ),
        "dead": TimedMethod(dead, 1e8),
    }
    turns: list[int] = []
    timings = measure_latencies(
        openers, queries, PROTOCOLS["quick"], 1, lambda done, total: turns.append(done)
    )
    assert timings["dead"].failed == "it does not open"
    assert "crashed with ZeroDivisionError" in str(timings["broken"].failed)
    for name in ("plain", "slow"):
        samples = timings[name].samples
        assert (
            len(samples["latency_ms"]) >= LEAST_QUERIES or samples["used"][:, 0].max() > MOST_TURN_S
        )
        assert {tuple(pair) for pair in zip(samples["process"], samples["round"], strict=True)} == {
            (p, r) for p in range(2) for r in range(5)
        }
        assert samples["used"][:, 0].min() >= LEAST_TURN_S
        assert len(samples["all_threads_ms"]) >= 2
        assert set(timings[name].throughput) == {"8", "64", "512"}
        assert timings[name].memory_bytes > 5e7
    assert np.median(timings["slow"].latency_ms) > 2 * np.median(timings["plain"].latency_ms)
    assert turns == sorted(turns)


def test_answers_that_are_worse_while_timed_than_when_scored_are_found(
    tiny: Dataset, tmp_path: Path
) -> None:
    queries = Queries(tiny.test.forces, tiny.test.displacements, tiny.scene.output_nodes, tmp_path)
    honest = TimedMethod(partial(opened, tiny, "tests.third_party:Slowed", {}, tmp_path), 1e8)
    zero = TimedMethod(partial(opened, tiny, "tests.third_party:Zero", {}, tmp_path), 1e8)
    timings = measure_latencies(
        {"honest": honest, "zero": zero}, queries, Protocol(1, 2, all_cores=False), 1
    )
    scored = sample_errors(
        Slowed().fit(tiny.scene, None).predict(queries.forces), queries.references
    ).relative_l2
    assert 0 < np.median(scored) < 1e-4
    check_answers(timings["honest"], scored)
    with pytest.raises(
        MethodFailedError,
        match=r"median relative l2 error is 1 while it is timed, on loads on which it was scored with \S+e-",
    ):
        check_answers(timings["zero"], scored)
