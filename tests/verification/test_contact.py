"""A rigid instrument that presses: Hertz, closed forms, derivatives, balance, and robustness."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

import mor_bench
from mor_bench.counting import counted
from mor_bench.errors import InvalidInputError, SolverError, UnsupportedSceneError
from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics.contact import ContactModel, penetrations
from mor_bench.mechanics.contact_acceleration import PressedInverse, TouchedDofs
from mor_bench.mechanics.contact_points import ContactPoints
from mor_bench.mechanics.linear_contact import LinearContact
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.moved_bodies import ToolForces
from mor_bench.mechanics.newton import Solution
from mor_bench.mechanics.problem import Attempt
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.given import given_of
from mor_bench.snapshots.solve import pack

from .pressed_blocks import BALL, FLAT, PLANES, TIGHT, YOUNG_PA, block, given, graded, pressed
from .scenes import reactions

Array = NDArray[np.float64]


def hertz_ratio(scene: Scene, depth: float) -> float:
    """Return the force of the ball over that on a half-space, 4/3 E* √R d^1.5."""
    model, u = pressed(scene, [0.0, 0.0, -depth])
    exact = 4 / 3 * YOUNG_PA / (1 - 0.3**2) * np.sqrt(20.0) * depth**1.5
    return float(4 * model.reaction(u)[2] / exact)  # a quarter of the ball


def test_a_ball_on_a_large_block_feels_the_force_of_hertz_within_ten_percent() -> None:
    errors = [hertz_ratio(graded(n, 32.0), 0.05) - 1 for n in (1, 2)]
    # Two cells per contact radius, and a block of 32 contact radii, which is stiffer by 2 percent.
    assert 0.0 < errors[1] < 0.1
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
def test_the_force_of_a_ball_converges_to_that_of_hertz() -> None:
    errors = [hertz_ratio(graded(n, 64.0), 0.05) - 1 for n in (1, 2, 4)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2] > 0
    # The stiffening by the finite block is inverse to its size.
    smaller = hertz_ratio(graded(4, 32.0), 0.05) - 1
    assert abs(2 * errors[2] - smaller) < 0.01


@pytest.mark.parametrize("confined", [False, True])
def test_a_plane_compresses_a_block_as_the_closed_form_with_the_penalty(confined: bool) -> None:
    supports = [*PLANES]
    if confined:
        supports += [{"region": f"{axis}-max", "components": [axis]} for axis in "xy"]
    nu, depth, penalty, height = 0.3, 0.1, 1e4, 0.5
    scene = block(
        FLAT,
        supports=supports,
        material=material_table("saint-venant-kirchhoff", YOUNG_PA, nu),
        loads={"penalty_n_m3": penalty},
    )
    model, u = pressed(scene, [0.0, 0.0, -depth])
    modulus = YOUNG_PA
    if confined:
        modulus *= (1 - nu) / ((1 + nu) * (1 - 2 * nu))

    def traction(stretch: float) -> float:
        return 0.5 * modulus * (stretch - stretch**3)

    def penetration(stretch: float) -> float:
        return depth - (1 - stretch) * height

    stretch = brentq(lambda x: traction(x) - penalty * penetration(x), 0.7, 1.0, xtol=1e-15)
    np.testing.assert_allclose(model.reaction(u), [0.0, 0.0, traction(stretch)], rtol=1e-8)
    moved = np.zeros(scene.mesh.n_dofs)
    moved[scene.free_dofs] = u
    nodal = moved.reshape(-1, 3)
    np.testing.assert_allclose(nodal[:, 2], (stretch - 1) * scene.mesh.points[:, 2], atol=1e-9)
    across = 1.0 if confined else np.sqrt(1 - nu * (stretch**2 - 1))
    np.testing.assert_allclose(nodal[:, 0], (across - 1) * scene.mesh.points[:, 0], atol=1e-9)
    (deepest,) = penetrations(scene, nodal[None], np.array([[0.0, 0.0, -depth]]))
    assert deepest == pytest.approx(traction(stretch) / penalty, rel=1e-8)


@pytest.mark.parametrize(
    "element",
    [{"element": "hexahedron"}, {"element": "tetrahedron"}, {"element": "tetrahedron", "order": 2}],
)
@pytest.mark.parametrize("instrument", [BALL, FLAT])
def test_force_and_tangent_are_derivatives_of_the_energy(
    element: dict[str, Any], instrument: dict[str, Any]
) -> None:
    scene = block(instrument, discretisation=element)
    model = ContactModel(scene).under(np.array([0.05, -0.03, -0.1]))
    generator = np.random.default_rng(0)
    q, along = 0.02 * generator.normal(size=(2, model.n_unknowns))
    q *= 0.25  # larger ones invert small elements
    assert len(model.touch(q).points) > 10
    step = 1e-6
    after, before = (model.force(q + sign * step * along) for sign in (1, -1))
    state, values = model.linearise(q)
    np.testing.assert_allclose(state.force, model.force(q).force, atol=1e-12)
    slope = (after.energy_j - before.energy_j) / (2 * step)
    assert slope == pytest.approx(float(state.force @ along), rel=1e-6)
    tangent = model.assembler.pattern.symmetric(values) @ along
    difference = (after.force - before.force) / (2 * step)
    # A few points begin or cease to touch within the step.
    assert np.linalg.norm(tangent - difference) < 1e-5 * np.linalg.norm(difference)


def test_the_work_of_the_instrument_is_the_stored_energy() -> None:
    scene = block(FLAT)
    depth, (x, weights) = 0.1, np.polynomial.legendre.leggauss(6)
    work = 0.0
    for part, weight in zip(0.5 * (1 + x), 0.5 * weights, strict=True):
        model, u = pressed(scene, [0.0, 0.0, -depth * part])
        work += weight * depth * float(model.reaction(u)[2])
    model, u = pressed(scene, [0.0, 0.0, -depth])
    assert work == pytest.approx(model.force(u).energy_j, rel=1e-8)


@pytest.mark.parametrize("instrument", [BALL, FLAT])
def test_the_supports_carry_the_instrument(instrument: dict[str, Any]) -> None:
    scene = block(instrument)
    model, u = pressed(scene, [0.05, -0.03, -0.1])
    full = np.zeros(scene.mesh.n_dofs)
    full[scene.free_dofs] = u
    on_body = ToolForces(scene)(u[None])[0]
    others = reactions(scene, on_body, full.reshape(-1, 3))
    force = model.reaction(u)
    size = float(np.linalg.norm(force))
    np.testing.assert_allclose(on_body.sum(axis=0), -force, atol=1e-10 * size)
    np.testing.assert_allclose(others[scene.fixed_nodes].sum(axis=0), force, atol=1e-10 * size)
    others[scene.fixed_nodes] = 0.0
    assert np.abs(others).max() < 1e-10 * size
    assert force[2] > 1.0


def test_contact_has_no_friction() -> None:
    _, straight = pressed(block(FLAT), [0.0, 0.0, -0.1])
    _, sliding = pressed(block(FLAT), [0.3, -0.2, -0.1])
    np.testing.assert_allclose(sliding, straight, atol=1e-12)
    scene = block()
    model, u = pressed(scene, [0.05, -0.03, -0.1])
    touch = model.touch(u)
    across = touch.forces - np.sum(touch.forces * touch.normals, axis=1)[:, None] * touch.normals
    assert np.abs(across).max() < 1e-12 * np.abs(touch.forces).max()
    centre = np.array(BALL["sphere"]["centre_m"]) + model.motion
    moved = np.zeros(scene.mesh.n_dofs)
    moved[scene.free_dofs] = u
    surface = scene.contact_surface
    where = (surface.points + surface.values @ moved.reshape(-1, 3))[touch.points]
    torque = np.cross(where - centre, touch.forces).sum(axis=0)  # a ball cannot be turned
    assert np.abs(torque).max() < 1e-12 * np.abs(touch.forces).sum()


@pytest.mark.parametrize("gravity", [None, {"density_kg_m3": 2.0}])
def test_an_instrument_that_does_not_touch_moves_nothing(gravity: Any) -> None:
    scene = block(gravity=gravity)
    for motion in ([0.0, 0.0, 0.3], [0.0, 0.0, 0.0], [0.3, 0.0, 0.1]):
        model, u = pressed(scene, motion)
        assert not u.any()
        assert not model.reaction(u).any()
    model, u = pressed(scene, [2.0, 0.0, -0.05])  # it touches on its way
    assert np.abs(u).max() < 1e-12
    assert not model.reaction(u).any()


def test_a_stiffer_penalty_penetrates_less() -> None:
    depths = []
    for penalty in (1e4, 1e5, 1e6):
        scene = block(loads={"penalty_n_m3": penalty})
        model, u = pressed(scene, [0.0, 0.0, -0.1])
        depths.append(model.touch(u).penetration.max())
    orders = np.log10(np.divide(depths[:-1], depths[1:]))
    assert orders.min() > 0.5  # 1, if the traction did not depend on it
    default = block().contact_surface
    assert default.penalty_n_m3 == pytest.approx(1000 * YOUNG_PA / 0.25)
    assert default.stiffness.sum() == pytest.approx(default.penalty_n_m3)  # the area is 1 m²


@pytest.mark.parametrize("solver", ["cholesky", "jacobi-pcg", "rotated-pcg", "superlu"])
def test_all_solvers_find_the_same_equilibria_where_contact_opens_and_closes(solver: Any) -> None:
    scene, generator = block(), np.random.default_rng(0)
    model = ContactModel(scene, solver)
    motions = generator.uniform([-0.4, -0.4, -0.2], [0.4, 0.4, 0.02], size=(8, 3))
    rows = np.array([given(scene, m.tolist()).ravel()[scene.free_dofs] for m in motions])
    for motion, found in zip(motions, model.solve_many(rows, TIGHT), strict=True):
        assert not isinstance(found, Exception), (motion, found)
        _, u = pressed(scene, motion.tolist())
        np.testing.assert_allclose(found.displacement, u, atol=1e-9)


def test_a_small_ball_never_gets_past_the_surface() -> None:
    """The motion is two radii: in one step, the surface would be behind the centre."""
    scene = block({"sphere": {"radius_m": 0.15, "centre_m": [0.5, 0.5, 0.65]}})
    model, u = pressed(scene, [0.0, 0.0, -0.3])
    touch = model.touch(u)
    assert touch.penetration.max() < 0.1 * 0.15
    assert touch.forces[:, 2].max() < 0
    assert touch.normals[:, 2].max() < 0


def test_a_tool_that_crushes_a_body_is_reported() -> None:
    scene = block(FLAT, material=material_table("saint-venant-kirchhoff", YOUNG_PA, 0.3))
    with pytest.raises(SolverError, match="the load is the motion of the instrument"):
        pressed(scene, [0.0, 0.0, -0.45])


def test_a_heavy_body_on_springs_is_pressed_from_its_rest_state() -> None:
    changed: dict[str, Any] = {
        "gravity": {"density_kg_m3": 2.0},
        "springs": [{"region": "x-min", "stiffness_n_m3": 100.0}],
    }
    scene = block(**changed)
    model, u = pressed(scene, [0.0, 0.0, -0.12])
    body = FullOrderModel(scene).force(u).force
    on_body = ToolForces(scene)(u[None])[0].ravel()[scene.free_dofs]
    np.testing.assert_allclose(body, on_body, atol=1e-10 * np.abs(body).sum())
    np.testing.assert_allclose(
        on_body.reshape(-1, 3).sum(axis=0), -model.reaction(u), atol=1e-9 * np.abs(body).sum()
    )
    # The rest state lies lower, so that the ball presses less.
    light, v = pressed(block(springs=changed["springs"]), [0.0, 0.0, -0.12])
    assert 0 < model.reaction(u)[2] < 0.99 * light.reaction(v)[2]


@pytest.mark.parametrize(
    "instrument", [FLAT, {"sphere": {"radius_m": 5.0, "centre_m": [0.45, 0.55, 5.5]}}]
)
def test_linear_elasticity_with_contact_is_the_limit_of_small_motions(
    instrument: dict[str, Any],
) -> None:
    scene = block(instrument)
    response = LinearContact(scene)
    errors = []
    for depth in (1e-2, 1e-3):
        _, u = pressed(scene, [0.0, 0.0, -depth])
        linear = response.respond(given(scene, [0.0, 0.0, -depth]).reshape(1, -1))[0]
        errors.append(np.linalg.norm(linear[scene.free_dofs] - u) / np.linalg.norm(u))
        held = linear[scene.fixed_dofs]
        assert not held.any()
    assert errors[1] < 0.01
    assert errors[0] > 5 * errors[1]
    with pytest.raises(UnsupportedSceneError, match="not a linear function"):
        response.to_coordinates(np.ones((len(scene.free_dofs), 1)))


@pytest.mark.parametrize("instrument", [BALL, FLAT])
def test_linear_elasticity_balances_the_contact_at_large_motions(
    instrument: dict[str, Any],
) -> None:
    scene = block(instrument)
    model, response = ContactModel(scene), LinearContact(scene)
    stiffness = model.assembler.pattern.symmetric(model.rest_tangent)
    for motion in ([0.05, -0.03, -0.1], [0.3, 0.3, -0.2], [0.0, 0.0, -0.3]):
        u = response.respond(given(scene, motion).reshape(1, -1))[0, scene.free_dofs]
        placed = model.under(np.array(motion))
        # The force of the model is that of the body less that of the contact.
        contact = FullOrderModel(scene).force(u).force - placed.force(u).force
        excess = np.linalg.norm(stiffness @ u - contact)
        assert excess < 1e-7 * np.linalg.norm(contact)
        assert placed.reaction(u)[2] > 1.0


def test_linear_elasticity_keeps_the_surface_on_its_side_of_a_ball() -> None:
    """Beyond the ball's centre, the potential has another minimum: the ball pushes from below."""
    scene = block({"sphere": {"radius_m": 0.3, "centre_m": [0.5, 0.5, 0.8]}})
    model, response = ContactModel(scene), LinearContact(scene)
    for motion in np.array([[0.1, 0.03, -0.2], [0.2, 0.06, -0.4], [0.1, 0.03, -0.45]]):
        u = response.respond(given(scene, motion).reshape(1, -1))[0, scene.free_dofs]
        assert model.under(motion).reaction(u) @ motion < 0


