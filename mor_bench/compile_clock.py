"""The time that Numba spends on compilation, in wall time and in processor time.

A function is compiled once per machine, and the result is stored. So compilation is part of no
measured cost. Wall time is taken from wall time and processor time from processor time: on a busy
machine they differ by factors.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter, thread_time

from numba.core.event import Event, Listener, install_listener


class CompileClock(Listener):
    """Sums the time of compilations, s; one that starts within another counts once.

    Attributes
    ----------
    wall_s : float
    core_s : float
        Processor time of the threads that compile.
    """

    def __init__(self) -> None:
        self.wall_s = self.core_s = 0.0
        self._own = threading.local()

    def on_start(self, event: Event) -> None:
        depth = getattr(self._own, "depth", 0)
        if depth == 0:
            self._own.begun = perf_counter(), thread_time()
        self._own.depth = depth + 1

    def on_end(self, event: Event) -> None:
        self._own.depth -= 1
        if self._own.depth == 0:
            wall, core = self._own.begun
            self.wall_s += perf_counter() - wall
            self.core_s += thread_time() - core


@contextmanager
def compile_clock() -> Iterator[CompileClock]:
    """Listen to compilations in the block."""
    clock = CompileClock()
    with install_listener("numba:compile", clock):
        yield clock
