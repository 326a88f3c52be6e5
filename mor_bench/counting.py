"""The work of a prediction in units that no machine changes: what is factorised, solved with, integrated and multiplied.

Whoever does such work says so where it is done, and only while someone counts; otherwise that costs one comparison:

    if counting.running is not None:
        counting.running.add(back_solves=1, multiply_adds=2 * n_nonzeros)

What is counted follows from sizes, sparsity patterns and numbers of iterations, never from a clock or a hardware counter. It
differs between machines or numbers of threads only where their round-off changes a number of iterations.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass


@dataclass
class Cost:
    """Counted work.

    Attributes
    ----------
    factorisations : int
        Matrices factorised, of any size; `multiply_adds` tells how large they were. Inverses of 3x3 blocks do not count.
    back_solves : int
        Right-hand sides taken through both triangular factors of a matrix, of any size, or through one multigrid cycle in
        their place. A sweep that serves eight right-hand sides counts as eight.
    reduced_factorisations, reduced_back_solves : int
        The part of the above that was done with dense matrices of a reduced basis; the rest was done with sparse matrices
        of a mesh.
    element_evaluations : int
        Cells whose internal force, or force and tangent, were integrated, times how often.
    multiply_adds : int
        Multiplications, with or without an addition, of all of the above and of every product of matrices and vectors.
        A division, root, power or logarithm counts as one, in single precision as in double; an addition or comparison
        alone does not count, nor do norms and sums in the loop around (less than 1 % of the whole), padding, and the
        zeros that a dense format stores.
    """

    factorisations: int = 0
    back_solves: int = 0
    reduced_factorisations: int = 0
    reduced_back_solves: int = 0
    element_evaluations: int = 0
    multiply_adds: int = 0

    def add(
        self,
        *,
        factorisations: int = 0,
        back_solves: int = 0,
        reduced_factorisations: int = 0,
        reduced_back_solves: int = 0,
        element_evaluations: int = 0,
        multiply_adds: int = 0,
    ) -> None:
        """Count more work; what is reduced must be in the totals as well."""
        self.factorisations += factorisations
        self.back_solves += back_solves
        self.reduced_factorisations += reduced_factorisations
        self.reduced_back_solves += reduced_back_solves
        self.element_evaluations += element_evaluations
        self.multiply_adds += multiply_adds


running: Cost | None = None
"""What this process counts into; None while nobody counts."""


@contextmanager
def counted() -> Iterator[Cost]:
    """Count the work of this process that is done inside; a count around this one gets it too."""
    global running
    around, running = running, Cost()
    cost = running
    try:
        yield cost
    finally:
        running = around
        if around is not None:
            around.add(**asdict(cost))


@contextmanager
def uncounted() -> Iterator[None]:
    """Leave out what is computed once and kept: it is no part of a query, whichever comes first."""
    global running
    around, running = running, None
    try:
        yield
    finally:
        running = around


def cholesky_multiply_adds(n: int, bandwidth: int) -> int:
    """Of a Cholesky factorisation: (n, n) with ``bandwidth`` entries beside the diagonal, n - 1 for a dense matrix."""
    below = n * bandwidth - bandwidth * (bandwidth + 1) // 2
    updates = (n - bandwidth) * bandwidth * (bandwidth + 1) // 2 + (bandwidth - 1) * bandwidth * (
        bandwidth + 1
    ) // 6
    return n + below + updates


def triangular_multiply_adds(n: int, bandwidth: int) -> int:
    """Of a forward and a backward substitution with such a factor."""
    return 2 * (n + n * bandwidth - bandwidth * (bandwidth + 1) // 2)
