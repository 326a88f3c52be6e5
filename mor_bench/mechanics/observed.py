"""Equilibria of a body with given displacements at a part of the surface instead of forces.

The observed nodes are held at their observed displacements and the supports at rest. All other
nodes are hidden and carry no force: f_int(u) = 0 there. The model is exact if every loaded node is
observed, as where a tool moves the body. Otherwise it neglects the hidden loads.
"""

from __future__ import annotations

import warnings
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Protocol, Self

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.counting import count, uncounted
from mor_bench.errors import LockingWarning, NoEquilibriumError, SolverError, UnsupportedSceneError
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.banded import BandedFactor
from mor_bench.mechanics.compliance import Compliance
from mor_bench.mechanics.load_steps import LoadSteps
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.mechanics.newton import NewtonOptions, Solution
from mor_bench.mechanics.pattern import Pattern
from mor_bench.mechanics.pressed import full_order_model
from mor_bench.mechanics.rotated import RotatedRest, SingleFactor, nodal_rotations
from mor_bench.mechanics.turned import along_axes, in_frames
from mor_bench.scene.scene import Scene
from mor_bench.specs import SolverName

Array = NDArray[np.float64]


class _HiddenRest(RotatedRest):
    """`RotatedRest` of the hidden nodes, which rotate with the whole body.

    Parameters
    ----------
    factor : SingleFactor
        Factor of the hidden nodes' stiffness at rest.
    pattern : Pattern
        Pattern of that stiffness.
    whole : FullOrderModel
    hidden : (n_hidden,) int64
        Indices of the hidden dofs among the free ones.
    """

    def __init__(
        self,
        factor: SingleFactor,
        pattern: Pattern,
        whole: FullOrderModel,
        hidden: NDArray[np.int64],
    ) -> None:
        super().__init__(factor, pattern, whole.turning_cells, whole.moving_frames)
        self._whole, self._hidden = whole.assembler.pattern, hidden
        moving = whole.moving_nodes
        rows = np.searchsorted(moving, np.unique(whole.scene.free_dofs[hidden] // 3))
        self._rows = np.append(rows, len(moving))
        self._base = np.zeros(whole.n_unknowns)
        self.soft(self.turned(None))  # computes what copies share

    def beside(self, base: Array) -> Self:
        """Return a copy for displacements q relative to a state of the whole body, (n_free,), m."""
        found = copy(self)
        found._base = base
        return found

    def turned(self, q: Array | None) -> Array:
        base = self._base.copy()
        if q is not None:
            base[self._hidden] += q
        u = np.append(self._whole.pad(base), np.zeros(3)).reshape(-1, 3)
        if self.frames is not None:
            u = along_axes(u, *self.frames)
        rotations = np.empty((len(u), 3, 3))
        iterations = nodal_rotations(u, *self.cells, rotations)
        count(multiply_adds=4 * self.cells[1].size + 20 * len(rotations) + 40 * int(iterations))
        if self.frames is not None:
            rotations = in_frames(rotations, *self.frames)
        return np.asarray(rotations[self._rows])


class _HiddenModel(FullOrderModel):
    """The hidden nodes relative to a state u₀ of the whole body: u = u₀ + q.

    The internal force is f(u₀ + q) - f(u₀), and the load is -f(u₀).
    """

    _base: Array
    _offset: Array

    def __init__(self, whole: FullOrderModel, scene: Scene, solver: SolverName | None) -> None:
        super().__init__(scene, solver)
        self._whole, self.linear_at_rest = whole, whole.linear_at_rest
        self.hidden = np.searchsorted(whole.scene.free_dofs, scene.free_dofs)
        inside = np.zeros(whole.n_unknowns, dtype=bool)
        inside[self.hidden] = True
        pattern = whole.assembler.pattern
        self._kept = np.flatnonzero(inside[pattern.rows] & inside[pattern.indices])
        self.beside_force = np.zeros(whole.n_unknowns)

    @cached_property
    def rest_tangent(self) -> Array:
        return self._whole.rest_tangent[self._kept]

    def beside(self, base: Array) -> Self:
        """Return the model relative to another state of the whole body, (n_free,), m."""
        found = copy(self)
        found._base, found.beside_force = base, self._whole.force(base).force
        found._offset = found.beside_force[self.hidden]
        if self.turns:
            found.turned_rest = self.turned_rest.beside(base)
        return found

    @cached_property
    def turned_rest(self) -> _HiddenRest:
        factor = self.rest_factor
        assert isinstance(factor, BandedFactor | MultigridFactor)
        pattern = self.assembler.pattern
        return _HiddenRest(factor.single_precision(), pattern, self._whole, self.hidden)

    def at(self, q: Array) -> Array:
        """Return displacements of the whole body, (n_free,), m."""
        u = self._base.copy()
        u[self.hidden] += q
        return np.asarray(u)

    def _relative(self, state: State, q: Array) -> State:
        return State(
            state.force[self.hidden] - self._offset,
            state.energy_j - float(self._offset @ q),
            state.min_det_f,
        )

    def force(self, q: Array) -> State:
        return self._relative(self._whole.force(self.at(q)), q)

    def linearise(self, q: Array) -> tuple[State, Array]:
        state, values = self._whole.linearise(self.at(q))
        return self._relative(state, q), values[self._kept]


class ObservedModel:
    """Finite elements under given displacements of the observed nodes, over the free dofs.

    It offers `solve_many` as a `FullOrderModel` does, and `respond` and `to_coordinates` as a
    `Compliance` does.

    Parameters
    ----------
    scene : Scene
        A scene with observed nodes.
    solver : str, optional
        As for `FullOrderModel`.

    Raises
    ------
    UnsupportedSceneError
        If the scene has no observed nodes, or its equations are not known.
    UnconstrainedBodyError, MissingDependencyError
        As `FullOrderModel`.
    """

    def __init__(self, scene: Scene, solver: SolverName | None = None) -> None:
        if scene.observed_nodes is None:
            raise UnsupportedSceneError(f"{scene.name}: no displacements are observed.")
        self.scene = scene
        whole = FullOrderModel(scene, solver)
        held = replace(
            scene,
            # The whole model has the rest state, and moves the tool.
            spec=scene.generated.model_copy(
                update={"gravity": None, "constant_pressures": (), "loads": None}
            ),
            constant_pressures=(),
            fixed_nodes=np.union1d(scene.fixed_nodes, scene.observed_nodes),
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LockingWarning)  # the whole model warned
            self._model = _HiddenModel(whole, held, solver)
        self._model.prepare()
        self._seen = np.setdiff1d(np.arange(whole.n_unknowns), self._model.hidden)
        stiffness = whole.assembler.pattern.symmetric(whole.rest_tangent)
        self._coupling = sp.csr_array(stiffness[self._model.hidden][:, self._seen])

    def linear_response(self, observed: Array) -> Array:
        """Return the linear extension u_h = -K_hh⁻¹ K_ho u_o; h are hidden, o observed dofs.

        Parameters
        ----------
        observed : (n, n_free) float64
            Displacements, m; those of hidden dofs are ignored.

        Returns
        -------
        (n, n_free) float64
            Displacements of all free dofs, m.
        """
        out = np.empty(observed.shape)
        out[:, self._seen] = observed[:, self._seen]
        count(multiply_adds=len(out) * self._coupling.nnz)
        out[:, self._model.hidden] = -self._model.rest_factor.solve(
            np.asarray(self._coupling @ out[:, self._seen].T)
        ).T
        return out

    def respond(self, observed: Array) -> Array:
        """Return `linear_response` on all dofs, (n, n_dofs), m; zero at the supports."""
        return self.scene.at_all_dofs(self.linear_response(self.scene.at_free_dofs(observed)))

    def to_coordinates(self, axes: Array) -> Array:
        """Return Eᵀ A for all dofs, where E u_o is the linear extension of u_o.

        The product (Eᵀ A)ᵀ u_o equals Aᵀ (E u_o). Rows of dofs that are not observed are zero.

        Parameters
        ----------
        axes : (n_free, r) float64
            Matrix A.

        Returns
        -------
        (n_dofs, r) float64
        """
        out = np.zeros(axes.shape)
        with uncounted():
            hidden = self._model.rest_factor.solve(np.ascontiguousarray(axes[self._model.hidden]))
        out[self._seen] = axes[self._seen] - self._coupling.T @ hidden
        return self.scene.columns_at_all_dofs(out)

    def solve_many(
        self, observed: Array, options: NewtonOptions = NewtonOptions()
    ) -> list[Solution | SolverError]:
        """Solve for all free dofs, given the observed displacements.

        Returns a solution or an error for each sample.

        Parameters
        ----------
        observed : (n, n_free) float64
            Displacements, m; those of hidden dofs are ignored.
        options : NewtonOptions
            The tolerance bounds the residual on hidden dofs relative to the reactions on observed
            dofs. These reactions belong to the starting state, the linear response.
        """
        return [self._solved(self.linear_response(row[None])[0], options) for row in observed]

    def _solved(self, response: Array, options: NewtonOptions) -> Solution | SolverError:
        """Solve from the linear response; if that fails, in increments from rest."""
        u, steps, iterations = np.zeros(len(response)), LoadSteps(1.0), 0
        while True:
            base = u + (steps.target - steps.reached) * response
            found = self._beside(base, options.tolerance)
            if isinstance(found, Solution):
                iterations, u = iterations + found.iterations, found.displacement
                steps.accept()
                if steps.complete:
                    return replace(found, iterations=iterations, cuts=steps.cuts)
                continue
            steps.cut()
            if steps.cuts > options.max_cuts:
                return NoEquilibriumError(
                    f"no stable equilibrium found: stopped at {steps.reached:.4g} of the observed "
                    f"displacement; {found}"
                )

    def _beside(self, base: Array, tolerance: float) -> Solution | SolverError:
        """Solve from a state whose observed nodes have their observed displacements."""
        model = self._model.beside(base)
        force, load = model.beside_force, -model.beside_force[model.hidden]
        if not np.isfinite(force).all():
            return NoEquilibriumError("the linear response inverts elements.")
        size = float(np.linalg.norm(load))
        allowed = (
            min(1.0, tolerance * float(np.linalg.norm(force[self._seen])) / size) if size else 1.0
        )
        try:
            found = model.solve(load, options=NewtonOptions(allowed, max_cuts=0))
        except SolverError as error:
            return error
        return replace(found, displacement=model.at(found.displacement))


class LinearResponse(Protocol):
    """Linear response to the input of methods: a `Compliance` or an `ObservedModel`."""

    def respond(self, loads: Array, /) -> Array: ...
    def to_coordinates(self, axes: Array) -> Array: ...


def linear_response(scene: Scene) -> LinearResponse:
    """Prepare the linear response to forces or, with observed nodes, to their displacements.

    Where an instrument presses, it is that of linear elasticity with the same contact.
    """
    if scene.contact:
        from mor_bench.mechanics.linear_contact import LinearContact

        return LinearContact(scene)
    return (
        Compliance(full_order_model(scene))
        if scene.observed_nodes is None
        else ObservedModel(scene)
    )


def forward_model(scene: Scene, solver: SolverName | None = None) -> FullOrderModel | ObservedModel:
    """Return a factorised model whose input is forces or, with observed nodes, displacements."""
    if scene.observed_nodes is not None and not scene.contact:
        return ObservedModel(scene, solver)
    model = _contact_model(scene, solver) if scene.contact else full_order_model(scene, solver)
    model.prepare()
    return model


def _contact_model(scene: Scene, solver: SolverName | None) -> FullOrderModel:
    from mor_bench.mechanics.contact import ContactModel  # other scenes need not load it

    return ContactModel(scene, solver)


def generating_model(scene: Scene) -> FullOrderModel | ObservedModel:
    """Return the model whose input are the sampled loads: forces, or the motion of a tool."""
    if scene.contact:
        return _contact_model(scene, None)
    return ObservedModel(scene) if scene.motion else full_order_model(scene)
