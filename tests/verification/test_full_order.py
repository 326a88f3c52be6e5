"""Solvers of the full-order model agree, and notice loads without a stable equilibrium."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import (
    IllConditionedWarning,
    SolverError,
    UnconstrainedBodyError,
)
from mor_bench.hard_cases.setups import LAW, dense, distorted_box, free_assembler
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.banded import BandedCholesky
from mor_bench.mechanics.chebyshev import Chebyshev, cycles_for, lowest_eigenvalue
from mor_bench.mechanics.cycles import RELAXATION, Cycle, Exact, Inverse, level_of
from mor_bench.mechanics.discretisation import Discretisation
from mor_bench.mechanics.linear import (
    NotPositiveDefiniteError,
    SparseLU,
)
from mor_bench.mechanics.model import SOLVERS, FullOrderModel
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.mechanics.rotated import BlockJacobi, conjugate_gradients
from mor_bench.scene.mesh import box_mesh
from mor_bench.scene.scene import Scene
from mor_bench.specs import SolverName

from .scenes import patch_load, relative_residual

Array = NDArray[np.float64]


def test_force_alone_equals_force_with_tangent() -> None:
    assembler = free_assembler(distorted_box((2, 3, 2)))
    u = 0.05 * np.random.default_rng(0).normal(size=assembler.n_dofs)
    alone, (state, _) = assembler.force(u), assembler.force_and_tangent(u)
    np.testing.assert_allclose(alone.force, state.force, rtol=1e-13, atol=1e-13)
    assert alone.energy_j == pytest.approx(state.energy_j, rel=1e-14)
    assert alone.min_det_f == state.min_det_f


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


TRANSLATIONS = {"translation x", "translation y", "translation z"}
ROTATIONS = {"rotation about x", "rotation about y", "rotation about z"}


@pytest.mark.parametrize(
    ("supports", "free"),
    [
        ([], TRANSLATIONS | ROTATIONS),
        ([{"region": {"sphere_m": [[0.0, 0.0, 0.0], 0.01]}}], ROTATIONS),
        ([{"region": {"box_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]}}], {"rotation about z"}),
    ],
)
def test_free_rigid_modes_are_named(supports: list[dict[str, object]], free: set[str]) -> None:
    spec = {**mor_bench.load_scene("beam-tiny").spec.model_dump(mode="json"), "supports": supports}
    with pytest.raises(UnconstrainedBodyError) as caught:
        FullOrderModel(mor_bench.load_scene(spec))
    assert set(caught.value.free_motions) == free
    assert all(name in str(caught.value) for name in free)


@pytest.fixture(scope="module")
def large() -> FullOrderModel:
    """A beam large enough for conjugate gradients."""
    spec = mor_bench.load_scene("beam-coarse").spec.model_dump(mode="json")
    box = {"shape": "box", "size_m": [4.0, 1.0, 1.0], "cells": [18, 7, 7]}
    return FullOrderModel(mor_bench.load_scene({**spec, "geometry": box}))


def tip_load(scene: Scene, newton: float) -> Array:
    """Return a force downwards on the patch at the tip."""
    corner = scene.mesh.points[scene.patch_nodes] - [4.0, 0.5, 1.0]
    return patch_load(scene, int(np.linalg.norm(corner, axis=1).argmin()), [0.0, 0.0, -newton])


@pytest.mark.parametrize("solver", [name for name in SOLVERS if name != "auto"])
def test_every_solver_ends_at_the_same_equilibrium(
    large: FullOrderModel, solver: SolverName
) -> None:
    if solver == "pardiso":
        pytest.importorskip("pypardiso", reason="MKL is an extra")
    other, rng = FullOrderModel(large.scene, solver), np.random.default_rng(0)
    for patch in rng.integers(0, len(large.scene.patch_nodes), 2):
        direction = rng.normal(size=3)
        load = patch_load(large.scene, patch, list(direction / np.linalg.norm(direction)))
        ours, theirs = large.solve(load), other.solve(load)
        assert ours.iterations <= 20
        assert theirs.iterations <= 8
        for solution in (ours, theirs):
            assert relative_residual(large, load, solution.displacement) <= 1e-8
        apart = np.abs(ours.displacement - theirs.displacement).max()
        assert apart <= 1e-6 * np.abs(ours.displacement).max()


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_notices_inversion_and_cuts_back(solver: SolverName) -> None:
    """The load is three times that which crushes the tip of the coarse beam."""
    if solver == "pardiso":
        pytest.importorskip("pypardiso", reason="MKL is an extra")
    scene = mor_bench.load_scene("beam-tiny")
    with pytest.raises(SolverError, match=r"stopped at .* of the load after"):
        FullOrderModel(scene, solver).solve(tip_load(scene, 2000.0))


def test_the_turned_factor_needs_few_iterations_far_from_rest(large: FullOrderModel) -> None:
    """The tip is turned by half a radian; the unturned factor needs twice as many or more."""
    u = large.solve(tip_load(large.scene, 6.0)).displacement
    tangent = large.linearise(u)[1]
    rhs = np.random.default_rng(0).normal(size=large.n_unknowns)
    rotated = large.accelerator
    assert rotated is not None
    x, turned = conjugate_gradients(large.assembler.pattern, tangent, rotated.at(u), rhs, 1e-8)
    assert np.linalg.norm(dense(large.assembler, tangent) @ x - rhs) <= 2e-8 * np.linalg.norm(rhs)
    assert turned <= 30
    unturned = rotated.at(None)
    many = conjugate_gradients(large.assembler.pattern, tangent, unturned, rhs, 1e-8)[1]
    assert many >= 2 * turned


@pytest.mark.parametrize("plain", [False, True])
def test_conjugate_gradients_notice_an_indefinite_tangent(
    large: FullOrderModel, plain: bool
) -> None:
    """With one negative eigenvalue they would converge if they ignored the curvature."""
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


def test_multigrid_out_of_cycles_returns_no_solution(
    large: FullOrderModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mor_bench.mechanics.model.MAX_BAND_ENTRIES", 0)
    factor = FullOrderModel(large.scene).rest_factor
    assert isinstance(factor, MultigridFactor)
    monkeypatch.setattr("mor_bench.mechanics.multigrid.MAX_CYCLES", 2)
    with pytest.raises(SolverError, match="multigrid does not converge"):
        factor.solve(np.ones(large.n_unknowns))


@pytest.mark.slow
@pytest.mark.parametrize(("thickness", "may_fail"), [(0.1, False), (0.01, True)])
def test_multigrid_solves_plates_or_gives_the_reason(
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
        assert "multigrid does not converge" in str(error)  # noqa: PT017
    else:
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * np.abs(expected).max())


def test_a_load_has_the_same_answer_alone_and_among_others(large: FullOrderModel) -> None:
    rng = np.random.default_rng(0)
    sizes = (0.1, 0.0, 3.0, 200.0, *rng.uniform(0.0, 2.0, 14))
    loads = np.stack([tip_load(large.scene, newton) for newton in sizes])
    refused = 0
    for load, among in zip(loads, large.solve_many(loads), strict=True):
        if isinstance(among, SolverError):
            refused += 1
            with pytest.raises(type(among), match=re.escape(str(among))):
                large.solve(load)
            continue
        alone = large.solve(load)
        assert (alone.displacement == among.displacement).all()
        for name in ("min_det_f", "iterations", "cuts"):
            assert getattr(alone, name) == getattr(among, name)
    assert refused == 1


def beam_across(across: int) -> FullOrderModel:
    spec = mor_bench.load_scene("beam-coarse").spec.model_dump(mode="json")
    box = {"shape": "box", "size_m": [4.0, 1.0, 1.0], "cells": [4 * across, across, across]}
    return FullOrderModel(mor_bench.load_scene({**spec, "geometry": box}))


def test_a_multigrid_cycle_is_symmetric_and_as_good_on_finer_meshes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fourfold number of unknowns takes at most a third more iterations."""
    monkeypatch.setattr("mor_bench.mechanics.model.MAX_BAND_ENTRIES", 0)
    monkeypatch.setattr("mor_bench.mechanics.multigrid.COARSEST", 6)
    iterations, rng = [], np.random.default_rng(0)
    for across in (5, 8):
        model = beam_across(across)
        factor = model.rest_factor
        assert isinstance(factor, MultigridFactor)
        x = rng.normal(size=(2, model.n_unknowns)).astype(np.float32)
        answers = x.copy()
        factor.solve_in_place(answers)
        work, back = float(x[0] @ answers[1]), float(x[1] @ answers[0])
        assert abs(work - back) <= 1e-4 * np.linalg.norm(x[0]) * np.linalg.norm(answers[1])
        iterations.append(model.solve(tip_load(model.scene, 0.5)).iterations)
    assert iterations[1] <= 4 / 3 * iterations[0]


