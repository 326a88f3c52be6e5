"""Limit points: a closed form, and an arch that snaps through."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import LimitPointError, SolverError
from mor_bench.hard_cases.setups import LAW, LIMIT_PA, Arch, confined_column, dense, make_arch
from mor_bench.mechanics import accelerated, curvature
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, Solution, solve_equilibrium
from mor_bench.mechanics.observed import ObservedModel
from mor_bench.mechanics.pressed import full_order_model
from mor_bench.mechanics.problem import Attempt
from mor_bench.mechanics.stability import (
    LimitPoint,
    limit_load,
    lowest_tangent_eigenvalue,
    solve_on_path,
)
from mor_bench.scene.materials import NeoHookean
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.sampling import draw_loads
from tests.benchmarks.probe_cost import NoSearch

from .scenes import relative_residual

Array = NDArray[np.float64]


def test_the_limit_of_confined_compression_matches_its_closed_form() -> None:
    """At stretch α the tangent is (3α² - 1)/2 of that at rest: it vanishes at α = 1/√3."""
    problem = confined_column()
    for alpha in (0.7, 0.9, 1.2):
        assert lowest_tangent_eigenvalue(problem, np.array([alpha - 1])) == pytest.approx(
            (3 * alpha**2 - 1) / 2, rel=1e-12
        )
    limit = limit_load(problem, np.array([3 * LIMIT_PA]))
    assert limit is not None
    assert limit.factor == pytest.approx(1 / 3, rel=1e-7)
    assert 1 + limit.displacement[0] == pytest.approx(1 / np.sqrt(3), abs=1e-4)
    assert 0 < limit.lowest_eigenvalue < 1e-3


def test_a_load_beyond_the_limit_raises_an_error_that_names_the_limit() -> None:
    with pytest.raises(LimitPointError, match=r"ends at 0\.66666.*eigenvalue") as caught:
        solve_on_path(confined_column(), np.array([1.5 * LIMIT_PA]))
    assert caught.value.load_factor == pytest.approx(1 / 1.5, abs=1e-6)
    assert caught.value.lowest_eigenvalue is not None
    assert 0 < caught.value.lowest_eigenvalue < 1e-3
    assert limit_load(confined_column(), np.array([0.99 * LIMIT_PA])) is None
    np.testing.assert_allclose(
        1 + solve_on_path(confined_column(), np.array([0.99 * LIMIT_PA])), 0.6238701392, atol=1e-8
    )


def test_the_lowest_eigenvalue_of_a_large_tangent_matches_dense_matrices() -> None:
    scene = mor_bench.load_scene("beam-coarse")
    model = FullOrderModel(scene)
    load = (scene.patch_weights[[62]].toarray()[0][:, None] * np.array([-2.0, 0.5, 1.0])).ravel()[
        scene.free_dofs
    ]
    u = model.solve(load).displacement
    tangent, rest = (
        dense(model.assembler, values) for values in (model.linearise(u)[1], model.rest_tangent)
    )
    expected = np.linalg.eigvals(np.linalg.solve(rest, tangent)).real.min()
    assert lowest_tangent_eigenvalue(model, u) == pytest.approx(expected, rel=1e-6)
    assert lowest_tangent_eigenvalue(model, 0 * u) == pytest.approx(1.0, rel=1e-10)


@pytest.fixture(scope="module")
def arch() -> Arch:
    return make_arch()


@pytest.fixture(scope="module")
def limit(arch: Arch) -> LimitPoint:
    found = limit_load(arch.problem, arch.load)
    assert found is not None
    return found


def test_limit_of_the_arch_is_the_greatest_reaction_to_a_prescribed_displacement(
    arch: Arch, limit: LimitPoint
) -> None:
    assert limit.factor == pytest.approx(arch.greatest_reaction(), rel=1e-6)
    assert 0 < limit.lowest_eigenvalue < 1e-3
    assert arch.reactions(np.linspace(0.0, 0.4, 81))[-1] < limit.factor


@pytest.mark.parametrize(
    "factor",
    [1.01, pytest.param(1.5, marks=pytest.mark.slow), pytest.param(3.0, marks=pytest.mark.slow)],
)
def test_beyond_its_limit_the_arch_snaps_to_a_stable_state_or_says_why_not(
    arch: Arch, limit: LimitPoint, factor: float
) -> None:
    load = factor * limit.factor * arch.load
    with pytest.raises(LimitPointError) as caught:
        solve_on_path(arch.problem, load)
    assert caught.value.load_factor == pytest.approx(1 / factor, abs=1e-6)
    try:
        solution = solve_equilibrium(arch.problem, load)
    except SolverError:
        return
    assert solution.min_det_f > 0
    assert lowest_tangent_eigenvalue(arch.problem, solution.displacement) > 0
    assert solution.displacement[arch.crown].max() < -0.4
    residual = load - arch.problem.force(solution.displacement).force
    assert np.linalg.norm(residual) <= 1e-8 * np.linalg.norm(load)


def test_an_unstable_equilibrium_is_never_returned_by_the_accelerated_pass() -> None:
    """On the falling part of the arch's path the residual vanishes at an indefinite tangent."""
    arch = make_arch()
    model = FullOrderModel(
        Scene(mor_bench.load_scene("beam-tiny").spec, arch.mesh, LAW, np.flatnonzero(arch.fixed))
    )
    crown = arch.crown
    others, q = np.setdiff1d(np.arange(model.n_unknowns), crown), np.zeros(model.n_unknowns)
    for depth in np.linspace(0.0, 0.35, 71):
        q[crown] = -depth
        for _ in range(8):
            state, values = model.linearise(q)
            q[others] -= np.linalg.solve(
                dense(model.assembler, values)[np.ix_(others, others)], state.force[others]
            )
    assert lowest_tangent_eigenvalue(model, q) < 0
    load = model.force(q).force
    for start in (None, q, q * (1 + 1e-6)):
        solution = model.solve(load, start)
        assert lowest_tangent_eigenvalue(model, solution.displacement) > 0
        assert relative_residual(model, load, solution.displacement) <= 1e-8


