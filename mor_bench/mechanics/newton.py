"""The nonlinear solve of an equilibrium, full-order or reduced: the fast way first, a safeguarded one where it fails.

Where there is an approximate inverse of all tangents, an accelerated iteration with it goes first; it fails on the
largest deformations only. Newton's plain full steps follow: the residual first rises by orders of magnitude, which is
not divergence. When neither ends in a stable, uninverted state, the load is applied in increments, each a descent on the
potential energy with a line search, and cut back on failure.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import (
    InvalidInputError,
    InvertedElementError,
    NoEquilibriumError,
    SolverError,
)
from mor_bench.mechanics.anderson import Anderson
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.linear import Factor, NotPositiveDefiniteError

ACCELERATED_ITERATIONS = 40
DIVERGED = 1e4
"""A residual this many times the load ends the accelerated pass, which does not come back from there."""
TURNING = 1e-2
"""Nodal rotations are taken anew while corrections are larger than this, relative to the displacement."""
PLAIN_ITERATIONS = 25
DAMPED_ITERATIONS = 60
HOPELESS = 1e10
"""A residual this many times the load ends the plain pass; near incompressibility it rises 3,000-fold and still converges."""
ROUND_OFF = 1e-13
"""A correction this small relative to the displacement is round-off: slender bodies never meet a force tolerance.

So is one this small relative to the body, once the residual falls no further: strains lose their digits to the 1 in F.
"""
ARMIJO = 1e-4
DAMPED_FORCING = 1e-3
"""Relative tolerance of an iterative solve in the safeguarded pass."""
MAX_HALVINGS = 14
PROBE_FROM = 0.1
"""Probing begins when the residual has fallen to this share of the load: the tangent then hardly changes any more."""
PROBES = 3
"""Directions in which the accelerated pass looks for negative curvature; soft ones first."""
PROBE_LENGTH = 1e-6
"""Length of the difference that gives the tangent's product with a probe, relative to the body."""
LINEAR = 1e-11
"""Displacements this small relative to the body are those of the stiffness at rest, to more digits than a law in F keeps."""
MAX_LOAD_N = 1e30
MAX_ITERATIONS = 300
"""Newton iterations over all increments before the solve gives up."""


@dataclass(frozen=True)
class NewtonOptions:
    """Stopping and stepping.

    Parameters
    ----------
    tolerance : float
        Norm of the residual relative to that of the load.
    max_cuts : int
        How often an increment may be halved before the solve gives up.
    """

    tolerance: float = 1e-8
    max_cuts: int = 10

    def __post_init__(self) -> None:
        if not 0 < self.tolerance <= 1:
            raise InvalidInputError(f"`tolerance` must be in (0, 1]; got {self.tolerance}.")


@dataclass(frozen=True)
class Solution:
    """A stable equilibrium with det F > 0 at every Gauss point."""

    displacement: NDArray[np.float64]
    min_det_f: float
    iterations: int
    cuts: int


