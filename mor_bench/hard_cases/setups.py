"""Bodies with a known answer, for the hard cases and for the tests of the full-order model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.banded import BandedCholesky
from mor_bench.mechanics.discretisation import Discretisation
from mor_bench.mechanics.linear import Factor
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.scene.materials import Material, SaintVenantKirchhoff
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.scene import load_scene
from mor_bench.scene.second_order import with_middles
from mor_bench.specs import SolverName

Array = NDArray[np.float64]

LAW = SaintVenantKirchhoff(young_pa=500.0, poisson=0.4)

LIMIT_PA = -206.19652
"""Limit of `LAW` in confined compression, at stretch 1/√3: P = (λ + 2μ) (α³ - α) / 2."""


def dense(assembler: Assembler, values: Array) -> Array:
    """The whole tangent as a dense matrix."""
    return np.asarray(assembler.pattern.symmetric(values).toarray())


def free_assembler(mesh: Mesh, law: Material = LAW, selective: bool = False) -> Assembler:
    """Return an assembler of a mesh with all dofs free, numbered as in the mesh."""
    body = Discretisation(mesh.points, mesh.cells, law, selective)
    return Assembler(body, np.arange(mesh.n_dofs).reshape(-1, 3), mesh.n_dofs)


def of_order(mesh: Mesh, order: int) -> Mesh:
    """Return the mesh, or with order 2 that of T10 made from its T4."""
    return with_middles(mesh, {})[0] if order == 2 else mesh


def distorted_box(
    cells: tuple[int, int, int], tetrahedra: bool = False, seed: int = 0, order: int = 1
) -> Mesh:
    """Return a unit box whose inner nodes are moved at random.

    They move by up to 0.3 of a cell's edge, or 0.15 with tetrahedra, which are thinner. Edges stay
    straight.
    """
    mesh = box_mesh((1.0, 1.0, 1.0), cells, tetrahedra)
    inner = np.all((mesh.points > 1e-9) & (mesh.points < 1 - 1e-9), axis=1)
    points = mesh.points.copy()
    points[inner] += (
        np.random.default_rng(seed).uniform(-1, 1, (int(inner.sum()), 3))
        * (0.15 if tetrahedra else 0.3)
        / np.array(cells)
    )
    return of_order(Mesh(points, mesh.cells), order)


def patch_test_error(mesh: Mesh, law: Material = LAW, selective: bool = False) -> float:
    """Return the largest error of the patch test on a unit box, m.

    The surface gets a homogeneous deformation, and Newton's method starts near the solution.
    """
    gradient = np.eye(3) + np.array([[0.1, 0.05, -0.02], [0.03, -0.08, 0.04], [0.0, 0.06, 0.07]])
    exact = mesh.points @ (gradient - np.eye(3)).T
    outer = np.any((mesh.points < 1e-9) | (mesh.points > 1 - 1e-9), axis=1)
    model = free_assembler(mesh, law, selective)
    inner = np.flatnonzero(np.repeat(~outer, 3))
    u = exact.ravel().copy()
    u[inner] += 0.003 * np.random.default_rng(0).normal(size=len(inner))
    for _ in range(12):
        state, values = model.force_and_tangent(u)
        u[inner] -= np.linalg.solve(dense(model, values)[np.ix_(inner, inner)], state.force[inner])
    return float(np.abs(u.reshape(-1, 3) - exact).max())


def confined_column(
    law: Material = LAW, tetrahedra: bool = False, selective: bool = False, order: int = 1
) -> GalerkinProblem:
    """Return a cube between rigid lateral walls whose top moves along the axis as one.

    It has a single unknown.
    """
    mesh = of_order(box_mesh((1.0, 1.0, 1.0), (1, 1, 1), tetrahedra), order)
    moved = mesh.points[:, 0] > 0
    n = int(moved.sum())
    dofs = np.full((mesh.n_nodes, 3), n)
    dofs[moved, 0] = np.arange(n)
    body = Discretisation(mesh.points, mesh.cells, law, selective)
    return GalerkinProblem(Assembler(body, dofs, n), mesh.points[moved, :1])


@dataclass(frozen=True)
class Arch:
    """Two straight bars between hinges 4 m apart, with the crown 0.4 m above them.

    The load is 2 N downwards on the crown's edge.

    Attributes
    ----------
    mesh : Mesh
    fixed : (n_nodes,) bool
    problem : GalerkinProblem
        On the basis of all free dofs.
    load : (n_free,) float64
        Nodal forces, N.
    crown : (2,) int64
        The free dofs that are loaded.
    """

    mesh: Mesh
    fixed: NDArray[np.bool_]
    problem: GalerkinProblem
    load: Array
    crown: NDArray[np.int64]

    def reactions(self, depths: Array) -> Array:
        """Return the load on each loaded dof, N, that holds the crown at prescribed depths, m.

        The depths must be close to each other.
        """
        others = np.setdiff1d(np.arange(len(self.load)), self.crown)
        q, found = np.zeros(len(self.load)), []
        for depth in depths:
            q[self.crown] = -depth
            for _ in range(8):
                state, tangent = self.problem.linearise(q)
                q[others] -= np.linalg.solve(tangent[np.ix_(others, others)], state.force[others])
            found.append(-self.problem.force(q).force[self.crown].mean())
        return np.array(found)

    def greatest_reaction(self) -> float:
        """Return the load at which the arch snaps through, N.

        It is the top of the path under a prescribed displacement.
        """
        found = self.reactions(np.linspace(0.0, 0.4, 81))
        most = int(np.argmax(found))
        top = np.polynomial.Polynomial.fit(
            np.arange(most - 2, most + 3), found[most - 2 : most + 3], 4
        )
        return float(top(np.linspace(most - 1, most + 1, 2001)).max())


def make_arch() -> Arch:
    """Return the arch, made of 16 H8."""
    mesh = box_mesh((4.0, 1.0, 0.2), (8, 1, 2))
    x, _, z = mesh.points.T
    fixed = ((x == 0) | (x == 4.0)) & np.isclose(z, 0.1)
    lifted = Mesh(mesh.points + np.outer(0.4 * (1 - np.abs(x / 2 - 1)), [0, 0, 1]), mesh.cells)
    dofs, n = _numbered(mesh, ~fixed)
    body = Discretisation(lifted.points, lifted.cells, LAW)
    problem = GalerkinProblem(Assembler(body, dofs, n), np.eye(n))
    crown = dofs[(x == 2.0) & (z == 0.2), 2]
    load = np.zeros(n)
    load[crown] = -1.0
    return Arch(lifted, fixed, problem, load, crown)


@dataclass(frozen=True)
class Bars:
    """Two bars of 1 m in series, clamped at one end.

    The second is a million times softer, so all of the stretch is in it.
    """

    stretch = 1.2
    assembler: Assembler
    load: Array
    end: NDArray[np.bool_]

    @property
    def rest(self) -> tuple[Array, Factor]:
        """Return the stiffness at rest and its factor."""
        values = self.assembler.force_and_tangent(np.zeros(self.assembler.n_dofs))[1]
        return values, BandedCholesky(self.assembler.pattern).factor(values)

    def end_displacement(self) -> Array:
        """Return the displacement of the loaded end's nodes along the bars, m.

        It is found by twelve Newton steps. The exact value is the stretch minus 1.
        """
        u = np.zeros(self.assembler.n_dofs)
        for _ in range(12):
            state, values = self.assembler.force_and_tangent(u)
            u += (
                BandedCholesky(self.assembler.pattern).factor(values).solve(self.load - state.force)
            )
        return np.asarray(u.reshape(-1, 3)[self.end, 0])


def make_bars(
    tetrahedra: bool = False, selective: bool = False, contrast: float = 1e6, order: int = 1
) -> Bars:
    """Return the bars, of Saint Venant-Kirchhoff with Y = 1 Pa in the soft one and ν = 0."""
    mesh = of_order(box_mesh((2.0, 1.0, 1.0), (2, 1, 1), tetrahedra), order)
    free = mesh.points[:, 0] > 0
    dofs, n = _numbered(mesh, free)
    stiff = mesh.points[mesh.cells].mean(axis=1)[:, 0] < 1
    body = Discretisation(mesh.points, mesh.cells, SaintVenantKirchhoff(1.0, 0.0), selective)
    assembler = Assembler(body, dofs, n, np.where(stiff, contrast, 1.0))
    load = np.zeros((mesh.n_nodes, 3))
    for facet in mesh.boundary_facets[
        (mesh.points[mesh.boundary_facets][:, :, 0] == 2.0).all(axis=1)
    ]:
        # A uniform traction acts on a facet's corners, or on the middles of six nodes.
        share = 0.5 * (Bars.stretch**3 - Bars.stretch) / (4 if len(facet) == 4 else 6)
        load[facet[-3:] if len(facet) == 6 else facet, 0] += share
    return Bars(assembler, load[free].ravel(), mesh.points[free][:, 0] == 2.0)


def _numbered(mesh: Mesh, free: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    """Return the numbers of the nodes' dofs, (n_nodes, 3), and the number of free dofs."""
    n = 3 * int(free.sum())
    dofs = np.full((mesh.n_nodes, 3), n)
    dofs[free] = np.arange(n).reshape(-1, 3)
    return dofs, n


