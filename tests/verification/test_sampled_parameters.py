"""Sampled parameters: each sample is that of a scene built with its parameters."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.parametric import ParametricModel, ParametricResponse
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.specs import load_generated_spec

EXACT = NewtonOptions(1e-12)

RANGES: dict[str, dict[str, Any]] = {
    "stiffness": {"young_pa": [300.0, 800.0], "poisson": [0.3, 0.45]},
    "shape": {"scale": {"x": [0.8, 1.2], "z": [0.7, 1.1]}},
    "both": {
        "young_pa": [300.0, 800.0],
        "poisson": [0.3, 0.45],
        "scale": {"x": [0.8, 1.2], "y": [0.9, 1.3], "z": [0.7, 1.1]},
    },
}

VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "neo-hookean": {"material": {"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.4}},
    "selective": {"discretisation": {"integration": "selective"}},
    "gravity": {"gravity": {"density_kg_m3": 5.0, "acceleration_m_s2": [0.0, 0.0, -1.0]}},
}


def built(ranges: dict[str, Any] | None, **changed: Any) -> Scene:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json", exclude_none=True)
    table = {} if ranges is None else {"parameters": ranges}
    return mor_bench.load_scene({**spec, "name": "several-bodies", **table, **changed})


def with_parameters(parameters: dict[str, float], **changed: Any) -> Scene:
    """Build the scene from a file with these parameters, without the table `parameters`."""
    size = [2.0, 1.0, 1.0]
    size = [
        side * parameters.get(f"scale_{axis}", 1.0) for side, axis in zip(size, "xyz", strict=True)
    ]
    material = {"law": "saint-venant-kirchhoff", "young_pa": 500.0, "poisson": 0.4}
    material |= changed.pop("material", {})
    material |= {name: value for name, value in parameters.items() if "scale" not in name}
    geometry = {"shape": "box", "size_m": size, "cells": [6, 2, 2]}
    return built(None, geometry=geometry, material=material, **changed)


def named(scene: Scene, row: np.ndarray) -> dict[str, float]:
    return dict(zip(scene.parameter_names, row.tolist(), strict=True))


def drawn(scene: Scene, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return loads (n, n_free), N, and parameters of a scene's first samples."""
    loads = draw_loads(scene, 0, n)
    forces = loads.nodal_forces(scene.patch_weights).reshape(n, -1)
    return forces[:, scene.free_dofs], loads.parameters


@cache
def samples(kind: str) -> Snapshots:
    """Solve a few samples without the cache."""
    scene = built(RANGES[kind])
    forces, parameters = drawn(scene, 42)
    found = ParametricModel(scene).solve_many(forces, parameters)
    u = np.array([one.displacement for one in found])  # type: ignore[union-attr]
    return Snapshots(scene, draw_loads(scene, 0, 42), u, np.ones(42))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("kind", RANGES)
def test_a_solution_is_that_of_a_scene_with_these_parameters(kind: str, variant: str) -> None:
    scene = built(RANGES[kind], **VARIANTS[variant])
    forces, parameters = drawn(scene, 2)
    found = ParametricModel(scene).solve_many(forces, parameters, EXACT)
    for load, row, solution in zip(forces, parameters, found, strict=True):
        own = with_parameters(named(scene, row), **VARIANTS[variant])
        expected = FullOrderModel(own).solve(load, options=EXACT)
        error = np.linalg.norm(solution.displacement - expected.displacement)  # type: ignore[union-attr]
        # The rest state under gravity is known to about 1e-12 m.
        assert error <= 1e-10 * np.linalg.norm(expected.displacement) + 2e-12
        assert solution.min_det_f == pytest.approx(expected.min_det_f, abs=1e-10)  # type: ignore[union-attr]


@pytest.mark.parametrize("kind", RANGES)
def test_a_linear_response_is_that_of_a_scene_with_these_parameters(kind: str) -> None:
    scene = built(RANGES[kind])
    forces, parameters = drawn(scene, 3)
    loads = np.zeros((3, scene.mesh.n_dofs))
    loads[:, scene.free_dofs] = forces
    found = ParametricResponse(scene).respond(loads, parameters)[:, scene.free_dofs]
    for load, row, response in zip(forces, parameters, found, strict=True):
        own = FullOrderModel(with_parameters(named(scene, row)), "cholesky")
        expected = own.rest_factor.solve(load)
        assert np.linalg.norm(response - expected) <= 1e-10 * np.linalg.norm(expected)


def test_a_tiny_force_moves_each_body_by_its_own_linear_response() -> None:
    scene = built(RANGES["both"])
    forces, parameters = drawn(scene, 2)
    found = ParametricModel(scene).solve_many(1e-13 * forces, parameters)
    for load, row, solution in zip(forces, parameters, found, strict=True):
        own = FullOrderModel(with_parameters(named(scene, row)), "cholesky")
        expected = own.rest_factor.solve(1e-13 * load)
        error = np.linalg.norm(solution.displacement - expected)  # type: ignore[union-attr]
        assert error <= 1e-9 * np.linalg.norm(expected)


def test_a_stiffer_body_under_a_larger_force_moves_the_same() -> None:
    scene = built(RANGES["stiffness"])
    forces, parameters = drawn(scene, 4)
    stiffer = parameters * np.array([1.7, 1.0])
    model = ParametricModel(scene)
    soft = model.solve_many(forces, parameters, EXACT)
    stiff = model.solve_many(1.7 * forces, stiffer, EXACT)
    for one, other in zip(soft, stiff, strict=True):
        u, v = one.displacement, other.displacement  # type: ignore[union-attr]
        assert np.linalg.norm(u - v) <= 1e-10 * np.linalg.norm(u)


