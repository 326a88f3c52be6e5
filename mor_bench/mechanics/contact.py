"""Equilibria of a body that a rigid instrument presses, from the instrument's displacement."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import (
    InvertedElementError,
    NoEquilibriumError,
    SolverError,
    UnsupportedSceneError,
)
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.contact_acceleration import (
    PressedInverse,
    TouchedDofs,
    accelerated_contact,
)
from mor_bench.mechanics.contact_points import ContactPoints, NodalContact, Touch, motion_of
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.load_steps import LoadSteps
from mor_bench.mechanics.model import CERTIFY_TOLERANCE, FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, Solution, descent, is_certified
from mor_bench.mechanics.problem import Attempt, Problem, is_round_off
from mor_bench.mechanics.rotated import conjugate_gradients
from mor_bench.scene.scene import Scene
from mor_bench.specs import SolverName

Array = NDArray[np.float64]

ITERATIONS = 60
"""Largest number of Newton iterations in one step of the instrument."""

MOST_ITERATIONS = 1000
"""Largest number of Newton iterations, over all steps of the instrument."""

MAX_HALVINGS = 14
ARMIJO = 1e-4
LEVEL = 0.9
"""Slope of the potential at the end of a step, relative to its begin, that accepts the step.

At small strains, round-off in the energy hides its descent. The slope does not suffer from that.
"""


class PressedProblem(Problem, Protocol):
    """A model of a body and an instrument, full-order or reduced."""

    def under(self, motion: Array) -> Self:
        """Return the model with the instrument displaced by (3,), m."""
        ...

    def contact_size(self, q: Array) -> float:
        """Return the norm of the contact's force on the unknowns."""
        ...

    def quickly(self, start: Array, tolerance: float) -> Attempt:
        """Solve by an accelerated iteration; without one, the attempt has not converged."""
        ...


def solve_contact(
    model: PressedProblem, motion: Array, first_step: float, options: NewtonOptions
) -> Solution | SolverError:
    """Find the equilibrium of a body that an instrument presses; return an error if there is none.

    The instrument moves along a straight line. Each step begins with the model's accelerated
    iteration, if it has one. If that fails, a descent on the potential of body and contact with a
    line search follows, so that contact may open and close. Steps that fail are halved.

    Parameters
    ----------
    model : PressedProblem
    motion : (3,) float64
        Displacement of the instrument, m.
    first_step : float
        Largest step, as a part of the motion.
    options : NewtonOptions
        The tolerance is relative to the norm of the contact's force.
    """
    q, steps, spent = np.zeros(model.n_unknowns), LoadSteps(first_step), 0
    while True:
        placed = model.under(steps.target * motion)
        half = model.under(0.5 * (steps.reached + steps.target) * motion)
        for places in ([placed], [half, placed]):
            found = _quickly(places, q, options.tolerance)
            spent += found.iterations
            if found.valid:
                break
        else:
            found = _settled(placed, q, options.tolerance)
            spent += found.iterations
        if found.valid:
            q = found.q
            steps.accept()
            steps.increment = min(steps.increment, first_step)
            if steps.complete:
                return Solution(q, found.min_det_f, spent, steps.cuts)
            continue
        steps.cut()
        if steps.cuts > options.max_cuts or spent > MOST_ITERATIONS:
            story = f"{steps.story(spent)}; the load is the motion of the instrument"
            if found.min_det_f <= 0:
                return InvertedElementError(f"elements invert: {story}.", cuts=steps.cuts)
            return NoEquilibriumError(f"no stable equilibrium found: {story}.", cuts=steps.cuts)


def _quickly(places: Sequence[PressedProblem], q: Array, tolerance: float) -> Attempt:
    """Return the last of accelerated iterations with the instrument at several places in turn."""
    found = Attempt(q, 1.0, 0, converged=True)
    for placed in places:
        if found.valid:
            after = placed.quickly(found.q, tolerance)
            found = replace(after, iterations=found.iterations + after.iterations)
    return found


def _settled(model: PressedProblem, start: Array, tolerance: float) -> Attempt:
    """Descend on the potential of body and contact from a valid state, never leaving det F > 0."""
    if not start.any() and not model.contact_size(start):  # exactly at rest
        return Attempt(start, model.force(start).min_det_f, 1, converged=True)
    q, before = start, np.inf
    for iteration in range(1, ITERATIONS + 1):
        state, tangent = model.linearise(q)
        residual = -state.force
        step, stable = descent(model, q, tangent, residual)
        size = float(np.linalg.norm(residual))
        floor, before = model.extent if size > 0.5 * before else 0.0, size
        small = size <= tolerance * model.contact_size(q) or is_round_off(step, q, floor)
        if stable and small:
            return Attempt(q, state.min_det_f, iteration, converged=is_certified(model, q))
        slope = float(residual @ step)
        for halving in range(MAX_HALVINGS):
            length = 0.5**halving
            trial = model.force(q + length * step)
            descends = trial.energy_j <= state.energy_j - ARMIJO * length * slope
            levels = abs(float(trial.force @ step)) <= LEVEL * slope
            if trial.min_det_f > 0 and (descends or levels):
                break
        else:
            if stable and is_round_off(step, q, model.extent):  # nothing can descend any more
                return Attempt(q, state.min_det_f, iteration, converged=is_certified(model, q))
            return Attempt(q, trial.min_det_f, iteration, converged=False)
        q = q + length * step
    return Attempt(q, trial.min_det_f, ITERATIONS, converged=False)


