"""Constant pressures as a pre-load: closed forms, balance, derivatives, and the same equilibria."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

import mor_bench
from mor_bench.errors import SpecError, UnsupportedSceneError
from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.contact import ContactModel
from mor_bench.mechanics.discretisation import discretisation_of
from mor_bench.mechanics.model import FullOrderModel, rest_displacement
from mor_bench.mechanics.moved_bodies import ToolForces, generator_of
from mor_bench.mechanics.newton import Solution
from mor_bench.mechanics.observed import ObservedModel
from mor_bench.mechanics.pressed import PressedModel
from mor_bench.mechanics.reactions import reaction_forces
from mor_bench.scene.other_meshes import refined
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.scene.scene_at import scene_at
from mor_bench.scene.symmetry import mirrors
from mor_bench.snapshots.solve import pack
from mor_bench.specs import load_generated_spec

from .laws_and_elements import ELEMENTS, discretisation
from .pressed_blocks import PLANES, TIGHT, YOUNG_PA, block, given
from .test_following_pressure import area_vectors

Array = NDArray[np.float64]

FORCES: dict[str, Any] = {
    "kind": "force",
    "region": "z-max",
    "patch_area_m2": 0.1,
    "samples": 8,
    "magnitude_n": [0.5, 3.0],
}
TOOL: dict[str, Any] = {
    "kind": "displacement",
    "region": {"box_m": [[0.2, 0.2, 0.5], [0.8, 0.8, 0.5]]},
    "samples": 8,
    "magnitude_m": [0.05, 0.15],
}
SIDE: dict[str, Any] = {"region": "x-max", "pressure_pa": 40.0}
FOLLOWER: dict[str, Any] = {**SIDE, "follower": True}
HEAVY: dict[str, Any] = {
    "gravity": {"density_kg_m3": 1.0, "acceleration_m_s2": [2.0, 0.0, -9.81]},
    "springs": [{"region": "y-max", "stiffness_n_m3": 50.0}],
}


def body(loads: dict[str, Any] | None, *pressures: dict[str, Any], **changed: Any) -> Scene:
    """Return the block of `pressed_blocks` under constant pressures, with other loads."""
    content = block(**changed).generated.model_dump()
    return load_scene({**content, "loads": loads, "constant_pressures": list(pressures)})


def rest_of(scene: Scene) -> Array:
    """Return the displacements (n_nodes, 3), m, of the rest state."""
    found = rest_displacement(scene)
    assert found is not None
    return found


def residual_beside(scene: Scene, u: Array, dead: Array) -> float:
    """Return the largest force that nothing balances, relative to the sum of all forces.

    The internal force is that of the body without a pre-load. The constant pressures are added by
    another rule, on the deformed facets or on the undeformed ones.
    """
    rest = rest_of(scene)
    content = {**scene.generated.model_dump(), "constant_pressures": [], "loads": None, "split": {}}
    bare, n_dofs = discretisation_of(load_scene(content)), scene.mesh.n_dofs
    assembler = Assembler(bare, np.arange(n_dofs).reshape(-1, 3), n_dofs)
    found = assembler.force((rest + u).ravel()).force.reshape(-1, 3) - dead
    for held in scene.constant_pressures:
        moved = rest + u if held.follower else 0.0
        found -= pressed(scene.mesh.points + moved, held.facets, held.pressure_pa)
    free = scene.at_free_dofs(found.reshape(1, -1))
    return float(np.abs(free).max() / np.abs(found).sum())


def pressed(points: Array, facets: NDArray[np.int64], pressure: float) -> Array:
    """Return the nodal forces (n_nodes, 3), N, on quadrilaterals, by 4 x 4 Gauss points."""
    at, weights = np.polynomial.legendre.leggauss(4)
    out = np.zeros(points.shape)
    for x, a in zip(0.5 + 0.5 * at, 0.5 * weights, strict=True):
        for y, b in zip(0.5 + 0.5 * at, 0.5 * weights, strict=True):
            values = np.array([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y])
            along_x = np.einsum("a,fai->fi", [y - 1, 1 - y, y, -y], points[facets])
            along_y = np.einsum("a,fai->fi", [x - 1, -x, x, 1 - x], points[facets])
            force = -pressure * a * b * np.cross(along_x, along_y)
            np.add.at(out, facets, values[None, :, None] * force[:, None])
    return out


@pytest.mark.parametrize("follower", [False, True])
@pytest.mark.parametrize("kind", ELEMENTS)
def test_the_rest_state_of_a_cube_has_its_closed_form(
    kind: tuple[str, bool], follower: bool
) -> None:
    pressure = 60.0 if follower else -60.0
    side = {"pressure_pa": pressure, "follower": follower}
    sides = [{"region": f"{axis}-max", **side} for axis in "xyz"]
    scene = body(
        None,
        *sides,
        supports=PLANES,
        discretisation=discretisation(kind),
        material=material_table("saint-venant-kirchhoff", YOUNG_PA, 0.3),
    )
    bulk = YOUNG_PA / (3 * (1 - 2 * 0.3))
    # S = 3 K (λ² - 1) / 2; Cauchy's stress S / λ is -p of a follower, P = λ S of a dead load.
    power = -1 if follower else 1
    stretch = brentq(lambda x: 1.5 * bulk * (x**2 - 1) * x**power + pressure, 0.6, 1.5)
    np.testing.assert_allclose(rest_of(scene), scene.mesh.points * (stretch - 1), atol=1e-9)


@pytest.mark.parametrize("pressure", [SIDE, FOLLOWER])
@pytest.mark.parametrize("more", [{}, HEAVY])
def test_all_forces_balance_under_a_tool(pressure: dict[str, Any], more: dict[str, Any]) -> None:
    scene = body(TOOL, pressure, {**pressure, "region": "y-min", "pressure_pa": -15.0}, **more)
    motion = given(scene, [0.1, 0.05, -0.12])
    (found,) = ObservedModel(scene).solve_many(motion.reshape(1, -1)[:, scene.free_dofs], TIGHT)
    assert isinstance(found, Solution)
    u = scene.at_all_dofs(found.displacement[None])[0].reshape(-1, 3)
    assert np.abs(u - motion)[scene.observed_nodes].max() < 1e-14
    tool = ToolForces(scene)(found.displacement[None])[0]
    held = reaction_forces(scene, u, tool)
    free = scene.at_free_dofs(held.reshape(1, -1))
    assert not free.any()
    model = FullOrderModel(scene)
    left = model.force(found.displacement).force - scene.at_free_dofs(tool.reshape(1, -1))[0]
    assert np.abs(left).max() < 1e-10 * np.abs(tool).sum()
    if not more:
        assert residual_beside(scene, u, tool) < 1e-10


@pytest.mark.parametrize("pressure", [SIDE, FOLLOWER])
@pytest.mark.parametrize("more", [{}, HEAVY])
def test_the_forces_of_a_contact_give_the_same_equilibrium(
    pressure: dict[str, Any], more: dict[str, Any]
) -> None:
    higher = {"sphere": {"radius_m": 0.4, "centre_m": [0.45, 0.55, 0.92]}}
    content = block(higher, **more).generated.model_dump()
    scene = load_scene({**content, "constant_pressures": [pressure]})
    motion = given(scene, [0.02, 0.0, -0.1])
    u = ContactModel(scene).solve(motion.ravel()[scene.free_dofs], options=TIGHT).displacement
    on_body = ToolForces(scene)(u[None])[0]
    assert on_body[:, 2].sum() < -0.1
    load = on_body.ravel()[scene.free_dofs]
    again = FullOrderModel(body(None, pressure, **more)).solve(load, options=TIGHT).displacement
    assert np.abs(again - u).max() < 1e-9 * np.abs(u).max()


def test_the_resultant_of_a_follower_is_that_of_the_deformed_facets() -> None:
    inside = {"region": {"box_m": [[1.0, 0.0, 0.2], [1.0, 1.0, 0.5]]}, "pressure_pa": 40.0}
    scene = body(TOOL, {**inside, "follower": True})
    motion = given(scene, [0.1, 0.05, -0.12])
    (found,) = ObservedModel(scene).solve_many(motion.reshape(1, -1)[:, scene.free_dofs], TIGHT)
    assert isinstance(found, Solution)
    u = scene.at_all_dofs(found.displacement[None])[0].reshape(-1, 3)
    tool = ToolForces(scene)(found.displacement[None])[0]
    held = reaction_forces(scene, u, tool).sum(axis=0)
    points = scene.mesh.points + u + rest_of(scene)
    pressed = -40.0 * area_vectors(points, scene.constant_pressures[0].facets).sum(axis=0)
    total = held + tool.sum(axis=0) + pressed
    assert np.abs(total).max() < 1e-10 * np.linalg.norm(tool.sum(axis=0))


def test_a_constant_follower_is_the_sampled_one_that_was_applied_first() -> None:
    sampled = {
        "kind": "pressure",
        "regions": ["x-max"],
        "magnitude_pa": [0.0, 60.0],
        "samples": 4,
        "follower": True,
    }
    whole = body(sampled)
    unit = whole.patch_weights.toarray().reshape(3, -1)
    load = -whole.at_free_dofs(unit.T.reshape(1, -1))[0]
    both = PressedModel(whole).solve(60.0 * load, options=TIGHT).displacement
    first = body(sampled, {**FOLLOWER, "pressure_pa": 35.0})
    rest = first.at_free_dofs(rest_of(first).reshape(1, -1))[0]
    then = PressedModel(first).solve(25.0 * load, options=TIGHT).displacement
    assert np.abs(rest + then - both).max() < 1e-9 * np.abs(both).max()


@pytest.mark.parametrize("kind", [kind for kind in ELEMENTS if not kind[1]])
def test_force_energy_and_tangent_are_derivatives(kind: tuple[str, bool]) -> None:
    closed = {"region": "surface", "pressure_pa": 30.0, "follower": True}
    scene = body(None, closed, FOLLOWER, discretisation=discretisation(kind))
    model = FullOrderModel(scene)
    generator = np.random.default_rng(0)
    size = 0.005 if "quadratic" in kind[0] else 0.02
    q, along = size * generator.normal(size=(2, model.n_unknowns))
    step = 1e-6
    after, before = (model.force(q + sign * step * along) for sign in (1, -1))
    values = model.linearise(q)[1]
    difference = (after.force - before.force) / (2 * step)
    skew = model.assembler.skew_tangent(q)
    assert skew is not None
    found = (model.assembler.pattern.symmetric(values) + skew) @ along
    np.testing.assert_allclose(found, difference, rtol=1e-5, atol=1e-5)
    assert np.abs(model.force(np.zeros(model.n_unknowns)).force).max() < 1e-12 * YOUNG_PA
    assert not model.linear_at_rest
    conservative = FullOrderModel(body(None, closed, discretisation=discretisation(kind)))
    after, before = (conservative.force(q + sign * step * along) for sign in (1, -1))
    slope = (after.energy_j - before.energy_j) / (2 * step)
    assert slope == pytest.approx(float(conservative.force(q).force @ along), rel=1e-6)


def test_a_tiny_load_feels_the_skew_part_of_the_tangent() -> None:
    scene = body(None, {**FOLLOWER, "pressure_pa": 80.0})
    model = FullOrderModel(scene)
    load = np.random.default_rng(0).normal(size=model.n_unknowns)
    for size in (1e-6, 5e-11):  # the smaller one is linear to all digits
        u = model.solve(size * load).displacement
        skew = model.assembler.skew_tangent(u)
        assert skew is not None
        tangent = model.assembler.pattern.symmetric(model.rest_tangent) + skew
        left = tangent @ u - size * load
        assert np.linalg.norm(left) < 1e-3 * np.linalg.norm(size * load)


@pytest.mark.parametrize("pressure", [SIDE, FOLLOWER])
def test_bodies_of_other_stiffness_have_their_own_rest_state(pressure: dict[str, Any]) -> None:
    ranges = {"young_pa": [300.0, 800.0], "poisson": [0.2, 0.4]}
    content = body(FORCES, pressure).generated.model_dump()
    scene = load_scene({**content, "parameters": ranges})
    load = scene.at_free_dofs(
        np.outer(scene.patch_weights.toarray()[3], [0.4, 0.2, -1.5]).reshape(1, -1)
    )
    values = np.array([[350.0, 0.25]])
    (found,) = generator_of(scene).solve_many(load, values)
    assert isinstance(found, Solution)
    alone = scene_at(scene, values[0])
    expected = FullOrderModel(alone).solve(load[0], options=TIGHT).displacement
    assert np.abs(found.displacement - expected).max() < 1e-6 * np.abs(expected).max()
    other = FullOrderModel(scene_at(scene, np.array([700.0, 0.25]))).solve(load[0]).displacement
    assert np.abs(found.displacement - other).max() > 0.1 * np.abs(other).max()


def test_a_refined_mesh_has_the_same_pressures() -> None:
    scene = body(None, SIDE, discretisation={"element": "tetrahedron"})
    finer = refined(scene)
    (old,), (new,) = scene.constant_pressures, finer.constant_pressures
    assert len(new.facets) == 4 * len(old.facets)
    forces = [held.dead_forces(s.mesh) for held, s in ((old, scene), (new, finer))]
    np.testing.assert_allclose(forces[0].sum(axis=0), [-20.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(forces[1].sum(axis=0), [-20.0, 0.0, 0.0], atol=1e-12)
    assert not mirrors(scene)
    assert pack(scene)


@pytest.mark.parametrize(
    ("pressures", "changed", "message"),
    [
        ([{**SIDE, "pressure_pa": 0.0}], {}, r"`constant_pressures\[0\]\.pressure_pa`"),
        (
            [SIDE, {**SIDE, "region": {"box_m": [[0.9, 0.4, 0.2], [1.1, 0.6, 0.3]]}}],
            {},
            r"`constant_pressures\[1\]\.region` holds no facet of the surface",
        ),
        ([SIDE], {"parameters": {"scale": {"x": [0.9, 1.1]}}}, "`constant_pressures` are given"),
        ([{**SIDE, "direction": [1, 0, 0]}], {}, r"`constant_pressures\[0\]\.direction`"),
    ],
)
def test_bad_pressures_are_refused(
    pressures: list[dict[str, Any]], changed: dict[str, Any], message: str
) -> None:
    content = body(FORCES).generated.model_dump()
    with pytest.raises(SpecError, match=message):
        load_scene({**content, "constant_pressures": pressures, **changed})


def test_a_follower_on_an_embedded_surface_is_refused_with_all_other_mistakes() -> None:
    liver = load_generated_spec("liver-hex").model_dump()
    nowhere = {"sphere_m": [[9.0, 9.0, 9.0], 1.0]}
    wrong = [{**FOLLOWER, "region": "surface"}, {**SIDE, "region": nowhere}]
    with pytest.raises(SpecError) as found:
        load_scene({**liver, "constant_pressures": wrong, "needs": {"outputs": nowhere}})
    for part in ("[0].follower` must be false", "[1].region", "needs.outputs"):
        assert part in str(found.value)
    dead = load_scene({**liver, "constant_pressures": [{**SIDE, "region": "surface"}]})
    forces = dead.constant_pressures[0].dead_forces(dead.mesh)
    assert np.abs(forces.sum(axis=0)).max() < 1e-3 * np.abs(forces).sum()


def test_files_without_constant_pressures_keep_their_digests() -> None:
    assert "constant_pressures" not in load_generated_spec("beam-tiny").physics()


def test_reduced_cells_refuse_followers() -> None:
    scene = body(None, FOLLOWER)
    with pytest.raises(UnsupportedSceneError, match="follow the surface"):
        discretisation_of(scene, np.arange(3))


@pytest.mark.slow
@pytest.mark.parametrize("pressure", [FOLLOWER, pytest.param(SIDE, marks=pytest.mark.nightly)])
def test_a_run_answers_or_says_why_not(
    pressure: dict[str, Any], tmp_path: Path, cache: Path
) -> None:
    table = {**body({**FORCES, "samples": 120}, pressure).generated.model_dump(), "name": "held"}
    methods = ["fem", "linear-fem", "pod[n_modes=30]", "hpod[n_modes=30]", "pca-regression-linear"]
    made = mor_bench.run([table], methods, out=tmp_path / "out", cache=cache)
    rows = {row.method: row for row in made.rows}
    reduced = {rows[name].status for name in ("pod", "hpod")}
    if pressure is FOLLOWER:
        assert reduced == {"skipped"}
        assert all("dead loads only" in str(rows[name].reason) for name in ("pod", "hpod"))
    else:
        assert reduced == {"ok"}
    for name in ("fem", "linear-fem", "pca-regression-linear"):
        error = rows[name].error
        assert error is not None
        assert error.rel_l2_median < 0.3