def test_an_instrument_that_barely_touches_needs_no_smaller_steps() -> None:
    """The energy of tiny strains is round-off, which must not stop the descent."""
    scene = block({"sphere": {"radius_m": 5.0, "centre_m": [0.45, 0.55, 5.5]}})
    model = ContactModel(scene)
    nearest = scene.contact_surface.gaps_at_rest.min()
    for depth in nearest + np.array([1e-8, 1e-7, 1e-6, 1e-5]):
        values = given(scene, [0.0, 0.0, -depth]).ravel()[scene.free_dofs]
        found = model.solve(values, options=TIGHT)
        assert found.cuts == 0
        assert found.iterations < 20
        placed = model.under(np.array([0.0, 0.0, -depth]))
        assert placed.reaction(found.displacement)[2] > 0
        forces = placed.contact_size(found.displacement)
        residual = np.linalg.norm(placed.force(found.displacement).force)
        assert residual < 1e-5 * forces  # round-off of the strains


@pytest.mark.parametrize("name", ["pod", "hpod", "ecm"])
def test_reduced_models_with_all_modes_give_the_full_order_answer(name: str) -> None:
    scene = block(geometry={"shape": "box", "size_m": [1.0, 1.0, 0.5], "cells": [3, 3, 2]})
    n = len(scene.free_dofs)
    modes = np.linalg.qr(np.random.default_rng(0).normal(size=(n, n)))[0]
    model = {"modes": modes}
    if name != "pod":
        model["cells"] = np.arange(scene.mesh.n_cells)
        model["weights"] = np.ones(scene.mesh.n_cells)
    method = mor_bench.load_method(name, tolerance=1e-12).restore(scene, model)
    for motion in ([0.0, 0.0, -0.1], [0.2, -0.1, -0.12], [0.0, 0.0, 0.1]):
        _, u = pressed(scene, motion)
        query = given_of(scene, given(scene, motion)).query
        found = method.predict(query).ravel()[scene.free_dofs]
        np.testing.assert_allclose(found, u, atol=1e-9)