def material_table(law: str, young: float, poisson: float) -> dict[str, Any]:
    """Return the material table of a law with Young's modulus, Pa, and Poisson's ratio."""
    shear, bulk = young / (2 * (1 + poisson)), young / (3 * (1 - 2 * poisson))
    if law == "mooney-rivlin":
        return {"law": law, "c10_pa": 0.4 * shear, "c01_pa": 0.1 * shear, "bulk_pa": bulk}
    if law == "yeoh":
        coefficients = {"c10_pa": 0.5 * shear, "c20_pa": -0.1 * shear, "c30_pa": 0.05 * shear}
        return {"law": law, **coefficients, "bulk_pa": bulk}
    if law == "holzapfel-gasser-ogden":
        fibres = {"k1_pa": shear, "k2": 1.0, "dispersion": 0.1, "fibres": [[1, 1, 0], [1, -1, 0]]}
        return {"law": law, "c10_pa": 0.5 * shear, "bulk_pa": bulk, **fibres}
    if law == "ogden":
        return {
            "law": law,
            "mu_pa": [1.6 * shear / 2.1, -0.4 * shear / 1.7],
            "alpha": [2.1, -1.7],
            "bulk_pa": bulk,
        }
    return {"law": law, "young_pa": young, "poisson": poisson}


