"""Equilibria of every law on every element, and loads that have none."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import threadpool_info, threadpool_limits

import mor_bench
from mor_bench.errors import (
    InvertedElementError,
    SolverError,
)
from mor_bench.hard_cases.setups import (
    LAW,
    LIMIT_PA,
    Bars,
    confined_column,
    make_bars,
)
from mor_bench.mechanics.assembly import State
from mor_bench.mechanics.banded import BandedCholesky
from mor_bench.mechanics.indicator import ErrorIndicator
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions, solve_equilibrium
from mor_bench.specs import SolverName
from tests.case_marks import nightly_but

from .laws_and_elements import (
    ELEMENTS,
    EVERY,
    ISOTROPIC,
    LAWS,
    mesh_options,
    piola,
    quick_first,
)
from .scenes import patch_load, relative_residual, scene_of

Array = NDArray[np.float64]


@pytest.mark.parametrize("kind", ELEMENTS)
@pytest.mark.parametrize("steps", [1, 10])
@pytest.mark.parametrize("factor", [0.99, 1.01, 1.5, 3.0])
def test_confined_compression_ends_at_the_limit_point(
    kind: tuple[str, bool], steps: int, factor: float
) -> None:
    """Beyond it, plain Newton converges to a mirrored element."""
    column, q = confined_column(LAW, selective=kind[1], **mesh_options(kind[0])), None
    for step in range(1, steps + 1):
        level = factor * step / steps
        if level > 1:
            with pytest.raises(SolverError):
                solve_equilibrium(column, np.array([level * LIMIT_PA]), q)
            return
        solution = solve_equilibrium(column, np.array([level * LIMIT_PA]), q)
        q = solution.displacement
        assert solution.min_det_f == pytest.approx(1 + q[0], rel=1e-12)
        assert q[0] > 1 / np.sqrt(3) - 1
    assert q is not None
    assert 1 + q[0] == pytest.approx(0.6238701392, abs=1e-7)


@pytest.mark.parametrize("kind", ELEMENTS)
def test_an_unstable_equilibrium_is_never_returned(kind: tuple[str, bool]) -> None:
    """Under 0.9 of the limit load the residual vanishes at a stable and an unstable stretch."""
    column = confined_column(LAW, selective=kind[1], **mesh_options(kind[0]))
    ratio = 0.9 * 2 / (3 * np.sqrt(3))
    unstable, stable = sorted(
        root.real for root in np.roots([1.0, 0.0, -1.0, ratio]) if root.real > 0
    )
    load = column.force(np.array([unstable - 1])).force
    assert load == pytest.approx([0.9 * LIMIT_PA], rel=1e-7)
    solution = solve_equilibrium(column, load, np.array([unstable - 1]))
    assert 1 + solution.displacement[0] == pytest.approx(stable, abs=1e-6)


@pytest.mark.parametrize(
    ("law", "kind"),
    quick_first(pair for pair in EVERY if pair[0] != "saint-venant-kirchhoff"),
)
def test_laws_without_a_limit_point_carry_more(law: str, kind: tuple[str, bool]) -> None:
    for factor in (1.01, 3.0):
        solution = solve_equilibrium(
            confined_column(LAWS[law], selective=kind[1], **mesh_options(kind[0])),
            np.array([factor * LIMIT_PA]),
        )
        alpha = 1 + solution.displacement[0]
        assert piola(LAWS[law], np.diag([alpha, 1.0, 1.0]))[0, 0] == pytest.approx(
            factor * LIMIT_PA, rel=1e-7
        )
        assert solution.min_det_f == pytest.approx(alpha, rel=1e-12)


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_newton_converges_quadratically_near_the_solution(law: str, kind: tuple[str, bool]) -> None:
    model = FullOrderModel(scene_of(law, kind))
    load = np.zeros(model.n_unknowns)
    load[-1] = 2.0
    exact = model.solve(load, options=NewtonOptions(tolerance=1e-12)).displacement
    noise = np.random.default_rng(0).normal(size=len(exact))
    u, errors = exact + 1e-2 * noise * np.abs(exact).max(), []
    for _ in range(4):
        errors.append(float(np.linalg.norm(u - exact)))
        state, tangent = model.linearise(u)
        u = u + model.factor(tangent).solve(load - state.force)
    orders = [
        np.log(c / b) / np.log(b / a)
        for a, b, c in zip(errors, errors[1:], errors[2:], strict=False)
        if c > 1e-12 * np.linalg.norm(exact)
    ]
    assert max(orders) >= 1.8


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_work_of_loading_is_the_stored_energy_and_unloading_returns_to_rest(
    law: str, kind: tuple[str, bool]
) -> None:
    model = FullOrderModel(scene_of(law, kind))
    load = patch_load(model.scene, -1, [0.2, -1.0, 2.0])
    levels = np.linspace(0, 1, 21)
    states = [np.zeros(model.n_unknowns)]
    for level in levels[1:]:
        states.append(model.solve(level * load, start=states[-1]).displacement)
    work = sum(
        0.5 * (a + b) * load @ (v - u)
        for (a, b), (u, v) in zip(
            itertools.pairwise(levels), itertools.pairwise(states), strict=True
        )
    )
    assert work == pytest.approx(model.force(states[-1]).energy_j, rel=4e-3)
    u = model.solve(levels[1] * load, start=states[-1]).displacement
    np.testing.assert_allclose(u, states[1], atol=1e-6 * np.abs(states[1]).max())
    for _ in range(6):
        state, tangent = model.linearise(u)
        u = u - model.factor(tangent).solve(state.force)
    assert np.abs(u).max() <= 1e-9 * np.abs(states[-1]).max()


@pytest.mark.parametrize(("law", "selective"), list(itertools.product(LAWS, (False, True))))
def test_mirrored_load_gives_the_mirrored_answer(law: str, selective: bool) -> None:
    """H8 only: the split into T4 is not symmetric."""
    scene = scene_of(law, ("hexahedron", selective), base="beam-coarse")
    model, points = FullOrderModel(scene), scene.mesh.points
    mirror = np.array(
        [
            int(np.linalg.norm(points - (p * [1, -1, 1] + [0, 1, 0]), axis=1).argmin())
            for p in points
        ]
    )
    forces = scene.patch_weights[[30]].toarray()[0][:, None] * np.array([0.3, 0.5, -0.4])
    answers = np.zeros((2, scene.mesh.n_dofs))
    for answer, load in zip(answers, (forces, forces[mirror] * [1, -1, 1]), strict=True):
        found = model.solve(load.ravel()[scene.free_dofs], options=NewtonOptions(tolerance=1e-13))
        answer[scene.free_dofs] = found.displacement
    first, second = answers.reshape(2, -1, 3)
    apart = np.linalg.norm(second - first[mirror] * [1, -1, 1])
    assert apart <= 1e-12 * np.linalg.norm(first)
    assert np.abs(second - first).max() > 0.1 * np.abs(first).max()


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_two_runs_are_identical(law: str, kind: tuple[str, bool]) -> None:
    first, second = (FullOrderModel(scene_of(law, kind)) for _ in range(2))
    loads = [patch_load(first.scene, patch, [0.3, -1.0, 1.5]) for patch in (-1, 3)]
    once = [first.solve(load) for load in loads]
    again = [second.solve(load) for load in reversed(loads)]
    for one, other in zip(once, reversed(again), strict=True):
        np.testing.assert_array_equal(one.displacement, other.displacement)
        for name in ("min_det_f", "iterations", "cuts"):
            assert getattr(one, name) == getattr(other, name)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mor_bench.errors.LockingWarning")
@pytest.mark.parametrize("poisson", nightly_but(2, [0.4999, 0.49]))
@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_nearly_incompressible_converges(law: str, kind: tuple[str, bool], poisson: float) -> None:
    scene = scene_of(law, kind, poisson)
    model, load = FullOrderModel(scene), patch_load(scene, -1, [0.0, 0.5, 1.0])
    assert scene.material is not None
    assert scene.material.poisson_at_rest == pytest.approx(poisson, rel=1e-9)
    solution = model.solve(load)
    assert relative_residual(model, load, solution.displacement) <= 1e-8
    assert solution.min_det_f > 0


def test_one_huge_step_is_cut_back_and_ends_where_small_steps_do() -> None:
    scene = scene_of("neo-hookean", ("hexahedron", False))
    model, load = FullOrderModel(scene), patch_load(scene, -1, [-20.0, 0.0, -20.0])
    solution = model.solve(load)
    q = None
    for level in np.linspace(0.05, 1.0, 20):
        q = model.solve(level * load, start=q).displacement
    assert q is not None
    assert solution.iterations > 10
    np.testing.assert_allclose(solution.displacement, q, atol=1e-6 * np.abs(q).max())
    few = NewtonOptions(max_cuts=3)
    with pytest.raises(SolverError, match="4 cut-backs"):
        solve_equilibrium(confined_column(), np.array([3 * LIMIT_PA]), options=few)


def test_newton_keeps_blas_to_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside other programs, more threads made a query last half a minute instead of a second."""
    seen: list[int] = []

    def blas_threads() -> list[int]:
        """Threads of SciPy's BLAS; other packages may bring their own."""
        libraries = [one for one in threadpool_info() if one["user_api"] == "blas"]
        of_scipy = [one for one in libraries if "scipy.libs" in one["filepath"]]
        return [one["num_threads"] for one in of_scipy or libraries]

    def factored(self: BandedCholesky, values: Array) -> Any:
        seen.extend(blas_threads())
        return original(self, values)

    scene = scene_of("neo-hookean", ("hexahedron", False))
    model, load = FullOrderModel(scene), patch_load(scene, -1, [-20.0, 0.0, -20.0])
    model.solve(1e-3 * load)  # factors the stiffness at rest
    original = BandedCholesky.factor
    monkeypatch.setattr(BandedCholesky, "factor", factored)
    with threadpool_limits(2, user_api="blas"):
        model.solve(load)
        assert set(blas_threads()) == {2}
    assert set(seen) == {1}


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param("auto"),
        pytest.param("rotated-pcg"),
        pytest.param("jacobi-pcg", marks=pytest.mark.slow),
    ],
)
def test_a_column_beyond_its_buckling_load_is_never_called_stable_when_straight(
    solver: SolverName,
) -> None:
    """Euler's load is about 1 N. The straight column has no residual, but is unstable."""
    spec = mor_bench.load_scene("beam-coarse").spec.model_dump(mode="json")
    spec["geometry"] = {"shape": "box", "size_m": [10.0, 1.0, 1.0], "cells": [20, 2, 2]}
    spec["loads"] |= {"region": "x-max", "patch_area_m2": 1.0}
    spec["material"] = {"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.3}
    scene = mor_bench.load_scene(spec)
    model = FullOrderModel(scene, solver)
    for push in ([-1.2, 0.0, 0.0], [-2.0, 0.0, 0.02], [-1.5, 0.03, 0.01]):
        load = patch_load(scene, 4, push)
        try:
            u = model.solve(load).displacement
        except SolverError:
            continue
        assert relative_residual(model, load, u) <= 1e-8
        BandedCholesky(model.assembler.pattern).factor(model.linearise(u)[1])


@pytest.mark.parametrize("kind", ELEMENTS)
def test_stiffness_contrast_of_a_million(kind: tuple[str, bool]) -> None:
    bars = make_bars(selective=kind[1], **mesh_options(kind[0]))
    np.testing.assert_allclose(bars.end_displacement(), Bars.stretch - 1, rtol=2e-6)


@pytest.mark.parametrize(("law", "kind"), quick_first())
def test_tiny_loads_have_proportional_answers(law: str, kind: tuple[str, bool]) -> None:
    """Laws in terms of F lose their digits where displacements are 1e-13 of the body."""
    model = FullOrderModel(scene_of(law, kind))
    load = patch_load(model.scene, -1, [0.2, -1.0, 2.0])
    unit = model.solve(1e-3 * load).displacement / 1e-3
    # Where all strains are round-off, it decides which fibres are slack.
    tiniest = (1e-12, 1e-14, 1e-100, 1e-300) if law in ISOTROPIC else ()
    for size in (1e-6, 1e-9, *tiniest):
        u = model.solve(size * load).displacement
        assert np.linalg.norm(u / size - unit) <= 0.01 * np.linalg.norm(unit)


class Cubic:
    """One unknown with the force q³; far from its solution, Newton converges linearly.

    Its extent is so large that every step is round-off relative to it. An infinite energy at the
    first linearisations hands the solve over to the safeguarded pass.
    """

    n_unknowns, extent, linear_at_rest, accelerator = 1, 1e30, True, None

    def __init__(self, hopeless: int) -> None:
        self._hopeless = hopeless

    def force(self, q: Array) -> State:
        return State(q**3, float(q[0] ** 4 / 4), 1.0)

    def linearise(self, q: Array) -> tuple[State, Array]:
        self._hopeless -= 1
        state = self.force(q)
        return replace(state, energy_j=np.inf) if self._hopeless >= 0 else state, 3 * q**2

    def step(self, q: Array, tangent: Array, residual: Array, tolerance: float) -> Array:
        return residual / tangent

    def certify(self, q: Array) -> None:
        pass

    @property
    def rest_tangent(self) -> Array:
        raise NotImplementedError

    rest_factor: Any = None


@pytest.mark.parametrize("hopeless", [0, 1])
def test_a_small_step_is_no_convergence_while_the_residual_falls(hopeless: int) -> None:
    """The first case takes full Newton steps, the second the safeguarded pass."""
    solution = solve_equilibrium(Cubic(hopeless), np.ones(1), np.array([1e3]))
    assert solution.displacement[0] == pytest.approx(1.0, rel=1e-8)


def test_small_corrections_of_a_tiny_answer_go_on_while_the_residual_falls() -> None:
    """At 1e-10 of the body's size, corrections are round-off relative to the body."""
    scene = scene_of("saint-venant-kirchhoff", ("hexahedron", False))
    model, load = FullOrderModel(scene), patch_load(scene, -1, [0.2, -1.0, 2.0])
    load = load * 1e-10 * model.extent / np.abs(model.rest_factor.solve(load)).max()
    assert relative_residual(model, load, model.solve(load).displacement) <= 1e-8


def test_a_prediction_that_moves_a_clamp_has_an_error_at_least_as_large() -> None:
    scene = mor_bench.load_scene("beam-tiny")
    force = np.zeros((1, scene.mesh.n_nodes, 3))
    force.reshape(1, -1)[:, scene.free_dofs] = patch_load(scene, -1, [0.0, 0.1, 1.0])
    u = mor_bench.load_method("fem").fit(scene, None).predict(force)
    moved = u.copy()
    moved[:, scene.fixed_nodes, 2] += 0.5 * np.abs(u).max()
    indicated = [ErrorIndicator(scene)(force, v).relative_correction[0] for v in (u, moved)]
    assert indicated[0] <= 1e-6
    assert indicated[1] >= 0.99 * np.linalg.norm(moved - u) / np.linalg.norm(u)


class Mirrored(Cubic):
    """The same with inverted cells at every state."""

    extent, linear_at_rest = 1.0, True

    def force(self, q: Array) -> State:
        return replace(super().force(q), min_det_f=-1.0)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_mirrored_state_without_residual_is_refused() -> None:
    with pytest.raises(InvertedElementError, match="elements invert"):
        solve_equilibrium(Mirrored(0), np.ones(1), np.full(1, 1.1))
