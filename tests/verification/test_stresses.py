"""Stresses: every law and element, Lamé's tube, rotation, weight, errors in a run, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import InvalidInputError, SpecError, UnsupportedSceneError
from mor_bench.hard_cases.setups import material_table
from mor_bench.measure.stress_errors import StressErrors
from mor_bench.mechanics.assembly import Assembler
from mor_bench.mechanics.discretisation import discretisation_of
from mor_bench.mechanics.model import rest_displacement
from mor_bench.mechanics.stresses import CellStresses, Stresses
from mor_bench.report.entries import entries_of
from mor_bench.report.page_tables import figure_tables
from mor_bench.scene.scene import Scene, load_scene

from .laws_and_elements import LAWS
from .oblique import ROTATION, SPEC, loads, solved

Array = NDArray[np.float64]
F = np.eye(3) + 0.3 * np.random.default_rng(5).uniform(-1.0, 1.0, (3, 3))
"""A homogeneous deformation with det F > 0."""
ELEMENTS: list[dict[str, Any]] = [
    {},
    {"integration": "selective"},
    {"element": "tetrahedron"},
    {"element": "tetrahedron", "order": 2},
]


def block(law: str, discretisation: dict[str, Any]) -> Scene:
    material = material_table(law, 500.0, 0.4)
    return load_scene({**SPEC, "material": material, "discretisation": discretisation})


def energy_density(scene: Scene, deformation: Array) -> float:
    """Return the energy of a homogeneous deformation over the volume, J/m³."""
    body, n = discretisation_of(scene), scene.mesh.n_dofs
    assembler = Assembler(body, np.arange(n).reshape(-1, 3), n)
    u = scene.mesh.points @ (deformation - np.eye(3)).T
    return float(assembler.force(u.ravel()).energy_j) / 2.0  # the block has 2 m³


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("discretisation", ELEMENTS, ids=["H8", "selective", "T4", "T10"])
def test_the_stress_is_the_derivative_of_the_energy(
    law: str, discretisation: dict[str, Any]
) -> None:
    scene, step = block(law, discretisation), 1e-4
    P = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            change = np.zeros((3, 3))
            change[i, j] = step
            ends = [energy_density(scene, F + sign * change) for sign in (1.0, -1.0)]
            P[i, j] = (ends[0] - ends[1]) / (2 * step)
    expected = P @ F.T / np.linalg.det(F)
    found = mor_bench.stresses(scene, scene.mesh.points @ (F - np.eye(3)).T)
    assert found.cauchy.shape == (len(scene.mesh.cells), 3, 3)
    size = np.abs(expected).max()
    np.testing.assert_allclose(
        found.cauchy, np.broadcast_to(expected, found.cauchy.shape), atol=1e-6 * size
    )


def test_equivalent_and_principal_stresses_of_known_tensors() -> None:
    tension, shear = np.diag([7.0, 0.0, 0.0]), np.array([[0, 2, 0], [2, 0, 0], [0, 0, 0.0]])
    found = Stresses(np.stack([tension, shear, -5.0 * np.eye(3)]))
    np.testing.assert_allclose(found.von_mises, [7.0, 2.0 * np.sqrt(3.0), 0.0], atol=1e-12)
    np.testing.assert_allclose(found.principal, [[0, 0, 7], [-2, 0, 2], [-5, -5, -5]], atol=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_a_rotation_turns_the_stress_and_makes_none(law: str) -> None:
    scene = block(law, {})
    points = scene.mesh.points
    alone = mor_bench.stresses(scene, points @ (ROTATION - np.eye(3)).T)
    np.testing.assert_allclose(alone.cauchy, 0.0, atol=1e-9 * 500.0)
    stretched = mor_bench.stresses(scene, points @ (F - np.eye(3)).T)
    both = mor_bench.stresses(scene, points @ (ROTATION @ F - np.eye(3)).T)
    expected = ROTATION @ stretched.cauchy @ ROTATION.T
    np.testing.assert_allclose(both.cauchy, expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(both.von_mises, stretched.von_mises, rtol=1e-9)


def hoop_error(cells: list[int]) -> float:
    """Return the largest error of the hoop stress of Lamé's tube in plane strain, relative."""
    inner, outer, pressure = 1.0, 1.5, 1e-3
    scene = load_scene(
        {
            "name": "tube",
            "title": "Tube",
            "geometry": {
                "shape": "tube",
                "radii_m": [inner, outer],
                "length_m": 0.2,
                "cells": cells,
            },
            "material": material_table("neo-hookean", 500.0, 0.3),
            "supports": [
                {"region": "z-min", "components": ["z"]},
                {"region": "z-max", "components": ["z"]},
            ],
            "springs": [{"region": {"point_set": "outer"}, "stiffness_n_m3": 1e-3}],
            "loads": {
                "kind": "pressure",
                "regions": [{"point_set": "inner"}],
                "magnitude_pa": [0.0, pressure],
                "samples": 4,
            },
            "split": {"by": "sample"},
        }
    )
    forces = -pressure * scene.patch_weights.toarray().T[None]
    u = solved(scene, forces)[0]
    stress = mor_bench.stresses(scene, u).cauchy
    centre = scene.mesh.points[scene.mesh.cells].mean(axis=1)
    radius = np.hypot(centre[:, 0], centre[:, 1])
    along = np.stack([-centre[:, 1], centre[:, 0], 0.0 * radius], axis=1) / radius[:, None]
    hoop = np.einsum("ci,cij,cj->c", along, stress, along)
    lame = pressure * inner**2 / (outer**2 - inner**2) * (1.0 + (outer / radius) ** 2)
    return float(np.abs(hoop / lame - 1.0).max())


