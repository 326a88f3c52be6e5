"""Other meshes of a body: interpolation, coarse and warm-started FEM, discretisation error."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import (
    InvalidInputError,
    OutsideMeshError,
    SpecError,
    StoreError,
    UnsupportedSceneError,
)
from mor_bench.measure.discretisation_error import (
    RefinementPlan,
    chosen_samples,
    measured,
    refine,
)
from mor_bench.measure.mesh_limit import limit_of
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.report.page import render
from mor_bench.scene.interpolation import interpolation_matrix
from mor_bench.scene.mesh import Mesh, box_mesh
from mor_bench.scene.other_meshes import with_cells
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import DatasetSpec, TetrahedraGeometry, load_generated_spec
from tests.relative_errors import relative_l2
from tests.small_runs import LIMIT, run_small, short_timing

SHIPPED = ("beam-coarse", "beam-tiny")


def distorted(tetrahedra: bool) -> Mesh:
    """A graded, sheared and bent box: no cell is a parallelepiped."""
    mesh = box_mesh((2.0, 1.0, 1.0), (7, 3, 4), tetrahedra)
    x, y, z = mesh.points.T
    return replace(
        mesh, points=np.stack([x**2 + 0.2 * y * z, y + 0.1 * x * z, z + 0.15 * x * y], axis=1)
    )


@pytest.mark.parametrize("tetrahedra", [False, True])
def test_interpolation_is_exact_for_linear_fields_and_at_the_nodes(tetrahedra: bool) -> None:
    mesh = distorted(tetrahedra)
    generator = np.random.default_rng(0)
    shares = generator.dirichlet(np.ones(mesh.cells.shape[1]), size=500)
    corners = mesh.points[mesh.cells[generator.integers(mesh.n_cells, size=500)]]
    if not tetrahedra:  # a convex combination of a bent hexahedron's corners may lie outside it
        corners = corners.mean(axis=1, keepdims=True) + 0.5 * (
            corners - corners.mean(axis=1, keepdims=True)
        )
    points = np.einsum("na,nai->ni", shares, corners)
    matrix = interpolation_matrix(mesh, points)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, rtol=0, atol=1e-13)
    np.testing.assert_allclose(matrix @ mesh.points, points, rtol=0, atol=1e-12)
    assert matrix.toarray().min() > -1e-9
    np.testing.assert_allclose(
        interpolation_matrix(mesh, mesh.points).toarray(), np.eye(mesh.n_nodes), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("tetrahedra", [False, True])
def test_points_outside_are_refused_unless_only_by_round_off(
    tetrahedra: bool,
) -> None:
    mesh = box_mesh((2.0, 1.0, 1.0), (4, 2, 2), tetrahedra)
    surface = mesh.points[np.unique(mesh.boundary_facets)]
    outwards = np.sign(surface - np.array([1.0, 0.5, 0.5]))
    interpolation_matrix(mesh, surface + 1e-13 * outwards)
    with pytest.raises(
        OutsideMeshError,
        match=r"a point lies outside the mesh, .* the first is \[2.0, 0.5, 1.01\] m",
    ):
        interpolation_matrix(mesh, np.array([[1.0, 0.5, 0.5], [2.0, 0.5, 1.01]]))
    with pytest.raises(OutsideMeshError, match="63 points lie outside"):
        interpolation_matrix(mesh, box_mesh((2.0, 1.0, 1.0), (6, 2, 2)).points + 10.0)


def with_element(name: str, element: str) -> Scene:
    spec = load_generated_spec(name)
    return load_scene(
        spec.model_copy(
            update={"discretisation": spec.discretisation.model_copy(update={"element": element})}
        )
    )


@pytest.mark.parametrize("element", ["hexahedron", "tetrahedron"])
def test_forces_keep_their_sum_and_moment_on_the_coarse_mesh(element: str) -> None:
    scene = with_element("beam-coarse", element)
    method = mor_bench.load_method("fem-coarse", coarsening=2).fit(scene, None)
    coarse = method.model_.scene.mesh  # type: ignore[attr-defined]
    assert coarse.grid_shape == (9, 3, 3)
    forces = np.random.default_rng(1).normal(size=(scene.mesh.n_nodes, 3))
    carried = method.interpolation_.T @ forces  # type: ignore[attr-defined]
    np.testing.assert_allclose(
        carried.sum(axis=0), forces.sum(axis=0), rtol=0, atol=1e-12 * np.abs(forces).sum()
    )
    moments = (
        np.cross(scene.mesh.points, forces).sum(axis=0),
        np.cross(coarse.points, carried).sum(axis=0),
    )
    np.testing.assert_allclose(
        *moments, rtol=0, atol=1e-12 * np.abs(np.cross(scene.mesh.points, forces)).sum()
    )


def test_coarse_fem_equals_the_coarse_model_at_shared_nodes(tiny: Dataset) -> None:
    knobs = {"coarsening": 2, "tolerance": 1e-10, "static_correction": False}
    method = mor_bench.load_method("fem-coarse", **knobs).fit(tiny.scene, None)
    mesh = with_cells(tiny.scene, (3, 1, 1))
    force = np.zeros((mesh.mesh.n_nodes, 3))
    force[-1] = [0.0, 0.1, -0.5]
    at = np.array(
        [int(np.linalg.norm(tiny.scene.mesh.points - x, axis=1).argmin()) for x in mesh.mesh.points]
    )
    fine = np.zeros((tiny.scene.mesh.n_nodes, 3))
    fine[at] = force
    expected = np.zeros(mesh.mesh.n_dofs)
    expected[mesh.free_dofs] = (
        FullOrderModel(mesh).solve(force.ravel()[mesh.free_dofs]).displacement
    )
    np.testing.assert_allclose(method.predict(fine)[at], expected.reshape(-1, 3), rtol=0, atol=1e-9)


def test_static_correction_leaves_the_coarse_mesh_the_nonlinear_part_only(tiny: Dataset) -> None:
    forces, truth = tiny.test.forces[:20], tiny.test.displacements[:20]
    plain, corrected = (
        mor_bench.load_method("fem-coarse", static_correction=chosen).fit(tiny.scene, None)
        for chosen in (False, True)
    )

    def errors(method: Any) -> Any:
        apart = np.linalg.norm(method.predict(forces) - truth, axis=(1, 2))
        return apart / np.linalg.norm(truth, axis=(1, 2))

    assert errors(corrected).max() < 0.2 * errors(plain).min()
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None).predict(1e-4 * forces)
    apart = np.linalg.norm(corrected.predict(1e-4 * forces) - linear, axis=(1, 2))
    assert (apart < 1e-4 * np.linalg.norm(linear, axis=(1, 2))).all()
    assert not corrected.predict(0.0 * forces[:1]).any()


def box(**changes: Any) -> Scene:
    content = {**load_generated_spec("beam-tiny").model_dump(mode="json"), **changes}
    return load_scene(content)


def test_scenes_without_a_coarser_mesh_are_refused_with_the_reason() -> None:
    one = box(geometry={"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [1, 1, 1]})
    held = box(supports=[{"region": {"box_m": [[0.3, 0.0, 0.0], [0.4, 1.0, 1.0]]}}])
    method = mor_bench.load_method("fem-coarse")
    for scene, reason in (
        (one, "one cell cannot be made coarser"),
        (held, "holds no node"),
        (not_a_box(held), "only the mesh of a box or an L"),
    ):
        assert reason in (method.supports(scene) or "")
        with pytest.raises(UnsupportedSceneError, match=reason):
            method.fit(scene, None)


def not_a_box(scene: Scene) -> Scene:
    return replace(
        scene,
        spec=scene.spec.model_copy(
            update={"geometry": TetrahedraGeometry(shape="tetrahedra", surface="liver")}
        ),
    )


@pytest.mark.parametrize("start", ["nearest", "previous"])
def test_warm_starts_end_at_the_equilibrium_of_the_full_order_model(
    tiny: Dataset, start: str
) -> None:
    method = mor_bench.load_method("fem-warm", start=start, tolerance=1e-8).fit(
        tiny.scene, tiny.train
    )
    predicted = method.predict(tiny.test.forces)
    backwards = method.predict(tiny.test.forces[::-1])[::-1]
    for found in (predicted, backwards):
        assert (relative_l2(found, tiny.test.displacements) <= 1e-6).all()
    if start == "nearest":
        np.testing.assert_array_equal(predicted, backwards)


@pytest.mark.parametrize(("start", "needed"), [("nearest", True), ("previous", False)])
def test_a_start_at_the_solution_needs_no_step(tiny: Dataset, start: str, needed: bool) -> None:
    method = mor_bench.load_method("fem-warm", start=start, tolerance=1e-6)
    assert method.needs_snapshots is needed
    method.fit(tiny.scene, tiny.train if needed else None)
    iterations = []
    solve = method.model_.solve  # type: ignore[attr-defined]

    def counted(*arguments: Any) -> Any:
        solution = solve(*arguments)
        iterations.append(solution.iterations)
        return solution

    method.model_.solve = counted  # type: ignore[attr-defined]
    for _ in range(2):
        method.predict(tiny.train.forces[5])
    assert iterations[1] == 1
    assert (iterations[0] == 1) == needed


def tip_deflection(scene: Scene, cells: tuple[int, int, int]) -> np.ndarray[Any, Any]:
    """Return the tip face's mean deflection, m, shape (1,), under 1 N spread evenly over it."""
    mesh = with_cells(scene, cells)
    points = mesh.mesh.points
    tip = np.flatnonzero(points[:, 0] == points[:, 0].max())
    inner = (points[tip, 1:] > 1e-9) & (points[tip, 1:] < 1 - 1e-9)
    weights = np.where(inner, 1.0, 0.5).prod(axis=1)
    load = np.zeros((mesh.mesh.n_nodes, 3))
    load[tip, 2] = -weights / weights.sum()
    displacement = np.zeros(mesh.mesh.n_dofs)
    displacement[mesh.free_dofs] = (
        FullOrderModel(mesh).solve(load.ravel()[mesh.free_dofs]).displacement
    )
    return np.array([-weights @ displacement.reshape(-1, 3)[tip, 2] / weights.sum()])


