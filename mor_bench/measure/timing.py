"""The raw timing of one configuration, its reliability and its summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import cpu_count
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mor_bench.sandbox.process import MethodFailedError

BATCHES = (8, 64, 512)
"""Sizes of the batches whose throughput is measured."""

OTHERS_CORES, OTHERS_SHARE = 0.2, 0.1
"""Cores that other processes may use before a timing counts as disturbed.

The second number is the share of all cores; the larger of the two limits holds.
"""

LEAST_CORES, MOST_CORES = 0.9, 1.2
"""Lowest and highest number of cores that a single-threaded process may have used."""

MOST_SPREAD = 0.1
"""Relative spread of the medians of rounds, or of processes, above which a timing is unstable."""

SAME_SPEED = 0.1
"""Relative change of the machine's speed below which an earlier timing is reused."""

ERROR_FACTOR, ERROR_ADDEND = 2.0, 1e-6
"""Relative and absolute tolerance between the median error while timed and the scored one.

A solve that starts at the previous answer need not end where a single one does.
"""


@dataclass
class Timing:
    """Raw measurements of one configuration.

    Attributes
    ----------
    latency_ms, gc_ms : list of float
        Wall time of each query, and the garbage collector's part of it, in the order of
        measurement.
    process, round : list of int
        The replicate and the round in which each query was measured.
    all_threads_ms : list of float
        Latencies on all cores, one turn per process.
    throughput : dict
        Queries per second by batch size.
    memory_bytes : int
        Peak resident memory with the model loaded and single queries answered.
    used : list of (3,) float
        Wall time of each turn, its own processor time, and that of all other processes, s.
    failed : str or None
        Reason why there is no timing.
    probe_s : float
        The machine's `probe_s` at the time of measurement.
    checked : list of (int, float)
        Number of the query and relative l2 error of each checked answer.
    """

    latency_ms: list[float] = field(default_factory=list)
    gc_ms: list[float] = field(default_factory=list)
    process: list[int] = field(default_factory=list)
    round: list[int] = field(default_factory=list)
    all_threads_ms: list[float] = field(default_factory=list)
    throughput: dict[str, float | None] = field(default_factory=dict)
    memory_bytes: int = 0
    used: list[tuple[float, float, float]] = field(default_factory=list)
    failed: str | None = None
    probe_s: float = 0.0
    checked: list[tuple[int, float]] = field(default_factory=list)

    def holds(self, probe_s: float) -> bool:
        """Return whether the machine is as fast as at the time of measurement."""
        return abs(probe_s / self.probe_s - 1) < SAME_SPEED

    @property
    def samples(self) -> dict[str, NDArray[Any]]:
        """The raw samples as arrays."""
        names = ("latency_ms", "gc_ms", "process", "round", "all_threads_ms", "used")
        return {name: np.asarray(getattr(self, name)) for name in names}

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """All cached data as arrays; NaN stands for a batch that was too slow."""
        rates = [self.throughput.get(str(size)) for size in BATCHES]
        return {
            **self.samples,
            "throughput": np.array([np.nan if rate is None else rate for rate in rates]),
            "memory_bytes": np.array(self.memory_bytes),
            "probe_s": np.array(self.probe_s),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Restore a timing from its `arrays`."""
        names = ("latency_ms", "gc_ms", "process", "round", "all_threads_ms")
        return cls(
            **{name: arrays[name].tolist() for name in names},
            throughput={
                str(size): None if np.isnan(rate) else float(rate)
                for size, rate in zip(BATCHES, arrays["throughput"], strict=True)
            },
            memory_bytes=int(arrays["memory_bytes"]),
            used=[(wall, own, others) for wall, own, others in arrays["used"].tolist()],
            probe_s=float(arrays["probe_s"]),
        )


def why_unstable(timing: Timing, threads: int) -> list[str]:
    """Return the reasons why a timing should not be relied on; none if it can be."""
    reasons = []
    wall, own, others = np.sum(timing.used, axis=0)
    if others / wall > max(OTHERS_CORES, OTHERS_SHARE * (cpu_count() or 1)):
        reasons.append(f"other processes used about {others / wall:.1f} cores meanwhile")
    if threads == 1 and own / wall < LEAST_CORES:
        reasons.append(f"its process had {own / wall:.0%} of a core")
    if threads == 1 and own / wall > MOST_CORES:
        reasons.append(f"it used {own / wall:.1f} cores though pinned to one")
    samples = timing.samples
    for name, groups in (
        ("rounds", samples["process"] * (samples["round"].max() + 1) + samples["round"]),
        ("processes", samples["process"]),
    ):
        medians = [
            float(np.median(samples["latency_ms"][groups == group])) for group in np.unique(groups)
        ]
        spread = _relative_spread(medians)
        if spread > MOST_SPREAD:
            reasons.append(f"medians of {len(medians)} {name} spread by {spread:.0%}")
    return reasons


def _relative_spread(medians: Sequence[float]) -> float:
    """Return half the interquartile range over the median.

    For fewer than four values it is half the range over the mean.
    """
    if len(medians) < 4:
        return (max(medians) - min(medians)) / (2 * float(np.mean(medians)))
    low, middle, high = np.percentile(medians, [25, 50, 75])
    return float((high - low) / (2 * middle))


def check_answers(timing: Timing, scored: NDArray[np.float64]) -> None:
    """Raise `MethodFailedError` if a method answers worse while timed than when scored.

    Parameters
    ----------
    timing : Timing
    scored : (n_queries,) float64
        Relative l2 error of each query when the method was scored.
    """
    if not timing.checked:
        return
    numbers, errors = (np.array(column) for column in zip(*timing.checked, strict=True))
    then, now = float(np.median(scored[numbers.astype(int)])), float(np.median(errors))
    if now > ERROR_FACTOR * then + ERROR_ADDEND:
        raise MethodFailedError(
            f"during timing, the median relative l2 error is {now:.3g}; the scored error "
            f"on the same loads is {then:.3g}"
        )


def timing_summary(timing: Timing, interval: tuple[float, float], threads: int) -> dict[str, Any]:
    """Return the figures of a results row: `latency_ms`, `all_threads_ms`, `throughput`.

    Parameters
    ----------
    timing : Timing
    interval : (low, high)
        95 % prediction interval for the median of a rerun, ms.
    threads : int
        Threads of a single query.
    """
    latency = np.asarray(timing.latency_ms)
    reasons = why_unstable(timing, threads)
    return {
        "latency_ms": {
            "median": float(np.median(latency)),
            "p95": float(np.percentile(latency, 95)),
            "p99": float(np.percentile(latency, 99)),
            "low": interval[0],
            "high": interval[1],
            "gc": float(np.mean(timing.gc_ms)),
            "n_queries": len(latency),
            "n_processes": len(set(timing.process)),
            "stable": not reasons,
            "unstable_because": reasons,
        },
        "all_threads_ms": {"median": float(np.median(timing.all_threads_ms))},
        "throughput": timing.throughput,
    }
