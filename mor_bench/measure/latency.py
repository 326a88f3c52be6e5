"""Latency of fitted methods: fresh processes, interleaved rounds, every raw sample kept, unstable timings told.

All configurations of a dataset are alive at once, each in a process of its own, and answer in turn:
whatever slows the machine for a while slows all of them. That is done again in other fresh
processes, since where a process's memory happens to lie makes its every query faster or slower.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from os import cpu_count
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any, Self

import numpy as np
import psutil
from numpy.typing import NDArray

from mor_bench.errors import MorBenchError
from mor_bench.machine import pinned_threads
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.measure.method_session import MethodSession
from mor_bench.sandbox.fork_server import CAN_FORK, ForkServer
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess

BATCHES = (8, 64, 512)

LEAST_QUERIES = 200
"""Single queries of each configuration, over all processes and rounds, unless it is too slow."""

CHUNK_S = 0.03
"""A configuration's turn lasts no less than this, and no more than MOST_S where it is too slow for its queries."""

MOST_S = 1.0
BATCH_S = 0.25
MOST_BATCH_S = 5.0

ANSWER_LIMIT_S = 300.0
"""For what should take seconds: a method that hangs while it is timed is ended."""

BUSY = 0.2
"""Cores that others may use, or a tenth of all cores if that is more, before a timing counts as disturbed."""

STARVED, MORE_THAN_ONE = 0.9, 1.2
"""Part of a core that a process on one thread must have had, and may not exceed."""

SAME_ERROR = 2.0, 1e-6
"""Factor and addend by which the median error of what is answered while timed may exceed the scored one; a solve that starts at
the answer before need not end where a single one does."""

SAME_SPEED = 0.1
"""Relative change of `probe_s` from which an earlier timing is taken again."""

SPREAD = 0.1
"""Relative spread of the medians of rounds and of processes from which a timing counts as unstable."""