def test_a_query_must_be_one_motion() -> None:
    scene = block()
    values = given(scene, [0.0, 0.0, -0.1])
    values[scene.observed_nodes[0], 2] *= 1.01  # type: ignore[index]
    with pytest.raises(InvalidInputError, match=r"along z it differs by 0\.001 m"):
        ContactModel(scene).solve(values.ravel()[scene.free_dofs])


@pytest.mark.slow
def test_an_instrument_presses_the_smooth_surface_in_a_mesh_of_voxels() -> None:
    """Workers get the scene without its caches, and must find the same surface."""
    table = load_scene("liver-hex").generated.model_dump()
    loads = {
        "kind": "contact",
        "region": {"box_m": [[0.0, -0.09, 0.04], [0.11, 0.02, 0.09]]},
        "instrument": {"sphere": {"radius_m": 0.03, "centre_m": [0.07, -0.04, 0.115]}},
        "direction": [0.0, 0.0, -1.0],
        "magnitude_m": [0.0, 0.02],
        "samples": 4,
    }
    table["geometry"]["cells"] = [9, 8, 9]
    table["material"]["poisson"] = 0.4
    scene = load_scene({**table, "loads": loads, "split": {"by": "sample"}, "tests": {}})
    model, u = pressed(scene, [0.0, 0.0, -0.015])
    sent, weights = pickle.loads(pack(scene))
    np.testing.assert_array_equal(sent.observed_nodes, scene.observed_nodes)
    assert abs(weights - scene.patch_weights).max() == 0
    other = ContactModel(sent).under(np.array([0.0, 0.0, -0.015]))
    np.testing.assert_array_equal(other.reaction(u), model.reaction(u))
    force = ToolForces(scene)(u[None])[0].sum(axis=0)
    np.testing.assert_allclose(force, -model.reaction(u), atol=1e-9 * float(np.abs(force).max()))
    assert model.reaction(u)[2] > 0.01


