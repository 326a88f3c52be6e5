"""Winkler foundations: closed forms, balance, reduced models, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

import mor_bench
from mor_bench.errors import SpecError, UnconstrainedBodyError
from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.relaxation import DynamicRelaxation
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.tensors import TensorProblem
from mor_bench.scene.loads import Facets
from mor_bench.scene.mesh import Mesh
from mor_bench.scene.other_meshes import refined
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.scene.springs import foundations
from mor_bench.scene.symmetry import mirrors
from mor_bench.specs import load_generated_spec
from mor_bench.surrogates.hyper_reduced import nodal, reduced_points

from .laws_and_elements import ELEMENTS, discretisation
from .scenes import patch_load, reactions
from .test_pressure import forces_of, tube

Array = NDArray[np.float64]
BED = {"region": "z-min", "stiffness_n_m3": 200.0}


def block(young_pa: float, **changed: Any) -> Scene:
    """Return a block of 2 x 1 x 1 m without supports on springs."""
    return load_scene(
        {
            "name": "block",
            "title": "Block on springs",
            "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [4, 2, 2]},
            "material": material_table("saint-venant-kirchhoff", young_pa, 0.0),
            "springs": [BED],
            **changed,
        }
    )


def on_top(scene: Scene, traction_pa: float) -> Array:
    """Return the forces (n_nodes, 3), N, of a traction that pulls at the top face."""
    top = scene.surface.within(np.flatnonzero(scene.mesh.points[:, 2] == 1.0))
    forces = np.zeros((scene.mesh.n_nodes, 3))
    top = top[:, -3:] if top.shape[1] == 6 else top  # only the middles of six nodes carry
    np.add.at(forces[:, 2], top, traction_pa * 2.0 / top.size)
    return forces


def solved(scene: Scene, forces: Array, solver: Any = None) -> Array:
    u = np.zeros(scene.mesh.n_dofs)
    found = FullOrderModel(scene, solver).solve(
        forces.ravel()[scene.free_dofs], options=NewtonOptions(1e-12)
    )
    u[scene.free_dofs] = found.displacement
    return u.reshape(-1, 3)


@pytest.mark.parametrize("kind", ELEMENTS)
def test_a_block_is_pulled_off_its_springs_and_stretched(kind: tuple[str, bool]) -> None:
    scene = block(500.0, discretisation=discretisation(kind))
    # A pressure of this size would tilt the block, because its springs are too soft.
    u = solved(scene, on_top(scene, 30.0))
    stretch = brentq(lambda a: 250.0 * (a**3 - a) - 30.0, 1.0, 1.2, xtol=1e-15)
    expected = 30.0 / 200.0 + (stretch - 1.0) * scene.mesh.points[:, 2]
    np.testing.assert_allclose(u[:, 2], expected, atol=1e-10)
    np.testing.assert_allclose(u[:, :2], 0.0, atol=1e-10)


def test_a_rigid_block_tilts_on_springs_as_a_foundation_does() -> None:
    scene = block(1e9)
    corners = np.flatnonzero((scene.mesh.points[:, [0, 2]] == [2.0, 1.0]).all(axis=1))
    forces = np.zeros((scene.mesh.n_nodes, 3))
    forces[corners, 2] = -1e-4 / len(corners)
    u, x = solved(scene, forces), scene.mesh.points[:, 0] - 1.0
    area, inertia = 2.0, 2.0**3 / 12.0
    expected = -1e-4 / (200.0 * area) - 1e-4 * x / (200.0 * inertia)
    np.testing.assert_allclose(u[:, 2], expected, atol=1e-5 * np.abs(expected).max())


def test_springs_along_one_axis_resist_that_axis_alone() -> None:
    with pytest.raises(UnconstrainedBodyError) as raised:
        FullOrderModel(block(500.0, springs=[{**BED, "components": ["z"]}]))
    motions = ("rotation about z", "translation x", "translation y")
    assert tuple(sorted(raised.value.free_motions)) == motions
    FullOrderModel(block(500.0))


def test_springs_along_the_normal_of_a_plane_are_those_along_its_axis() -> None:
    normal, axis = (
        block(500.0, springs=[{**BED, **direction}]).spring_matrix
        for direction in ({"normal": True}, {"components": ["z"]})
    )
    assert normal is not None
    assert axis is not None
    np.testing.assert_allclose(normal.toarray(), axis.toarray(), atol=1e-12 * axis.max())


@pytest.mark.parametrize("normal", [False, True])
def test_a_pressed_tube_in_a_bed_converges_to_the_solution_of_lame(normal: bool) -> None:
    pressure, young, poisson, inner, outer, bed = 1.0, 1e5, 0.3, 1.0, 2.0, 5e4
    # u = (1 + ν) / E ((1 - 2ν) A r + B / r), the radial stress is A - B / r².
    factors = np.array([(1 - 2 * poisson) * outer, 1 / outer]) * bed * (1 + poisson) / young
    rows = [[1.0, -1 / inner**2], [1.0 + factors[0], factors[1] - 1 / outer**2]]
    a, b = np.linalg.solve(rows, [-pressure, 0.0])
    errors = []
    for n in (4, 8):
        spring = {"region": {"point_set": "outer"}, "stiffness_n_m3": bed, "normal": normal}
        scene = load_scene({**tube(n, young).spec.model_dump(mode="json"), "springs": [spring]})
        u = solved(scene, forces_of(scene, pressure))
        radius = np.linalg.norm(scene.mesh.points[:, :2], axis=1)
        exact = (1 + poisson) / young * ((1 - 2 * poisson) * a * radius + b / radius)
        radial = np.sum(u[:, :2] * scene.mesh.points[:, :2], axis=1) / radius
        errors.append(np.linalg.norm(radial - exact) / np.linalg.norm(exact))
    assert errors[-1] < 5e-3
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


def test_a_tube_turns_almost_freely_in_springs_along_its_normals() -> None:
    ratios = []  # only facets that do not follow the circle resist the turn
    for n in (4, 8):
        works = []
        for normal in (True, False):
            spring = {"region": {"point_set": "outer"}, "stiffness_n_m3": 1.0, "normal": normal}
            content = tube(n, 1e3, 360.0).spec.model_dump(mode="json")
            scene = load_scene({**content, "springs": [spring]})
            x, y = scene.mesh.points[:, :2].T
            turn = np.stack([-y, x, 0.0 * x], axis=1).ravel()
            assert scene.spring_matrix is not None
            works.append(float(turn @ (scene.spring_matrix @ turn)))
        ratios.append(works[0] / works[1])
        assert {mirror.axis for mirror in mirrors(scene)} == {0, 1, 2}
    assert ratios[0] < 0.01
    assert np.log2(ratios[0] / ratios[1]) == pytest.approx(2.0, abs=0.2)


def bedded(**changed: Any) -> Scene:
    """Return beam-tiny on springs below, held at its end."""
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    return load_scene({**spec, "springs": [BED], **changed})


def test_supports_and_springs_balance_the_load() -> None:
    scene = bedded()
    forces = scene.patch_weights.toarray()[9][:, None] * np.array([0.5, 0.5, -2.0])
    u = solved(scene, forces)
    held = reactions(scene, forces, u)
    bed = scene.surface.within(np.flatnonzero(scene.mesh.points[:, 2] == 0.0))
    area = 2.0 / len(bed)
    springs = -200.0 * area * u[bed].mean(axis=1).sum(axis=0)
    size = float(np.linalg.norm(forces))
    fixed = held[scene.fixed_nodes]
    assert np.abs(springs).max() > 0.1 * size
    assert scene.spring_matrix is not None
    own = -(scene.spring_matrix @ u.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(own.sum(axis=0), springs, atol=1e-10 * size)
    np.testing.assert_allclose(np.delete(held, scene.fixed_nodes, axis=0), 0.0, atol=1e-10 * size)
    rest = forces.sum(axis=0) + springs + fixed.sum(axis=0)
    np.testing.assert_allclose(rest, 0.0, atol=1e-10 * size)


@pytest.mark.parametrize("gravity", [None, {"density_kg_m3": 2.0}])
def test_solvers_and_reduced_models_agree_on_springs(gravity: Any) -> None:
    scene, generator = bedded(gravity=gravity), np.random.default_rng(2)
    model = FullOrderModel(scene)
    load = patch_load(scene, 9, [0.5, 0.5, -2.0])
    expected = model.solve(load, options=NewtonOptions(1e-11)).displacement
    size = np.abs(expected).max()
    for solver in ("rotated-pcg", "jacobi-pcg", "cholesky"):
        other = FullOrderModel(scene, solver).solve(load, options=NewtonOptions(1e-11))
        np.testing.assert_allclose(other.displacement, expected, atol=1e-9 * size)
    relaxed = DynamicRelaxation(model).solve(load, 1e-10, 100_000).displacement
    np.testing.assert_allclose(relaxed, expected, atol=1e-7 * size)
    modes = np.linalg.qr(generator.normal(size=(model.n_unknowns, 6)))[0]
    q = 0.2 * generator.normal(size=6)
    state, tangent = GalerkinProblem(model.assembler, modes).linearise(q)
    cells = np.arange(scene.mesh.n_cells)
    points = reduced_points(scene, cells, np.ones(len(cells)), nodal(scene, modes))
    tensors = TensorProblem.of_modes(model, modes, q[None])
    for found, derivative in (points.force_and_tangent(q), tensors.linearise(q)):
        np.testing.assert_allclose(found.force, state.force, atol=1e-10 * np.abs(state.force).max())
        np.testing.assert_allclose(derivative, tangent, atol=1e-10 * np.abs(tangent).max())


def test_force_and_tangent_of_springs_are_derivatives_of_the_energy() -> None:
    model, generator = FullOrderModel(bedded()), np.random.default_rng(4)
    q, step = 0.05 * generator.normal(size=(2, model.n_unknowns))
    up, down = model.force(q + 1e-4 * step), model.force(q - 1e-4 * step)
    state, values = model.linearise(q)
    rise = (up.energy_j - down.energy_j) / 2e-4
    assert rise == pytest.approx(float(state.force @ step), rel=1e-6)
    product = model.assembler.pattern.symmetric(values) @ step
    change = (up.force - down.force) / 2e-4
    np.testing.assert_allclose(change, product, atol=1e-6 * np.abs(product).max())


def test_springs_have_the_area_of_their_surface_on_any_mesh() -> None:
    liver = {"shape": "voxels", "surface": "liver", "cells": [8, 8, 8]}
    for scene in (
        block(500.0),
        block(500.0, geometry=liver, springs=[{**BED, "region": "surface"}]),
    ):
        (springs,) = scene.springs
        if scene.embedded_surface:
            points, triangles = scene.surface.points, scene.surface.facets
            a, b, c = np.moveaxis(points[triangles], 1, 0)
            area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
        else:
            area = 2.0
            graph = Mesh(scene.mesh.points, scene.mesh.cells)
            assert springs.matrix(graph).sum() == pytest.approx(3 * 200.0 * area, rel=1e-12)
        assert scene.spring_matrix is not None
        assert scene.spring_matrix.sum() == pytest.approx(3 * 200.0 * area, rel=1e-10)
        load = np.ones(3 * scene.mesh.n_nodes)
        force = FullOrderModel(scene).force(1e-9 * load[scene.free_dofs]).force
        assert force.sum() == pytest.approx(3e-9 * 200.0 * area, rel=1e-4)


@pytest.mark.parametrize("name", ["artery-pressure", "liver-pressed"])
def test_springs_lie_on_the_surface_of_divided_cells(name: str) -> None:
    """They are those of a foundation on it; on an embedded surface they stay."""
    scene = load_scene(name)
    finer = refined(refined(scene))
    assert scene.spring_matrix is not None
    assert finer.spring_matrix is not None
    own = Facets(finer.mesh.points, finer.mesh.boundary_facets)
    surface = finer.embedded_surface or own
    (wanted,) = foundations(finer.generated, surface, finer.point_sets)
    found, expected = finer.spring_matrix, wanted.matrix(finer.mesh)
    assert abs(found - expected).max() <= 1e-12 * abs(expected).max()
    assert found.sum() == pytest.approx(scene.spring_matrix.sum(), rel=1e-10)


@pytest.mark.parametrize(
    ("spring", "message"),
    [
        ({"region": "z-min"}, r"key `springs\[0\].stiffness_n_m3` is missing"),
        ({**BED, "stiffness_n_m3": 0.0}, r"`springs\[0\].stiffness_n_m3` must be greater than 0"),
        ({**BED, "components": []}, "one to three different components"),
        ({**BED, "components": ["z"], "normal": True}, "exclude each other"),
        ({**BED, "region": {"nearest_m": [[0.0, 0.0, 0.0], 1]}}, "holds no facet of the surface"),
    ],
)
def test_wrong_springs_are_refused(spring: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        block(500.0, springs=[spring])


def test_springs_belong_to_the_digest() -> None:
    digest = mor_bench.load_scene("beam-tiny").spec.digest()
    assert bedded().spec.digest() != digest
    assert bedded(springs=[]).spec.digest() == digest
