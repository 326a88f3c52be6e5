"""Large meshes on several cores: kernels run on slabs of rows that share no entries.

Rows are divided into slabs. The slabs with even numbers run at the same time, then those with odd
numbers. Between two of one kind lies another, so that they write to different entries. Each entry
receives its parts in the same order on any number of cores, and results are the same bit by bit.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mor_bench.machine import kernel_threads

T = TypeVar("T")
Range = tuple[int, int]

N_SLABS = 8
"""Slabs; half of them run at the same time, on as many cores."""


class Slabs:
    """Groups of ranges of rows; the ranges of a group may run at the same time."""

    def __init__(self, groups: list[list[Range]]) -> None:
        self.groups = groups

    def run(self, kernel: Callable[[int, int], T], *, backward: bool = False) -> list[T]:
        """Call a kernel for the first and last row of each range, one group after the other."""
        return [
            result
            for group in (reversed(self.groups) if backward else self.groups)
            for result in _at_once(kernel, group)
        ]

    def run_all(self, kernel: Callable[[int, int], T]) -> list[T]:
        """Call a kernel that writes to its own rows only, for all ranges at the same time."""
        return _at_once(kernel, [one for group in self.groups for one in group])


def _at_once(kernel: Callable[[int, int], T], ranges: list[Range]) -> list[T]:
    n = min(kernel_threads(), len(ranges))
    if n == 1:
        return [kernel(*one) for one in ranges]
    return list(_pool(n, os.getpid()).map(lambda one: kernel(*one), ranges))


@cache
def _pool(n: int, process: int) -> ThreadPoolExecutor:
    """Return a pool of n threads of this process; a fork has the object without its threads."""
    return ThreadPoolExecutor(n, thread_name_prefix="mor-bench-slabs")


def whole(n: int) -> Slabs:
    """Return all n rows as one range."""
    return Slabs([[(0, n)]])


def are_apart(ranges: list[Range], touched: Callable[[int, int], NDArray[np.integer]]) -> bool:
    """Return whether no entry is touched by two ranges."""
    entries = [np.unique(touched(*one)) for one in ranges]
    return len(np.unique(np.concatenate(entries))) == sum(map(len, entries))


def slabs_of(n: int, touched: Callable[[int, int], NDArray[np.integer]]) -> Slabs:
    """Return n rows in slabs, or in one range where slabs of a group touch the same entries.

    Parameters
    ----------
    n : int
    touched : callable
        Returns the entries that the rows from a first to a last one read or write.
    """
    bounds = np.linspace(0, n, N_SLABS + 1).astype(int).tolist()
    ranges = list(pairwise(bounds))
    groups = [ranges[::2], ranges[1::2]]
    return Slabs(groups) if all(are_apart(group, touched) for group in groups) else whole(n)