@pytest.mark.slow
def test_the_tip_deflection_converges_to_an_independent_limit() -> None:
    """An independent study gives 0.417 m on 8 x 2 x 2 cells and 0.518 m in the limit."""
    scene = load_scene("beam-coarse")
    assert tip_deflection(scene, (8, 2, 2))[0] == pytest.approx(0.417, rel=2e-3)
    limit, order, kind = limit_of(
        [tip_deflection(scene, (15 * k, 3 * k, 3 * k)) for k in (1, 2, 4)]
    )
    assert kind == "extrapolated"
    assert order is not None
    assert limit[0] == pytest.approx(0.518, rel=0.02)


T4: dict[str, Any] = {"element": "tetrahedron"}
TABLES = [{}, T4, {"integration": "selective"}, {**T4, "order": 2}]


@pytest.mark.parametrize("changes", TABLES)
def test_every_mesh_carries_the_same_force_and_moment(changes: dict[str, Any]) -> None:
    scene = box(discretisation=changes)
    patches = np.array([0, 10, 20])
    points, shares = scene.patch_points(patches)
    for factor in (1, 2, 3):
        mesh = with_cells(scene, (6 * factor, 2 * factor, 2 * factor)).mesh
        weights = shares @ interpolation_matrix(mesh, points)
        np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=0, atol=1e-12)
        np.testing.assert_allclose(weights @ mesh.points, shares @ points, rtol=0, atol=1e-12)
        if factor == 1:
            np.testing.assert_allclose(
                weights.toarray(), scene.patch_weights[patches].toarray(), rtol=0, atol=1e-12
            )