def test_nearly_incompressible_bodies_take_few_iterations_on_every_mesh(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Single cycles take more than 40 iterations or fail."""
    monkeypatch.setattr("mor_bench.mechanics.model.MAX_BAND_ENTRIES", 0)
    spec = mor_bench.load_scene("beam-nearly-incompressible").spec.model_dump(mode="json")
    spec["material"]["poisson"], iterations = 0.49, []
    for across in (7, 12):
        spec["geometry"] = {"shape": "box", "size_m": [1.0, 1.0, 1.0], "cells": [across] * 3}
        model = FullOrderModel(mor_bench.load_scene(spec))
        assert isinstance(model.rest_factor, MultigridFactor)
        iterations.append(model.solve(tip_load(model.scene, 1.0)).iterations)
    assert max(iterations) <= 15, iterations


def cycle_of_dense_matrices(depth: int) -> tuple[Cycle, list[Array], list[Array]]:
    """Return a cycle on beam-tiny, in double precision, and its matrices and prolongations."""
    model, rng = FullOrderModel(mor_bench.load_scene("beam-tiny")), np.random.default_rng(0)
    matrices = [dense(model.assembler, model.rest_tangent)]
    transfers = [rng.normal(size=shape) for shape in ((len(matrices[0]), 60), (60, 18))[:depth]]
    for P in transfers:
        matrices.append(P.T @ matrices[-1] @ P)
    inverse: Inverse = Exact(np.linalg.inv(matrices[-1]))
    for A, P in reversed(list(zip(matrices, transfers, strict=False))):
        inverse = Cycle(level_of(A, P, np.float64), inverse)
    assert isinstance(inverse, Cycle)
    return inverse, matrices, transfers


def test_a_multigrid_cycle_equals_its_definition_with_dense_matrices() -> None:
    """Damped sweeps in blocks of 3 around the correction of the next level."""
    cycle, matrices, transfers = cycle_of_dense_matrices(2)

    def defined(depth: int, b: Array) -> Array:
        if depth == 2:
            return np.asarray(np.linalg.solve(matrices[2], b), dtype=np.float64)
        A, P = matrices[depth], transfers[depth]
        node = np.arange(len(b)) // 3
        lower = np.where(node[:, None] > node, A, 0.0)
        forward = lower + np.where(node[:, None] == node, A, 0.0) / RELAXATION
        x = np.linalg.solve(forward, b)
        x = x + P @ defined(depth + 1, P.T @ (b - A @ x))
        return np.asarray(x + np.linalg.solve(forward.T, b - A @ x))

    b = np.random.default_rng(1).normal(size=len(matrices[0]))
    wanted = defined(0, b)
    found, product = cycle.with_product(b)
    for x in (found, cycle(b)):
        np.testing.assert_allclose(x, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(
        product, matrices[0] @ wanted, rtol=0, atol=1e-9 * np.abs(matrices[0] @ wanted).max()
    )


def eigenvalues_of(inverse: Inverse, matrix: Array) -> Array:
    """Return the eigenvalues of an approximate inverse times a matrix, in ascending order."""
    product = np.stack([inverse(column) for column in matrix.T], axis=1)
    values = np.linalg.eigvals(product)
    assert np.abs(values.imag).max() <= 1e-9
    return np.sort(values.real)


def test_chebyshev_cycles_reduce_all_errors_as_their_polynomial() -> None:
    """The bound is 1 / T_k((1 + a) / (1 - a)) for eigenvalues from a to 1, attained at a."""
    cycle, (matrix, *_), _ = cycle_of_dense_matrices(1)
    of_cycle = eigenvalues_of(cycle, matrix)
    lowest = of_cycle[0]
    assert 0 < lowest <= lowest_eigenvalue(cycle) <= 1.2 * lowest
    assert of_cycle[-1] <= 1 + 1e-9
    for k in (2, 3, 5):
        left = 1 / np.cosh(k * np.arccosh((1 + lowest) / (1 - lowest)))
        found = (1 + left) * eigenvalues_of(Chebyshev(cycle, lowest, k), matrix)
        assert found[0] == pytest.approx(1 - left, rel=1e-6)
        assert found[-1] <= (1 + left) * (1 + 1e-9)
        assert cycles_for(lowest, 1.01 * left) == k
        assert cycles_for(lowest, 0.99 * left) == k + 1


@pytest.mark.parametrize("scaled", [False, True])
def test_equal_rows_of_a_multigrid_level_are_stored_once(scaled: bool) -> None:
    """On a regular grid, each row equals the stored one, also where one node differs a little."""
    model = beam_across(5)
    K = dense(model.assembler, model.rest_tangent)
    if scaled:
        K[30:33] *= 1.001
        K[:, 30:33] *= 1.001
    indptr, columns, begins, blocks = level_of(K, np.eye(len(K)), np.float64).lower
    assert len(blocks) < 0.5 * len(columns)
    for i, begin in enumerate(begins):
        own = 3 * columns[indptr[i] : indptr[i + 1]]
        row = np.stack([K[3 * i : 3 * i + 3, j : j + 3] for j in [*own, 3 * i]])
        stored = blocks[begin : begin + len(row)]
        np.testing.assert_allclose(stored, row, rtol=0, atol=4e-5 * np.abs(row).max())
        inverse = blocks[begin + len(row)] / RELAXATION
        np.testing.assert_allclose(inverse @ stored[-1], np.eye(3), atol=1e-8)
