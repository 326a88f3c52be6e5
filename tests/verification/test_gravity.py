"""Gravity as a pre-load: closed forms, felupe, and reduced models about the rest state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

import mor_bench
from mor_bench.errors import SolverError, SpecError
from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics import model as model_module
from mor_bench.mechanics.model import FullOrderModel, rest_displacement
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.observed import ObservedModel
from mor_bench.mechanics.relaxation import DynamicRelaxation
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.tensors import TensorProblem
from mor_bench.reduction.weighted_cells import weighted_cells
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.scene.symmetry import mirrors
from mor_bench.specs import load_generated_spec
from mor_bench.surrogates.hyper_reduced import nodal, reduced_points

from .laws_and_elements import ELEMENTS, discretisation
from .scenes import patch_load
from .test_independent_library import compare

Array = NDArray[np.float64]
WEIGHT = {"density_kg_m3": 5.0, "acceleration_m_s2": [0.5, -1.0, -2.0]}


def column(n_cells: int, weight_n_m3: float) -> Scene:
    """Return a column of 2 m that hangs along x and does not contract sideways."""
    return load_scene(
        {
            "name": "column",
            "title": "Column under its own weight",
            "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [n_cells, 1, 1]},
            "material": material_table("saint-venant-kirchhoff", 500.0, 0.0),
            "supports": [
                {"region": "x-min"},
                {"region": "surface", "components": ["y", "z"]},
            ],
            "gravity": {"density_kg_m3": 1.0, "acceleration_m_s2": [weight_n_m3, 0.0, 0.0]},
        }
    )


def sagging(law: str = "saint-venant-kirchhoff", **changed: Any) -> Scene:
    """Return beam-tiny under its own weight, which moves it by more than a fifth of its length."""
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    material = material_table(law, 500.0, 0.4)
    return load_scene({**spec, "material": material, "gravity": WEIGHT, **changed})


def test_a_light_column_stretches_as_in_linear_elasticity() -> None:
    scene = column(8, 1e-4)
    x = scene.mesh.points[:, 0]
    rest = rest_displacement(scene)
    assert rest is not None
    np.testing.assert_allclose(rest[:, 0], 1e-4 * (2.0 * x - 0.5 * x**2) / 500.0, rtol=2e-6)
    assert not rest[:, 1:].any()


def test_a_heavy_column_converges_to_the_integral_of_its_stretches() -> None:
    weight, errors = 100.0, []
    points, weights = np.polynomial.legendre.leggauss(20)
    end = sum(
        w * (brentq(lambda a, p=p: 250.0 * (a**3 - a) - weight * (1.0 - p), 1.0, 2.0) - 1.0)
        for p, w in zip(points, weights, strict=True)
    )
    assert end > 0.2
    for n_cells in (5, 10, 20):
        rest = rest_displacement(column(n_cells, weight))
        assert rest is not None
        errors.append(abs(rest[:, 0].max() - end))
    assert np.log2(errors[0] / errors[1]) > 1.9
    assert np.log2(errors[1] / errors[2]) > 1.9


@pytest.mark.parametrize("kind", [kind for kind in ELEMENTS if not kind[1]])
def test_solutions_under_gravity_agree_with_felupe(kind: tuple[str, bool]) -> None:
    scene = sagging(discretisation=discretisation(kind))
    rest = rest_displacement(scene)
    assert rest is not None
    assert np.abs(rest).max() > 0.2
    compare(scene, 3)


def answers(scene: Scene, solver: Any, load: Array) -> Array:
    return FullOrderModel(scene, solver).solve(load, options=NewtonOptions(1e-11)).displacement


def test_every_solver_measures_from_the_same_rest_state(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = sagging()
    load = patch_load(scene, 9, [0.5, 0.5, 2.0])
    expected = answers(scene, "cholesky", load)
    size = np.abs(expected).max()
    for solver in ("auto", "rotated-pcg", "jacobi-pcg", "superlu"):
        np.testing.assert_allclose(answers(scene, solver, load), expected, atol=1e-9 * size)
    relaxed = DynamicRelaxation(FullOrderModel(scene)).solve(load, 1e-10, 100_000).displacement
    np.testing.assert_allclose(relaxed, expected, atol=1e-7 * size)
    monkeypatch.setattr(model_module, "MAX_BAND_ENTRIES", 0)
    np.testing.assert_allclose(answers(sagging(), "auto", load), expected, atol=1e-9 * size)
    assert not FullOrderModel(scene).solve(0.0 * load).displacement.any()


def test_observed_displacements_are_measured_from_the_rest_state() -> None:
    scene, observed = sagging(), sagging(observed={"region": "z-max"})
    load = patch_load(scene, 9, [0.0, 0.5, 2.0])
    exact = answers(scene, "cholesky", load)
    model = ObservedModel(observed)
    found = model.solve_many(exact[None], NewtonOptions(1e-11))[0]
    assert not isinstance(found, SolverError)
    np.testing.assert_allclose(found.displacement, exact, atol=1e-9 * np.abs(exact).max())
    linear = FullOrderModel(scene).rest_factor.solve(1e-6 * load)
    np.testing.assert_allclose(
        model.linear_response(linear[None])[0], linear, atol=1e-9 * np.abs(linear).max()
    )


@pytest.mark.parametrize("law", ["saint-venant-kirchhoff", "neo-hookean"])
def test_reduced_models_about_the_rest_state_agree(law: str) -> None:
    scene, generator = sagging(law), np.random.default_rng(3)
    model = FullOrderModel(scene)
    modes = np.linalg.qr(generator.normal(size=(model.n_unknowns, 6)))[0]
    q, all_cells = 0.3 * generator.normal(size=6), np.arange(scene.mesh.n_cells)
    ones = np.ones(len(all_cells))
    exact = GalerkinProblem(model.assembler, modes)
    state, tangent = exact.linearise(q)
    points = reduced_points(scene, all_cells, ones, nodal(scene, modes))
    assembler, rows = weighted_cells(scene, all_cells, ones)
    others = [points.force_and_tangent(q), GalerkinProblem(assembler, modes[rows]).linearise(q)]
    if law == "saint-venant-kirchhoff":
        problem = TensorProblem.of_modes(model, modes, q[None])
        others.append(problem.linearise(q))
        assert problem.min_det_f(q) == pytest.approx(state.min_det_f, rel=1e-12)
    for found, derivative in others:
        np.testing.assert_allclose(found.force, state.force, atol=1e-10 * np.abs(state.force).max())
        np.testing.assert_allclose(derivative, tangent, atol=1e-10 * np.abs(tangent).max())
    summed = points.point_forces(q).sum(axis=0)
    np.testing.assert_allclose(summed, state.force, atol=1e-10 * np.abs(state.force).max())
    own = model.assembler.cell_forces(modes @ q)
    total = np.zeros(model.n_unknowns + 1)
    np.add.at(total, model.cell_dofs, own)
    assembled = model.force(modes @ q).force
    np.testing.assert_allclose(total[:-1], assembled, atol=1e-10 * np.abs(assembled).max())


def test_only_planes_along_gravity_mirror_the_scene() -> None:
    down = {"density_kg_m3": 1.0}
    assert [mirror.axis for mirror in mirrors(sagging(gravity=down))] == [1]
    assert mirrors(sagging()) == []


def test_a_body_that_cannot_carry_its_weight_is_refused() -> None:
    press = {"density_kg_m3": 1.0, "acceleration_m_s2": [-4000.0, 0.0, 0.0]}
    with pytest.raises(SolverError, match="no rest state under gravity"):
        FullOrderModel(sagging(gravity=press))


@pytest.mark.parametrize(
    ("gravity", "message"),
    [
        ({}, "key `gravity.density_kg_m3` is missing"),
        ({"density_kg_m3": 0.0}, "`gravity.density_kg_m3` must be greater than 0"),
        (
            {"density_kg_m3": 1.0, "acceleration_m_s2": [0.0, 1.0]},
            r"`gravity.acceleration_m_s2\[2\]` is missing",
        ),
        ({"densty": 1.0}, "unknown key `gravity.densty`; did you mean 'density_kg_m3'"),
    ],
)
def test_wrong_gravity_is_refused(gravity: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        sagging(gravity=gravity)


def test_gravity_belongs_to_the_digest() -> None:
    plain = mor_bench.load_scene("beam-tiny")
    assert sagging().spec.digest() != plain.spec.digest()
    assert sagging(gravity=None).spec.digest() == plain.spec.digest()


def test_the_force_under_gravity_is_the_derivative_of_the_energy() -> None:
    scene, generator = sagging(), np.random.default_rng(5)
    model = FullOrderModel(scene)
    modes = np.linalg.qr(generator.normal(size=(model.n_unknowns, 6)))[0]
    everywhere = np.arange(scene.mesh.n_cells)
    points = reduced_points(scene, everywhere, np.ones(len(everywhere)), nodal(scene, modes))
    for force, n in ((model.force, model.n_unknowns), (points.force, 6)):
        q, direction = 0.05 * generator.normal(size=(2, n))
        rise = force(q + 1e-4 * direction).energy_j - force(q - 1e-4 * direction).energy_j
        assert rise / 2e-4 == pytest.approx(float(force(q).force @ direction), rel=1e-6)
