"""Several tables of loads at once: sums, equilibrium, independent draws, methods, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mor_bench.errors import SpecError
from mor_bench.measure.discretisation_error import RefinementPlan, refine
from mor_bench.mechanics.reactions import reaction_forces
from mor_bench.method_loading import load_method
from mor_bench.report.scene_text import scene_text
from mor_bench.runs.file_check import check_file
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import load_dataset
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.snapshots.test_sets import available_sets, spec_of_set
from mor_bench.specs import DatasetSpec, tables_of

from .oblique import solved
from .test_points_and_lines import LINE, POINT, content

PRESSURE: dict[str, Any] = {
    "kind": "pressure",
    "regions": ["x-max", "y-max"],
    "magnitude_pa": [0.0, 8.0],
    "samples": 20,
}
FORCE: dict[str, Any] = {
    "kind": "normal",
    "region": "z-max",
    "patch_area_m2": 0.2,
    "magnitude_n": [0.5, 3.0],
    "samples": 20,
}
TABLES = [PRESSURE, FORCE, LINE]


def together(*tables: dict[str, Any], **changed: Any) -> Scene:
    return load_scene(content(loads=list(tables), **changed))


def test_forces_of_all_tables_are_added() -> None:
    scene = together(*TABLES)
    drawn = draw_loads(scene, 0, 20)
    assert drawn.patches.shape == (20, 8)  # two regions with three components, a patch and a line
    forces = drawn.nodal_forces(scene.patch_weights)
    expected = np.zeros_like(forces)
    for table in tables_of(scene.generated.load_plan):
        alone = load_scene(content(loads=table.model_dump()))
        expected += draw_loads(alone, 0, 20).nodal_forces(alone.patch_weights)
    np.testing.assert_allclose(forces, expected, atol=1e-14)
    np.testing.assert_array_equal(draw_loads(scene, 7, 9).vectors, drawn.vectors[7:9])


def test_the_first_table_has_the_draws_that_it_has_alone() -> None:
    alone, scene = load_scene(content(loads=PRESSURE)), together(*TABLES)
    first = draw_loads(scene, 0, 20)
    np.testing.assert_array_equal(first.vectors[:, :6], draw_loads(alone, 0, 20).vectors)
    single = together(PRESSURE)
    assert single.spec.digest() == alone.spec.digest()


@pytest.mark.parametrize("sampling", ["random", "latin-hypercube", "sobol"])
def test_tables_with_the_same_seed_have_independent_draws(sampling: str) -> None:
    tables = [{**POINT, "sampling": sampling, "samples": 400} for _ in range(2)]
    vectors = draw_loads(together(*tables), 0, 400).vectors
    assert not (vectors[:, 0] == vectors[:, 1]).any()
    centred = vectors.reshape(400, 6) - vectors.reshape(400, 6).mean(axis=0)
    centred /= np.linalg.norm(centred, axis=0)
    assert np.abs(centred[:, :3].T @ centred[:, 3:]).max() < 0.2


def test_the_supports_balance_the_sum() -> None:
    scene = together(*TABLES)
    forces = draw_loads(scene, 2, 3).nodal_forces(scene.patch_weights)
    u = solved(scene, forces)[0]
    acting = reaction_forces(scene, u, forces[0]) + forces[0]
    size = float(np.abs(forces).sum())
    np.testing.assert_allclose(acting.sum(axis=0), 0.0, atol=1e-10 * size)
    moment = np.cross(scene.mesh.points + u, acting).sum(axis=0)
    np.testing.assert_allclose(moment, 0.0, atol=2e-10 * size)


def test_points_of_patches_give_the_nodal_weights() -> None:
    scene = together(*TABLES)
    chosen = np.array([len(scene.patch_nodes) - 1, 4, 0, 9, 30])
    points, shares = scene.patch_points(chosen)
    expected = scene.patch_weights[chosen]
    np.testing.assert_allclose(shares.sum(axis=1), expected.sum(axis=1), atol=1e-12)
    at_nodes = np.asarray(expected @ scene.mesh.points)
    np.testing.assert_allclose(np.asarray(shares @ points), at_nodes, atol=1e-12)


def test_datasets_are_generated_and_learned(tmp_path: Path) -> None:
    size = {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [4, 2, 2]}
    spec = together(PRESSURE, FORCE, geometry=size).generated
    data = load_dataset(spec, workers=1, cache=tmp_path, tests=["2x"])
    assert len(data.train) + len(data.validation) + len(data.test) == 20
    assert isinstance(data.train.loads, PatchLoads)
    u = solved(data.scene, data.test.forces)
    np.testing.assert_allclose(data.test.displacements, u, atol=1e-6 * np.abs(u).max())
    for name in ("fem", "pod", "pca-regression-linear", "modal-derivatives", "quadratic-manifold"):
        parameters = {"tolerance": 1e-10} if name == "fem" else {}
        method = load_method(name, **parameters).fit(data.scene, data.train)
        error = np.linalg.norm(method.predict(data.test.forces) - u) / np.linalg.norm(u)
        assert error < (1e-8 if name == "fem" else 0.2)
    reason = load_method("pgd-snapshots").supports(data.scene)
    assert reason is not None
    assert "several act at once" in reason
    assert len(data.tests["2x"]) > 0
    assert {"in-range", "2x", "4x"} == set(available_sets(spec))
    doubled = tables_of(spec_of_set(spec, "2x").load_plan)
    assert [table.magnitude for table in doubled] == [(0.0, 16.0), (1.0, 6.0)]


def test_the_discretisation_error_can_be_measured(tmp_path: Path) -> None:
    size = {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [4, 2, 2]}
    spec = together(PRESSURE, FORCE, geometry=size).generated
    found = refine(spec, RefinementPlan(n_loads=2, levels=1), cache=tmp_path)
    assert all(0.0 < load["relative_l2"] < 0.5 for load in found["loads"])


def test_a_file_names_its_tables(tmp_path: Path) -> None:
    path = tmp_path / "cantilever.toml"
    path.write_text(
        """
