"""felupe as a contender: its Newton with several linear solvers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp

from mor_bench.scene.scene import Scene
from tests.benchmarks.contenders import MAX_STEPS, TOLERANCE, Array, Contender, common_material

LinearSolve = Callable[[Any, Array], Array]


def stress(mu: float, lmbda: float, x: list[Array]) -> list[Array]:
    """Return the stress P = F S, (3, 3, n_points, n_cells), and no state variables."""
    return [np.einsum("iM...,MJ...->iJ...", x[0], second_stress(mu, lmbda, x[0])), x[1]]


def second_stress(mu: float, lmbda: float, F: Array) -> Array:
    """S = λ tr(E) I + 2 μ E."""
    S = mu * np.einsum("mI...,mJ...->IJ...", F, F)
    trace = 0.5 * lmbda * (np.einsum("II...->...", S) / mu - 3)
    for i in range(3):
        S[i, i] += trace - mu
    return np.asarray(S)


def elasticity(mu: float, lmbda: float, x: list[Array]) -> list[Array]:
    """dP/dF = λ F_iJ F_kL + μ (F_iL F_kJ + (F Fᵀ)_ik δ_JL) + δ_ik S_JL."""
    F = x[0]
    A = lmbda * np.einsum("iJ...,kL...->iJkL...", F, F)
    A += mu * np.einsum("iL...,kJ...->iJkL...", F, F)
    B, S = mu * np.einsum("iM...,kM...->ik...", F, F), second_stress(mu, lmbda, F)
    for i in range(3):
        A[:, i, :, i] += B
        A[i, :, i] += S
    return [A]


class TunedPardiso:
    """Pardiso's Cholesky factorisation of the upper triangle, analysed once per pattern."""

    def __init__(self) -> None:
        self._analysed: list[tuple[Any, tuple[Any, Any]]] = []

    def __call__(self, matrix: sp.csr_matrix, rhs: Array) -> Array:
        from pypardiso import PyPardisoSolver

        upper = sp.triu(matrix, format="csr")
        upper.sort_indices()
        for pardiso, pattern in self._analysed:
            if all(map(np.array_equal, pattern, (upper.indptr, upper.indices))):
                pardiso.set_phase(23)
                break
        else:
            pardiso = PyPardisoSolver(mtype=2, phase=13)
            self._analysed.append((pardiso, (upper.indptr, upper.indices)))
        return np.asarray(pardiso._call_pardiso(upper, rhs))


def default_pardiso() -> LinearSolve:
    """pypardiso's `spsolve` with its defaults."""
    from pypardiso import spsolve as solve

    return partial(solve)


class Felupe(Contender):
    """felupe's Newton with one of several linear solvers."""

    def __init__(self, scene: Scene, name: str, make_solver: Callable[[], LinearSolve]) -> None:
        import felupe

        self.name = f"felupe, {name}"
        self._felupe, self._solver, self._free = felupe, make_solver(), scene.free_dofs
        material = common_material(scene)
        mesh = felupe.Mesh(scene.mesh.points, scene.mesh.cells, "hexahedron")
        self._field = felupe.FieldContainer([felupe.Field(felupe.RegionHexahedron(mesh), dim=3)])
        fixed = np.isin(np.arange(scene.mesh.n_nodes), scene.fixed_nodes)
        self._dof0, self._dof1 = felupe.dof.partition(
            self._field, {"fixed": felupe.Boundary(self._field[0], mask=fixed)}
        )
        law = felupe.Material(
            *(
                partial(function, material.lame_mu, material.lame_lambda)
                for function in (stress, elasticity)
            )
        )
        self._body = felupe.SolidBody(law, self._field)
        self._load = felupe.PointLoad(self._field, np.arange(scene.mesh.n_nodes))

    def prepare(self, forces: Array) -> None:
        self._field[0].values = np.zeros_like(forces)
        self._load.update(forces)
        self._size = float(np.linalg.norm(forces.ravel()[self._free]))

    def _check(
        self, *, dx: Array, f: Array, ftol: float, dof1: Any, **_: Any
    ) -> tuple[float, float, bool]:
        residual = float(np.linalg.norm(f[dof1])) / self._size
        return float(np.linalg.norm(dx)), residual, residual <= ftol

    def solve(self) -> int:
        result = self._felupe.newtonraphson(
            x0=self._field,
            items=[self._body, self._load],
            dof0=self._dof0,
            dof1=self._dof1,
            solver=self._solver,
            check=self._check,
            tol=TOLERANCE,
            maxiter=MAX_STEPS,
            verbose=0,
        )
        self._u = result.x[0].values
        return int(result.iterations)

    def displacement(self) -> Array:
        return np.array(self._u)
