"""The full-order model against closed forms, laws of mechanics and an independent library."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import mor_bench
from mor_bench.errors import (
    IllConditionedWarning,
    InvalidInputError,
    SolverError,
    UnconstrainedBodyError,
)
from mor_bench.hard_cases.setups import LAW, dense, distorted_box, free_assembler
from mor_bench.mechanics.assembly import Assembler, Discretisation
from mor_bench.mechanics.banded import BandedCholesky
from mor_bench.mechanics.linear import (
    NotPositiveDefiniteError,
    SparseLU,
)
from mor_bench.mechanics.model import SOLVERS, FullOrderModel
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.mechanics.rotated import BlockJacobi, conjugate_gradients
from mor_bench.scene.materials import SaintVenantKirchhoff
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.scene import Scene
from mor_bench.specs import SolverName

Array = NDArray[np.float64]


def stress(gradient: Array, law: SaintVenantKirchhoff = LAW) -> Array:
    """First Piola-Kirchhoff stress of one H8 cube under the homogeneous deformation gradient F, from its nodal forces."""
    mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1))
    u = mesh.points @ (gradient - np.eye(3)).T
    forces = free_assembler(mesh, law).force(u.ravel()).force.reshape(-1, 3)
    return np.stack([forces[mesh.points[:, axis] == 1.0].sum(axis=0) for axis in range(3)], axis=1)


def test_patch_of_distorted_cells() -> None:
    mesh = distorted_box((3, 3, 3))
    gradient = np.eye(3) + np.array([[0.1, 0.05, -0.02], [0.03, -0.08, 0.04], [0.0, 0.06, 0.07]])
    exact = mesh.points @ (gradient - np.eye(3)).T
    outer = np.any((mesh.points < 1e-9) | (mesh.points > 1 - 1e-9), axis=1)
    assembler = free_assembler(mesh)
    inner = np.flatnonzero(np.repeat(~outer, 3))
    u = np.where(outer[:, None], exact, 0.0).ravel()
    for _ in range(12):
        state, values = assembler.force_and_tangent(u)
        u[inner] -= np.linalg.solve(
            dense(assembler, values)[np.ix_(inner, inner)], state.force[inner]
        )
    assert np.abs(u.reshape(-1, 3) - exact).max() <= 1e-12


@pytest.mark.parametrize("seed", range(20))
def test_taylor_energy_to_force_and_force_to_tangent(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh = distorted_box((2, 2, 2), seed=seed)
    assembler = free_assembler(mesh)
    u, direction = 0.05 * rng.normal(size=mesh.n_dofs), rng.normal(size=mesh.n_dofs)
    state, values = assembler.force_and_tangent(u)
    stiffness = dense(assembler, values)
    steps = np.array([1e-1, 1e-2, 1e-3, 1e-4]) * 0.1
    energy, force = [], []
    for h in steps:
        there = assembler.force(u + h * direction)
        energy.append(abs(there.energy_j - state.energy_j - h * direction @ state.force))
        force.append(np.linalg.norm(there.force - state.force - h * stiffness @ direction))
    for remainder in (np.array(energy), np.array(force)):
        order = np.log10(remainder[:-1] / remainder[1:])
        assert order[-1] >= 1.95
        assert order.mean() >= 1.95


def test_force_alone_equals_force_with_tangent() -> None:
    assembler = free_assembler(distorted_box((2, 3, 2)))
    u = 0.05 * np.random.default_rng(0).normal(size=assembler.n_dofs)
    alone, (state, _) = assembler.force(u), assembler.force_and_tangent(u)
    np.testing.assert_allclose(alone.force, state.force, rtol=1e-13, atol=1e-13)
    assert alone.energy_j == pytest.approx(state.energy_j, rel=1e-14)
    assert alone.min_det_f == state.min_det_f


def test_free_body_at_rest_has_exactly_six_zero_modes() -> None:
    assembler = free_assembler(distorted_box((2, 2, 2)))
    stiffness = dense(assembler, assembler.force_and_tangent(np.zeros(assembler.n_dofs))[1])
    values = np.linalg.eigvalsh(stiffness)
    assert (np.abs(values) <= 1e-12 * values[-1]).sum() == 6
    assert values[6] > 1e-6 * values[-1]


def test_rigid_rotations_cost_nothing() -> None:
    mesh = distorted_box((2, 2, 2))
    assembler = free_assembler(mesh)
    stiffness = dense(assembler, assembler.force_and_tangent(np.zeros(mesh.n_dofs))[1])
    for rotation in Rotation.random(100, random_state=0).as_matrix():
        u = (mesh.points @ rotation.T - mesh.points).ravel()
        state = assembler.force(u)
        assert np.linalg.norm(state.force) <= 1e-12 * np.linalg.norm(stiffness, 2) * np.linalg.norm(
            u
        )
        assert state.min_det_f == pytest.approx(1.0, abs=1e-12)


def test_uniaxial_stress() -> None:
    """ONSAS `uniaxialExtension`: Y = 1, ν = 0.3, P = 3 gives α = 2, β = √0.1."""
    p = stress(np.diag([2.0, np.sqrt(0.1), np.sqrt(0.1)]), SaintVenantKirchhoff(1.0, 0.3))
    np.testing.assert_allclose(p, np.diag([3.0, 0.0, 0.0]), atol=1e-13)


def test_simple_shear() -> None:
    gradient = np.eye(3)
    gradient[0, 1] = 0.5
    p = stress(gradient)
    assert p[0, 1] == pytest.approx(156.25)
    assert p[1, 0] == pytest.approx(89.2857, abs=1e-4)
    assert p[2, 2] == pytest.approx(89.2857, abs=1e-4)
    assert p[0, 0] == pytest.approx(133.9286, abs=1e-4)
    assert p[1, 1] == pytest.approx(133.9286, abs=1e-4)
    mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1))
    u = (mesh.points @ (gradient - np.eye(3)).T).ravel()
    assert free_assembler(mesh).force(u).energy_j == pytest.approx(30.69196, abs=1e-5)


def test_a_huge_load_ends_in_the_answer_or_in_a_typed_error() -> None:
    scene = mor_bench.load_scene("beam-tiny")
    model = FullOrderModel(scene)
    for size in (10.0, 100.0, 1e4, 1e8):
        for axis in range(3):
            load = np.zeros((scene.mesh.n_nodes, 3))
            load[-1, axis] = -size
            free = load.ravel()[scene.free_dofs]
            try:
                solution = model.solve(free)
            except SolverError:
                continue
            state = model.force(solution.displacement)
            assert state.min_det_f > 0
            assert np.linalg.norm(free - state.force) <= 1e-8 * np.linalg.norm(free)


def test_both_direct_solvers_agree_and_notice_an_indefinite_matrix() -> None:
    model = FullOrderModel(mor_bench.load_scene("beam-coarse"))
    pattern, values = model.assembler.pattern, model.rest_tangent
    rhs = np.random.default_rng(0).normal(size=(pattern.n, 2))
    answers = [solver(pattern).factor(values).solve(rhs) for solver in (BandedCholesky, SparseLU)]
    np.testing.assert_allclose(answers[0], answers[1], rtol=1e-9, atol=1e-12)
    assert np.linalg.norm(
        dense(model.assembler, values) @ answers[0] - rhs
    ) <= 1e-9 * np.linalg.norm(rhs)
    spoilt = np.where(pattern.rows == pattern.indices, values - 0.5 * values.max(), values)
    for solver in (BandedCholesky, SparseLU):
        with pytest.raises(NotPositiveDefiniteError):
            solver(pattern).factor(spoilt)


def test_banded_solver_reorders_a_badly_numbered_mesh() -> None:
    mesh = box_mesh((8.0, 1.0, 1.0), (20, 2, 2))
    shuffle = np.random.default_rng(0).permutation(mesh.n_nodes)
    points = np.empty_like(mesh.points)
    points[shuffle] = mesh.points
    fixed = points[:, 0] == 0
    dofs = np.full((mesh.n_nodes, 3), 3 * int((~fixed).sum()))
    dofs[~fixed] = np.arange(3 * int((~fixed).sum())).reshape(-1, 3)
    assembler = Assembler(
        Discretisation(points, shuffle[mesh.cells], LAW), dofs, 3 * int((~fixed).sum())
    )
    values = assembler.force_and_tangent(np.zeros(assembler.n_dofs))[1]
    solver = BandedCholesky(assembler.pattern)
    assert solver.bandwidth < assembler.n_dofs // 3
    rhs = np.random.default_rng(1).normal(size=assembler.n_dofs)
    np.testing.assert_allclose(
        dense(assembler, values) @ solver.factor(values).solve(rhs), rhs, rtol=0, atol=1e-9
    )


def test_an_inverted_cell_is_refused() -> None:
    mesh = box_mesh((1.0, 1.0, 1.0), (1, 1, 1))
    with pytest.raises(
        InvalidInputError, match=r"cell 0 is inverted or degenerate.*det J must be > 0"
    ):
        free_assembler(Mesh(mesh.points, mesh.cells[:, [4, 5, 6, 7, 0, 1, 2, 3]]))


@pytest.mark.parametrize(
    ("supports", "named"),
    [
        (
            [],
            "translation x, translation y, translation z, rotation about x, rotation about y, rotation about z",
        ),
        (
            [{"region": {"sphere_m": [[0.0, 0.0, 0.0], 0.01]}}],
            "rotation about x, rotation about y, rotation about z",
        ),
        ([{"region": {"box_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]}}], "rotation about z"),
    ],
)
def test_free_rigid_modes_are_named(supports: list[dict[str, object]], named: str) -> None:
    spec = {**mor_bench.load_scene("beam-tiny").spec.model_dump(mode="json"), "supports": supports}
    with pytest.raises(UnconstrainedBodyError) as caught:
        FullOrderModel(mor_bench.load_scene(spec))
    assert set(named.split(", ")) <= set(
        str(caught.value).split("free: ")[1].split("; ")[0].split(", ")
    )


@pytest.fixture(scope="module")
def large() -> FullOrderModel:
    """A beam large enough for conjugate gradients."""
    spec = mor_bench.load_scene("beam-coarse").spec.model_dump(mode="json")
    return FullOrderModel(
        mor_bench.load_scene(
            {**spec, "geometry": {"shape": "box", "size_m": [4.0, 1.0, 1.0], "cells": [18, 7, 7]}}
        )
    )


def tip_load(scene: Scene, newton: float) -> Array:
    tip = int(
        np.linalg.norm(scene.mesh.points[scene.patch_nodes] - [4.0, 0.5, 1.0], axis=1).argmin()
    )
    force = scene.patch_weights.toarray()[tip][:, None] * np.array([0.0, 0.0, -newton])
    return np.asarray(force.ravel()[scene.free_dofs])


@pytest.mark.parametrize("solver", [name for name in SOLVERS if name != "auto"])
def test_every_solver_ends_at_the_same_equilibrium(
    large: FullOrderModel, solver: SolverName
) -> None:
    if solver == "pardiso":
        pytest.importorskip("pypardiso", reason="MKL is an extra")
    other, rng = FullOrderModel(large.scene, solver), np.random.default_rng(0)
    for patch in rng.integers(0, len(large.scene.patch_nodes), 3):
        direction = rng.normal(size=3)
        force = (
            large.scene.patch_weights.toarray()[patch][:, None]
            * direction
            / np.linalg.norm(direction)
        )
        load = force.ravel()[large.scene.free_dofs]
        ours, theirs = large.solve(load), other.solve(load)
        assert ours.iterations <= 20
        assert theirs.iterations <= 8
        for solution in (ours, theirs):
            assert np.linalg.norm(
                load - large.force(solution.displacement).force
            ) <= 1e-8 * np.linalg.norm(load)
        np.testing.assert_allclose(
            ours.displacement,
            theirs.displacement,
            rtol=0,
            atol=1e-6 * np.abs(ours.displacement).max(),
        )


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_notices_inversion_and_cuts_back(solver: SolverName) -> None:
    """Three times the load that crushes the tip of the coarse beam."""
    if solver == "pardiso":
        pytest.importorskip("pypardiso", reason="MKL is an extra")
    scene = mor_bench.load_scene("beam-tiny")
    with pytest.raises(SolverError, match=r"stopped at .* of the load after"):
        FullOrderModel(scene, solver).solve(tip_load(scene, 2000.0))


def test_the_turned_factor_needs_few_iterations_far_from_rest(large: FullOrderModel) -> None:
    """With the tip turned by more than half a radian, the factor as it is needs several times as many."""
    u = large.solve(tip_load(large.scene, 6.0)).displacement
    tangent = large.linearise(u)[1]
    rhs = np.random.default_rng(0).normal(size=large.n_unknowns)
    rotated = large.accelerator
    assert rotated is not None
    x, turned = conjugate_gradients(large.assembler.pattern, tangent, rotated.at(u), rhs, 1e-8)
    assert np.linalg.norm(dense(large.assembler, tangent) @ x - rhs) <= 2e-8 * np.linalg.norm(rhs)
    assert turned <= 30
    assert (
        conjugate_gradients(large.assembler.pattern, tangent, rotated.at(None), rhs, 1e-8)[1]
        >= 2 * turned
    )


@pytest.mark.parametrize("plain", [False, True])
def test_conjugate_gradients_notice_an_indefinite_tangent(
    large: FullOrderModel, plain: bool
) -> None:
    """One negative eigenvalue: without a look at the curvature they would converge."""
    pattern, values = large.assembler.pattern, large.rest_tangent
    spoilt = values.copy()
    spoilt[pattern.indptr[300]] *= -1.0
    rotated, jacobi = large.accelerator, BlockJacobi(pattern)
    assert rotated is not None
    jacobi.take(values)
    preconditioner = jacobi if plain else rotated.at(None)
    with pytest.raises(NotPositiveDefiniteError):
        conjugate_gradients(pattern, spoilt, preconditioner, np.ones(large.n_unknowns), 1e-6)


def test_multigrid_solves_as_the_banded_factor_does_and_accelerates(
    large: FullOrderModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mor_bench.mechanics.model.MAX_BAND_ENTRIES", 0)
    model = FullOrderModel(large.scene)
    rhs = np.random.default_rng(0).normal(size=(large.n_unknowns, 2))
    assert isinstance(model.rest_factor, MultigridFactor)
    expected = large.rest_factor.solve(rhs)
    np.testing.assert_allclose(
        model.rest_factor.solve(rhs), expected, rtol=0, atol=1e-8 * np.abs(expected).max()
    )
    load = tip_load(large.scene, 1.0)
    solution = model.solve(load)
    assert solution.iterations <= 40
    np.testing.assert_allclose(
        solution.displacement,
        large.solve(load).displacement,
        rtol=0,
        atol=1e-6 * np.abs(solution.displacement).max(),
    )


@pytest.mark.parametrize(("thickness", "may_fail"), [(0.1, False), (0.01, True)])
def test_multigrid_bears_plates_or_says_why_not(
    thickness: float, may_fail: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The coarsest matrix of the thinner one is not definite in single precision."""
    spec = mor_bench.load_scene("beam-coarse").spec.model_dump(mode="json")
    spec["loads"]["patch_area_m2"] = 1.0
    scene = mor_bench.load_scene(
        {
            **spec,
            "geometry": {"shape": "box", "size_m": [4.0, 1.0, thickness], "cells": [40, 20, 2]},
        }
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IllConditionedWarning)
        expected = FullOrderModel(scene).rest_factor.solve(np.ones(len(scene.free_dofs)))
    monkeypatch.setattr("mor_bench.mechanics.model.MAX_BAND_ENTRIES", 0)
    try:
        found = FullOrderModel(scene).rest_factor.solve(np.ones(len(scene.free_dofs)))
    except SolverError as error:
        if not may_fail:
            raise
        assert "multigrid does not solve" in str(error)  # noqa: PT017
    else:
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * np.abs(expected).max())


def test_a_load_has_the_same_answer_alone_and_among_others(large: FullOrderModel) -> None:
    rng = np.random.default_rng(0)
    loads = np.stack(
        [
            tip_load(large.scene, newton)
            for newton in (0.1, 0.0, 1.0, 3.0, 200.0, *rng.uniform(0.0, 2.0, 20))
        ]
    )
    refused = 0
    for load, among in zip(loads, large.solve_many(loads), strict=True):
        if isinstance(among, SolverError):
            refused += 1
            with pytest.raises(type(among), match=re.escape(str(among))):
                large.solve(load)
            continue
        alone = large.solve(load)
        assert (alone.displacement == among.displacement).all()
        assert (alone.min_det_f, alone.iterations, alone.cuts) == (
            among.min_det_f,
            among.iterations,
            among.cuts,
        )
    assert refused == 1
