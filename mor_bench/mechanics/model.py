"""The full-order model of a scene, from nodal forces to displacements at a stable equilibrium."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cached_property
from importlib.util import find_spec
from typing import ClassVar, Self, get_args

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mor_bench.counting import uncounted
from mor_bench.errors import (
    MissingDependencyError,
    SolverError,
    SpecError,
    UnsupportedSceneError,
)
from mor_bench.machine import kernels_alone
from mor_bench.mechanics.assembly import Assembler, State
from mor_bench.mechanics.banded import BandedCholesky, BandedFactor
from mor_bench.mechanics.discretisation import (
    FOLLOWS,
    Discretisation,
    discretisation_of,
)
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.linear import (
    Factor,
    LinearSolver,
    NotPositiveDefiniteError,
    Pardiso,
    SparseLU,
)
from mor_bench.mechanics.locking import warn_if_ill_conditioned, warn_of_locking
from mor_bench.mechanics.multigrid import Multigrid, MultigridFactor
from mor_bench.mechanics.newton import NewtonOptions, Solution, solve_equilibria, solve_equilibrium
from mor_bench.mechanics.rest_state import solved_at_rest
from mor_bench.mechanics.rigid_motions import check_supports
from mor_bench.mechanics.rotated import (
    BlockJacobi,
    JacobiFactor,
    RotatedRest,
    conjugate_gradients,
)
from mor_bench.mechanics.warping import warp_of
from mor_bench.scene.constant_pressures import followers_of
from mor_bench.scene.scene import Scene
from mor_bench.specs import CONTACT, NO_EQUATIONS, NO_FORCES, SolverName

SOLVERS: tuple[SolverName, ...] = get_args(SolverName)
"""Methods of solving equilibria.

auto
    Anderson-accelerated iteration with the stiffness at rest, factorised once in single precision
    and rotated with the nodes. If it fails, Newton's method follows, with `cholesky` on small
    meshes and `rotated-pcg` on others.
rotated-pcg
    Newton's method. Conjugate gradients, preconditioned by the rotated rest-state factor, find each
    step.
jacobi-pcg
    Newton's method. Conjugate gradients, preconditioned by the tangent's own 3x3 diagonal blocks,
    find each step.
cholesky, superlu, pardiso
    Newton's method with a fresh direct factor for each step: banded Cholesky, SuperLU, or MKL's
    (extra `mkl`).

Meshes whose band exceeds `MAX_BAND_ENTRIES` use multigrid instead of a rest-state factor.
"""

MAX_BAND_ENTRIES = 5e7
"""Largest number of entries of a banded rest-state factor (0.4 GB); larger meshes use multigrid."""

PCG_FROM = 3000
"""Number of unknowns above which conjugate gradients beat a banded factor per Newton step."""
JACOBI_ITERATIONS = 20_000
CERTIFY_TOLERANCE = 1e-2


def missing_library(solver: SolverName) -> str | None:
    """Return what must be installed before a solver can be used; None if nothing."""
    if solver == "pardiso" and find_spec("pypardiso") is None:
        return "the solver `pardiso` needs pypardiso: pip install 'mor-bench[mkl]'"
    return None


SYMMETRIC_PART = (
    "Constant pressures that follow the surface are solved for with the symmetric part of the "
    "tangent, which may refuse states that a sampled one in `[loads]` reaches with the whole."
)

_BODIES = "an instrument presses bodies that vary between samples"


def unknown_equations(scene: Scene, *, observed: bool = False, contact: bool = False) -> str | None:
    """Return why a scene's equilibria cannot be solved for; None if they can.

    Parameters
    ----------
    scene : Scene
    observed : bool
        Whether observed displacements may replace the forces, as for an `ObservedModel`, and
        pressures may follow the surface, as for a `PressedModel`, and an instrument may press.
    contact : bool
        Whether an instrument may press.
    """
    if scene.material is None:
        return NO_EQUATIONS
    if observed:  # known displacements tell nothing about pressures that vary
        return FOLLOWS if scene.follows and scene.observed_nodes is not None else None
    if contact and scene.contact:
        if followers_of(scene.constant_pressures):
            return FOLLOWS
        return _BODIES if scene.parameter_names else None
    if scene.contact:
        return CONTACT
    if scene.follows or followers_of(scene.constant_pressures):
        return FOLLOWS
    return None if scene.observed_nodes is None else NO_FORCES


def rest_displacement(scene: Scene) -> NDArray[np.float64] | None:
    """Return the displacements (n_nodes, 3) of the rest state under the pre-load, m.

    The pre-load is gravity and constant pressures. It is solved for once. Returns None for a scene
    without any.

    Raises
    ------
    SolverError
        If the body has no stable equilibrium under the pre-load.
    """
    if not scene.generated.is_preloaded:
        return None
    if "rest" not in scene.memo:
        try:
            found = solved_at_rest(scene, FullOrderModel)
        except SolverError as error:
            causes = {
                "gravity": scene.generated.gravity,
                "constant pressures": scene.constant_pressures,
            }
            acting = " and ".join(name for name, given in causes.items() if given)
            text = f"{scene.name}: no rest state under {acting}: {error}"
            if followers_of(scene.constant_pressures):
                text = f"{text} {SYMMETRIC_PART}"
            raise SolverError(text) from None
        scene.memo["rest"] = found
    return scene.memo["rest"].reshape(-1, 3)


def body_of(scene: Scene, chosen: NDArray[np.int64] | slice = slice(None)) -> Discretisation:
    """Return the discretisation of a scene's cells, measured from its rest state."""
    body = discretisation_of(scene, chosen)
    return replace(body, rest=rest_displacement(scene))


