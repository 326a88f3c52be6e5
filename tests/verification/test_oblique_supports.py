"""Oblique supports: rotated blocks, Lamé's tube, every solver, the methods, balance, refusals."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.errors import UnsupportedSceneError
from mor_bench.hard_cases.setups import material_table
from mor_bench.mechanics import model as model_module
from mor_bench.mechanics.model import FullOrderModel, rest_displacement
from mor_bench.mechanics.multigrid import MultigridFactor
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.observed import ObservedModel
from mor_bench.method_loading import load_method
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.imported_dataset import NodalLoads

from .oblique import ROTATION, SPEC, loads, solved, turned
from .scenes import reactions

Array = NDArray[np.float64]
SPRINGS = [{"region": "x-max", "stiffness_n_m3": 40.0}]


@pytest.mark.parametrize("solver", ["auto", "rotated-pcg", "jacobi-pcg", "cholesky", "superlu"])
@pytest.mark.parametrize("law", ["neo-hookean", "saint-venant-kirchhoff"])
def test_a_turned_block_on_oblique_planes_moves_like_the_block(law: str, solver: str) -> None:
    scene = load_scene({**SPEC, "material": material_table(law, 500.0, 0.4)})
    forces = loads(scene)
    expected = solved(scene, forces)
    assert np.abs(expected).max() > 0.1
    found = solved(turned(scene), forces @ ROTATION.T, solver)
    np.testing.assert_allclose(found @ ROTATION, expected, atol=1e-10)


@pytest.mark.parametrize("order", [1, 2])
def test_a_turned_block_of_tetrahedra_moves_like_the_block(order: int) -> None:
    elements = {"element": "tetrahedron", "order": order}
    scene = load_scene({**SPEC, "discretisation": elements})
    forces = loads(scene)
    found = solved(turned(scene), forces @ ROTATION.T)
    np.testing.assert_allclose(found @ ROTATION, solved(scene, forces), atol=1e-10)


@pytest.mark.parametrize("changed", [{"springs": SPRINGS}, {"gravity": True}])
def test_a_turned_block_with_springs_or_weight_moves_like_the_block(changed: Any) -> None:
    down, side = [0.3, -0.5, -1.0], ROTATION @ [0.3, -0.5, -1.0]
    weight = {"density_kg_m3": 20.0, "acceleration_m_s2": down}
    whole = {**SPEC, **({"gravity": weight} if "gravity" in changed else changed)}
    scene = load_scene(whole)
    other = turned(scene)
    if "gravity" in changed:
        turned_weight = load_scene(
            {**whole, "gravity": {**weight, "acceleration_m_s2": side.tolist()}}
        )
        other = turned(turned_weight)
        np.testing.assert_allclose(
            rest_displacement(other) @ ROTATION,
            rest_displacement(scene),  # type: ignore[arg-type]
            atol=1e-10,
        )
    forces = loads(scene, size=20.0)
    expected, found = solved(scene, forces), solved(other, forces @ ROTATION.T)
    np.testing.assert_allclose(found @ ROTATION, expected, atol=1e-10)


def test_multigrid_solves_on_oblique_planes(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene({**SPEC, "geometry": {**SPEC["geometry"], "cells": [10, 6, 6]}})
    forces = loads(scene)
    expected = solved(scene, forces)
    monkeypatch.setattr(model_module, "MAX_BAND_ENTRIES", 0)
    other = turned(scene)
    assert isinstance(FullOrderModel(other).rest_factor, MultigridFactor)
    found = solved(other, forces @ ROTATION.T, "rotated-pcg")
    np.testing.assert_allclose(found @ ROTATION, expected, atol=1e-10)


def test_the_work_does_not_depend_on_the_position() -> None:
    scene = load_scene(SPEC)
    forces, n = loads(scene), []
    for body, given in ((scene, forces), (turned(scene), forces @ ROTATION.T)):
        values = body.at_free_dofs(given.reshape(1, -1))[0]
        n.append(FullOrderModel(body).solve(values).iterations)
    assert n[0] == n[1]


def test_the_tangent_is_the_derivative_of_the_force() -> None:
    scene = turned(load_scene({**SPEC, "springs": SPRINGS}))
    model, rng = FullOrderModel(scene), np.random.default_rng(0)
    q, step = 0.05 * rng.normal(size=(2, model.n_unknowns))
    tangent = model.assembler.pattern.symmetric(model.linearise(q)[1])
    h = 1e-5
    slope = (model.force(q + h * step).force - model.force(q - h * step).force) / (2 * h)
    np.testing.assert_allclose(tangent @ step, slope, atol=1e-7 * np.abs(slope).max())
    energy = (model.force(q + h * step).energy_j - model.force(q - h * step).energy_j) / (2 * h)
    assert energy == pytest.approx(float(model.force(q).force @ step), rel=1e-7)


def test_forces_of_cells_add_up_to_the_force() -> None:
    scene = turned(load_scene(SPEC))
    model = FullOrderModel(scene)
    q = 0.05 * np.random.default_rng(2).normal(size=model.n_unknowns)
    own = model.assembler.cell_forces(q)
    total = np.bincount(model.cell_dofs.ravel(), own.ravel(), model.n_unknowns + 1)[:-1]
    np.testing.assert_allclose(total, model.force(q).force, atol=1e-12)


def tube(angle: float, n: int, follower: bool) -> Scene:
    """Return a sector of a tube between planes of symmetry under an inner pressure."""
    across = [-sin(angle), cos(angle), 0.0]
    end = {"region": {"plane_m": [[0.0, 0.0, 0.0], across]}, "direction": across}
    return load_scene(
        {
            "name": "sector",
            "title": "Sector of a tube",
            "geometry": {
                "shape": "tube",
                "radii_m": [1.0, 1.5],
                "length_m": 0.2,
                "cells": [6, n, 1],
                "angle_deg": angle * 180.0 / pi,
            },
            "material": material_table("neo-hookean", 1000.0, 0.3),
            "supports": [
                {"region": "y-min", "components": ["y"]},
                {"region": "surface", "components": ["z"]},
                end,
            ],
            "loads": {
                "kind": "pressure",
                "regions": [{"point_set": "inner"}],
                "magnitude_pa": [0.0, 200.0],
                "samples": 5,
                "follower": follower,
            },
            "split": {"by": "sample"},
        }
    )


@pytest.mark.parametrize("follower", [False, True])
def test_a_sector_of_a_tube_widens_like_a_quarter(follower: bool) -> None:
    widened = []
    for angle, n in ((pi / 3, 8), (pi / 2, 12)):  # the same cells
        scene = tube(angle, n, follower)
        assert (scene.frames is not None) == (angle < pi / 2)
        areas = scene.patch_weights.toarray()  # components of the area vectors
        u = solved(scene, -150.0 * areas.T[None])[0]
        radius = np.linalg.norm(scene.mesh.points[:, :2], axis=1)
        radial = np.einsum("ni,ni->n", u[:, :2], scene.mesh.points[:, :2]) / radius
        across = scene.mesh.points[:, :2] @ [-sin(angle), cos(angle)]
        end = np.abs(across) < 1e-9
        assert np.abs(u[end, :2] @ [-sin(angle), cos(angle)]).max() <= 1e-15
        order = np.lexsort((np.round(radius, 9), np.round(scene.mesh.points[:, 2], 9)))
        inner = order[radius[order] < 1.0 + 1e-9]
        assert np.ptp(radial[inner]) <= 1e-10
        widened.append(radial[inner][0])
    assert widened[0] == pytest.approx(widened[1], abs=1e-10)
    assert widened[0] > 0.2


def test_a_sector_converges_to_lame() -> None:
    # Plane strain: u = (1 + ν) p a² / (E (b² - a²)) [(1 - 2ν) r + b² / r], at a small pressure.
    young, poisson, a, b, pressure, errors = 1000.0, 0.3, 1.0, 1.5, 1e-4, []
    scale = (1 + poisson) * pressure * a**2 / (young * (b**2 - a**2))
    exact = scale * ((1 - 2 * poisson) * a + b**2 / a)
    for n in (1, 2, 4):
        scene = tube(pi / 3, 4 * n, follower=False)
        spec = scene.generated.model_dump(mode="json")
        spec["geometry"]["cells"] = [3 * n, 4 * n, 1]
        scene = load_scene(spec)
        u = solved(scene, -pressure * scene.patch_weights.toarray().T[None])[0]
        inner = np.abs(np.linalg.norm(scene.mesh.points[:, :2], axis=1) - a) < 1e-9
        errors.append(abs(np.linalg.norm(u[inner][:, :2], axis=1).mean() / exact - 1.0))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 2e-3
    np.testing.assert_allclose(orders, 2.0, atol=0.15)


def test_reactions_act_along_the_direction_and_balance_the_load() -> None:
    scene = turned(load_scene(SPEC))
    forces = loads(scene)
    u = solved(scene, forces)[0]
    held, size = reactions(scene, forces[0], u), float(np.linalg.norm(forces))
    assert np.abs(scene.at_free_dofs(held.reshape(1, -1))).max() <= 1e-10 * size
    np.testing.assert_allclose((held + forces[0]).sum(axis=0), 0.0, atol=1e-10 * size)
    moment = np.cross(scene.mesh.points + u, held + forces[0]).sum(axis=0)
    np.testing.assert_allclose(moment, 0.0, atol=2e-10 * size)


def test_observed_displacements_reproduce_a_solution_on_oblique_planes() -> None:
    scene = load_scene({**SPEC, "observed": {"region": "x-max"}})
    other = turned(scene)
    plain = turned(load_scene(SPEC))
    forces = loads(plain)
    exact = solved(plain, forces)
    values = other.at_free_dofs(exact.reshape(1, -1))
    hidden = np.ones(other.mesh.n_nodes, dtype=bool)
    assert other.observed_nodes is not None
    hidden[other.observed_nodes] = False
    given = exact.copy()
    given[:, hidden] = 0.0
    model = ObservedModel(other)
    found = model.solve_many(other.at_free_dofs(given.reshape(1, -1)), NewtonOptions(1e-11))[0]
    np.testing.assert_allclose(found.displacement, values[0], atol=1e-9)  # type: ignore[union-attr]
    axes = np.random.default_rng(1).normal(size=(len(other.free_dofs), 2))
    z = model.to_coordinates(axes).T @ given.ravel()
    np.testing.assert_allclose(
        z, axes.T @ other.at_free_dofs(model.respond(given.reshape(1, -1)))[0], atol=1e-10
    )


METHODS: dict[str, tuple[dict[str, Any], float]] = {
    "fem": ({"tolerance": 1e-12}, 1e-10),
    "fem-warm": ({"tolerance": 1e-12}, 1e-10),
    "linear-fem": ({}, 1e-10),
    "pod": ({"n_modes": 12, "tolerance": 1e-12}, 1e-8),
    "pod-tensor": ({"n_modes": 12, "tolerance": 1e-12}, 1e-8),
    "sparse-polynomial": ({}, 1e-5),
    "hpod": ({"n_modes": 6, "cubature_tolerance": 0.0, "tolerance": 1e-12}, 1e-8),
    "hpod, corrected": (
        {"n_modes": 6, "cubature_tolerance": 0.0, "tolerance": 1e-12, "static_correction": True},
        1e-8,
    ),
    "ecm": ({"n_modes": 6, "cubature_tolerance": 1e-6, "tolerance": 1e-12}, 1e-3),
    "deim": ({"n_modes": 6, "n_force_modes": 10, "tolerance": 1e-12}, 5e-2),
    "deim, cells": ({"n_modes": 6, "n_force_modes": 10, "sampling": "cells"}, 5e-2),
    "local-pod": ({}, 1e-5),
    "modal-derivatives": ({}, 1e-3),
    "quadratic-manifold": ({"cubature_tolerance": 0.0}, 1e-3),
    "pca-regression-linear": ({}, 1e-7),
    "pca-regression": ({}, 1e-7),
    "pgd-weak-form": ({"n_terms": 20}, 5e-2),
    "pgd-snapshots": ({"n_terms": 10}, 1e-8),  # later terms fit round-off of the samples
    "hybrid": ({"start": "linear-fem", "start_parameters": {}, "tolerance": 1e-12}, 1e-10),
}


def samples_of(scene: Scene, forces: Array) -> Snapshots:
    free = scene.at_free_dofs(solved(scene, forces).reshape(len(forces), -1))
    loads = NodalLoads(forces, np.arange(len(forces))[:, None])
    return Snapshots(scene, loads, free, np.ones(len(forces)))


@pytest.mark.parametrize("name", METHODS)
def test_methods_predict_for_a_turned_block_what_they_predict_for_the_block(name: str) -> None:
    law = {"material": material_table("saint-venant-kirchhoff", 500.0, 0.4)}
    scene = load_scene({**SPEC, **law})
    parameters, tolerance = METHODS[name]
    forces, other = loads(scene, 30, 10.0), turned(scene)
    answers = []
    for body, given in ((scene, forces), (other, forces @ ROTATION.T)):
        method = load_method(name.partition(",")[0], **parameters).fit(
            body, samples_of(body, given[:25])
        )
        answers.append(method.predict(given[25:]))
    size = float(np.abs(answers[0]).max())
    np.testing.assert_allclose(answers[1] @ ROTATION, answers[0], atol=tolerance * size)
    assert other.frames is not None
    local = other.frames.to_local(answers[1].reshape(5, -1))
    assert np.abs(local[:, other.frames.held_dofs]).max() <= 1e-14 * size


@pytest.mark.parametrize("name", ["pod-tensor", "pod", "hpod"])
def test_methods_know_springs_and_weight_on_oblique_planes(name: str) -> None:
    law = material_table("saint-venant-kirchhoff", 500.0, 0.4)
    down = np.array([0.3, -0.5, -1.0])
    bodies = []
    for direction in (down, ROTATION @ down):
        weight = {"density_kg_m3": 10.0, "acceleration_m_s2": direction.tolist()}
        bodies.append(load_scene({**SPEC, "material": law, "springs": SPRINGS, "gravity": weight}))
    scene, other = bodies[0], turned(bodies[1])
    forces, answers = loads(scene, 12, 10.0), []
    for body, given in ((scene, forces), (other, forces @ ROTATION.T)):
        method = load_method(name, **METHODS[name][0]).fit(body, samples_of(body, given[:9]))
        answers.append(method.predict(given[9:]))
    size = float(np.abs(answers[0]).max())
    np.testing.assert_allclose(answers[1] @ ROTATION, answers[0], atol=1e-7 * size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("umesh-linear", {"channels": 8, "steps": 1, "iterations": 3}),
        ("deeponet", {"iterations": 3}),
    ],
)
def test_networks_predict_no_displacement_along_a_direction(
    name: str, parameters: dict[str, Any]
) -> None:
    slope = {"region": "x-min", "direction": [1.0, 0.5, 0.0]}
    others = [{"region": f"{axis}-min", "components": [axis]} for axis in "yz"]
    scene = load_scene({**SPEC, "supports": [slope, *others]})
    forces = loads(scene, 12, 10.0)
    method = load_method(name.partition(",")[0], **parameters).fit(
        scene, samples_of(scene, forces[:10])
    )
    found = method.predict(forces[10:])
    edge = scene.mesh.points[:, 0] == 0.0
    assert np.abs(found[:, ~edge]).max() > 0.0
    along = found[:, edge] @ [1.0, 0.5, 0.0]
    assert np.abs(along).max() <= 1e-14 * np.abs(found).max()


def test_what_supports_hold_is_removed_from_predictions() -> None:
    scene = turned(load_scene(SPEC))
    fields = np.random.default_rng(5).normal(size=(3, scene.mesh.n_dofs))
    kept = fields.copy()
    scene.hold(kept)
    expected = scene.at_all_dofs(scene.at_free_dofs(fields))
    np.testing.assert_allclose(kept, expected, atol=1e-15)
    assert np.abs(kept - fields).max() > 0.1


def test_explicit_dynamics_says_that_it_has_no_oblique_supports() -> None:
    with pytest.raises(UnsupportedSceneError, match="some supports are oblique"):
        load_method("explicit-dynamics").fit(turned(load_scene(SPEC)))
