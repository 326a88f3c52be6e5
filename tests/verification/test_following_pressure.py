"""Pressures that follow the surface: derivatives, closed forms, balance, and refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.optimize import brentq

import mor_bench
from mor_bench.errors import InvalidInputError, SpecError, UnsupportedSceneError
from mor_bench.hard_cases.setups import material_table
from mor_bench.measure.discretisation_error import RefinementPlan, refine
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.newton import NewtonOptions
from mor_bench.mechanics.pressed import PressedModel
from mor_bench.scene.scene import Scene, load_scene

from .laws_and_elements import ELEMENTS, discretisation
from .scenes import reactions
from .test_pressure import LOADS, PLANES, TUBE, YOUNG_PA, content, forces_of, pressed

Array = NDArray[np.float64]

FOLLOWING: dict[str, Any] = {**LOADS, "follower": True}
TIGHT = NewtonOptions(1e-12)
CLAMPED = [{"region": "x-min"}]


def solved(scene: Scene, *pressures: float) -> Array:
    """Return the equilibrium (n_nodes, 3), m, under pressures on the regions, Pa."""
    u, free = np.zeros(scene.mesh.n_dofs), scene.free_dofs
    load = forces_of(scene, *pressures).ravel()[free]
    u[free] = PressedModel(scene).solve(load, options=TIGHT).displacement
    return u.reshape(-1, 3)


def area_vectors(points: Array, facets: NDArray[np.int64]) -> Array:
    """Return the area vector (n_facets, 3), m², of facets that may be warped."""
    corners = points[facets]
    if facets.shape[1] != 4:
        return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])


@pytest.mark.parametrize("kind", [kind for kind in ELEMENTS if not kind[1]])
@pytest.mark.parametrize("whole", [True, False])
def test_force_energy_and_tangent_are_derivatives(kind: tuple[str, bool], whole: bool) -> None:
    scene = pressed(
        discretisation=discretisation(kind),
        supports=CLAMPED,
        loads={**FOLLOWING, "regions": ["surface" if whole else "z-max"]},
    )
    model = PressedModel(scene).under(np.array([30.0]))
    generator = np.random.default_rng(0)
    size = 0.01 if "quadratic" in kind[0] else 0.05
    q, along = size * generator.normal(size=(2, model.n_unknowns))
    step = 1e-6
    after, before = (model.force(q + sign * step * along) for sign in (1, -1))
    state, values = model.linearise(q)
    np.testing.assert_array_equal(state.force, model.force(q).force)
    tangent = model.assembler.pattern.symmetric(values)
    difference = (after.force - before.force) / (2 * step)
    if whole:  # a closed surface has a potential
        slope = (after.energy_j - before.energy_j) / (2 * step)
        assert slope == pytest.approx(float(state.force @ along), rel=1e-7)
        np.testing.assert_allclose(tangent @ along, difference, rtol=1e-6, atol=1e-6)
        assert model.whole_tangent(q, values) is None
    else:
        slope = float(along @ difference)
        assert float(along @ (tangent @ along)) == pytest.approx(slope, rel=1e-6)
        found = model.whole_tangent(q, values)
        assert found is not None
        np.testing.assert_allclose(found @ along, difference, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("pressure", [30.0, 150.0, -60.0])
@pytest.mark.parametrize("kind", ELEMENTS)
def test_a_cube_under_pressure_on_all_sides_has_its_closed_form(
    pressure: float, kind: tuple[str, bool]
) -> None:
    scene = pressed(
        loads={**FOLLOWING, "regions": ["x-max", "y-max", "z-max"]},
        discretisation=discretisation(kind),
    )
    u = solved(scene, pressure, pressure, pressure)
    # Cauchy's stress S / λ is -p, with S = 3 K (λ² - 1) / 2.
    bulk = YOUNG_PA / (3 * (1 - 2 * 0.3))
    stretch = brentq(lambda x: 1.5 * bulk * (x**2 - 1) / x + pressure, 0.5, 1.5)
    np.testing.assert_allclose(u, scene.mesh.points * (stretch - 1), atol=1e-9)


def test_an_inflated_tube_converges_to_the_incompressible_closed_form() -> None:
    inner, outer, inflated, shear = 1.0, 2.0, 1.5, 100.0
    shift = inflated**2 - inner**2

    def integrand(radius: float) -> float:
        at_rest = np.sqrt(radius**2 - shift)
        return float(shear * ((radius / at_rest) ** 2 - (at_rest / radius) ** 2) / radius)

    pressure = quad(integrand, inflated, np.sqrt(outer**2 + shift))[0]
    errors = []
    for n in (4, 8, 16):
        scene = pressed(
            geometry={**TUBE, "cells": [n, 2 * n, 1], "angle_deg": 90.0},
            discretisation={"element": "hexahedron", "integration": "selective"},
            material=material_table("neo-hookean", 2 * shear * 1.4999, 0.4999),
            supports=[*PLANES, {"region": "z-max", "components": ["z"]}],
            loads={**FOLLOWING, "regions": [{"point_set": "inner"}]},
        )
        radius = np.linalg.norm((scene.mesh.points + solved(scene, pressure))[:, :2], axis=1)
        exact = np.sqrt(np.sum(scene.mesh.points[:, :2] ** 2, axis=1) + shift)
        errors.append(float(np.abs(radius - exact).max()))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[-1] < 5e-3
    assert orders.min() > 1.7


def test_the_supports_carry_the_pressure_on_the_deformed_surface() -> None:
    scene = pressed(
        geometry={"shape": "box", "size_m": [4.0, 1.0, 1.0], "cells": [8, 2, 2]},
        supports=CLAMPED,
        # No facet has a corner on the support, where its force would be unknown.
        loads={**FOLLOWING, "regions": [{"box_m": [[0.5, 0.0, 1.0], [4.0, 1.0, 1.0]]}]},
    )
    pressure = 1.5
    u = solved(scene, pressure)
    assert np.abs(u).max() > 1.0  # a large rotation
    force = -pressure * area_vectors(scene.mesh.points + u, scene.pressed_facets[0]).sum(axis=0)
    found = reactions(scene, np.zeros_like(u), u)[scene.fixed_nodes].sum(axis=0)
    np.testing.assert_allclose(found, -force, rtol=1e-8, atol=1e-12)
    assert abs(force[0]) > 0.5  # a dead load has no such component


def test_small_pressures_are_dead_loads() -> None:
    scene = pressed(supports=CLAMPED, loads={**FOLLOWING, "regions": ["z-max"]})
    dead = pressed(supports=CLAMPED, loads={**LOADS, "regions": ["z-max"]})
    load = forces_of(dead, 1e-4).ravel()[dead.free_dofs]
    expected = FullOrderModel(dead).solve(load, options=TIGHT).displacement
    found = PressedModel(scene).solve(load, options=TIGHT).displacement
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_other_forces_and_other_models_are_refused() -> None:
    scene = pressed(supports=CLAMPED, loads={**FOLLOWING, "regions": ["z-max"]})
    with pytest.raises(UnsupportedSceneError, match="follow the surface"):
        FullOrderModel(scene)
    with pytest.raises(InvalidInputError, match="forces must be those of pressures"):
        mor_bench.load_method("fem").fit(scene).predict(np.ones((scene.mesh.n_nodes, 3)))
    with pytest.raises(SpecError, match=r"`loads\.follower` must be false"):
        load_scene({**_liver(), "loads": {**FOLLOWING, "regions": ["surface"]}})
    seen = pressed(
        supports=CLAMPED,
        loads={**FOLLOWING, "regions": ["z-max"]},
        observed={"region": "x-max"},
    )
    assert "follow the surface" in str(mor_bench.load_method("fem").supports(seen))
    with pytest.raises(UnsupportedSceneError, match="no pressure follows"):
        PressedModel(pressed())


def _liver() -> dict[str, Any]:
    table = load_scene("liver-hex").generated.model_dump()
    return {**table, "split": {"by": "sample"}, "tests": {}}


def test_the_discretisation_error_of_a_following_pressure_is_measured(tmp_path: Path) -> None:
    loads = {**FOLLOWING, "regions": ["z-max"], "magnitude_pa": [0.5, 1.0]}
    record = refine(
        pressed(supports=CLAMPED, loads=loads).generated, RefinementPlan(2, 1), cache=tmp_path
    )
    assert 0.0 < record["relative_l2"] < 0.5


@pytest.mark.slow
def test_methods_learn_following_pressures(tmp_path: Path) -> None:
    box = {"shape": "chambered-box", "size_m": [3.0, 1.0, 1.0], "cells": [6, 3, 5]}
    sets = [{"point_set": "chamber-a"}, {"point_set": "chamber-b"}]
    loads = {**FOLLOWING, "regions": sets, "magnitude_pa": [0.0, 20.0], "samples": 200}
    table = content(
        geometry={**box, "chambers": [[[1, 1, 1], [5, 2, 2]], [[1, 1, 3], [5, 2, 4]]]},
        supports=CLAMPED,
        loads=loads,
    )
    methods = ["fem", "linear-fem", "pod[n_modes=2]", "pca-regression-linear"]
    comparison = mor_bench.run([table], methods, out=tmp_path / "out", cache=tmp_path)
    rows = {row.method: row for row in comparison.rows}
    assert "follow the surface" in str(rows["pod"].reason)
    medians = {name: row.error.rel_l2_median for name, row in rows.items() if row.error}
    assert medians["fem"] < 1e-2
    assert medians["pca-regression-linear"] < medians["linear-fem"]
