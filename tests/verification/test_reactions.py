"""Forces of the supports: balance of forces and moments, closed forms, and refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import InvalidInputError, UnsupportedSceneError
from mor_bench.mechanics.discretisation import body_force, discretisation_of
from mor_bench.mechanics.model import rest_displacement
from mor_bench.mechanics.reactions import Reactions
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.given import ObservedDisplacements

from .oblique import SPEC, loads, solved, turned
from .test_pressure import LOADS, pressed

Array = NDArray[np.float64]


def balance(scene: Scene, u: Array, acting: Array) -> None:
    """Check that the reactions and all other forces have no resultant and no moment."""
    size = float(np.abs(acting).sum())
    place = scene.mesh.points + u
    np.testing.assert_allclose(acting.sum(axis=0), 0.0, atol=1e-10 * size)
    extent = float(np.ptp(scene.mesh.points, axis=0).max())
    moment = np.cross(place, acting).sum(axis=0)
    np.testing.assert_allclose(moment, 0.0, atol=1e-10 * size * extent)


@pytest.mark.parametrize("body", ["beam-tiny", "rollers", "oblique"])
def test_reactions_balance_the_forces(body: str) -> None:
    scene = mor_bench.load_scene("beam-tiny") if body == "beam-tiny" else load_scene(SPEC)
    forces = loads(scene, 2, 3.0)
    if body == "oblique":
        scene = turned(scene)
    u = solved(scene, forces)
    held = mor_bench.reaction_forces(scene, u, forces)
    assert np.abs(scene.at_free_dofs(held.reshape(2, -1))).max() <= 1e-15 * np.abs(held).max()
    for row in range(2):
        balance(scene, u[row], held[row] + forces[row])
    np.testing.assert_array_equal(mor_bench.reaction_forces(scene, u[0], forces[0]), held[0])


def test_reactions_carry_the_weight_and_what_springs_do_not() -> None:
    weight = {"density_kg_m3": 20.0, "acceleration_m_s2": [0.3, -0.5, -1.0]}
    springs = [{"region": "x-max", "stiffness_n_m3": 40.0}]
    scene = load_scene({**SPEC, "gravity": weight, "springs": springs})
    forces = loads(scene, 1, 10.0)
    u, rest = solved(scene, forces), rest_displacement(scene)
    assert rest is not None
    assert scene.spring_matrix is not None
    own = body_force(discretisation_of(scene), 20.0 * np.array([0.3, -0.5, -1.0]))
    pull = -(scene.spring_matrix @ (u[0] + rest).ravel()).reshape(-1, 3)
    held = mor_bench.reaction_forces(scene, u, forces)[0]
    balance(scene, u[0] + rest, held + forces[0] + own + pull)
    at_rest = mor_bench.reaction_forces(scene, 0.0 * u, 0.0 * forces)[0]
    total = (at_rest + own - (scene.spring_matrix @ rest.ravel()).reshape(-1, 3)).sum(axis=0)
    np.testing.assert_allclose(total, 0.0, atol=1e-10 * np.abs(own).sum())


@pytest.mark.parametrize("follower", [False, True])
def test_reactions_balance_a_pressure_on_the_surface_on_which_it_acts(follower: bool) -> None:
    scene = pressed(
        loads={**LOADS, "regions": ["z-max"], "follower": follower},
        supports=[{"region": "x-min"}],
    )
    areas = scene.patch_weights.toarray()
    forces = -10.0 * areas.T[None]
    u = solved(scene, forces)
    held = mor_bench.reaction_forces(scene, u, forces)[0]
    total = forces[0].sum(axis=0)
    if follower:
        facets = scene.pressed_facets[0]
        corners = (scene.mesh.points + u[0])[facets]
        # The vector area of a quadrilateral is half the cross product of its diagonals.
        diagonals = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
        total = -10.0 * 0.5 * np.cross(*diagonals).sum(axis=0)
        assert np.abs(total - forces[0].sum(axis=0)).max() > 0.5
    np.testing.assert_allclose(held.sum(axis=0), -total, atol=1e-9 * np.abs(total).max())


def test_reactions_are_those_of_each_body() -> None:
    """Young's modulus and the height vary, and each body balances its own load."""
    varied = {"young_pa": [300.0, 800.0], "scale": {"z": [0.8, 1.2]}}
    scene = load_scene({**SPEC, "parameters": varied})
    forces, values = loads(scene, 3, 3.0), np.array([[800.0, 1.1], [300.0, 0.9], [800.0, 1.1]])
    u = mor_bench.load_method("fem", tolerance=1e-12).fit(scene).predict(forces, values)
    held = mor_bench.reaction_forces(scene, u, forces, values)
    size = np.abs(forces).sum()
    np.testing.assert_allclose((held + forces).sum(axis=1), 0.0, atol=1e-9 * size)
    single = mor_bench.reaction_forces(scene, u[1], forces[1], values[1])
    np.testing.assert_array_equal(single, held[1])
    with pytest.raises(InvalidInputError, match="`parameters` must be of shape"):
        mor_bench.reaction_forces(scene, u, forces)
    with pytest.raises(UnsupportedSceneError, match="each sample has its own body"):
        Reactions(scene)
    with pytest.raises(InvalidInputError, match="`parameters` must be left out; got shape"):
        mor_bench.reaction_forces(load_scene(SPEC), u, forces, values)