def test_the_pressed_inverse_is_that_of_the_stiffness_at_rest_with_the_contact() -> None:
    model, u = pressed(block(), [0.0, 0.0, -0.1])
    touched, touch = TouchedDofs(model, ContactPoints(model.scene)), model.touch(u)
    inverse = PressedInverse(model.turned_rest.at(None), touched, touch)
    used, push = touched.contact.dense(touch, curved=False)
    force = np.random.default_rng(0).normal(size=model.n_unknowns)
    found = inverse.solve(force)
    on_contact = np.zeros(touched.n)
    on_contact[used] = push @ touched.at(found)[used]
    stiffness = model.assembler.pattern.symmetric(model.assembler.force_and_tangent(0.0 * u)[1])
    left = stiffness @ found + touched.spread(on_contact) - force
    assert np.linalg.norm(left) < 1e-3 * np.linalg.norm(force)


@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron"])
def test_the_accelerated_iteration_finds_the_states_of_the_descent(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    order = {} if kind == "hexahedron" else {"order": 2}
    scene, generator = block(discretisation={"element": kind, **order}), np.random.default_rng(1)
    motions = generator.uniform([-0.2, -0.2, -0.2], [0.2, 0.2, 0.0], size=(6, 3))
    rows = np.array([given(scene, m.tolist()).ravel()[scene.free_dofs] for m in motions])
    model = ContactModel(scene)
    with counted() as fast:
        found = model.solve_many(rows)
    missed = Attempt(np.zeros(0), 1.0, 0, converged=False)
    monkeypatch.setattr(ContactModel, "quickly", lambda *_: missed)
    with counted() as slow:
        expected = model.solve_many(rows)
    for one, other in zip(found, expected, strict=True):
        assert isinstance(one, Solution)
        assert isinstance(other, Solution)
        size = np.abs(other.displacement).max()
        assert np.abs(one.displacement - other.displacement).max() < 1e-6 * size
    assert fast.multiply_adds > 0
    assert fast.element_evaluations < slow.element_evaluations