@dataclass(frozen=True)
class Protocol:
    """How often is measured: so many fresh processes, each with so many rounds."""

    processes: int
    rounds: int

    @property
    def queries(self) -> int:
        """Queries in a turn."""
        return -(-LEAST_QUERIES // (self.processes * self.rounds))


PROTOCOLS = {"quick": Protocol(2, 5), "full": Protocol(8, 5)}


@dataclass
class Timing:
    """What was measured of one configuration.

    Attributes
    ----------
    latency_ms, gc_ms : list of float
        Of each query in the order of measurement, and the garbage collector's part of it.
    process, round : list of int
        Where it was measured.
    all_threads_ms : list of float
        The same with all cores, one turn per process.
    throughput : dict
        Queries per second by size of the batch.
    memory_bytes : int
        Resident at most, the model loaded and single queries answered.
    used : list of (3,) float
        Of each turn: wall time, its own processor time, that of all other processes, s.
    failed : str or None
        Why there is no timing.
    probe_s : float
        Of `probe_s` when it was measured.
    checked : list of (int, float)
        Of some queries their number and the relative l2 error of what was answered.
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
        """Whether the machine is as fast as it was then."""
        return abs(probe_s / self.probe_s - 1) < SAME_SPEED

    @property
    def samples(self) -> dict[str, NDArray[Any]]:
        """Raw samples as arrays."""
        names = ("latency_ms", "gc_ms", "process", "round", "all_threads_ms", "used")
        return {name: np.asarray(getattr(self, name)) for name in names}

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """All of it as arrays, to be kept; NaN where a batch was too slow."""
        rates = [
            np.nan if rate is None else rate for rate in map(self.throughput.get, map(str, BATCHES))
        ]
        return {
            **self.samples,
            "throughput": np.array(rates),
            "memory_bytes": np.array(self.memory_bytes),
            "probe_s": np.array(self.probe_s),
        }

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """A timing that was kept."""
        lists = {
            name: arrays[name].tolist()
            for name in ("latency_ms", "gc_ms", "process", "round", "all_threads_ms")
        }
        rates = {
            str(size): None if np.isnan(rate) else float(rate)
            for size, rate in zip(BATCHES, arrays["throughput"], strict=True)
        }
        used = [(wall, own, others) for wall, own, others in arrays["used"].tolist()]
        return cls(
            **lists,
            throughput=rates,
            memory_bytes=int(arrays["memory_bytes"]),
            used=used,
            probe_s=float(arrays["probe_s"]),
        )


def probe_s() -> float:
    """How long the machine takes for a fixed piece of work: products of matrices in the cache, and sums over memory, s."""
    small, large = np.ones((192, 192)), np.ones(4_000_000)
    times = []
    with pinned_threads(1):
        for _ in range(15):
            start = perf_counter()
            for _ in range(5):
                small @ small
            large.sum()
            times.append(perf_counter() - start)
    return float(np.median(times))


@dataclass(frozen=True)
class Opener:
    """How a fresh process of a configuration comes to a fitted method.

    Attributes
    ----------
    open : callable
        Starts the process, forked from a fork_server if there is one, and loads the model.
    memory_bytes : float
        What the process is expected to take.
    """

    open: Callable[[ForkServer | None], SandboxedProcess]
    memory_bytes: float


@dataclass(frozen=True)
class Queries:
    """What methods are asked while they are timed.

    Attributes
    ----------
    forces, references : (n, n_nodes, 3) float64
        Loads, N, and the displacements that answer them, m, which methods do not get.
    nodes : (n_output_nodes,) int64
        The nodes where answers count.
    scratch : Path
        A folder for answers.
    """

    forces: NDArray[np.float64]
    references: NDArray[np.float64]
    nodes: NDArray[np.int64]
    scratch: Path


def measure(
    openers: Mapping[str, Opener],
    queries: Queries,
    protocol: Protocol,
    threads: int,
    progress: Callable[[int, int], None] = lambda *_: None,
    seed: int = 0,
    *,
    single_only: bool = False,
) -> dict[str, Timing]:
    """Time configurations beside each other.

    Parameters
    ----------
    openers : dict of str to Opener
        By label.
    queries : Queries
    protocol : Protocol
    threads : int
        Threads of a single query; batches and a turn of single queries also run on all cores.
    progress : callable
        Called with (turns done, turns in all).
    seed : int
        Of the order in which configurations take their turns.
    single_only : bool
        Leave out what runs on all cores.

    Returns
    -------
    dict of str to Timing
    """
    timings = {label: Timing() for label in openers}
    order = np.random.default_rng(seed)
    groups = _groups(openers)
    total, done = protocol.processes * (protocol.rounds + 1) * len(openers), 0
    for process in range(protocol.processes if openers else 0):
        for group in groups:
            with ExitStack() as stack:
                fork_server = (
                    stack.enter_context(closing(ForkServer(MethodSession))) if CAN_FORK else None
                )
                workers = _open_all(
                    stack,
                    fork_server,
                    {label: openers[label] for label in group},
                    queries,
                    threads,
                    seed + process,
                    timings,
                )
                for number in range(protocol.rounds):
                    for label in order.permutation(list(workers)):
                        _attempt(
                            timings[label],
                            _turn,
                            workers[label],
                            queries,
                            protocol.queries,
                            threads,
                            process,
                            number,
                        )
                        done += 1
                        progress(done, total)
                for label, worker in workers.items() if not single_only else ():
                    _attempt(
                        timings[label],
                        _on_all_cores,
                        worker,
                        queries,
                        protocol.queries,
                        process == 0,
                    )
                    done += 1
                    progress(done, total)
    return timings


def _groups(openers: Mapping[str, Opener]) -> list[list[str]]:
    """Labels in groups that fit into half of the free memory."""
    free = 0.5 * psutil.virtual_memory().available
    groups: list[list[str]] = []
    room = 0.0
    for label, opener in openers.items():
        if not groups or opener.memory_bytes > room:
            groups.append([])
            room = free
        groups[-1].append(label)
        room -= opener.memory_bytes
    return groups


def _open_all(
    stack: ExitStack,
    fork_server: ForkServer | None,
    openers: Mapping[str, Opener],
    queries: Queries,
    threads: int,
    seed: int,
    timings: Mapping[str, Timing],
) -> dict[str, SandboxedProcess]:
    """Processes with a loaded and warm method each; what fails on the way says so in its timing."""

    def start(label: str) -> SandboxedProcess | None:
        worker = None
        try:
            worker = openers[label].open(fork_server)
            found = worker.ask(
                "warm", ANSWER_LIMIT_S, forces=queries.forces, threads=threads, seed=seed
            )
        except MorBenchError as error:
            timings[label].failed = str(error)
            if worker:
                worker.end()
            return None
        stack.callback(worker.end)
        timings[label].memory_bytes = max(timings[label].memory_bytes, found["memory_bytes"])
        return worker

    wanted = [label for label in openers if not timings[label].failed]
    with ThreadPoolExecutor(cpu_count() or 1) as pool:
        started = dict(zip(wanted, pool.map(start, wanted), strict=True))
    return {label: worker for label, worker in started.items() if worker}


def _attempt(
    timing: Timing, measurement: Callable[..., None], worker: SandboxedProcess, *arguments: Any
) -> None:
    if timing.failed:
        return
    try:
        measurement(timing, worker, *arguments)
    except MorBenchError as error:
        timing.failed = f"while timed: {error}"


def _ask(
    timing: Timing, worker: SandboxedProcess, queries: Queries, n: int, threads: int
) -> dict[str, Any]:
    """A turn of single queries; errors of the answers that were kept are noted."""
    with TemporaryDirectory(dir=queries.scratch) as folder:
        out = Path(folder) / "answers.npy"
        found = worker.ask(
            "time", ANSWER_LIMIT_S, out=out, n=n, floor_s=CHUNK_S, most_s=MOST_S, threads=threads
        )
        try:
            answers, references = (
                np.load(out, allow_pickle=False),
                queries.references[found["checked"]],
            )
            errors = sample_errors(answers, references, queries.nodes).relative_l2
        except (OSError, ValueError, IndexError, KeyError, TypeError) as error:
            raise MethodFailedError(f"its answers cannot be read: {error}") from None
    timing.checked += list(zip(found["checked"], errors.tolist(), strict=True))
    return found


def _turn(
    timing: Timing,
    worker: SandboxedProcess,
    queries: Queries,
    n: int,
    threads: int,
    process: int,
    number: int,
) -> None:
    busy, own = _busy_s(), process_time()
    start = perf_counter()
    found = _ask(timing, worker, queries, n, threads)
    wall = perf_counter() - start
    others = max(0.0, _busy_s() - busy - (process_time() - own) - found["cpu_all_s"])
    timing.latency_ms += found["latency_ms"]
    timing.gc_ms += found["gc_ms"]
    timing.process += [process] * len(found["latency_ms"])
    timing.round += [number] * len(found["latency_ms"])
    timing.used.append((wall, found["cpu_s"] / found["wall_s"] * wall, others))


def _on_all_cores(
    timing: Timing, worker: SandboxedProcess, queries: Queries, n: int, batches: bool
) -> None:
    cores = cpu_count() or 1
    timing.all_threads_ms += _ask(timing, worker, queries, n, cores)["latency_ms"]
    if batches:
        found = worker.ask(
            "throughput",
            ANSWER_LIMIT_S,
            sizes=list(BATCHES),
            floor_s=BATCH_S,
            most_s=MOST_BATCH_S,
            threads=cores,
        )
        timing.throughput = found["throughput"]


def _busy_s() -> float:
    """Processor time that all processes of the machine have used, s."""
    times = psutil.cpu_times()
    return float(
        sum(times)
        - times.idle
        - getattr(times, "iowait", 0.0)
        - getattr(times, "guest", 0.0)
        - getattr(times, "guest_nice", 0.0)
    )


def why_unstable(timing: Timing, threads: int) -> list[str]:
    """The reasons for which a timing should not be relied on; none if it can be."""
    reasons = []
    wall, own, others = np.sum(timing.used, axis=0)
    if others / wall > max(BUSY, 0.1 * (cpu_count() or 1)):
        reasons.append(f"other processes used about {others / wall:.1f} cores meanwhile")
    if threads == 1 and own / wall < STARVED:
        reasons.append(f"its process had {own / wall:.0%} of a core")
    if threads == 1 and own / wall > MORE_THAN_ONE:
        reasons.append(f"it used {own / wall:.1f} cores though pinned to one")
    samples = timing.samples
    for name, groups in (
        ("rounds", samples["process"] * (samples["round"].max() + 1) + samples["round"]),
        ("processes", samples["process"]),
    ):
        medians = [
            float(np.median(samples["latency_ms"][groups == group])) for group in np.unique(groups)
        ]
        spread = _spread(medians)
        if spread > SPREAD:
            reasons.append(f"medians of {len(medians)} {name} spread by {spread:.0%}")
    return reasons


def _spread(medians: Sequence[float]) -> float:
    """Half the distance of the quartiles over the median; of two values half their distance over their mean."""
    if len(medians) < 4:
        return (max(medians) - min(medians)) / (2 * float(np.mean(medians)))
    low, middle, high = np.percentile(medians, [25, 50, 75])
    return float((high - low) / (2 * middle))


def check_answers(timing: Timing, scored: NDArray[np.float64]) -> None:
    """Raise `MethodFailedError` if a method answers otherwise while it is timed than when it was scored.

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
    if now > SAME_ERROR[0] * then + SAME_ERROR[1]:
        raise MethodFailedError(
            f"its median relative l2 error is {now:.3g} while it is timed, on loads on which it was scored with {then:.3g}"
        )


def summary_of_timing(
    timing: Timing, interval: tuple[float, float], threads: int
) -> dict[str, Any]:
    """The figures of a results row: `latency_ms`, `all_threads_ms`, `throughput`.

    Parameters
    ----------
    timing : Timing
    interval : (low, high)
        In which a repeated measurement's median is expected, ms.
    threads : int
        Of a single query.
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