def beams(thickness: float, beside: float) -> tuple[FullOrderModel, Array]:
    """Return a beam of 2 m with another beside it, and a load that compresses the first by 1 N.

    The second is longer by a factor, and therefore softer. It carries no load.
    """
    first = box_mesh((2.0, 0.5, thickness), (12, 2, 2))
    second = box_mesh((2.0 * beside, 0.5, thickness), (12, 2, 2))
    points = np.concatenate([first.points, second.points + np.array([0.0, 2.0, 0.0])])
    mesh = Mesh(points, np.concatenate([first.cells, second.cells + first.n_nodes]))
    spec = mor_bench.load_scene("beam-tiny").spec
    scene = Scene(spec, mesh, NeoHookean(500.0, 0.3), np.flatnonzero(points[:, 0] == 0))
    end = (points[:, 0] == 2.0) & (points[:, 1] < 1.0)
    corners = end[mesh.cells] & (end[mesh.cells].sum(axis=1) == 4)[:, None]
    load = np.zeros_like(points)
    load[:, 0] = -np.bincount(mesh.cells[corners], minlength=len(points)) / corners.sum()
    return FullOrderModel(scene), load.ravel()[scene.free_dofs]


@pytest.mark.parametrize(("thickness", "beside"), [(0.35, 1.0), (0.3, 2.5), (0.3, 6.0)])
def test_buckling_is_noticed_under_a_symmetric_load_also_beside_a_softer_body(
    thickness: float, beside: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing pushes a straight column to the side: only the search sees that it is unstable."""
    model, push = beams(thickness, beside)
    euler = np.pi**2 * 500.0 * 0.5 * thickness**3 / 12 / 4 / 2.0**2

    def straight(factor: float, start: Array | None) -> Attempt:
        load = factor * euler * push
        one = accelerated.accelerated(model, model.turned_rest, load, start, 1e-8)
        ((_, found),) = accelerated.run_in_step(model.turned_rest, iter([one]))
        return found

    q = None
    for factor in (0.5, 0.9, 1.1, 1.3):
        with monkeypatch.context() as patch:
            patch.setattr(accelerated, "search_of", NoSearch)
            q = straight(factor, q).q
        stable = lowest_tangent_eigenvalue(model, q) > 0
        assert stable == (factor < 1.2)
        assert straight(factor, q).converged == stable


BAR: dict[str, Any] = {
    "geometry": {"shape": "box", "size_m": [4.0, 1.0, 1.0], "cells": [16, 4, 4]},
    "material": {"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.4},
}
EULER_PA = 4.0 * np.pi**2 * 500.0 / 12.0 / 4.0**2
"""Buckling pressure of the bar as a slender beam that is guided at both ends; it is stocky."""


@pytest.mark.filterwarnings("ignore::mor_bench.errors.LockingWarning")
@pytest.mark.parametrize(("poisson", "tolerance"), [(0.4, 1e-8), (0.4, 1e-6), (0.48, 1e-8)])
@pytest.mark.parametrize("factor", [0.3, 0.5, 0.8, 1.0])
def test_a_column_that_is_guided_at_both_ends_is_solved_for_a_stable_state(
    factor: float, poisson: float, tolerance: float
) -> None:
    """Its buckling mode is not among the softest modes at rest, so few probes do not see it."""
    guide = {"region": "x-max", "components": ["y", "z"]}
    bar = {**BAR, "material": {**BAR["material"], "poisson": poisson}}
    scene = mor_bench.load_scene({**bar, "supports": [{"region": "x-min"}, guide]})
    model, points, cells = FullOrderModel(scene), scene.mesh.points, scene.mesh.cells
    end = points[:, 0] == points[:, 0].max()
    corners = end[cells] & (end[cells].sum(axis=1) == 4)[:, None]
    load = np.zeros_like(points)
    load[:, 0] = -np.bincount(cells[corners], minlength=len(points)) / corners.sum()
    push = factor * EULER_PA * load.ravel()[scene.free_dofs]
    q = model.solve(push, options=NewtonOptions(tolerance)).displacement
    assert lowest_tangent_eigenvalue(model, q) > 0
    aside = scene.at_all_dofs(q[None])[0].reshape(-1, 3)[:, 1:]
    assert (np.abs(aside).max() > 0.5) == (factor > 0.6)


@pytest.mark.parametrize("tolerance", [1e-8, 1e-6])
@pytest.mark.parametrize("motion", [(-0.5, 0.1, 0.0), (-0.9, 0.0, 0.0), (-1.0, 0.0, 0.01)])
def test_a_column_under_a_moved_tool_is_solved_for_a_stable_state(
    motion: tuple[float, float, float], tolerance: float
) -> None:
    tool = {"kind": "displacement", "region": "x-max", "magnitude_m": [0.0, 1.0], "samples": 1}
    scene = mor_bench.load_scene({**BAR, "supports": [{"region": "x-min"}], "loads": tool})
    moved = np.tile(motion, (scene.mesh.n_nodes, 1)).ravel()[scene.free_dofs]
    (found,) = ObservedModel(scene).solve_many(moved[None], NewtonOptions(tolerance))
    assert isinstance(found, Solution)
    assert scene.observed_nodes is not None
    model = FullOrderModel(scene)
    tangent = dense(model.assembler, model.linearise(found.displacement)[1])
    hidden = ~np.isin(scene.free_dofs // 3, scene.observed_nodes)
    assert np.linalg.eigvalsh(tangent[np.ix_(hidden, hidden)])[0] > 0


class Identity:
    """An approximate inverse of stiffness one, and its response to a random force."""

    def __init__(self, n: int, seed: int) -> None:
        self._force = np.random.default_rng(seed).normal(size=n)

    def turned(self, q: Array | None) -> Array:
        return np.zeros(0)

    def soft(self, rotations: Array) -> tuple[Array, Array]:
        return self._force, self._force

    def solve_many(self, residuals: Any, rotations: Any) -> Array:
        return np.array(residuals)


def test_a_disturbance_is_not_removed_along_earlier_steps_of_negative_curvature() -> None:
    """The load moves a mode of negative curvature; Anderson's memory could remove it unseen."""
    n = 300
    for seed in range(40):
        rng = np.random.default_rng(seed)
        stiffness = np.linspace(0.8, 1.2, n)
        problem: Any = SimpleNamespace(n_unknowns=n, extent=1.0, linear_at_rest=False)
        problem.force = lambda q, k=stiffness: SimpleNamespace(force=k * q, min_det_f=1.0)
        load, inverse = 0.1 * rng.normal(size=n), Identity(n, 1000 + seed)
        load[0] *= 10.0
        for lowest in (0.8, -0.3):
            stiffness[0] = lowest
            one: Any = accelerated.accelerated(problem, inverse, load, None, 1e-8)  # type: ignore[arg-type]
            ((_, found),) = accelerated.run_in_step(inverse, iter([one]))  # type: ignore[arg-type]
            assert found.iterations < accelerated.ACCELERATED_ITERATIONS
            assert found.converged == (lowest > 0)


def test_the_disturbance_serves_fine_tolerances_and_symmetric_tangents(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Pressures that follow the surface have no symmetric tangent: the probes serve them."""
    kinds: list[type] = []

    def recorded(*request: Any) -> curvature.Search:
        kinds.append(type(curvature.search_of(*request)))
        return curvature.search_of(*request)

    monkeypatch.setattr(accelerated, "search_of", recorded)
    pressure = {"kind": "pressure", "regions": ["z-max"], "magnitude_pa": [1.0, 4.0], "samples": 1}
    for tolerance, follower in ((1e-8, False), (1e-4, False), (1e-8, True)):
        loads = {**pressure, "follower": follower}
        scene = mor_bench.load_scene({**BAR, "supports": [{"region": "x-min"}], "loads": loads})
        load = draw_loads(scene, 0, 1).nodal_forces(scene.patch_weights).ravel()[scene.free_dofs]
        full_order_model(scene).solve(load, options=NewtonOptions(tolerance))
    assert kinds == [curvature.Disturbance, curvature.Probes, curvature.Probes]