class ContactModel(FullOrderModel):
    """Finite elements of a body that an instrument presses; its unknowns are the free dofs.

    Its input is the displacement of the instrument from its place at rest, written at the nodes
    that it may touch, as for an `ObservedModel`.

    Parameters
    ----------
    scene : Scene
        A scene with an instrument.
    solver : str, optional
        As for `FullOrderModel`.

    Raises
    ------
    UnsupportedSceneError
        If no instrument presses the scene.
    UnconstrainedBodyError, MissingDependencyError
        As `FullOrderModel`.
    SpecError
        If the instrument penetrates the body at rest under its pre-load.
    """

    def __init__(self, scene: Scene, solver: SolverName | None = None) -> None:
        if scene.contact is None:
            raise UnsupportedSceneError(f"{scene.name}: no instrument presses it.")
        super().__init__(scene, solver)
        number = np.full(scene.mesh.n_dofs, self.n_unknowns, dtype=np.int64)
        number[scene.free_dofs] = np.arange(self.n_unknowns)
        points, pattern = ContactPoints(scene), self.assembler.pattern
        self._contact = NodalContact(points, number.reshape(-1, 3), pattern)
        self.motion = np.zeros(3)
        self._touched: TouchedDofs | None = None

    def prepare(self) -> None:
        _ = self.rest_tangent
        if self.iterative:
            _ = self.turned_rest if self.turns else self.rest_factor
        if self._touched is None and self.accelerator is not None:
            self._touched = TouchedDofs(self, self._contact.points)

    def under(self, motion: Array) -> Self:
        """Return the model with the instrument displaced by (3,), m."""
        found = copy(self)
        found.motion = motion
        return found

    def touch(self, q: Array) -> Touch:
        """Return the contact at displacements q (n_free,), m."""
        return self._contact.touch(q, self.motion)

    def contact_size(self, q: Array) -> float:
        """Return the norm of the contact's force on the free dofs, N."""
        return float(np.linalg.norm(self._contact.force(self.touch(q))))

    def reaction(self, q: Array) -> Array:
        """Return the force (3,), N, of the body on the instrument at displacements q (n_free,)."""
        return np.asarray(-self.touch(q).forces.sum(axis=0))

    def contact_force(self, touch: Touch) -> Array:
        """Return the forces (n_free,), N, of a contact on the body."""
        return self._contact.force(touch)

    def quickly(self, start: Array, tolerance: float) -> Attempt:
        if self._touched is None:
            return Attempt(start, 1.0, 0, converged=False)
        found = accelerated_contact(self, self._touched, start, tolerance)
        stable = found.valid and self._is_stable(found.q, self._touched)
        return replace(found, converged=stable)

    def _is_stable(self, q: Array, touched: TouchedDofs) -> bool:
        """Return whether no negative curvature was found at q."""
        force = np.random.default_rng(0).normal(size=self.n_unknowns)
        tangent, touch = self.linearise(q)[1], self.touch(q)
        try:
            if self.iterative and len(touch.points):
                inverse = PressedInverse(self.turned_rest.at(q), touched, touch)
                pattern = self.assembler.pattern
                conjugate_gradients(pattern, tangent, inverse, force, CERTIFY_TOLERANCE)
            else:
                self.step(q, tangent, force, CERTIFY_TOLERANCE)
        except NotPositiveDefiniteError:
            return False
        return True

    def force(self, q: Array) -> State:
        return self._pressed(super().force(q), self.touch(q))

    def linearise(self, q: Array) -> tuple[State, Array]:
        state, values = super().linearise(q)
        touch = self.touch(q)
        return self._pressed(state, touch), values + self._contact.stiffness(touch)

    def _pressed(self, state: State, touch: Touch) -> State:
        force = state.force - self._contact.force(touch)
        return State(force, state.energy_j + touch.energy_j, state.min_det_f)

    def solve(
        self,
        load: Array,
        start: Array | None = None,
        options: NewtonOptions = NewtonOptions(),
    ) -> Solution:
        """Solve for a displacement of the instrument, given at the free dofs, (n_free,), m.

        Raises
        ------
        InvalidInputError
            If it is not the same at all nodes that the instrument may touch.
        SolverError
            If there is no stable equilibrium.
        """
        found = self._solved(load, options)
        if isinstance(found, SolverError):
            raise found
        return found

    def solve_many(
        self,
        loads: Array,
        options: NewtonOptions = NewtonOptions(),
        starts: Sequence[Array | None] | None = None,
    ) -> list[Solution | SolverError]:
        """Solve for displacements (m, n_free), m; return solutions, or errors of `solve`.

        Starts are not used, since every solve follows the path of the instrument.
        """
        return [self._solved(load, options) for load in loads]

    def _solved(self, given: Array, options: NewtonOptions) -> Solution | SolverError:
        self.prepare()  # what copies share
        motion = motion_of(self.scene, given)
        points = self._contact.points
        found = solve_contact(self, motion, points.first_step(motion), options)
        if isinstance(found, Solution):
            moved = self.scene.at_all_dofs(found.displacement[None]).reshape(-1, 3)
            depth, allowed = points.depth_of_nodes(moved, motion), points.surface.deepest_m
            if depth > allowed:
                return NoEquilibriumError(
                    f"no valid equilibrium found: a node lies {depth:.3g} m deep in the "
                    f"instrument, more than {allowed:.3g} m, so the body has passed through it.",
                    cuts=found.cuts,
                )
        return found


def penetrations(scene: Scene, displacements: Array, motions: Array) -> Array:
    """Return the largest depth (n,), m, of the surface in the instrument: the penalty's error.

    Parameters
    ----------
    scene : Scene
        A scene with an instrument.
    displacements : (n, n_nodes, 3) float64
        Of the body, m.
    motions : (n, 3) float64
        Of the instrument, m.
    """
    points = ContactPoints(scene)
    found = [
        points.touch(points.surface.values @ u, motion).penetration.max(initial=0.0)
        for u, motion in zip(displacements, motions, strict=True)
    ]
    return np.array(found)