class Turning(Protocol):
    """An approximate inverse of all tangents, which turns with the body."""

    def turned(self, q: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """Nodal rotations of the body at q; the identity for None."""
        ...

    def soft(self, rotations: NDArray[np.float64]) -> NDArray[np.float64]:
        """The response at rest to a random force, turned: soft modes dominate it."""
        ...

    def solve_many(
        self, residuals: Sequence[NDArray[np.float64]], rotations: Sequence[NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Corrections (m, n_unknowns), one for each residual under its own rotations, whatever the others are."""
        ...


class Problem(Protocol):
    """What the solve needs of a model with unknowns q.

    Attributes
    ----------
    n_unknowns : int
    extent : float
        Unknowns of this size are displacements of the size of the body.
    """

    n_unknowns: int
    extent: float

    @property
    def accelerator(self) -> Turning | None:
        """What the accelerated pass iterates with; without it there is none."""
        ...

    def force(self, q: NDArray[np.float64]) -> State: ...
    def linearise(self, q: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        """State and tangent at q."""
        ...

    def step(
        self,
        q: NDArray[np.float64],
        tangent: NDArray[np.float64],
        residual: NDArray[np.float64],
        tolerance: float,
    ) -> NDArray[np.float64]:
        """Solve tangent · step = residual, to a relative tolerance if the solver is iterative.

        Raises `NotPositiveDefiniteError` where the tangent is seen not to be positive definite.
        """
        ...

    def certify(self, q: NDArray[np.float64]) -> None:
        """Look for negative curvature at a solution q, if the solves of the steps that led there do not prove that there is none.

        Raises `NotPositiveDefiniteError` where there is some.
        """
        ...

    @property
    def rest_tangent(self) -> NDArray[np.float64]: ...
    @property
    def rest_factor(self) -> Factor: ...


@dataclass
class _Pass:
    """The outcome of one Newton pass."""

    q: NDArray[np.float64]
    min_det_f: float
    iterations: int
    converged: bool

    @property
    def valid(self) -> bool:
        return self.converged and self.min_det_f > 0


def _met(residual: NDArray[np.float64], load_norm: float, tolerance: float) -> bool:
    return float(np.linalg.norm(residual)) <= tolerance * load_norm


def _is_round_off(step: NDArray[np.float64], q: NDArray[np.float64], extent: float = 0.0) -> bool:
    return float(np.abs(step).max()) <= ROUND_OFF * max(float(np.abs(q).max()), extent)


def is_linear(problem: Problem, q: NDArray[np.float64]) -> bool:
    """Whether a response at rest is so small that it is the solution, to as many digits as there are."""
    return float(np.abs(q).max()) <= LINEAR * problem.extent


def _forcing(size: float, before: float, target: float) -> float:
    """How exactly to solve for a step: Eisenstat and Walker's second choice, and no further than the target needs.

    SIAM J. Sci. Comput. 17 (1996), section 2.1, with γ = 0.9 and exponent 2.
    """
    return 0.1 if size <= target else min(0.1, max(0.9 * (size / before) ** 2, 0.3 * target / size))


_Asked = list[tuple[NDArray[np.float64], NDArray[np.float64]]]
_Correcting = Generator[_Asked, list[NDArray[np.float64]], _Pass]
"""Asks for the corrections under some residuals and rotations, again and again."""


class _Probes:
    """A search for negative curvature that goes along with the iteration, at one more residual for each of its steps.

    The first probe is the turned response to a random force, which soft modes dominate; each next one is P⁻¹ K of the one
    before, as in Lanczos' method. The probes' products with K are differences of the internal force.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._probes: list[NDArray[np.float64]] = []
        self._products: list[NDArray[np.float64]] = []

    @property
    def begun(self) -> bool:
        return bool(self._probes)

    @property
    def complete(self) -> bool:
        return len(self._probes) >= PROBES

    @property
    def wanted(self) -> NDArray[np.float64]:
        """The residual whose correction is the next probe."""
        return self._products[-1]

    def add(
        self, answer: NDArray[np.float64], q: NDArray[np.float64], force: NDArray[np.float64]
    ) -> None:
        """Take the next probe, at q with its internal force."""
        for probe in self._probes:
            answer = answer - float(probe @ answer) / float(probe @ probe) * probe
        length = PROBE_LENGTH * self._problem.extent / (float(np.abs(answer).max()) or 1.0)
        probe = length * answer
        self._probes.append(probe)
        self._products.append(self._problem.force(q + probe).force - force)

    @property
    def convex(self) -> bool:
        """Whether no combination of the probes has negative curvature."""
        probes, products = np.array(self._probes), np.array(self._products)
        matrix = probes @ products.T
        scale = np.sqrt(np.abs(np.diag(matrix)))
        matrix = 0.5 * (matrix + matrix.T) / np.outer(scale, scale)
        return bool(np.isfinite(matrix).all()) and float(np.linalg.eigvalsh(matrix)[0]) > 0


def _accelerated(
    problem: Problem,
    inverse: Turning,
    load: NDArray[np.float64],
    start: NDArray[np.float64] | None,
    tolerance: float,
) -> _Correcting:
    """Anderson's acceleration of the iteration with an approximate inverse; converged only where no curvature was negative."""
    load_norm = float(np.linalg.norm(load))
    memory, probes = Anderson(problem.n_unknowns), _Probes(problem)
    rotations = inverse.turned(start)
    q = (yield [(load, rotations)])[0] if start is None else start.copy()
    if start is None and is_linear(problem, q):
        return _Pass(problem.rest_factor.solve(load), 1.0, 1, converged=True)
    turning, min_det, before = True, -np.inf, np.inf
    for iteration in range(1, ACCELERATED_ITERATIONS + 1):
        state = problem.force(q)
        residual, min_det = load - state.force, state.min_det_f
        size = float(np.linalg.norm(residual))
        if size <= tolerance * load_norm:
            break
        if not size <= DIVERGED * load_norm:
            return _Pass(q, min_det, iteration, converged=False)
        if turning:
            rotations = inverse.turned(q)
        asked = [(residual, rotations)]
        if size <= PROBE_FROM * load_norm and not probes.complete:
            if not probes.begun:
                probes.add(inverse.soft(rotations), q, state.force)
            asked.append((probes.wanted, rotations))
        correction, *answers = yield asked
        for answer in answers:
            probes.add(answer, q, state.force)
        if size > 0.5 * before and _is_round_off(correction, q, problem.extent):
            break
        before = size
        turning = float(np.abs(correction).max()) > TURNING * float(np.abs(q).max())
        q = q + memory.advance(q, correction, residual)
    else:
        return _Pass(q, min_det, ACCELERATED_ITERATIONS, converged=False)
    if not (min_det > 0 and memory.convex):
        return _Pass(q, min_det, iteration, converged=False)
    if not probes.begun:
        probes.add(inverse.soft(rotations), q, state.force)
    while not probes.complete:
        probes.add((yield [(probes.wanted, rotations)])[0], q, state.force)
    return _Pass(q, min_det, iteration, converged=probes.convex)


def _in_step(inverse: Turning, passes: Iterator[_Correcting]) -> Iterator[tuple[int, _Pass]]:
    """Run passes, several at a time, so that they share each sweep over the factor; yields number and outcome as they end."""
    waiting: list[tuple[int, _Correcting, _Asked]] = []
    numbered = enumerate(passes)
    while True:
        while len(waiting) < TOGETHER and (item := next(numbered, None)) is not None:
            try:
                waiting.append((*item, next(item[1])))
            except StopIteration as ended:
                yield item[0], ended.value
        if not waiting:
            return
        together_asked = [pair for _, _, asked in waiting for pair in asked]
        answers = iter(
            inverse.solve_many(
                [residual for residual, _ in together_asked],
                [rotations for _, rotations in together_asked],
            )
        )
        still = []
        for number, running, asked in waiting:
            try:
                still.append((number, running, running.send([next(answers) for _ in asked])))
            except StopIteration as ended:
                yield number, ended.value
        waiting = still


def _is_certified(problem: Problem, q: NDArray[np.float64]) -> bool:
    try:
        problem.certify(q)
    except NotPositiveDefiniteError:
        return False
    return True


def _plain(
    problem: Problem, load: NDArray[np.float64], start: NDArray[np.float64] | None, tolerance: float
) -> _Pass:
    """Full Newton steps; from rest, the first one uses the rest-state factor that every solve shares."""
    load_norm = float(np.linalg.norm(load))
    q = problem.rest_factor.solve(load) if start is None else start.copy()
    if start is None and is_linear(problem, q):
        return _Pass(q, 1.0, 1, converged=True)
    min_det, before, near = -np.inf, np.inf, False
    for iteration in range(1, PLAIN_ITERATIONS + 1):
        if near:  # one more residual is cheap, and usually no further tangent is needed
            state = problem.force(q)
            if _met(load - state.force, load_norm, tolerance):
                return _Pass(q, state.min_det_f, iteration, converged=_is_certified(problem, q))
        state, tangent = problem.linearise(q)
        residual, min_det = load - state.force, state.min_det_f
        size = float(np.linalg.norm(residual))
        if not (size <= HOPELESS * load_norm and np.isfinite(state.energy_j)):
            break
        try:
            # Also at a solution that was not come to from near by: that the tangent is positive definite there is seen.
            step = problem.step(q, tangent, residual, _forcing(size, before, tolerance * load_norm))
        except NotPositiveDefiniteError:
            break
        if size <= tolerance * load_norm:
            return _Pass(q, min_det, iteration, converged=_is_certified(problem, q))
        floor = problem.extent if size > 0.5 * before else 0.0
        near, before = size <= np.sqrt(tolerance) * load_norm, size
        q = q + step
        if _is_round_off(step, q, floor):
            return _Pass(q, min_det, iteration, converged=_is_certified(problem, q))
    return _Pass(q, min_det, PLAIN_ITERATIONS, converged=False)


def _descent(
    problem: Problem,
    q: NDArray[np.float64],
    tangent: NDArray[np.float64],
    residual: NDArray[np.float64],
) -> tuple[NDArray[np.float64], bool]:
    """A descent direction of the potential, and whether the tangent itself was positive definite.

    An indefinite tangent is shifted towards the rest-state stiffness until it is positive definite.
    """
    try:
        return problem.step(q, tangent, residual, DAMPED_FORCING), True
    except NotPositiveDefiniteError:
        pass
    shift = 0.01
    while True:
        try:
            return problem.step(
                q, tangent + shift * problem.rest_tangent, residual, DAMPED_FORCING
            ), False
        except NotPositiveDefiniteError:
            shift *= 4.0
            if shift > 1e6:
                return problem.rest_factor.solve(residual), False


def _damped(
    problem: Problem, load: NDArray[np.float64], start: NDArray[np.float64], tolerance: float
) -> _Pass:
    """Descent on the potential W(q) - f·q from a valid state, never leaving det F > 0."""
    load_norm = float(np.linalg.norm(load))
    q, before = start, np.inf
    for iteration in range(1, DAMPED_ITERATIONS + 1):
        state, tangent = problem.linearise(q)
        residual = load - state.force
        step, stable = _descent(problem, q, tangent, residual)
        size = float(np.linalg.norm(residual))
        floor, before = problem.extent if size > 0.5 * before else 0.0, size
        if stable and (size <= tolerance * load_norm or _is_round_off(step, q, floor)):
            return _Pass(q, state.min_det_f, iteration, converged=_is_certified(problem, q))
        slope, work = float(residual @ step), float(load @ q)
        potential, noise = state.energy_j - work, 1e-14 * (state.energy_j + abs(work))
        for halving in range(MAX_HALVINGS):
            length = 0.5**halving
            trial_q = q + length * step
            trial = problem.force(trial_q)
            if (
                trial.min_det_f > 0
                and trial.energy_j - float(load @ trial_q)
                <= potential - ARMIJO * length * slope + noise
            ):
                break
        else:
            return _Pass(q, trial.min_det_f, iteration, converged=False)
        q = trial_q
    return _Pass(q, trial.min_det_f, DAMPED_ITERATIONS, converged=False)


def solve_equilibrium(
    problem: Problem,
    load: NDArray[np.float64],
    start: NDArray[np.float64] | None = None,
    options: NewtonOptions = NewtonOptions(),
) -> Solution:
    """Find the stable equilibrium under a dead load.

    Parameters
    ----------
    problem : Problem
    load : (n_unknowns,) float64
        External force, N (projected on the basis for a reduced problem).
    start : (n_unknowns,) float64, optional
        A guess; rest by default.
    options : NewtonOptions

    Returns
    -------
    Solution

    Raises
    ------
    InvertedElementError
        If the load can be followed only through det F <= 0.
    NoEquilibriumError
        If no stable equilibrium was found within the allowed cut-backs.
    InvalidInputError
        If the load or the start has another shape, NaN or infinity, or the load more than `MAX_LOAD_N`.
    """
    found = next(solve_equilibria(problem, [load], [start], options))[1]
    if isinstance(found, SolverError):
        raise found
    return found


def _checked(values: ArrayLike, name: str, problem: Problem) -> NDArray[np.float64]:
    """A float64 vector of the problem's unknowns; the kernels behind check no bounds."""
    array = np.asarray(values)
    if (
        array.dtype.kind not in "fiu"
        or array.shape != (problem.n_unknowns,)
        or not np.isfinite(array).all()
    ):
        raise InvalidInputError(
            f"{name} must be finite real numbers of shape ({problem.n_unknowns},); got shape {array.shape}, dtype {array.dtype}."
        )
    return np.ascontiguousarray(array, dtype=np.float64)


TOGETHER = 16
"""Loads that are solved in step; the fine beam's back-solves take 2.4 ms alone and 0.7 ms each among 16."""


def solve_equilibria(
    problem: Problem,
    loads: Sequence[NDArray[np.float64]],
    starts: Sequence[NDArray[np.float64] | None] | None = None,
    options: NewtonOptions = NewtonOptions(),
) -> Iterator[tuple[int, Solution | SolverError]]:
    """`solve_equilibrium` for many loads, which share the sweeps over the factor.

    Yields the number of a load and its solution, or the error that it would raise, in the order in which they are found. A
    solution is the same to the last digit whatever the other loads are.
    """
    loads = [_checked(load, f"load {number}", problem) for number, load in enumerate(loads)]
    for number, load in enumerate(loads):
        if np.abs(load).max() > MAX_LOAD_N:
            raise InvalidInputError(
                f"load {number} must be within ±{MAX_LOAD_N:g} N; got {load[np.abs(load).argmax()]:g}."
            )
    starts = [
        None if start is None else _checked(start, "`start`", problem)
        for start in starts or [None] * len(loads)
    ]
    pending = [i for i, load in enumerate(loads) if load.any()]
    for i in sorted(set(range(len(loads))) - set(pending)):
        yield i, Solution(np.zeros(problem.n_unknowns), 1.0, 0, 0)
    inverse = problem.accelerator
    if inverse is None:
        outcomes: Iterator[tuple[int, _Pass | None]] = (
            (number, None) for number in range(len(pending))
        )
    else:
        passes = (
            _accelerated(problem, inverse, loads[i], starts[i], options.tolerance) for i in pending
        )
        outcomes = _in_step(inverse, passes)
    for number, first in outcomes:
        i = pending[number]
        if first is not None and first.valid:
            yield i, Solution(first.q, first.min_det_f, first.iterations, 0)
            continue
        try:
            yield (
                i,
                _by_newton(problem, loads[i], starts[i], options, first.iterations if first else 0),
            )
        except SolverError as error:
            yield i, error


def _by_newton(
    problem: Problem,
    load: NDArray[np.float64],
    start: NDArray[np.float64] | None,
    options: NewtonOptions,
    iterations: int,
) -> Solution:
    """Plain Newton steps, then increments; ``iterations`` were done before."""
    first = _plain(problem, load, start, options.tolerance)
    iterations, cuts = iterations + first.iterations, 0
    if first.valid:
        return Solution(first.q, first.min_det_f, iterations, 0)
    if start is not None:  # which may lie on a branch that cannot be reached from rest
        attempt = _damped(problem, load, start, options.tolerance)
        iterations += attempt.iterations
        if attempt.valid:
            return Solution(attempt.q, attempt.min_det_f, iterations, 0)
    q, reached, increment = np.zeros(problem.n_unknowns), 0.0, 0.5
    while True:
        target = min(1.0, reached + increment)
        attempt = _damped(problem, target * load, q, options.tolerance)
        iterations += attempt.iterations
        if attempt.valid:
            if target == 1.0:
                return Solution(attempt.q, attempt.min_det_f, iterations, cuts)
            q, reached, increment = attempt.q, target, 2.0 * increment
            continue
        cuts += 1
        increment *= 0.5
        if cuts > options.max_cuts or iterations > MAX_ITERATIONS:
            story = f"stopped at {reached:.4g} of the load after {iterations} iterations and {cuts} cut-backs"
            if attempt.min_det_f <= 0 or (first.converged and first.min_det_f <= 0):
                raise InvertedElementError(
                    f"elements invert: {story}; the largest det F <= 0 tried was {min(attempt.min_det_f, first.min_det_f):.3g}."
                )
            raise NoEquilibriumError(
                f"no stable equilibrium found: {story}; `mor_bench.mechanics.stability.limit_load` tells where its path ends."
            )
