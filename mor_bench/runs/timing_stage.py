"""The timing stage: time all configurations of a dataset side by side."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mor_bench.analysis.latency_intervals import latency_intervals
from mor_bench.measure.latency import (
    PROTOCOLS,
    Queries,
    TimedMethod,
    measure_latencies,
    probe_s,
)
from mor_bench.measure.timing import Timing, check_answers, timing_summary
from mor_bench.results.parts import Memory
from mor_bench.results.row import AllThreadsLatency, Latency, Row
from mor_bench.runs.cached_fit import CachedFit
from mor_bench.runs.code_digest import measuring_digest
from mor_bench.runs.extra_stages import Stage
from mor_bench.sandbox.process import MethodFailedError

MOST_QUERY_BYTES, LEAST_LOADS = 2**26, 200
"""Most memory of the test loads that are timed, bytes, and the number that is always timed."""


class StopRunError(Exception):
    """A row failed, and the run shall stop at the first failure."""


def time_configurations(stage: Stage, fits: Mapping[str, CachedFit]) -> None:
    """Time configurations that have no timing at this machine's present speed; complete the rows.

    Raises
    ------
    StopRunError
        If a timing failed and the run shall stop at the first failure.
    """
    speed = probe_s()
    name = _timing_name(stage)
    kept = {} if stage.context.options.retime else _kept_timings(fits, name, speed)
    fresh = _measured(stage, {label: fit for label, fit in fits.items() if label not in kept})
    for label, timing in fresh.items():
        if not timing.failed:
            timing.probe_s = speed
            fits[label].keep_arrays(name, timing.arrays)
    timings = kept | fresh
    succeeded = {label: timing for label, timing in timings.items() if not timing.failed}
    intervals = latency_intervals({label: timing.samples for label, timing in succeeded.items()})
    for label in fits:
        row, timing = stage.row(label), timings[label]
        if timing.failed:
            stage.comparison.put(row.with_parts(status="failed", reason=timing.failed))
        else:
            stage.comparison.put(_timed_row(row, timing, intervals[label]))
            stage.comparison.add_samples(row, timing.samples)
    for label in fits:
        stage.context.listener.finished(stage.row(label))
    if stage.context.options.fail_fast and len(succeeded) < len(timings):
        raise StopRunError


def _timing_name(stage: Stage) -> str:
    protocol = PROTOCOLS[stage.context.options.profile]
    digest = f"{measuring_digest()}-{stage.training_data.sets['test'].digest[:12]}"
    threads = stage.environment.threads
    return f"timing-{protocol.processes}x{protocol.rounds}-{threads}-{digest}"


def _kept_timings(fits: Mapping[str, CachedFit], name: str, speed: float) -> dict[str, Timing]:
    kept = {label: fit.arrays(name) for label, fit in fits.items()}
    timings = {label: Timing.from_arrays(arrays) for label, arrays in kept.items() if arrays}
    return {label: timing for label, timing in timings.items() if timing.holds(speed)}


def _measured(stage: Stage, fits: Mapping[str, CachedFit]) -> dict[str, Timing]:
    """Time configurations in fresh processes; fail those with larger errors than when scored."""
    budget_s = stage.context.budget.seconds
    methods = {
        label: TimedMethod(partial(fit.open_worker, budget_s), fit.fitted.fit_memory_bytes)
        for label, fit in fits.items()
    }
    test = stage.training_data.sets["test"]
    chosen = timed_numbers(test.references)
    asked, scratch = test.queries(chosen), stage.training_data.scratch
    queries = Queries(
        test.forces[chosen], test.references[chosen], test.nodes, scratch, asked["parameters"]
    )
    timings = measure_latencies(
        methods,
        queries,
        PROTOCOLS[stage.context.options.profile],
        stage.environment.threads,
        partial(stage.context.listener.timing, stage.spec.name),
    )
    for label, timing in timings.items():
        scored = stage.comparison.samples(stage.row(label))["relative_l2"][chosen]
        try:
            check_answers(timing, scored)
        except MethodFailedError as error:
            timing.failed = timing.failed or str(error)
    return timings


def timed_numbers(references: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the numbers of the test loads that are timed, in the order of their displacements.

    If the loads take too much memory, the numbers are spread evenly over the sizes of the
    displacements, on which the work of a query depends.

    Parameters
    ----------
    references : (n, n_nodes, 3) float64
        Reference displacements, m.
    """
    n, bytes_of_one = len(references), references[0].nbytes
    wanted = min(n, max(LEAST_LOADS, MOST_QUERY_BYTES // bytes_of_one))
    by_size = np.argsort(np.linalg.norm(references, axis=(1, 2)))
    return np.asarray(by_size[np.linspace(0, n - 1, wanted).round().astype(int)])


def _timed_row(row: Row, timing: Timing, interval: tuple[float, float]) -> Row:
    figures = timing_summary(timing, interval, row.threads)
    assert row.memory_bytes is not None
    return row.with_parts(
        latency_ms=Latency(**figures["latency_ms"]),
        all_threads_ms=AllThreadsLatency(**figures["all_threads_ms"]),
        throughput=figures["throughput"],
        memory_bytes=Memory(fit=row.memory_bytes.fit, predict=timing.memory_bytes),
    )