def test_chosen_samples_come_from_the_dataset_and_spread_over_its_patches(tiny: Dataset) -> None:
    samples = chosen_samples(tiny.scene, 7)
    assert (samples % 21 // 3 == np.arange(7)).all()
    assert samples.max() < 210
    np.testing.assert_array_equal(samples, chosen_samples(tiny.scene, 7))


@pytest.fixture(scope="module")
def changed() -> DatasetSpec:
    """beam-tiny with another stiffness, for which no record is shipped."""
    spec = load_generated_spec("beam-tiny")
    return spec.model_copy(
        update={"material": spec.material.model_copy(update={"young_pa": 600.0})}
    )


@pytest.mark.parametrize("discretisation", TABLES)
def test_refinement_works_for_every_element(discretisation: dict[str, Any], tmp_path: Path) -> None:
    record = refine(
        box(discretisation=discretisation).generated, RefinementPlan(2, 1), cache=tmp_path
    )
    n = 144 if "element" in discretisation else 24
    assert [mesh["n_cells"] for mesh in record["meshes"]] == [n, 8 * n]
    assert {load["limit"] for load in record["loads"]} == {"finest"}
    assert 0.02 < record["relative_l2"] * (15 if "order" in discretisation else 1) < 0.7


def test_a_record_keeps_its_measurements_and_is_used_only_for_its_physics(
    changed: DatasetSpec, tmp_path: Path
) -> None:
    assert measured(changed, tmp_path) is None
    record = refine(changed, RefinementPlan(3, 3, 7000), cache=tmp_path)
    assert [mesh["n_dofs"] for mesh in record["meshes"]] == [189, 975, 6075]
    assert [mesh["n_dofs"] for mesh in record["left_out"]] == [42483]
    assert record["error_m"] == pytest.approx(
        np.mean([load["error_m"] for load in record["loads"]])
    )
    assert record["relative_l2_median"] == pytest.approx(
        np.median([load["relative_l2"] for load in record["loads"]])
    )
    assert record["command"].endswith("beam-tiny --loads 3 --levels 3 --max-dofs 7000")
    assert measured(changed, tmp_path) == json.loads(json.dumps(record))
    stiffer = changed.model_copy(
        update={"material": changed.material.model_copy(update={"young_pa": 601.0})}
    )
    assert measured(stiffer, tmp_path) is None


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_records_belong_to_the_shipped_datasets(name: str, tmp_path: Path) -> None:
    spec = load_generated_spec(name)
    record = measured(spec, tmp_path)
    assert record is not None
    assert record["digest"] == spec.digest()
    assert record["command"].startswith(f"mor-bench refine {name} ")


@pytest.mark.slow
def test_the_measured_error_is_shown_in_every_row_and_page(cache: Path, tmp_path: Path) -> None:
    spec = load_generated_spec("beam-tiny")
    record = measured(spec, tmp_path)
    assert record is not None
    run = run_small(["linear-fem", "fem-coarse"], tmp_path / "out", cache)
    assert {row.discretisation_error_m for row in run.rows} == {record["error_m"]}
    assert {row.discretisation_rel_l2 for row in run.rows} == {record["relative_l2_median"]}
    stored = json.loads((tmp_path / "out" / "results.json").read_text())["rows"]
    assert {row["discretisation_error_m"] for row in stored} == {record["error_m"]}
    assert (run.table["discretisation_error_m"] == record["error_m"]).all()
    assert str(record["error_m"]) in (tmp_path / "out" / "results.csv").read_text()
    page = render(run)[-1].read_text(encoding="utf-8")
    assert page.count(f"<td>{record['error_m']:.1e}</td>") >= len(run.rows)
    assert "is not evidence about the real body" in page


@pytest.mark.slow
def test_a_changed_dataset_has_no_discretisation_error_until_it_is_measured(
    changed: DatasetSpec, tmp_path: Path
) -> None:
    content = changed.model_dump(mode="json")
    arguments: dict[str, Any] = {
        "methods": ["linear-fem"],
        "cache": tmp_path / "cache",
        "workers": 1,
        "limit": LIMIT,
        "out": tmp_path / "out",
    }
    with short_timing():
        before = mor_bench.run([content], **arguments)
        record = refine(content, RefinementPlan(2, 1), cache=tmp_path / "cache")
        after = mor_bench.run([content], **arguments)
    assert [row.discretisation_error_m for row in before.rows] == [None]
    assert [row.discretisation_error_m for row in after.rows] == [record["error_m"]]
    assert [
        row.discretisation_error_m for row in mor_bench.Comparison.read(tmp_path / "out").rows
    ] == [record["error_m"]]


@pytest.mark.parametrize(
    "damage",
    [
        "",
        "{}",
        '{"format": "mor-bench discretisation error", "schema_version": 1, "digest": "x", '
        '"error_m": "nan"}',
    ],
)
def test_a_damaged_record_gives_an_error_that_names_it(
    changed: DatasetSpec, tmp_path: Path, damage: str
) -> None:
    refine(changed, RefinementPlan(1, 1), cache=tmp_path)
    path = next(tmp_path.rglob("discretisation.json"))
    path.write_text(damage)
    with pytest.raises(StoreError, match=r"discretisation\.json: damaged"):
        measured(changed, tmp_path)


def test_bad_arguments_give_an_error_of_one_clear_line(tmp_path: Path) -> None:
    for arguments, message in (
        ({"levels": 0}, r"`levels` must be an integer in \[1, 10\]; got 0\."),
        (
            {"n_loads": 0},
            r"`loads` must be an integer in \[1, 21\], the number of load patches of beam-tiny; "
            r"got 0\.",
        ),
        ({"n_loads": 22}, r"got 22\."),
        (
            {"max_dofs": 974},
            r"`max_dofs` must be at least 975, the number of unknowns of the first refinement of "
            r"beam-tiny; got 974\.",
        ),
    ):
        with pytest.raises(InvalidInputError, match=message):
            refine("beam-tiny", RefinementPlan(**arguments), cache=tmp_path)
    with pytest.raises(SpecError, match="unknown dataset 'beam-tini'; did you mean 'beam-tiny'"):
        refine("beam-tini", cache=tmp_path)
    assert not list(tmp_path.iterdir())
