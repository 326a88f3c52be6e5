"""Latency of single queries, threads pinned, every raw sample kept."""

from __future__ import annotations

import gc
import os
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

N_QUERIES = 200
"""Queries that are timed, on different loads where the test set has as many."""

N_WARM_UP = 20
MAX_SECONDS = 10.0
"""A method so slow that its queries take longer than this is timed on fewer, but never on fewer than MIN_QUERIES."""

MIN_QUERIES = 20


@contextmanager
def pinned_threads(threads: int) -> Iterator[None]:
    """Limit BLAS, OpenMP and, where it is loaded, torch to a number of threads."""
    torch: Any = sys.modules.get("torch")
    before = torch.get_num_threads() if torch else None
    with threadpool_limits(threads):
        if torch:
            torch.set_num_threads(threads)
        try:
            yield
        finally:
            if torch:
                torch.set_num_threads(before)


def measure_latency(predict: Callable[[NDArray[np.float64]], Any], queries: NDArray[np.float64]) -> NDArray[np.float64]:
    """Wall time of single predictions.

    Parameters
    ----------
    predict : callable
        From (n_nodes, 3) forces to displacements on the host, so that pre- and post-processing are inside the clock.
    queries : (n, n_nodes, 3) float64
        Loads, taken in turn.

    Returns
    -------
    (n_timed,) float64
        ms, in the order of measurement; the warm-up is not among them. The garbage collector is off meanwhile.
    """
    times: list[float] = []
    start = perf_counter()
    for i in range(N_WARM_UP):
        predict(queries[-1 - i % len(queries)])
        if perf_counter() - start > MAX_SECONDS / 4:
            break
    collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        start = perf_counter()
        for i in range(N_QUERIES):
            query = queries[i % len(queries)]
            before = perf_counter()
            predict(query)
            after = perf_counter()
            times.append(1e3 * (after - before))
            if after - start > MAX_SECONDS and len(times) >= MIN_QUERIES:
                break
    finally:
        if collecting:
            gc.enable()
    return np.array(times)


def latency_summary(samples_ms: NDArray[np.float64]) -> dict[str, float]:
    """Median, 95th and 99th percentile, ms."""
    return {"median": float(np.median(samples_ms)), "p95": float(np.percentile(samples_ms, 95)), "p99": float(np.percentile(samples_ms, 99))}


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def describe_machine() -> dict[str, Any]:
    """Processor, cores, system and the versions that timings depend on."""
    versions = {}
    for package in ("mor-bench", "numpy", "scipy", "numba", "scikit-learn", "torch"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "processor": _processor(),
        "cores": os.cpu_count() or 1,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "versions": versions,
    }