def test_springs_do_not_scale_with_the_stiffness_of_the_body() -> None:
    springs = {"springs": [{"region": "z-min", "stiffness_n_m3": 200.0}]}
    scene = built({"young_pa": [300.0, 800.0]}, **springs)
    forces, parameters = drawn(scene, 2)
    found = ParametricModel(scene).solve_many(forces, parameters, EXACT)
    for load, row, solution in zip(forces, parameters, found, strict=True):
        own = FullOrderModel(with_parameters(named(scene, row), **springs))
        expected = own.solve(load, options=EXACT).displacement
        error = np.linalg.norm(solution.displacement - expected)  # type: ignore[union-attr]
        assert error <= 1e-10 * np.linalg.norm(expected)


def test_the_polynomial_gives_the_answers_of_plain_pod_for_every_stiffness() -> None:
    training = samples("stiffness")
    exact = {"n_modes": 8, "tolerance": 1e-12}
    plain = mor_bench.load_method("pod", **exact).fit(training.scene, training)
    polynomial = mor_bench.load_method("pod-tensor", **exact).fit(training.scene, training)
    forces, parameters = training.forces[:12], training.parameters[:12]
    expected = plain.predict(forces, parameters)
    found = polynomial.predict(forces, parameters)
    assert np.linalg.norm(found - expected) <= 1e-10 * np.linalg.norm(expected)


@pytest.mark.parametrize("kind", ["stiffness", "both"])
def test_pod_solves_the_projected_equations_of_a_scene_with_these_parameters(kind: str) -> None:
    training = samples(kind)
    scene = training.scene
    method: Any = mor_bench.load_method("pod", n_modes=6, tolerance=1e-12)
    method.fit(scene, training)
    for i in range(3):
        own = FullOrderModel(with_parameters(named(scene, training.parameters[i])))
        reduced = GalerkinProblem(own.assembler, method.modes_)
        u = method.predict(training.forces[i], training.parameters[i])
        q = method.modes_.T @ u.ravel()[scene.free_dofs]
        load = method.modes_.T @ training.free_forces[i]
        residual = np.linalg.norm(reduced.force(q).force - load)
        assert residual <= 1e-9 * np.linalg.norm(load)


@pytest.mark.parametrize("kind", ["stiffness", "both"])
def test_a_cubature_of_all_cells_gives_the_answers_of_plain_pod(kind: str) -> None:
    training = samples(kind)
    exact = {"n_modes": 6, "tolerance": 1e-12}
    plain = mor_bench.load_method("pod", **exact).fit(training.scene, training)
    whole = mor_bench.load_method("hpod", **exact, cubature_tolerance=0.0)
    whole.fit(training.scene, training)
    forces, parameters = training.forces[:6], training.parameters[:6]
    expected = plain.predict(forces, parameters)
    found = whole.predict(forces, parameters)
    assert np.linalg.norm(found - expected) <= 1e-10 * np.linalg.norm(expected)


def test_a_cubature_reproduces_the_forces_of_bodies_with_other_shapes() -> None:
    """A cubature that was trained on one body only misses by far more."""
    training = samples("both")
    few = mor_bench.load_method("hpod", n_modes=4, cubature_tolerance=1e-3)
    few.fit(training.scene, training)
    plain = mor_bench.load_method("pod", n_modes=4).fit(training.scene, training)
    expected = plain.predict(training.forces, training.parameters)
    found = few.predict(training.forces, training.parameters)
    assert np.linalg.norm(found - expected) <= 0.02 * np.linalg.norm(expected)


def test_a_regression_gives_no_displacement_without_force_on_any_body() -> None:
    training = samples("both")
    method = mor_bench.load_method("pca-regression-linear", n_input_modes=4, n_output_modes=6)
    method.fit(training.scene, training)
    still = method.predict(0.0 * training.forces, training.parameters)
    assert not still.any()
    moved = method.predict(training.forces, training.parameters)
    others = method.predict(training.forces, training.parameters[::-1])
    assert np.abs(moved - others).max() > 0.01 * np.abs(moved).max()


def test_parameters_do_not_change_the_draws_of_the_loads() -> None:
    plain, several = built(None), built(RANGES["both"])
    alone, joint = draw_loads(plain, 0, 30), draw_loads(several, 0, 30)
    assert np.array_equal(alone.vectors, joint.vectors)
    assert np.array_equal(draw_loads(several, 7, 9).parameters, joint.parameters[7:9])


@pytest.mark.parametrize("sampling", ["random", "latin-hypercube", "sobol"])
def test_drawn_parameters_fill_their_ranges_and_nothing_else(sampling: str) -> None:
    loads = load_generated_spec("beam-tiny").load_plan.model_dump(mode="json", exclude_none=True)
    scene = built(RANGES["both"], loads={**loads, "sampling": sampling, "samples_per_patch": 16})
    table = scene.generated.parameters
    assert table is not None
    low, high = np.array(list(table.ranges.values())).T
    parameters = draw_loads(scene, 0, 336).parameters
    unit = (parameters - low) / (high - low)
    assert unit.min() >= 0
    assert unit.max() <= 1
    assert np.abs(unit.mean(axis=0) - 0.5).max() < 0.06
    correlations = np.corrcoef(unit.T)[~np.eye(len(low), dtype=bool)]
    assert np.abs(correlations).max() < 0.2
    if sampling == "latin-hypercube":  # of each patch, one sample lies in each sixteenth
        assert (np.sort(unit[::21] * 16, axis=0).astype(int) == np.arange(16)[:, None]).all()
