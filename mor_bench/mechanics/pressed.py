"""The full-order model under pressures that follow the deformed surface."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import ClassVar, Self

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.errors import (
    InvalidInputError,
    InvertedElementError,
    NoEquilibriumError,
    SolverError,
    UnsupportedSceneError,
)
from mor_bench.mechanics.accelerated import accelerated, run_in_step
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.linear import NotPositiveDefiniteError
from mor_bench.mechanics.load_steps import LoadSteps
from mor_bench.mechanics.model import CERTIFY_TOLERANCE, FullOrderModel
from mor_bench.mechanics.newton import (
    MAX_ITERATIONS,
    NewtonOptions,
    Solution,
    checked_load,
    full_steps,
)
from mor_bench.mechanics.pressed_facets import PressedFacets
from mor_bench.mechanics.problem import Attempt
from mor_bench.mechanics.unsymmetric import LU_UP_TO, GeneralFactor, is_stable, whole_matrix
from mor_bench.scene.scene import Scene
from mor_bench.specs import SolverName

Array = NDArray[np.float64]

NOT_A_PRESSURE = 1e-6
"""Part of a load, relative to its norm, that no pressure on the regions explains: round-off."""

PREDICTOR_TOLERANCE = 1e-3
"""Relative tolerance of the linear solve that begins an increment."""


class PressedModel(FullOrderModel):
    """Finite-element model of a scene under pressures that follow the deformed surface.

    A load is that of the pressures on the undeformed body, from which the pressures are found. The
    force of the model is the internal force less the change of the pressures' force.

    Parameters
    ----------
    scene : Scene
        A scene whose pressures follow the surface.
    solver : str, optional
        As for `FullOrderModel`.

    Raises
    ------
    UnsupportedSceneError
        If no pressure of the scene follows the surface.
    UnconstrainedBodyError, MissingDependencyError
        As `FullOrderModel`.
    """

    follows: ClassVar[bool] = True

    def __init__(self, scene: Scene, solver: SolverName | None = None) -> None:
        if not scene.follows:
            raise UnsupportedSceneError(f"{scene.name}: no pressure follows the surface.")
        super().__init__(scene, solver)
        mesh = scene.mesh
        number = np.full(mesh.n_dofs, self.n_unknowns, dtype=np.int64)
        number[scene.free_dofs] = np.arange(self.n_unknowns)
        regions = scene.pressed_facets
        turned, dof_of_node = self.assembler.turned, number.reshape(-1, 3)
        self._facets = PressedFacets(
            self.points,
            regions,
            dof_of_node if turned is None else turned.dof_of_node,
            self.assembler.summed_pattern,
        )
        unit = scene.patch_weights.toarray().reshape(len(regions), 3, -1)
        self._loads = -scene.at_free_dofs(unit.swapaxes(1, 2).reshape(len(regions), -1)).T
        self.pressures = np.zeros(len(regions))
        self._at_rest = np.zeros(self.n_unknowns)

    def pressures_of(self, load: Array) -> Array:
        """Return the pressures (n_regions,), Pa, of a load (n_free,), N.

        Raises
        ------
        InvalidInputError
            If the load is not that of pressures on the regions.
        """
        pressures = np.linalg.lstsq(self._loads, load, rcond=None)[0]
        rest = float(np.linalg.norm(load - self._loads @ pressures))
        size = float(np.linalg.norm(load))
        if not rest <= NOT_A_PRESSURE * size:
            raise InvalidInputError(
                f"{self.scene.name}: forces must be those of pressures on its regions, which "
                f"follow the surface; a part of {rest / size:.2g} of them is not."
            )
        return np.asarray(pressures)

    def under(self, pressures: Array) -> Self:
        """Return the model under other pressures (n_regions,), Pa."""
        found = copy(self)
        found.pressures, found._at_rest = pressures, self._loads @ pressures
        return found

    def under_load(self, load: Array) -> Self:
        return self.under(self.pressures_of(load))

    def _moved(self, q: Array) -> Array:
        """Return the change of the pressures' force at displacements q, N."""
        if (turned := self.assembler.turned) is None:
            return self._facets.force(q, self.pressures) - self._at_rest
        return turned.gather(self._facets.force(turned.spread(q), self.pressures)) - self._at_rest

    def _less(self, state: State, q: Array) -> State:
        # The change is quadratic along the line to q, so that Simpson's rule gives its exact work.
        begin, middle, end = (self._moved(part * q) for part in (0.0, 0.5, 1.0))
        work = float((begin + 4.0 * middle + end) @ q) / 6.0
        return State(state.force - end, state.energy_j - work, state.min_det_f)

    def force(self, q: Array) -> State:
        return self._less(super().force(q), q)

    def linearise(self, q: Array) -> tuple[State, Array]:
        state, values = super().linearise(q)
        if (turned := self.assembler.turned) is None:
            return self._less(state, q), values + self._facets.stiffness(q, self.pressures)
        own = self._facets.stiffness(turned.spread(q), self.pressures)
        return self._less(state, q), values + turned.tangent(own)

    def whole_tangent(self, q: Array, tangent: Array) -> sp.csr_array | None:
        """Return -df/dq from the values of its symmetric part; None if that is all of it.

        It is also None if there are more than `LU_UP_TO` unknowns.
        """
        if self.n_unknowns > LU_UP_TO:
            return None
        if (turned := self.assembler.turned) is None:
            skew = self._facets.skew_stiffness(q, self.pressures)
        else:
            skew = turned.matrix(self._facets.skew_stiffness(turned.spread(q), self.pressures))
        if (constant := self.assembler.skew_tangent(q)) is not None:
            skew = sp.csr_array(skew + constant)
        return whole_matrix(self.assembler.pattern.symmetric(tangent), skew)

    def step(self, q: Array, tangent: Array, residual: Array, tolerance: float) -> Array:
        """Solve with the whole tangent, whose symmetric part is given; it may be indefinite."""
        whole = self.whole_tangent(q, tangent)
        if whole is None:
            try:
                return super().step(q, tangent, residual, tolerance)
            except NotPositiveDefiniteError:
                if self.n_unknowns > LU_UP_TO:
                    raise
                whole = self.assembler.pattern.symmetric(tangent)
        return GeneralFactor(whole).solve(residual)

    def certify(self, q: Array) -> None:
        """Raise `NotPositiveDefiniteError` if the equilibrium q is found unstable.

        It is stable if the symmetric part of its tangent is positive definite. Otherwise, the
        eigenvalues of the whole tangent decide.
        """
        tangent = self.linearise(q)[1]
        force = np.random.default_rng(0).normal(size=self.n_unknowns)
        try:
            super().step(q, tangent, force, CERTIFY_TOLERANCE)
        except NotPositiveDefiniteError:
            whole, symmetric = self.whole_tangent(q, tangent), self.assembler.pattern.symmetric
            if whole is None or not is_stable(whole, symmetric(self.rest_tangent)):
                raise

    def solve(
        self,
        load: Array,
        start: Array | None = None,
        options: NewtonOptions = NewtonOptions(),
    ) -> Solution:
        """Solve for forces of pressures on the free dofs, (n_free,) N; see `solve_equilibrium`.

        Raises
        ------
        InvalidInputError
            If the load is not that of pressures on the regions, or as `solve_equilibrium`.
        SolverError
            As `solve_equilibrium`.
        """
        found = self._solved([load], [start], options)[0]
        if isinstance(found, SolverError):
            raise found
        return found

    def solve_many(
        self,
        loads: Array,
        options: NewtonOptions = NewtonOptions(),
        starts: Sequence[Array | None] | None = None,
    ) -> list[Solution | SolverError]:
        """Solve for loads (m, n_free), N, optionally each from a guess (n_free,), m.

        Returns solutions, or the errors `solve` would raise.
        """
        return self._solved(list(loads), starts or [None] * len(loads), options)

    def _solved(
        self, loads: Sequence[Array], starts: Sequence[Array | None], options: NewtonOptions
    ) -> list[Solution | SolverError]:
        self.prepare()  # what copies share
        loads = [checked_load(load, number, self) for number, load in enumerate(loads)]
        parts = [self.under_load(load) for load in loads]
        found: list[Solution | SolverError | None] = [
            None if load.any() else Solution(np.zeros(self.n_unknowns), 1.0, 0, 0) for load in loads
        ]
        left, inverse = [i for i, one in enumerate(found) if one is None], self.accelerator
        spent = dict.fromkeys(left, 0)
        if inverse is not None:
            passes = (
                accelerated(
                    parts[i], inverse, loads[i], starts[i], options.tolerance, symmetric=False
                )
                for i in left
            )
            for number, attempt in run_in_step(inverse, passes):
                i = left[number]
                spent[i] = attempt.iterations
                if attempt.valid:
                    found[i] = Solution(attempt.q, attempt.min_det_f, attempt.iterations, 0)
        return [
            self._in_increments(parts[i], loads[i], starts[i], options, spent[i])
            if one is None
            else one
            for i, one in enumerate(found)
        ]

    def _in_increments(
        self, whole: Self, load: Array, start: Array | None, options: NewtonOptions, spent: int
    ) -> Solution | SolverError:
        """Solve by Newton's method, with the pressures in increments if they are too large.

        The tangent at an old state is rarely positive definite under a new pressure. So each
        increment begins with the linear response to it, of the old state under the old pressure.
        """
        tolerance, steps, smallest = options.tolerance, LoadSteps(1.0, growth=1.0), 1.0
        q = np.zeros(self.n_unknowns)
        if start is not None:
            attempt = full_steps(whole, load, start, tolerance)
            spent += attempt.iterations
            if attempt.valid:
                return Solution(attempt.q, attempt.min_det_f, spent, 0)
        while not steps.complete:
            old, new = (self.under(t * whole.pressures) for t in (steps.reached, steps.target))
            attempt = _increment(old, new, q, steps.target * load, tolerance)
            spent += attempt.iterations
            if attempt.valid:
                q = attempt.q
                steps.accept()
                continue
            smallest = min(smallest, attempt.min_det_f)
            steps.cut()
            if steps.cuts > options.max_cuts or spent > MAX_ITERATIONS:
                story = steps.story(spent)
                if smallest <= 0:
                    return InvertedElementError(f"elements invert: {story}.", cuts=steps.cuts)
                return NoEquilibriumError(f"no stable equilibrium found: {story}.", cuts=steps.cuts)
        return Solution(q, attempt.min_det_f, spent, steps.cuts)


def _increment(
    old: PressedModel, new: PressedModel, q: Array, load: Array, tolerance: float
) -> Attempt:
    """Solve under a new pressure, from the state under an old one."""
    residual = load - new.force(q).force
    try:
        step = old.step(q, old.linearise(q)[1], residual, PREDICTOR_TOLERANCE)
    except NotPositiveDefiniteError:
        return Attempt(q, 1.0, 1, converged=False)
    return full_steps(new, load, q + step, tolerance)


def full_order_model(scene: Scene, solver: SolverName | None = None) -> FullOrderModel:
    """Return the model of a scene's forces: dead ones, or pressures that follow the surface."""
    return PressedModel(scene, solver) if scene.follows else FullOrderModel(scene, solver)
