"""The cost of a fit: wall time and core-seconds, without the compilation of Numba's functions.

A function is compiled once per machine, and the result is stored. So compilation is not part of a
fit that is repeated, and a method must not pay for it because it happened to run first.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter, process_time

from mor_bench.compile_clock import compile_clock


@dataclass
class FitCost:
    """Cost of a fit.

    Attributes
    ----------
    wall_s : float
        Wall time, s.
    core_s : float
        Processor time of all threads of the process, and of its child processes that have ended, s.
    compile_s : float
        Wall time of compilation, s. Neither contains it.
    """

    wall_s: float = 0.0
    core_s: float = 0.0
    compile_s: float = 0.0


@contextmanager
def fit_clock() -> Iterator[FitCost]:
    """Measure the block; the cost is complete at its end."""
    cost = FitCost()
    with compile_clock() as compilation:
        busy, start = _core_s(), perf_counter()
        yield cost
        wall, cores = perf_counter() - start, _core_s() - busy
    cost.compile_s = compilation.wall_s
    cost.wall_s = max(wall - compilation.wall_s, 0.0)
    cost.core_s = max(cores - compilation.core_s, 0.0)


def _core_s() -> float:
    children = os.times()
    return process_time() + children.children_user + children.children_system