def test_the_hoop_stress_of_a_tube_converges_to_that_of_lame_with_the_second_order() -> None:
    coarse, fine = hoop_error([2, 16, 1]), hoop_error([4, 32, 1])
    assert fine < 0.01
    assert np.log2(coarse / fine) > 1.8


def test_stresses_under_gravity_contain_those_of_the_rest_state() -> None:
    weight = {"density_kg_m3": 20.0, "acceleration_m_s2": [0.0, 0.0, -1.0]}
    heavy, light = load_scene({**SPEC, "gravity": weight}), load_scene(SPEC)
    rest = rest_displacement(heavy)
    assert rest is not None
    found = mor_bench.stresses(heavy, np.zeros_like(rest)).cauchy
    assert np.abs(found).max() > 1.0
    np.testing.assert_allclose(found, mor_bench.stresses(light, rest).cauchy, rtol=1e-12)


def test_errors_of_the_field_and_of_the_largest_stress() -> None:
    weight = {"density_kg_m3": 2.0, "acceleration_m_s2": [0.0, 0.0, -1.0]}
    scene = load_scene({**SPEC, "gravity": weight})
    u = solved(scene, loads(scene, 2, 10.0))
    bad = u.copy()
    bad[1] = np.nan
    errors = StressErrors(scene)
    assert [part.tolist() for part in errors(u, u)] == [[0.0, 0.0]] * 3
    field, peak, tension = errors(1.1 * u, u)
    assert ((field > 0.05) & (field < 0.3)).all()
    assert ((peak > 0.03) & (peak < 0.3)).all()
    assert ((tension > 0.0) & (tension < 0.3)).all()
    assert [part[1] for part in errors(bad, u)] == [np.inf] * 3
    # No answer at all has the whole stress beyond the rest state as its error.
    np.testing.assert_allclose(errors(np.zeros_like(u), u)[0], 1.0, rtol=1e-12)


def test_the_error_of_the_tension_is_that_of_eigenvalues_also_where_all_is_compressed() -> None:
    scene = block("neo-hookean", {})
    strains = [np.diag([0.2, 0.0, -0.1]), -0.1 * np.eye(3)]
    u = np.stack([scene.mesh.points @ strain for strain in strains])
    predicted = 1.2 * u
    tension, size = np.empty((2, 2)), np.empty(2)
    for i in range(2):
        for j, displacement in enumerate((predicted[i], u[i])):
            cauchy = mor_bench.stresses(scene, displacement).cauchy
            eigenvalues = np.linalg.eigvals(cauchy).real
            tension[i, j], size[i] = eigenvalues.max(), np.abs(eigenvalues).max()
    assert tension[0].min() > 0 > tension[1].max()
    expected = np.abs(tension[:, 0] - tension[:, 1]) / size
    np.testing.assert_allclose(StressErrors(scene)(predicted, u)[2], expected, rtol=1e-9)


def test_an_inverted_cell_does_not_hide_the_principal_stresses_of_the_others() -> None:
    tensors = np.stack([np.diag([1.0, 3.0, 2.0]), np.full((3, 3), np.inf), np.full((3, 3), np.nan)])
    found = Stresses(tensors).principal
    assert found[0].tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(found[1:]).all()


def test_stresses_refuse_what_has_none() -> None:
    scene = mor_bench.load_scene("beam-tiny")
    with pytest.raises(InvalidInputError, match=r"must have shape \(n, 63, 3\)"):
        mor_bench.stresses(scene, np.zeros((4, 3)))
    with pytest.raises(UnsupportedSceneError, match="stresses need one body"):
        CellStresses(mor_bench.load_scene("beam-stiffness"))
    with pytest.raises(SpecError, match="`outputs` must be 'all' where `stress` is true"):
        load_scene({**SPEC, "needs": {"outputs": "x-max", "stress": True}})
    parameters = {"young_pa": [400.0, 600.0]}
    with pytest.raises(SpecError, match=r"absent where `needs\.stress` is true"):
        load_scene({**SPEC, "needs": {"stress": True}, "parameters": parameters})


@pytest.mark.slow
def test_a_run_gives_the_errors_of_the_stress(tmp_path: Path, cache: Path) -> None:
    path = tmp_path / "wanted.toml"
    spec = Path(mor_bench.__file__).parents[1] / "datasets" / "beam-tiny.toml"
    text = spec.read_text(encoding="utf-8")
    assert "[needs]" in text
    path.write_text(text.replace("[needs]", "[needs]\nstress = true"), encoding="utf-8")
    methods = ["fem", "linear-fem", "pod"]
    made = mor_bench.run([path], methods, out=tmp_path / "out", cache=cache, profile="quick")
    errors = {row.label: row.error for row in made.rows}
    exact = next(error for label, error in errors.items() if "1e-08" in label)
    linear = errors["linear-fem"]
    assert exact
    assert linear
    assert exact.stress_rel_max < 1e-6 < linear.stress_rel_median < linear.stress_rel_max
    assert exact.peak_stress_rel_max < 1e-6 < linear.peak_stress_rel_median
    assert exact.peak_tension_rel_max < 1e-6 < linear.peak_tension_rel_median
    titles = [table.title for table in figure_tables(entries_of(made, "wanted"))]
    assert "Stress at the cells' centroids (%)" in titles