@pytest.mark.parametrize("varied", [False, True])
def test_the_forces_of_a_tool_and_of_the_supports_have_no_resultant(varied: bool) -> None:
    tool = {"kind": "displacement", "region": "x-max", "magnitude_m": [0.0, 0.3], "samples": 4}
    table: dict[str, Any] = {"parameters": {"young_pa": [300.0, 800.0]}} if varied else {}
    table |= {"supports": [{"region": "x-min"}], "split": {"by": "sample"}}
    scene = load_scene({**SPEC, "loads": tool, **table})
    assert scene.observed_nodes is not None
    moved = np.zeros((2, scene.mesh.n_nodes, 3))
    moved[:, scene.observed_nodes] = [[[0.1, 0.05, -0.2]], [[0.0, 0.0, 0.3]]]
    values = (np.array([[300.0], [800.0]]),) if varied else ()
    fem = mor_bench.load_method("fem", tolerance=1e-12).fit(scene)
    u = fem.predict(ObservedDisplacements(moved, scene.observed_nodes), *values)
    acting = mor_bench.tool_forces(scene, u, *values)
    held = mor_bench.reaction_forces(scene, u, acting, *values)
    size = np.abs(acting).sum()
    np.testing.assert_allclose((acting + held).sum(axis=1), 0.0, atol=1e-9 * size)
    assert (np.einsum("nac,nac->n", acting, moved) > 0).all(), "the tool does work on the body"
    single = mor_bench.tool_forces(scene, u[1], *(row[1] for row in values))
    np.testing.assert_array_equal(single, acting[1])


def test_wrong_input_of_the_forces_of_a_tool_is_refused() -> None:
    scene = mor_bench.load_scene("beam-tiny")
    with pytest.raises(UnsupportedSceneError, match="no tool moves the body"):
        mor_bench.tool_forces(scene, np.zeros((63, 3)))
    with pytest.raises(InvalidInputError, match=r"displacements must have shape \(63, 3\)"):
        mor_bench.tool_forces(scene, np.zeros((62, 3)))


def test_a_wrong_shape_is_refused() -> None:
    scene: Any = mor_bench.load_scene("beam-tiny")
    good = np.zeros((scene.mesh.n_nodes, 3))
    with pytest.raises(InvalidInputError, match="must have the same shape"):
        mor_bench.reaction_forces(scene, good, good[:-1])
    with pytest.raises(InvalidInputError, match=r"must have shape \(n, 63, 3\)"):
        Reactions(scene)(good[None, :-1], good[None, :-1])
