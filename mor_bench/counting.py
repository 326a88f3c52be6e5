"""Count the work of a prediction in units that do not depend on the machine.

The units are factorisations, back-solves, integrated cells and multiplications. Code reports
countable work where it happens, and `count` ignores the report unless a counter is active:

    count(back_solves=1, multiply_adds=2 * n_nonzeros)

Counts follow from sizes, sparsity patterns and numbers of iterations, never from a clock or a
hardware counter. They depend on the machine or the number of threads only where round-off changes
a number of iterations.

An ignored report takes about 0.13 µs besides its arguments. If that is more than 1 % of a query, or
if an argument is costly, put the report under `if is_counting():` (0.04 µs).
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
        Factorised matrices of any size; `multiply_adds` depends on their size. Inverses of 3x3
        blocks do not count.
    back_solves : int
        Right-hand sides solved with both triangular factors of a matrix of any size, or
        approximately by multigrid cycles. A sweep over eight right-hand sides counts as eight.
    reduced_factorisations, reduced_back_solves : int
        The part of the above with dense matrices of a reduced basis. The rest has sparse matrices
        of a mesh.
    element_evaluations : int
        Integrated cells times the number of integrations of the internal force, or of force and
        tangent.
    multiply_adds : int
        Multiplications, with or without an addition, in all of the above and in every product of
        matrices and vectors. A division, root, power or logarithm counts as one, in single and
        double precision. These do not count: additions and comparisons alone; norms and sums in
        the surrounding loop (below 1 % of the whole); padding; stored zeros.
    """

    factorisations: int = 0
    back_solves: int = 0
    reduced_factorisations: int = 0
    reduced_back_solves: int = 0
    element_evaluations: int = 0
    multiply_adds: int = 0


_running: Cost | None = None


def is_counting() -> bool:
    """Return whether a counter is active; ask before computing costly arguments of `count`."""
    return _running is not None


def count(
    *,
    factorisations: int = 0,
    back_solves: int = 0,
    reduced_factorisations: int = 0,
    reduced_back_solves: int = 0,
    element_evaluations: int = 0,
    multiply_adds: int = 0,
) -> None:
    """Add work to the active counter, if there is one; totals include reduced work."""
    if _running is None:
        return
    _running.factorisations += factorisations
    _running.back_solves += back_solves
    _running.reduced_factorisations += reduced_factorisations
    _running.reduced_back_solves += reduced_back_solves
    _running.element_evaluations += element_evaluations
    _running.multiply_adds += multiply_adds


@contextmanager
def counted() -> Iterator[Cost]:
    """Count the work of this process inside the block, also for an enclosing counter.

    Examples
    --------
    >>> import mor_bench
    >>> scene = mor_bench.load_scene("beam-tiny")
    >>> method = mor_bench.load_method("linear-fem").fit(scene, None)
    >>> with counted() as cost:
    ...     displacement = method.predict(0.0 * scene.mesh.points + 0.001)
    >>> cost.multiply_adds > 0
    True
    """
    global _running
    enclosing, _running = _running, Cost()
    cost = _running
    try:
        yield cost
    finally:
        _running = enclosing
        count(**asdict(cost))


@contextmanager
def uncounted() -> Iterator[None]:
    """Exclude work that is done once and cached, because it belongs to no query."""
    global _running
    enclosing, _running = _running, None
    try:
        yield
    finally:
        _running = enclosing


def cholesky_multiply_adds(n: int, bandwidth: int) -> int:
    """Return the multiplications of a Cholesky factorisation of an (n, n) matrix.

    ``bandwidth`` is the number of entries beside the diagonal, n - 1 for a dense matrix.
    """
    below = n * bandwidth - bandwidth * (bandwidth + 1) // 2
    pairs = bandwidth * (bandwidth + 1)
    updates = (n - bandwidth) * pairs // 2 + (bandwidth - 1) * pairs // 6
    return n + below + updates


def triangular_multiply_adds(n: int, bandwidth: int) -> int:
    """Return the multiplications of a forward and a backward substitution with such a factor."""
    return 2 * (n + n * bandwidth - bandwidth * (bandwidth + 1) // 2)