title = "Cantilever"
supports = [{ region = "x-min" }]
split = { by = "sample" }

[geometry]
shape = "box"
size_m = [2.0, 1.0, 1.0]
cells = [4, 2, 2]

[material]
law = "neo-hookean"
young_pa = 500.0
poisson = 0.3

[[loads]]
kind = "pressure"
regions = ["x-max"]
magnitude_pa = [0.0, 8.0]
samples = 20

[[loads]]
kind = "point"
region = "z-max"
magnitude_n = [0.0, 1.0]
samples = 20
""",
        encoding="utf-8",
    )
    assert "2 tables of loads, 20 samples" in check_file(path)
    text = scene_text(load_scene(path).spec.model_dump(mode="json"))
    assert "dead pressures of 0 to 8 Pa on x-max, and one dead force" in text


FOLLOWING = {**PRESSURE, "follower": True}
TOOL = {"kind": "displacement", "region": "x-max", "magnitude_m": [0.0, 0.1], "samples": 20}


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ([FORCE, TOOL], "cannot combine the kinds 'displacement' and 'normal'"),
        ([TOOL, FORCE], "cannot combine the kinds 'displacement' and 'normal'"),
        ([FOLLOWING, POINT], "cannot combine the kinds 'follower pressure' and 'point'"),
        ([FOLLOWING, FOLLOWING], "cannot combine the kinds 'follower pressure' and 'follower"),
        ([PRESSURE, {**FORCE, "samples": 30}], "the same `samples`; got 20, 30"),
        (
            [
                PRESSURE,
                {k: v for k, v in FORCE.items() if k != "samples"} | {"samples_per_patch": 2},
            ],
            "the same `samples`; got 20, none",
        ),
        ([PRESSURE, {**FORCE, "steps": 2}], "the same `steps`; got 1, 2"),
        ([TOOL, {**FORCE, "samples": 30}], "cannot combine .*; .* the same `samples`; got 20, 30"),
        ([], r"`loads"),
        (
            [{**PRESSURE, "samples": 0}, {**FORCE, "magnitude_n": [2.0, 1.0]}],
            r"`loads\[0\].samples` must be .*`loads\[1\].magnitude_n`: the lower bound",
        ),
        ([PRESSURE, {**FORCE, "kind": "x"}], r"`loads\[1\].kind` must be 'force'"),
    ],
)
def test_wrong_tables_are_refused(tables: list[dict[str, Any]], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        together(*tables)


def test_several_tables_are_split_by_sample() -> None:
    assert DatasetSpec.model_validate(content(loads=TABLES)).split.by == "sample"
    with pytest.raises(SpecError, match=r"`split.by` must be 'sample' with several tables"):
        together(PRESSURE, FORCE, split={"by": "region"})
