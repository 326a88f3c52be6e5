"""The loads of timed queries: those of the test set, in random order, so that none comes twice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MOST_CHANGE = 0.03
"""Largest relative change of a timed load's size; the factors are uniform, with a mean of one."""

CLASSES = 20
"""Classes of size, each of which is spread evenly over an order of the loads.

The work of a query depends on the size of its answer. So even a few timed loads have about the mean
work of all.
"""


class TimedLoads:
    """Loads of a test set in random orders, each changed a little in size.

    An order takes every load once, so the work of the queries is that of the test set. The change
    makes a load of a later order a new one.

    Parameters
    ----------
    values : (n, n_nodes, 3) float64
        Loads, N, or observed displacements, m, sorted by the size of their answers.
    seed : int
    """

    def __init__(self, values: NDArray[np.float64], seed: int) -> None:
        self.values = values
        self._generator = np.random.default_rng(seed)
        self._left: list[int] = []
        self._given: set[int] = set()

    def next(self) -> int:
        """Return the number of the next load."""
        if not self._left:
            self._left = self._order().tolist()
        return self._left.pop()

    def changed(self, numbers: int | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return loads with changed sizes."""
        shape = np.shape(numbers)
        factors = self._generator.uniform(1 - MOST_CHANGE, 1 + MOST_CHANGE, (*shape, 1, 1))
        return np.asarray((self.values[numbers] * factors).reshape(*shape, *self.values.shape[1:]))

    def unchanged(self, number: int, probability: float) -> NDArray[np.float64] | None:
        """Return a load as it is with this probability, but only once; otherwise None."""
        if number in self._given or self._generator.random() >= probability:
            return None
        self._given.add(number)
        return np.array(self.values[number])

    def _order(self) -> NDArray[np.int64]:
        places = []
        for members in np.array_split(np.arange(len(self.values)), CLASSES):
            slots = self._generator.permutation(len(members))
            places.append((slots + self._generator.random(len(members))) / max(len(members), 1))
        return np.argsort(np.concatenate(places))
