"""Measure the latency of fitted methods in fresh processes and interleaved rounds.

All configurations of a dataset are alive at once, each in a process of its own, and take turns. So
whatever slows the machine for a while slows all of them. The measurement is repeated in fresh
processes, because the memory layout of a process changes the latency of all its queries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from mor_bench.array_files import parse_npy
from mor_bench.checked_files import read_written
from mor_bench.errors import MorBenchError, StoreError
from mor_bench.machine import free_memory_bytes, pinned_threads, usable_cores
from mor_bench.measure.course import Course
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.measure.method_session import MethodSession
from mor_bench.measure.timing import BATCHES, Timing
from mor_bench.sandbox.fork_server import CAN_FORK, ForkServer
from mor_bench.sandbox.process import MethodFailedError, SandboxedProcess, stoppable_threads

LEAST_QUERIES = 200
"""Number of single queries of each configuration, over all processes; fewer if it is slow."""

LEAST_TURN_S, MOST_TURN_S = 0.03, 1.0
"""Shortest and longest turn of a configuration, s. A turn at the limit skips its other queries."""

BATCH_S, MOST_BATCH_S = 0.25, 5.0
"""Time for repeating batches of one size, and time limit of one batch, s."""

SERVER_S, OPEN_S, TURN_S = 4.0, 0.1, 0.05
"""Typical times to start a replicate, to open a method in it and of a turn, s: for estimates."""

ANSWER_LIMIT_S = 300.0
"""Time limit of a request that should take seconds, s; a hanging method is then ended."""


@dataclass(frozen=True)
class Protocol:
    """Repetitions of a configuration's timing.

    Attributes
    ----------
    processes, rounds : int
        Number of fresh processes, and number of turns of each.
    all_cores : bool
        Whether to time single queries and batches on all cores too.
    """

    processes: int
    rounds: int
    all_cores: bool = True

    @property
    def queries(self) -> int:
        """Queries in a turn."""
        return -(-LEAST_QUERIES // (self.processes * self.rounds))


PROTOCOLS = {"quick": Protocol(4, 3), "full": Protocol(8, 5)}


def probe_s() -> float:
    """Return the seconds that the machine takes for fixed work.

    The work is products of matrices that fit into the cache, and sums over memory.
    """
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
class TimedMethod:
    """A fitted configuration that is to be timed.

    Attributes
    ----------
    open : callable
        Starts a fresh process, forked from a server if there is one, and loads the model into it.
    memory_bytes : float
        Expected memory of the process.
    """

    open: Callable[[ForkServer | None], SandboxedProcess]
    memory_bytes: float


@dataclass(frozen=True)
class Queries:
    """Queries and references for timing methods.

    Attributes
    ----------
    forces, references : (n, n_nodes, 3) float64
        Loads, N, sorted by the size of the reference displacements, m, which stay in this process.
    nodes : (n_output_nodes,) int64
        The nodes where answers count.
    scratch : Path
        A folder for answers.
    parameters : (n, n_parameters) float64, optional
        Sampled parameters of a parametric scene.
    """

    forces: NDArray[np.float64]
    references: NDArray[np.float64]
    nodes: NDArray[np.int64]
    scratch: Path
    parameters: NDArray[np.float64] | None = None


def measure_latencies(
    methods: Mapping[str, TimedMethod],
    queries: Queries,
    protocol: Protocol,
    threads: int,
    progress: Callable[[int, int], None] = lambda *_: None,
    seed: int = 0,
) -> dict[str, Timing]:
    """Time configurations side by side.

    Parameters
    ----------
    methods : dict of str to TimedMethod
        By label.
    queries : Queries
    protocol : Protocol
    threads : int
        Threads of a single query.
    progress : callable
        Called with the time that has passed and the time expected in all, ms.
    seed : int
        Seed of the order in which configurations take turns, and of their queries.

    Returns
    -------
    dict of str to Timing
        `Timing.failed` holds the reason if a configuration failed.
    """
    timings = {label: Timing() for label in methods}
    order = np.random.default_rng(seed)
    groups = groups_that_fit(methods)
    course = Course(_parts(groups, protocol), progress)
    for process in range(protocol.processes if methods else 0):
        for place, group in enumerate(groups):
            with ExitStack() as stack:
                server = ForkServer(MethodSession) if CAN_FORK else None
                if server:
                    stack.enter_context(closing(server))
                turns = {
                    label: _Turns(
                        methods[label], timings[label], queries, protocol.queries, threads, process
                    )
                    for label in group
                }
                opened = _open_all(stack, turns, server, seed + process)
                course.done(f"open {place}")
                for label in group:
                    if label not in opened:
                        course.skip(label)
                for number in range(protocol.rounds):
                    for label in order.permutation(list(opened)):
                        opened[label].attempt(opened[label].single_queries, number)
                        course.done(f"turn {label}")
                for label, turn in opened.items() if protocol.all_cores else ():
                    turn.attempt(turn.on_all_cores, process == 0)
                    course.done(f"{'cores' if process else 'batches'} {label}")
    return timings


def _parts(groups: list[list[str]], protocol: Protocol) -> dict[str, tuple[int, float]]:
    """Return the number and typical seconds of the parts of a measurement, see `Course`."""
    n = protocol.processes
    parts = {
        f"open {place}": (n, SERVER_S + len(group) * OPEN_S) for place, group in enumerate(groups)
    }
    for label in (label for group in groups for label in group):
        parts[f"turn {label}"] = n * protocol.rounds, TURN_S
        if protocol.all_cores:
            parts[f"batches {label}"] = 1, TURN_S + len(BATCHES) * BATCH_S
            parts[f"cores {label}"] = n - 1, TURN_S
    return parts


def groups_that_fit(methods: Mapping[str, TimedMethod]) -> list[list[str]]:
    """Return the labels in groups that fit into half of the free memory."""
    free = 0.5 * free_memory_bytes()
    groups: list[list[str]] = []
    room = 0.0
    for label, method in methods.items():
        if not groups or method.memory_bytes > room:
            groups.append([])
            room = free
        groups[-1].append(label)
        room -= method.memory_bytes
    return groups


def _open_all(
    stack: ExitStack, turns: Mapping[str, _Turns], server: ForkServer | None, seed: int
) -> dict[str, _Turns]:
    """Open and warm up all methods in parallel; return those that answer."""
    wanted = {label: turn for label, turn in turns.items() if not turn.timing.failed}
    for turn in wanted.values():
        stack.callback(turn.end)
    with stoppable_threads(usable_cores()) as pool:
        list(pool.in_order(lambda turn: turn.open(server, seed), wanted.values()))
    return {label: turn for label, turn in wanted.items() if not turn.timing.failed}


@dataclass
class _Turns:
    """The turns of one configuration in one process.

    Attributes
    ----------
    method : TimedMethod
    timing : Timing
        Collects what is measured.
    queries : Queries
    n_queries, threads : int
        Single queries in a turn, and their threads.
    number : int
        Number of the replicate.
    """

    method: TimedMethod
    timing: Timing
    queries: Queries
    n_queries: int
    threads: int
    number: int
    process: SandboxedProcess | None = None

    def open(self, server: ForkServer | None, seed: int) -> None:
        """Start a process with a loaded and warm method; a failure is recorded."""
        try:
            self.process = self.method.open(server)
            answer = self._ask(
                "warm",
                forces=self.queries.forces,
                parameters=self.queries.parameters,
                threads=self.threads,
                seed=seed,
            )
        except MorBenchError as error:
            self.timing.failed = str(error)
            self.end()
            return
        self.timing.memory_bytes = max(self.timing.memory_bytes, answer["memory_bytes"])

    def end(self) -> None:
        """End the process."""
        if self.process:
            self.process.end()

    def attempt(self, turn: Callable[[Any], None], argument: Any) -> None:
        """Take a turn, unless an earlier one failed; a failure is recorded."""
        if self.timing.failed:
            return
        try:
            turn(argument)
        except MorBenchError as error:
            self.timing.failed = f"while timed: {error}"

    def single_queries(self, round_number: int) -> None:
        """Time single queries, and record the use of processors meanwhile."""
        busy, own = _busy_s(), process_time()
        start = perf_counter()
        found = self._timed(self.n_queries, self.threads)
        wall = perf_counter() - start
        others = max(0.0, _busy_s() - busy - (process_time() - own) - found["cpu_all_s"])
        self.timing.latency_ms += found["latency_ms"]
        self.timing.gc_ms += found["gc_ms"]
        self.timing.process += [self.number] * len(found["latency_ms"])
        self.timing.round += [round_number] * len(found["latency_ms"])
        self.timing.used.append((wall, found["cpu_s"] / found["wall_s"] * wall, others))

    def on_all_cores(self, batches: bool) -> None:
        """Time single queries on all cores and, if wanted, batches."""
        cores = usable_cores()
        self.timing.all_threads_ms += self._timed(self.n_queries, cores)["latency_ms"]
        if batches:
            self.timing.throughput = self._ask(
                "throughput",
                sizes=list(BATCHES),
                floor_s=BATCH_S,
                most_s=MOST_BATCH_S,
                threads=cores,
            )["throughput"]

    def _timed(self, n: int, threads: int) -> dict[str, Any]:
        """Ask for a turn of single queries, and record the errors of the checked answers."""
        with TemporaryDirectory(dir=self.queries.scratch) as folder:
            out = Path(folder) / "answers.npy"
            limits = {"floor_s": LEAST_TURN_S, "most_s": MOST_TURN_S}
            found = self._ask("time", out=out, n=n, threads=threads, **limits)
            try:
                answers = parse_npy(read_written(out, self.queries.scratch), str(out))
                references = self.queries.references[found["checked"]]
                errors = sample_errors(answers, references, self.queries.nodes).relative_l2
            except (OSError, StoreError, ValueError, IndexError, KeyError, TypeError) as error:
                raise MethodFailedError(f"the method's answers cannot be read: {error}") from None
        self.timing.checked += list(zip(found["checked"], errors.tolist(), strict=True))
        return found

    def _ask(self, do: str, **request: Any) -> dict[str, Any]:
        assert self.process
        return self.process.ask(do, ANSWER_LIMIT_S, **request)


def _busy_s() -> float:
    """Return the processor time that all processes of the machine have used, s."""
    times = psutil.cpu_times()
    return float(
        sum(times)
        - times.idle
        - getattr(times, "iowait", 0.0)
        - getattr(times, "guest", 0.0)
        - getattr(times, "guest_nice", 0.0)
    )
