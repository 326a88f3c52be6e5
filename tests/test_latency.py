"""Latency: the contents of a timing, its stability, and configurations timed in turns."""

from __future__ import annotations

import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from mor_bench.machine import free_memory_bytes
from mor_bench.measure import latency
from mor_bench.measure.latency import (
    LEAST_TURN_S,
    Protocol,
    Queries,
    TimedMethod,
    groups_that_fit,
    measure_latencies,
    probe_s,
)
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.measure.timing import BATCHES, Timing, check_answers, timing_summary, why_unstable
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess
from mor_bench.snapshots.dataset import Dataset
from tests.timed_methods import timed_method


def timing(medians: list[float], others: float = 0.0, own: float = 1.0) -> Timing:
    """Two processes of five rounds with 20 queries each; the medians repeat over the rounds."""
    rounds = np.repeat(np.arange(10), 20)
    return Timing(
        latency_ms=np.resize(medians, 10)[rounds].tolist(),
        gc_ms=[0.01] * 200,
        process=(rounds // 5).tolist(),
        round=(rounds % 5).tolist(),
        all_threads_ms=[2.0] * 20,
        throughput=dict.fromkeys(map(str, BATCHES), 100.0),
        memory_bytes=10**8,
        used=[(0.1, 0.1 * own, 0.1 * others)] * 10,
    )


QUIET = timing([1.0, 1.01])


@pytest.mark.parametrize(
    ("found", "threads", "reasons"),
    [
        (QUIET, 1, []),
        (timing([1.0], others=1.0), 1, ["other processes used about 1.0 cores meanwhile"]),
        (timing([1.0], own=0.5), 1, ["its process had 50% of a core"]),
        (timing([1.0], own=0.5), 2, []),
        (timing([1.0], own=1.9), 1, ["it used 1.9 cores though pinned to one"]),
        (timing([1.0, 1.5, 1.0, 1.5, 1.25]), 1, ["medians of 10 rounds spread by 20%"]),
        (
            timing([1.0] * 5 + [1.5] * 5),
            1,
            ["medians of 10 rounds spread by 20%", "medians of 2 processes spread by 20%"],
        ),
    ],
)
def test_a_timing_reports_why_it_is_unstable(
    found: Timing, threads: int, reasons: list[str]
) -> None:
    assert why_unstable(found, threads) == reasons
    summary = timing_summary(found, (0.9, 1.1), threads)["latency_ms"]
    assert (summary["stable"], summary["unstable_because"]) == (not reasons, reasons)


def test_a_summary_holds_the_percentiles_and_the_interval() -> None:
    summary = timing_summary(QUIET, (0.9, 1.1), 1)
    found = summary["latency_ms"]
    assert (found["low"], found["high"]) == (0.9, 1.1)
    assert (found["median"], found["p95"], found["p99"]) == pytest.approx((1.005, 1.01, 1.01))
    assert (found["n_queries"], found["n_processes"]) == (200, 2)
    assert found["gc"] == pytest.approx(0.01)
    assert summary["all_threads_ms"] == {"median": 2.0}


def test_a_timing_can_be_restored_from_its_arrays() -> None:
    kept = timing([1.0, 2.0])
    kept.throughput["512"] = None
    kept.checked = [(3, 0.1)]
    kept.probe_s = 0.5
    again = Timing.from_arrays(kept.arrays)
    assert replace(again, checked=kept.checked) == kept
    assert again.holds(0.51)
    assert not again.holds(0.6)


def test_the_speed_probe_of_the_machine_is_short() -> None:
    assert 1e-5 < probe_s() < 5.0


def test_a_group_of_methods_fits_into_half_of_the_free_memory() -> None:
    half = 0.5 * free_memory_bytes()
    methods = {
        name: TimedMethod(lambda _: pytest.fail("not opened"), size * half)
        for name, size in (("a", 0.3), ("b", 0.3), ("c", 0.9), ("d", 5.0))
    }
    assert groups_that_fit(methods) == [["a", "b"], ["c"], ["d"]]


def timed(tiny: Dataset, folder: Path, name: str, **parameters: object) -> TimedMethod:
    return timed_method(tiny.scene, folder, f"tests.third_party:{name}", parameters)


@pytest.fixture
def queries(tiny: Dataset, tmp_path: Path) -> Queries:
    test = tiny.test[:20]
    return Queries(test.forces, test.displacements, tiny.scene.output_nodes, tmp_path)


def test_configurations_are_timed_in_turns_and_fail_alone(
    tiny: Dataset, queries: Queries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dead(server: ForkServer | None) -> SandboxedProcess:
        raise MethodFailedError("it does not open")

    monkeypatch.setattr(latency, "LEAST_QUERIES", 20)
    monkeypatch.setattr(latency, "BATCH_S", 0.01)
    methods = {
        "plain": timed(tiny, tmp_path, "Slowed"),
        "slow": timed(tiny, tmp_path, "Slowed", part=4.0),
        "broken": timed(tiny, tmp_path, "Broken", how="crash"),
        "dead": TimedMethod(dead, 1e8),
    }
    turns: list[int] = []
    timings = measure_latencies(
        methods, queries, Protocol(2, 2), 1, lambda done, total: turns.append(done)
    )
    assert timings["dead"].failed == "it does not open"
    assert "crashed with ZeroDivisionError" in str(timings["broken"].failed)
    for name in ("plain", "slow"):
        found = timings[name]
        assert found.failed is None
        assert len(found.latency_ms) >= 4 * 5
        assert set(zip(found.process, found.round, strict=True)) == {
            (process, number) for process in range(2) for number in range(2)
        }
        assert min(wall for wall, _, _ in found.used) >= LEAST_TURN_S
        assert len(found.all_threads_ms) >= 2
        assert set(found.throughput) == {"8", "64", "512"}
        assert found.memory_bytes > 5e7
    assert np.median(timings["slow"].latency_ms) > 2 * np.median(timings["plain"].latency_ms)
    assert turns == sorted(turns)


@pytest.mark.skipif(sys.platform == "win32", reason="sends itself SIGINT")
def test_an_interrupt_while_workers_open_ends_them(
    tiny: Dataset, queries: Queries, tmp_path: Path
) -> None:
    limit_s, opening = 60.0, []
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def hanging(server: ForkServer | None) -> SandboxedProcess:
        process = SandboxedProcess(MethodSession, fork_server=server, scene=tiny.scene)
        opening.append(process.pid)
        how = {"how": "hang"}
        request = FitRequest("tests.third_party:Broken", how, tmp_path, tmp_path / "m", 1, limit_s)
        process.ask("fit", limit_s, request=request)
        return process

    def interrupt() -> None:
        while not opening:
            time.sleep(0.05)
        # Linux may deliver a signal of the terminal to any thread.
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)

    began = time.monotonic()
    threading.Thread(target=interrupt, daemon=True).start()
    methods = {name: TimedMethod(hanging, 1e8) for name in ("a", "b", "c")}
    try:
        with pytest.raises(KeyboardInterrupt):
            measure_latencies(methods, queries, Protocol(1, 2), 1)
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - began < limit_s, "it waited for the workers"
    assert opening
    until = time.monotonic() + 10.0
    while any(map(psutil.pid_exists, opening)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(psutil.pid_exists, opening))


@pytest.mark.slow
def test_predictions_that_are_worse_while_timed_are_found(
    tiny: Dataset, queries: Queries, tmp_path: Path
) -> None:
    methods = {
        "honest": timed(tiny, tmp_path, "Slowed"),
        "zero": timed(tiny, tmp_path, "Zero"),
    }
    timings = measure_latencies(methods, queries, Protocol(1, 2, all_cores=False), 1)
    scored = np.full(len(queries.forces), 1e-5)
    assert timings["honest"].checked
    check_answers(timings["honest"], scored)
    with pytest.raises(MethodFailedError, match="error is 1; the scored error on the same loads"):
        check_answers(timings["zero"], scored)
