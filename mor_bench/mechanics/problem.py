"""Interfaces between the nonlinear solve and its models, and helpers that its passes share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.linear import Factor

Array = NDArray[np.float64]

ROUND_OFF = 1e-13
"""Size of a correction, relative to the displacement, that counts as round-off.

Slender bodies may never meet a force tolerance, so such a correction ends the solve. Once the
residual stagnates, a correction of this size relative to the body also ends it. Adding 1 in F then
cancels the digits of the strain.
"""
LINEAR = 1e-11
"""Largest displacement, relative to the body, that the linear response gives to all digits."""


class Turning(Protocol):
    """An approximate inverse of all tangents, which rotates with the body."""

    def turned(self, q: Array | None) -> Array:
        """Return the nodal rotations of the body at q; the identity for None."""
        ...

    def soft(self, rotations: Array) -> tuple[Array, Array]:
        """Return the rotated response at rest to a random force, and this force.

        Soft modes dominate the response.
        """
        ...

    def bent(self, q: Array) -> Array | None:
        """Return a linear response q with true rotations; None if that is not worth it."""
        ...

    def solve_many(self, residuals: Sequence[Array], rotations: Sequence[Array]) -> Array:
        """Return corrections (m, n_unknowns), each for one residual under its own rotations.

        A correction does not depend on the other residuals.
        """
        ...


class Problem(Protocol):
    """A model with unknowns q that the nonlinear solve can handle.

    Attributes
    ----------
    n_unknowns : int
    extent : float
        Unknowns of this size are displacements of the size of the body.
    linear_at_rest : bool
        Whether ``rest_factor`` holds the whole derivative of the force at rest.
    """

    n_unknowns: int
    extent: float
    linear_at_rest: bool

    @property
    def accelerator(self) -> Turning | None:
        """Approximate inverse for the accelerated pass; None if the model has none."""
        ...

    def force(self, q: Array) -> State: ...
    def linearise(self, q: Array) -> tuple[State, Array]:
        """Return the state and the tangent at q."""
        ...

    def step(self, q: Array, tangent: Array, residual: Array, tolerance: float) -> Array:
        """Solve tangent · step = residual; iterative solvers stop at the relative tolerance.

        Raises `NotPositiveDefiniteError` if the tangent is found not positive definite.
        """
        ...

    def certify(self, q: Array) -> None:
        """Look for negative curvature at a solution q, unless earlier steps excluded it.

        Raises `NotPositiveDefiniteError` if it finds any.
        """
        ...

    @property
    def rest_tangent(self) -> Array: ...
    @property
    def rest_factor(self) -> Factor: ...


@dataclass(frozen=True)
class Attempt:
    """The outcome of one pass of the nonlinear solve."""

    q: Array
    min_det_f: float
    iterations: int
    converged: bool

    @property
    def valid(self) -> bool:
        return self.converged and self.min_det_f > 0


def is_round_off(step: Array, q: Array, extent: float = 0.0) -> bool:
    """Return whether a step is round-off relative to q, or to the extent if that is larger."""
    return float(np.abs(step).max()) <= ROUND_OFF * max(float(np.abs(q).max()), extent)


def is_linear(problem: Problem, q: Array) -> bool:
    """Return whether a linear response is so small that it solves the nonlinear problem."""
    return problem.linear_at_rest and float(np.abs(q).max()) <= LINEAR * problem.extent
