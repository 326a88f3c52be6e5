"""Tools and instruments on bodies with sampled parameters, and parameters of several tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import InvalidInputError, NoEquilibriumError, SpecError
from mor_bench.measure.reaction_errors import ReactionErrors
from mor_bench.mechanics.contact import ContactModel
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.moved_bodies import MovedBodies, ToolForces, generator_of
from mor_bench.mechanics.newton import Solution
from mor_bench.mechanics.observed import ObservedModel
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.scene.scene_at import scene_at
from mor_bench.snapshots.given import ObservedDisplacements, ParametricForces
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.snapshots.solve import pack
from mor_bench.specs import load_generated_spec

from .pressed_blocks import TIGHT, block, given
from .test_constant_pressures import FOLLOWER, FORCES, SIDE, TOOL

Array = NDArray[np.float64]

STIFFNESS: dict[str, Any] = {"young_pa": [300.0, 900.0], "poisson": [0.1, 0.45]}
SOFT, STIFF = [320.0, 0.15], [850.0, 0.42]
BODIES = np.array([SOFT, STIFF])
BED: dict[str, Any] = {
    "gravity": {"density_kg_m3": 1.0, "acceleration_m_s2": [2.0, 0.0, -9.81]},
    "springs": [{"region": "y-max", "stiffness_n_m3": 50.0}],
    "constant_pressures": [FOLLOWER],
}


def moved(tool: bool, parameters: dict[str, Any] | None = STIFFNESS, **changed: Any) -> Scene:
    """Return the block with sampled parameters, moved by a tool or pressed by a ball."""
    higher = {"sphere": {"radius_m": 0.4, "centre_m": [0.45, 0.55, 0.93]}}
    content = block(higher).generated.model_dump()
    loads = {"loads": TOOL} if tool else {}
    return load_scene({**content, **loads, "parameters": parameters, **changed})


def rows(scene: Scene, motion: list[float], n: int) -> Array:
    return np.tile(given(scene, motion).ravel()[scene.free_dofs], (n, 1))


@pytest.mark.parametrize("tool", [True, False])
@pytest.mark.parametrize("more", [{}, BED])
def test_each_body_has_its_own_equilibrium_and_reaction(tool: bool, more: dict[str, Any]) -> None:
    scene = moved(tool, **more)
    asked = rows(scene, [0.04, 0.0, -0.1], 2)
    found = generator_of(scene).solve_many(asked, BODIES)
    forces = []
    for solution, values, row in zip(found, BODIES, asked, strict=True):
        assert isinstance(solution, Solution)
        alone = scene_at(scene, values)
        model = (ObservedModel if tool else ContactModel)(alone)
        (expected,) = model.solve_many(row[None], TIGHT)
        assert isinstance(expected, Solution)
        u = solution.displacement
        difference = np.abs(u - expected.displacement).max()
        assert difference < 1e-6 * np.abs(u).max()
        on_body = ToolForces(scene)(u[None], values[None])
        plain = load_scene({**alone.generated.model_dump(), "loads": None, "split": {}})
        load = on_body.reshape(1, -1)[:, scene.free_dofs][0]
        again = FullOrderModel(plain).solve(load, options=TIGHT).displacement
        assert np.abs(again - u).max() < 1e-6 * np.abs(u).max()
        forces.append(float(np.linalg.norm(on_body.sum(axis=1))))
    assert forces[1] > 2.0 * forces[0]


@pytest.mark.parametrize("tool", [True, False])
def test_displacements_do_not_depend_on_the_modulus_alone(tool: bool) -> None:
    scene = moved(tool, {"young_pa": [300.0, 900.0]})
    asked = rows(scene, [0.0, 0.05, -0.1], 2)
    found = generator_of(scene).solve_many(asked, np.array([[300.0], [900.0]]))
    u = np.array([each.displacement for each in found if isinstance(each, Solution)])
    np.testing.assert_array_equal(u[0], u[1])
    forces = np.linalg.norm(ToolForces(scene)(u, np.array([[300.0], [900.0]])).sum(axis=1), axis=1)
    assert forces[1] == pytest.approx(3.0 * forces[0], rel=1e-12)


def test_a_given_penalty_does_not_change_with_the_modulus() -> None:
    scene = moved(False, {"young_pa": [300.0, 900.0]})
    loads = {**scene.generated.model_dump()["loads"], "penalty_n_m3": 2e4}
    scene = moved(False, {"young_pa": [300.0, 900.0]}, loads=loads)
    asked, values = rows(scene, [0.0, 0.0, -0.1], 2), np.array([[300.0], [900.0]])
    found = generator_of(scene).solve_many(asked, values)
    u = np.array([each.displacement for each in found if isinstance(each, Solution)])
    assert np.abs(u[0] - u[1]).max() > 1e-3 * np.abs(u).max()
    expected = ContactModel(scene_at(scene, values[1])).solve(asked[1], options=TIGHT)
    assert np.abs(expected.displacement - u[1]).max() < 1e-6 * np.abs(u).max()


def test_a_tool_holds_the_same_nodes_of_a_scaled_body() -> None:
    scene = moved(True, {"scale": {"x": [0.8, 1.4], "z": [0.7, 1.2]}})
    asked = rows(scene, [0.0, 0.05, -0.05], 1)
    (found,) = generator_of(scene).solve_many(asked, np.array([[1.3, 0.8]]))
    assert isinstance(found, Solution)
    nodes = scene.observed_nodes
    u = scene.at_all_dofs(found.displacement[None]).reshape(-1, 3)
    np.testing.assert_allclose(u[nodes], np.tile([0.0, 0.05, -0.05], (len(u[nodes]), 1)))
    force = ToolForces(scene)(found.displacement[None], np.array([[1.3, 0.8]]))[0]
    alone = FullOrderModel(scene_at(scene, np.array([1.3, 0.8])))
    left = alone.force(found.displacement).force - force.ravel()[scene.free_dofs]
    assert np.abs(left).max() < 1e-6 * np.abs(force).sum()


def test_an_instrument_touches_the_smooth_surface_of_each_body() -> None:
    liver = load_generated_spec("liver-pressed").model_dump()
    scene = load_scene({**liver, "parameters": {"poisson": [0.3, 0.45]}})
    alone = scene_at(scene, np.array([0.35]))
    np.testing.assert_array_equal(alone.contact_surface.points, scene.contact_surface.points)
    ratio = alone.contact_surface.penalty_n_m3 / scene.contact_surface.penalty_n_m3
    assert ratio == pytest.approx(1.0)
    assert pack(scene)


def test_an_instrument_in_the_rest_state_of_a_soft_body_is_an_error_of_that_body() -> None:
    up = {"density_kg_m3": 8.0, "acceleration_m_s2": [0.0, 0.0, 9.81]}
    scene = moved(False, {"young_pa": [100.0, 3000.0]}, gravity=up)
    asked = rows(scene, [0.0, 0.0, -0.1], 2)
    soft, stiff = MovedBodies(scene).solve_many(asked, np.array([[120.0], [2500.0]]))
    assert isinstance(soft, NoEquilibriumError)
    assert "must not penetrate the body at rest" in str(soft)
    assert isinstance(stiff, Solution)


@pytest.mark.parametrize("sampling", ["random", "latin-hypercube", "sobol"])
@pytest.mark.parametrize("tool", [True, False])
def test_plans_draw_motions_and_parameters(tool: bool, sampling: str) -> None:
    plain = moved(tool, None)
    loads = {**plain.generated.model_dump()["loads"], "sampling": sampling, "samples": 64}
    drawn = draw_loads(moved(tool, loads=loads), 0, 64)
    low, high = np.array(list(STIFFNESS.values())).T
    assert drawn.parameters.shape == (64, 2)
    assert ((drawn.parameters >= low) & (drawn.parameters <= high)).all()
    assert (np.ptp(drawn.parameters, axis=0) > 0.8 * (high - low)).all()
    alone = draw_loads(moved(tool, None, loads=loads), 0, 64)
    assert (sampling == "random") == np.array_equal(alone.vectors, drawn.vectors)


def test_several_tables_share_one_draw_of_the_parameters() -> None:
    pressure = {"kind": "pressure", "regions": ["x-max"], "magnitude_pa": [1.0, 30.0], "samples": 8}
    scene = moved(True, loads=[FORCES, pressure])
    drawn = draw_loads(scene, 0, 8)
    assert drawn.parameters.shape == (8, 2)
    forces = scene.at_free_dofs(drawn.nodal_forces(scene.patch_weights).reshape(8, -1))
    (found,) = generator_of(scene).solve_many(forces[:1], drawn.parameters[:1])
    assert isinstance(found, Solution)
    model = FullOrderModel(scene_at(scene, drawn.parameters[0]))
    left = model.force(found.displacement).force - forces[0]
    assert np.linalg.norm(left) < 1e-6 * np.linalg.norm(forces[0])
    with pytest.raises(SpecError, match=r"`parameters\.scale` must be absent where the loads are"):
        moved(True, {"scale": {"x": [0.9, 1.1]}}, loads=[FORCES, pressure])


def test_a_scaled_body_has_no_instrument() -> None:
    with pytest.raises(SpecError, match=r"`parameters\.scale` must be absent where an instrument"):
        moved(False, {"scale": {"x": [0.9, 1.1]}})


def test_a_query_has_displacements_and_parameters() -> None:
    scene = moved(True)
    method, values = mor_bench.load_method("fem").fit(scene), given(scene, [0.0, 0.0, -0.1])
    assert scene.observed_nodes is not None
    seen = ObservedDisplacements(values, scene.observed_nodes)
    one = method.predict(seen, SOFT)
    both = method.predict(ParametricForces(np.stack([values] * 2), BODIES))
    np.testing.assert_array_equal(both[0], one)
    assert np.abs(both[1] - one).max() > 1e-3
    assert not method.predict(seen.with_values(0.0 * values), SOFT).any()
    with pytest.raises(InvalidInputError, match="must have `parameters`"):
        method.predict(seen)
    with pytest.raises(InvalidInputError, match="must be displacements"):
        method.predict(values, SOFT)
    with pytest.raises(InvalidInputError, match="`parameters` must be absent"):
        mor_bench.load_method("fem").fit(moved(True, None)).predict(seen, SOFT)


TAKE = ["fem[tolerance=1e-8]", "linear-fem", "pca-regression-linear[n_input_modes=6]"]
REFUSE = {
    "pod[n_modes=10]": ("are not known", "vary between samples"),
    "umesh": ("sampled parameters", "sampled parameters"),
}
"""A part of the reason of each method that cannot take a tool, or an instrument."""


@pytest.mark.slow
@pytest.mark.parametrize("tool", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_a_run_answers_or_says_why_not(tool: bool, tmp_path: Path, cache: Path) -> None:
    cells = {"shape": "box", "size_m": [1.0, 1.0, 0.5], "cells": [2, 2, 1]}
    scene = moved(tool, constant_pressures=[SIDE], geometry=cells)
    loads = {**scene.generated.model_dump()["loads"], "samples": 80, "magnitude_m": [0.05, 0.15]}
    table = {**scene.generated.model_dump(), "name": f"moved-{tool}".lower(), "loads": loads}
    chosen = [*TAKE, *REFUSE]
    made = mor_bench.run([table], chosen, out=tmp_path / "out", cache=cache, profile="quick")
    found = {row.method: row for row in made.rows}
    for name, reasons in REFUSE.items():
        row = found[name.partition("[")[0]]
        assert row.status == "skipped"
        assert reasons[0 if tool else 1] in str(row.reason)
    errors = {name: row.error for name, row in found.items() if row.error}
    assert set(errors) == {name.partition("[")[0] for name in TAKE}
    assert errors["fem"].rel_l2_median < 1e-5
    assert errors["fem"].reaction_rel_median < 1e-4
    assert errors["pca-regression-linear"].rel_l2_median < errors["linear-fem"].rel_l2_median < 0.5


def test_reaction_errors_belong_to_the_bodies() -> None:
    scene = moved(True)
    found = generator_of(scene).solve_many(rows(scene, [0.0, 0.05, -0.1], 2), BODIES)
    free = np.array([each.displacement for each in found if isinstance(each, Solution)])
    u = scene.at_all_dofs(free).reshape(2, -1, 3)
    errors = ReactionErrors(scene)
    assert not errors(u, u, BODIES).any()
    swapped = errors(u[::-1], u, BODIES)
    expected = ToolForces(scene)(free[::-1], BODIES).sum(axis=1)
    right = ToolForces(scene)(free, BODIES).sum(axis=1)
    ratio = np.linalg.norm(expected - right, axis=1) / np.linalg.norm(right, axis=1)
    np.testing.assert_allclose(swapped, ratio)
    assert (swapped > 1e-3).all()
