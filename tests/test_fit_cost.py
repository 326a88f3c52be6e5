"""The cost of a fit: core-seconds beside wall time, and no compilation."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from threading import Thread
from time import perf_counter, sleep, thread_time
from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.event import Event, EventStatus
from numpy.typing import NDArray

from mor_bench.compile_clock import CompileClock
from mor_bench.measure.fit_clock import fit_clock
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.snapshots.generate import generate, generation_seconds, n_samples_to_generate
from mor_bench.specs import load_generated_spec
from tests.synthetic import a_row

BUSY_S = 0.1


def busy() -> None:
    """Use one core for `BUSY_S` of processor time."""
    until = thread_time() + BUSY_S
    while thread_time() < until:
        pass


def test_core_seconds_count_threads_and_ended_children_but_no_waiting() -> None:
    with fit_clock() as waiting:
        sleep(BUSY_S)
    assert waiting.core_s < 0.5 * waiting.wall_s
    threads = [Thread(target=busy) for _ in range(2)]
    with fit_clock() as threaded:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert threaded.core_s >= 2 * BUSY_S
    loop = f"import time\nwhile time.process_time() < {2 * BUSY_S}: pass"
    with fit_clock() as child:
        subprocess.run([sys.executable, "-c", loop], check=True)
    assert child.core_s >= 1.9 * BUSY_S  # the times of children have a resolution of 10 ms
    assert threaded.compile_s == child.compile_s == 0.0


def test_compilation_is_part_of_neither_time() -> None:
    @njit(cache=False)
    def summed(n: int) -> int:
        total = 0
        for i in range(n):
            total += i * i
        return total

    with fit_clock() as cost:
        assert summed(4) == 14
    assert cost.compile_s > 0
    assert max(cost.wall_s, cost.core_s) < 0.5 * cost.compile_s


def test_the_clock_of_compilation_counts_nested_ones_once_and_waiting_as_wall_time_only() -> None:
    clock, event = CompileClock(), Event("numba:compile", EventStatus.START)  # type: ignore[no-untyped-call]
    clock.on_start(event)
    clock.on_start(event)
    sleep(BUSY_S)
    clock.on_end(event)
    assert clock.wall_s == 0.0
    clock.on_end(event)
    assert BUSY_S <= clock.wall_s < 2 * BUSY_S + 1.0
    assert clock.core_s < 0.5 * BUSY_S


def test_waiting_is_no_part_of_the_cost_of_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve_many, waited = FullOrderModel.solve_many, list[float]()

    def wait_and_solve(self: FullOrderModel, *arguments: Any) -> Any:
        sleep(2.0)
        waited.append(2.0)
        return solve_many(self, *arguments)

    monkeypatch.setattr(FullOrderModel, "solve_many", wait_and_solve)
    spec = load_generated_spec("beam-tiny")
    generate(spec, workers=1, cache=tmp_path)
    seconds = generation_seconds(spec, tmp_path, n_samples_to_generate(spec))
    assert seconds is not None
    assert 0 < seconds < sum(waited)


def test_compilation_is_no_part_of_the_cost_of_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve_many, took = FullOrderModel.solve_many, list[float]()

    def compile_and_solve(self: FullOrderModel, *arguments: Any) -> Any:
        @njit(cache=False)
        def summed(values: NDArray[np.float64]) -> float:
            return float(np.sort(np.linalg.inv(values.reshape(2, 2)).ravel())[0])

        begun = perf_counter()
        summed(np.array([1.0, 0.0, 0.0, 1.0]))
        took.append(perf_counter() - begun)
        return solve_many(self, *arguments)

    monkeypatch.setattr(FullOrderModel, "solve_many", compile_and_solve)
    spec = load_generated_spec("beam-tiny")
    generate(spec, workers=1, cache=tmp_path)
    seconds = generation_seconds(spec, tmp_path, n_samples_to_generate(spec))
    assert seconds is not None
    assert took
    assert seconds < sum(took)  # by far, without other work on the machine


@pytest.mark.parametrize(
    ("offline", "device", "known"),
    [
        ({"data": 3.0, "fit": 5.0, "fit_core_s": 9.0}, None, 12.0),
        ({"data": 3.0, "fit": 5.0, "fit_core_s": 9.0}, "cpu", 12.0),
        ({"data": 3.0, "fit": 5.0, "fit_core_s": 9.0}, "cuda", None),
        ({"data": 3.0, "fit": 5.0}, None, 8.0),  # a file of an earlier version
        ({"data": None, "fit": 5.0, "fit_core_s": 9.0}, None, None),
        (None, None, None),
    ],
)
def test_the_offline_cost_of_a_row_is_in_core_seconds(
    offline: dict[str, float | None] | None, device: str | None, known: float | None
) -> None:
    training = {"device": device} if device else None
    assert a_row("a", offline_s=offline, training=training).offline_core_s == known
