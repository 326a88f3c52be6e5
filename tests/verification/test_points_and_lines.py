"""Point loads and line loads: consistent weights, felupe, closed forms, convergence, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mor_bench.errors import SpecError
from mor_bench.hard_cases.setups import material_table
from mor_bench.measure.discretisation_error import RefinementPlan, refine
from mor_bench.mechanics.reactions import reaction_forces
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.snapshots.test_sets import available_sets, spec_of_set

from .oblique import solved

Array = NDArray[np.float64]
POINT: dict[str, Any] = {
    "kind": "point",
    "region": "z-max",
    "samples": 20,
    "magnitude_n": [1.0, 2.0],
}
EDGE = [[2.0, 0.0, 1.0], [2.0, 1.0, 1.0]]
LINE: dict[str, Any] = {"kind": "line", "lines": [EDGE], "samples": 20, "magnitude_n": [1.0, 2.0]}


def content(**changed: Any) -> dict[str, Any]:
    """Return a cantilever of 2 x 1 x 1 m as a dict."""
    return {
        "name": "cantilever",
        "title": "Cantilever",
        "geometry": {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [8, 4, 4]},
        "material": material_table("neo-hookean", 500.0, 0.3),
        "supports": [{"region": "x-min"}],
        "split": {"by": "sample"},
        **changed,
    }


def loaded(loads: dict[str, Any], **changed: Any) -> Scene:
    return load_scene(content(loads=loads, **changed))


def test_a_point_load_acts_on_one_node() -> None:
    scene = loaded(POINT)
    on_top = np.flatnonzero((scene.mesh.points[:, 2] == 1.0) & (scene.mesh.points[:, 0] > 0.0))
    np.testing.assert_array_equal(scene.patch_nodes, on_top)
    weights = scene.patch_weights.toarray()
    np.testing.assert_array_equal(weights, np.eye(scene.mesh.n_nodes)[on_top])
    drawn = draw_loads(scene, 0, 20)
    forces = drawn.nodal_forces(scene.patch_weights)
    assert (np.count_nonzero(forces.any(axis=2), axis=1) == 1).all()
    sizes = np.linalg.norm(forces.sum(axis=1), axis=1)
    assert ((sizes >= 1.0) & (sizes <= 2.0)).all()


def test_points_are_spread_over_the_region_and_may_act_together() -> None:
    scene = loaded({**POINT, "n_patches": 5, "simultaneous": 2, "min_distance_m": 0.7})
    assert len(scene.patch_nodes) == 5
    drawn = draw_loads(scene, 0, 20)
    gaps = np.diff(scene.patch_centres[drawn.patches], axis=1)[:, 0]
    assert np.linalg.norm(gaps, axis=1).min() >= 0.7


def test_a_line_along_an_edge_has_the_weights_of_its_elements() -> None:
    scene = loaded(LINE)
    weights = scene.patch_weights.toarray()[0]
    on_edge = (scene.mesh.points[:, 0] == 2.0) & (scene.mesh.points[:, 2] == 1.0)
    y = scene.mesh.points[:, 1]
    expected = np.where(on_edge, np.where((y == 0.0) | (y == 1.0), 1 / 8, 1 / 4), 0.0)
    np.testing.assert_allclose(weights, expected, atol=1e-12)


ELEMENTS = [
    {"element": "hexahedron"},
    {"element": "tetrahedron"},
    {"element": "tetrahedron", "order": 2},
]


@pytest.mark.parametrize("elements", ELEMENTS)
@pytest.mark.parametrize("line", [EDGE, [[0.3, 0.1, 1.0], [1.7, 0.85, 1.0]]])
def test_a_line_does_the_work_of_a_uniform_force_in_linear_fields(
    line: list[list[float]], elements: dict[str, Any]
) -> None:
    scene = loaded({**LINE, "lines": [line]}, discretisation=elements)
    weights = scene.patch_weights.toarray()[0]
    assert weights.sum() == pytest.approx(1.0, abs=1e-14)
    middle = np.mean(line, axis=0)
    np.testing.assert_allclose(weights @ scene.mesh.points, middle, atol=1e-14)
    if line is EDGE:  # ∫ y² dy, which linear elements interpolate
        found = weights @ scene.mesh.points[:, 1] ** 2
        error = 0.0 if "order" in elements else (1 / 4) ** 2 / 6
        assert found == pytest.approx(1 / 3 + error, abs=1e-6)


@pytest.mark.parametrize("loads", [POINT, LINE, {**LINE, "lines": [EDGE, EDGE[::-1]]}])
def test_the_supports_balance_the_load(loads: dict[str, Any]) -> None:
    scene = loaded(loads)
    forces = draw_loads(scene, 0, 1).nodal_forces(scene.patch_weights)
    u = solved(scene, forces)[0]
    acting = reaction_forces(scene, u, forces[0]) + forces[0]
    size = float(np.abs(forces).sum())
    np.testing.assert_allclose(acting.sum(axis=0), 0.0, atol=1e-10 * size)
    moment = np.cross(scene.mesh.points + u, acting).sum(axis=0)
    np.testing.assert_allclose(moment, 0.0, atol=2e-10 * size)


def test_the_tip_of_a_slender_beam_under_a_line_load_has_its_closed_form() -> None:
    # Without Poisson's effect, Timoshenko's beam: w = F L³ / 3EI + F L / (5/6 G A).
    length, side, force, errors = 8.0, 1.0, 1e-5, []
    for n in (4, 8, 16):
        scene = loaded(
            {**LINE, "lines": [[[length, 0.0, 0.5], [length, side, 0.5]]]},
            geometry={"shape": "box", "size_m": [length, side, side], "cells": [8 * n, 2, n]},
            material=material_table("saint-venant-kirchhoff", 500.0, 0.0),
        )
        forces = scene.patch_weights.toarray()[0][:, None] * np.array([0.0, 0.0, force])
        u = solved(scene, forces[None])[0]
        exact = force * length**3 / (3 * 500.0 / 12) + force * length / (5 / 6 * 250.0)
        # Beside the load, the displacement is that of the beam; under it, it grows with refinement.
        end = (scene.mesh.points[:, 0] == length) & (np.abs(scene.mesh.points[:, 2] - 0.5) == 0.5)
        errors.append(abs(u[end, 2].mean() / exact - 1.0))
    assert errors[2] < 4e-3
    assert min(errors[0] / errors[1], errors[1] / errors[2]) > 2.5


def test_a_point_load_goes_deeper_the_finer_the_mesh_and_a_line_load_less_so(
    tmp_path: Any,
) -> None:
    depths: dict[str, list[float]] = {"point": [], "line": []}
    for n in (2, 4, 8):
        size = {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [2 * n, n, n]}
        middle = {"nearest_m": [[1.0, 0.5, 1.0], 1]}
        for kind, loads in (
            ("point", {**POINT, "region": middle}),
            ("line", {**LINE, "lines": [[[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]]]}),
        ):
            scene = loaded(loads, geometry=size)
            forces = scene.patch_weights.toarray()[0][:, None] * np.array([0.0, 0.0, -1e-4])
            u = solved(scene, forces[None])[0]
            depths[kind].append(-u[scene.patch_nodes[0], 2])
    grown = {kind: np.diff(values) for kind, values in depths.items()}
    assert grown["point"][1] > 1.5 * grown["point"][0] > 0.0  # as 1 / h
    assert 0.5 < grown["line"][1] / grown["line"][0] < 1.5  # as the logarithm of h


def test_the_discretisation_error_of_lines_can_be_measured(tmp_path: Any) -> None:
    size = {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [4, 2, 2]}
    spec = loaded(LINE, geometry=size).generated
    found = refine(spec, RefinementPlan(n_loads=1, levels=1), cache=tmp_path)
    assert 0.0 < found["loads"][0]["relative_l2"] < 0.5


def test_named_test_sets_exist() -> None:
    for loads in (POINT, LINE):
        spec = loaded(loads).generated
        assert {"in-range", "2x", "4x"} <= set(available_sets(spec))
        twice = spec_of_set(spec, "2x").load_plan
        assert twice.magnitude == (2.0, 4.0)
        assert twice.seed != spec.load_plan.seed


@pytest.mark.parametrize(
    ("loads", "message"),
    [
        ({**POINT, "patch_area_m2": 0.1}, r"unknown key `loads.patch_area_m2`"),
        ({**POINT, "region": "x-min"}, "holds fixed nodes only"),
        ({**LINE, "lines": [[[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]]]}, "holds fixed nodes only"),
        ({**POINT, "n_patches": 1000}, r"`n_patches` must be in \[1, 40\]"),
        ({**LINE, "lines": []}, r"`loads.lines`"),
        ({**LINE, "lines": [[EDGE[0], EDGE[0]]]}, r"the two ends of `lines\[0\]` must differ"),
        ({**LINE, "lines": [[[2.0, 0.0, 1.0], [2.0, 1.2, 1.0]]]}, "`loads.lines` must lie in the"),
        ({**LINE, "region": "z-max"}, r"unknown key `loads.region`"),
        (
            {"kind": "line", "lines": [EDGE], "samples": 0, "magnitude_n": [2.0, 1.0]},
            r"`loads.samples` must be .*`loads.magnitude_n`: the lower bound",
        ),
    ],
)
def test_wrong_loads_are_refused(loads: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        loaded(loads)