def cantilever_spec(
    size: list[float],
    cells: list[int],
    poisson: float,
    integration: str = "full",
    law: str = "saint-venant-kirchhoff",
) -> dict[str, Any]:
    """Return a dataset of a beam along x, clamped at its start and loaded at its end.

    Young's modulus is 12 kPa, so EI is 1000 N m² if the beam is 1 m wide and high. The integration
    is that of H8, or "T10" for tetrahedra with ten nodes.
    """
    quadratic = {"element": "tetrahedron", "order": 2}
    return {
        "geometry": {"shape": "box", "size_m": size, "cells": cells},
        "discretisation": quadratic if integration == "T10" else {"integration": integration},
        "material": material_table(law, 12e3, poisson),
        "supports": [{"region": "x-min"}],
        "loads": {
            "region": "x-max",
            "kind": "force",
            "patch_area_m2": size[1] * size[2],
            "samples_per_patch": 1,
            "magnitude_n": [0.0, 1.0],
        },
        "needs": {"error": 0.01, "latency_ms": 1.0},
    }


def cantilever(
    size: list[float],
    cells: list[int],
    poisson: float,
    integration: str = "full",
    law: str = "saint-venant-kirchhoff",
    solver: SolverName | None = None,
) -> FullOrderModel:
    """Return the full-order model of `cantilever_spec`."""
    return FullOrderModel(
        load_scene(cantilever_spec(size, cells, poisson, integration, law)), solver
    )


def tip_load(model: FullOrderModel, force_z: float) -> Array:
    """Return the nodal forces, (n_free,), of a force spread over a cantilever's end face, N."""
    scene = model.scene
    load = np.zeros((scene.mesh.n_nodes, 3))
    load[:, 2] = scene.patch_weights.toarray()[0] * force_z
    return np.asarray(load.ravel()[scene.free_dofs])


def tip(model: FullOrderModel, force_z: float) -> Array:
    """Return the mean displacement, (3,), of a cantilever's end face under `tip_load`, m."""
    scene = model.scene
    u = np.zeros(scene.mesh.n_dofs)
    u[scene.free_dofs] = model.solve(tip_load(model, force_z)).displacement
    end = scene.mesh.points[:, 0] == scene.mesh.points[:, 0].max()
    return np.asarray(u.reshape(-1, 3)[end].mean(axis=0))