class FullOrderModel:
    """Finite-element model of a scene under dead loads; its unknowns are the free dofs.

    Under a pre-load, displacements and forces are measured from the rest state, so that no load
    causes no displacement. Constant pressures that follow the surface count as internal forces.

    Parameters
    ----------
    scene : Scene
    solver : str, optional
        One of `SOLVERS`; the scene's own solver by default.

    Raises
    ------
    UnsupportedSceneError
        If the scene's snapshots were imported, so that its equations are unknown; or its pressures
        follow the surface, see `PressedModel`.
    UnconstrainedBodyError
        If the supports leave rigid motions free; the message names them.
    MissingDependencyError
        If the solver's library is not installed.
    """

    follows: ClassVar[bool] = False
    """Whether the loads follow the surface."""

    def __init__(self, scene: Scene, solver: SolverName | None = None) -> None:
        if scene.follows and not self.follows:
            raise UnsupportedSceneError(f"{scene.name}: {FOLLOWS}.")
        check_supports(scene)
        body = body_of(scene)
        warn_of_locking(scene)
        self.solver = solver or scene.generated.solver
        if self.solver not in SOLVERS:
            raise SpecError(f"`solver` must be one of {', '.join(SOLVERS)}; got {self.solver!r}.")
        missing = missing_library(self.solver)
        if missing:
            raise MissingDependencyError(f"{missing}.")
        mesh = scene.mesh
        self.scene = scene
        self.n_unknowns = len(scene.free_dofs)
        number = np.full(mesh.n_dofs, self.n_unknowns, dtype=np.int64)
        number[scene.free_dofs] = np.arange(self.n_unknowns)
        dof_of_node = number.reshape(-1, 3)
        self.cell_dofs = dof_of_node[mesh.cells].reshape(mesh.n_cells, -1)
        self.rest: NDArray[np.float64] | None = None
        if body.rest is not None:
            self.rest = scene.at_free_dofs(body.rest.reshape(1, -1))[0]
        self.springs: sp.csr_array | None = None
        if body.springs is not None:
            springs, free = body.springs, scene.free_dofs
            if scene.frames is not None:
                turn = scene.frames.matrix(mesh.n_nodes)
                springs = sp.csr_array(turn @ springs @ turn.T)
            self.springs = springs[free][:, free]
        self.points = mesh.points if body.rest is None else mesh.points + body.rest
        self.assembler = Assembler(body, dof_of_node, self.n_unknowns, frames=scene.frames)
        self.extent = self.assembler.extent_m
        self.linear_at_rest = not body.followers  # the skew part of their tangent is left out
        self._direct = self._direct_solver()

    def _direct_solver(self) -> LinearSolver:
        pattern = self.assembler.pattern
        if self.solver == "cholesky":
            return self._narrow
        if self.solver == "superlu":
            return SparseLU(pattern)
        if self.solver == "pardiso":
            return Pardiso(pattern)
        if self._narrow.entries <= MAX_BAND_ENTRIES:
            return self._narrow
        points = self.scene.mesh.points[self.moving_nodes]
        return Multigrid(pattern, points, self.moving_frames)

    @cached_property
    def _narrow(self) -> BandedCholesky:
        """Factorises in an order of the unknowns with a narrow band."""
        return BandedCholesky(self.assembler.pattern)

    @cached_property
    def rest_tangent(self) -> NDArray[np.float64]:
        """Values of the stiffness at rest in the assembler's pattern, N/m."""
        return self.assembler.force_and_tangent(np.zeros(self.n_unknowns))[1]

    @cached_property
    def rest_factor(self) -> Factor:
        """Factor of the stiffness at rest; a linear response is one back-solve."""
        if self.solver == "jacobi-pcg":
            return JacobiFactor(self.assembler.pattern, self.rest_tangent)
        # A Pardiso solver holds one factor at a time.
        solver = self._direct_solver() if self.solver == "pardiso" else self._direct
        try:
            factor = solver.factor(self.rest_tangent)
        except NotPositiveDefiniteError:
            raise SolverError(
                f"{self.scene.name}: the stiffness at rest is not positive definite in "
                "double precision; Poisson's ratio may be too close to 0.5, or the body "
                "too slender."
            ) from None
        if isinstance(factor, BandedFactor):
            warn_if_ill_conditioned(
                self.scene.name, self.assembler.pattern, self.rest_tangent, factor
            )
        return factor

    def prepare(self) -> None:
        """Compute the factors that all solves share, and load all kernels, so no query has to."""
        if not self.turns:
            _ = self.rest_factor
            return
        with uncounted():  # few loads are large enough to use this kernel
            self.turned_rest.bent(np.zeros(self.n_unknowns))

    @property
    def turns(self) -> bool:
        """True if solves use the rotated rest-state factor."""
        return self.solver in ("auto", "rotated-pcg")

    def force(self, q: NDArray[np.float64]) -> State:
        return self.assembler.force(q)

    def linearise(self, q: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        return self.assembler.force_and_tangent(q)

    def factor(self, tangent: NDArray[np.float64]) -> Factor:
        """Factorise a tangent, or raise `NotPositiveDefiniteError`."""
        return self._direct.factor(tangent)

    @cached_property
    def turned_rest(self) -> RotatedRest:
        """An approximate inverse of all tangents, R K₀⁻¹ Rᵀ; needs a banded or multigrid factor."""
        factor, pattern, warp = self.rest_factor, self.assembler.pattern, None
        assert isinstance(factor, BandedFactor | MultigridFactor)
        single, cells, narrow = factor.single_precision(), self.turning_cells, self._narrow
        if self.moving_frames is None and narrow.node_entries <= MAX_BAND_ENTRIES:
            warp = warp_of(self.points, self.scene.mesh.cells, cells, pattern, narrow.place)
        return RotatedRest(single, pattern, cells, self.moving_frames, warp)

    @property
    def moving_frames(self) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Numbers among the moving nodes (n,), and axes (n, 3, 3), of nodes with frames."""
        frames = self.scene.frames
        if frames is None:
            return None
        own = np.isin(frames.nodes, self.moving_nodes)
        return np.searchsorted(self.moving_nodes, frames.nodes[own]), frames.axes[own]

    @property
    def moving_nodes(self) -> NDArray[np.int64]:
        """Nodes with a free dof, (n_moving,), sorted."""
        return np.unique(self.scene.free_dofs // 3)

    @property
    def turning_cells(self) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
        """The cells' moving nodes, and gradients and volumes at the centres; see `RotatedRest`."""
        mesh = self.scene.mesh
        element = element_of(mesh.cells)
        gradients, det_j = shape_gradients(self.points, mesh.cells, element.centre[None])
        number = np.full(mesh.n_nodes, len(self.moving_nodes), dtype=np.int32)
        number[self.moving_nodes] = np.arange(len(self.moving_nodes))
        return number[mesh.cells], gradients[:, 0], det_j[:, 0] * element.weights.sum()

    @cached_property
    def _jacobi(self) -> BlockJacobi:
        return BlockJacobi(self.assembler.pattern)

    @property
    def iterative(self) -> bool:
        """True if Newton's steps are found by conjugate gradients."""
        by_size = self.n_unknowns >= PCG_FROM or isinstance(self._direct, Multigrid)
        return self.solver in ("rotated-pcg", "jacobi-pcg") or (self.solver == "auto" and by_size)

    def certify(self, q: NDArray[np.float64]) -> None:
        """Look for negative curvature by conjugate gradients, if the solver is iterative."""
        if self.iterative:
            force = np.random.default_rng(0).normal(size=self.n_unknowns)
            self.step(q, self.linearise(q)[1], force, CERTIFY_TOLERANCE)

    @property
    def accelerator(self) -> RotatedRest | None:
        return self.turned_rest if self.solver == "auto" else None

    def step(
        self,
        q: NDArray[np.float64],
        tangent: NDArray[np.float64],
        residual: NDArray[np.float64],
        tolerance: float,
    ) -> NDArray[np.float64]:
        pattern = self.assembler.pattern
        if self.solver == "jacobi-pcg":
            self._jacobi.take(tangent)
            return conjugate_gradients(
                pattern, tangent, self._jacobi, residual, tolerance, JACOBI_ITERATIONS
            )[0]
        if self.iterative:
            return conjugate_gradients(
                pattern, tangent, self.turned_rest.at(q), residual, tolerance
            )[0]
        return self.factor(tangent).solve(residual)

    def under_load(self, load: NDArray[np.float64]) -> Self:
        """Return the model whose forces belong to a load (n_free,), N; they depend on it if it
        follows the surface."""
        return self

    def solve(
        self,
        load: NDArray[np.float64],
        start: NDArray[np.float64] | None = None,
        options: NewtonOptions = NewtonOptions(),
    ) -> Solution:
        """Solve for forces on the free dofs, (n_free,) N; see `solve_equilibrium`."""
        with self._threads():
            return solve_equilibrium(self, load, start, options)

    def _threads(self) -> AbstractContextManager[None]:
        return kernels_alone() if self.assembler.in_slabs else nullcontext()

    def solve_many(
        self,
        loads: NDArray[np.float64],
        options: NewtonOptions = NewtonOptions(),
        starts: Sequence[NDArray[np.float64] | None] | None = None,
    ) -> list[Solution | SolverError]:
        """Solve for loads (m, n_free), N, optionally each from a guess (n_free,), m.

        Returns solutions, or the errors `solve` would raise.
        """
        with self._threads():
            found = dict(solve_equilibria(self, list(loads), starts, options))
        return [found[i] for i in range(len(loads))]
