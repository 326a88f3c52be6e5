"""The full-order model of a scene: nodal forces in, nodal displacements at the stable equilibrium out."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import UnconstrainedBodyError
from mor_bench.mechanics.assembly import Assembler, State
from mor_bench.mechanics.elements import element_of, shape_gradients
from mor_bench.mechanics.linear import BandedFactor, Factor, choose_solver
from mor_bench.mechanics.locking import warn_of_locking
from mor_bench.mechanics.newton import NewtonOptions, Solution, solve_equilibrium
from mor_bench.mechanics.pcg import RotatedPCG
from mor_bench.scene.scene import Scene

PCG_FROM = 3000
"""Unknowns from which conjugate gradients beat a fresh banded factor for each Newton step."""

RIGID_MODES = ("translation x", "translation y", "translation z", "rotation about x", "rotation about y", "rotation about z")


def free_rigid_modes(scene: Scene) -> list[str]:
    """The rigid motions that the supports do not stop, each named by its largest component."""
    x = scene.mesh.points[scene.fixed_nodes] - scene.mesh.points.mean(axis=0)
    x = x / np.abs(scene.mesh.points - scene.mesh.points.mean(axis=0)).max()
    modes = np.zeros((len(x), 3, 6))
    modes[:, :, :3] = np.eye(3)
    for axis in range(3):
        modes[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x)
    if len(x) == 0:
        return list(RIGID_MODES)
    _, s, vt = np.linalg.svd(modes.reshape(-1, 6), full_matrices=True)
    free = vt[np.append(s, np.zeros(6 - len(s))) <= 1e-9 * s[0]]
    return [RIGID_MODES[int(np.abs(mode).argmax())] for mode in free]


def check_supports(scene: Scene) -> None:
    """Raise `UnconstrainedBodyError`, naming the rigid modes that the supports leave free."""
    free = free_rigid_modes(scene)
    if free:
        raise UnconstrainedBodyError(
            f"the supports of {scene.name} leave rigid motions free: {', '.join(free)}; fix at least three nodes not in line."
        )


class FullOrderModel:
    """Finite elements under dead loads, over the free dofs of a scene.

    Raises
    ------
    UnconstrainedBodyError
        If the supports leave rigid motions free; the message names them.
    """

    def __init__(self, scene: Scene) -> None:
        check_supports(scene)
        warn_of_locking(scene)
        mesh = scene.mesh
        self.scene = scene
        self.n_unknowns = len(scene.free_dofs)
        number = np.full(mesh.n_dofs, self.n_unknowns, dtype=np.int64)
        number[scene.free_dofs] = np.arange(self.n_unknowns)
        dof_of_node = number.reshape(-1, 3)
        self.cell_dofs = dof_of_node[mesh.cells].reshape(mesh.n_cells, -1)
        self.assembler = Assembler(mesh.points, mesh.cells, dof_of_node, self.n_unknowns, scene.material, selective=scene.selective)
        self._direct = choose_solver(self.assembler.pattern)

    @cached_property
    def rest_tangent(self) -> NDArray[np.float64]:
        """Values of the stiffness at rest, N/m, in the assembler's pattern."""
        return self.assembler.force_and_tangent(np.zeros(self.n_unknowns))[1]

    @cached_property
    def rest_factor(self) -> Factor:
        """The stiffness at rest, factorised: the linear response is one back-solve."""
        return self.factor(self.rest_tangent)

    def force(self, q: NDArray[np.float64]) -> State:
        return self.assembler.force(q)

    def linearise(self, q: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        return self.assembler.force_and_tangent(q)

    def factor(self, tangent: NDArray[np.float64]) -> Factor:
        """Factorise a tangent; raises `NotPositiveDefiniteError`."""
        return self._direct.factor(tangent)

    @cached_property
    def pcg(self) -> RotatedPCG | None:
        """The iterative solver, where it is faster than a fresh factor for each step."""
        if self.n_unknowns < PCG_FROM or not isinstance(self.rest_factor, BandedFactor):
            return None
        mesh = self.scene.mesh
        element = element_of(mesh.cells)
        gradients, det_j = shape_gradients(mesh.points, mesh.cells, element.centre[None])
        cell_nodes = (self.cell_dofs[:, ::3] // 3).astype(np.int32)
        return RotatedPCG(self.assembler.pattern, self.rest_factor, cell_nodes, gradients[:, 0], det_j[:, 0] * element.weights.sum())

    def step(
        self, q: NDArray[np.float64], tangent: NDArray[np.float64], residual: NDArray[np.float64], tolerance: float
    ) -> NDArray[np.float64]:  # fmt: skip
        if self.pcg is None:
            return self.factor(tangent).solve(residual)
        return self.pcg.solve(q, tangent, residual, tolerance)

    def solve(self, load: NDArray[np.float64], start: NDArray[np.float64] | None = None, options: NewtonOptions = NewtonOptions()) -> Solution:
        """Equilibrium under forces on the free dofs, (n_free,) N; see `solve_equilibrium`."""
        return solve_equilibrium(self, load, start, options)
