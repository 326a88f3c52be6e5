"""Scenes that an instrument presses: their files, samples, and what every method makes of them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError, SpecError, UnavailableBackendError
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.measure.reaction_errors import ReactionErrors
from mor_bench.mechanics.contact import ContactModel
from mor_bench.mechanics.moved_bodies import ToolForces
from mor_bench.report.scene_text import scene_text
from mor_bench.report.suite_overview import dataset_family
from mor_bench.runs.file_check import check_file
from mor_bench.scene.symmetry import mirrors
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.snapshots.sampling import draw_loads
from mor_bench.snapshots.test_sets import available_sets, spec_of_set, why_not
from mor_bench.specs import CONTACT, load_generated_spec
from tests.suite_methods import SPECS, cheap_method
from tests.verification.pressed_blocks import BALL, FLAT, block, content

LOADS: dict[str, Any] = {"spread_deg": 40.0, "samples": 60, "sampling": "sobol", "seed": 3}


@pytest.fixture(scope="module")
def data(cache: Path) -> Dataset:
    """A small block, pressed by a ball in all directions of a cone."""
    geometry = {"shape": "box", "size_m": [1.0, 1.0, 0.5], "cells": [3, 3, 2]}
    return mor_bench.load_dataset(content(geometry=geometry, loads=LOADS), cache=cache, workers=1)


@pytest.mark.parametrize(
    ("loads", "message"),
    [
        ({"instrument": {"ball": {}}}, r"unknown key `loads\.instrument\.ball`"),
        ({"instrument": {"sphere": {"radius_m": 1.0}}}, "`loads.instrument.sphere.centre_m`"),
        ({"instrument": {**BALL, **FLAT}}, r"unknown key `loads\.instrument\.sphere`"),
        ({"direction": [0, 0, 0]}, r"`loads\.direction`: the largest component must be in"),
        ({"spread_deg": 200.0}, r"`loads\.spread_deg` must be less than or equal to 180"),
        ({"magnitude_m": [0.1, 0.1]}, "must be a range where `spread_deg` is 0"),
        ({"penalty_n_m3": -1.0}, r"`loads\.penalty_n_m3` must be greater than 0"),
        ({"magnitude_n": [0.0, 1.0]}, "did you mean 'magnitude_m'"),
        ({"region": "top"}, r"`loads\.region`"),
        ({"region": {"box_m": [[0, 0, 0.4], [0.1, 0.1, 0.6]]}}, "no facet of the surface"),
    ],
)
def test_bad_plans_are_refused(loads: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        block(loads=loads)


def test_all_mistakes_are_reported_at_once() -> None:
    plane = {"plane": {"point_m": [0.0, 0.0], "normal": [0.0, 0.0, 0.0]}}
    loads = {"instrument": plane, "spread_deg": -1.0, "direction": [0.0, 0.0, 0.0]}
    with pytest.raises(SpecError) as found:
        block(loads=loads)
    for key in ("plane.point_m", "plane.normal", "spread_deg", "direction"):
        assert f"loads.{'instrument.' * ('plane' in key)}{key}" in str(found.value)
    inside = {"sphere": {"radius_m": 0.1, "centre_m": [0.5, 0.5, 0.55]}}
    with pytest.raises(SpecError) as found:
        block(inside, needs={"outputs": {"sphere_m": [[9.0, 9.0, 9.0], 1.0]}})
    assert "must not penetrate `loads.region` at rest; it does, by 0.05 m" in str(found.value)
    assert "`loads.instrument.sphere.radius_m` must be at least 0.125" in str(found.value)
    assert "holds no node of the mesh" in str(found.value)
    assert str(found.value).count("penetrate") == 1


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"split": {"by": "region"}}, "`split.by` must be 'sample' or 'direction'"),
        ({"observed": {"region": "z-max"}}, "the methods get the displacement of `loads.instr"),
        ({"tests": {"unseen_region": "z-max"}}, "`tests.unseen_region` must be absent"),
        (
            {
                "loads": {
                    "magnitude_m": [0.0, 0.2],
                    "instrument": {"sphere": {"radius_m": 0.4, "centre_m": [0.5, 0.5, 1.2]}},
                }
            },
            "is 0.3 m away from it and moves by",
        ),
        (
            {
                "supports": [{"region": "z-min"}, {"region": "surface", "components": ["x"]}],
                "loads": {"spread_deg": 10.0},
            },
            "moves along x, but the supports hold this component",
        ),
    ],
)
def test_contradictions_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        block(**changed)


def test_an_instrument_must_not_penetrate_the_body_at_rest_under_gravity() -> None:
    up = {"density_kg_m3": 10.0, "acceleration_m_s2": [0.0, 0.0, 9.81]}
    with pytest.raises(SpecError, match="must not penetrate the body at rest under its pre-load"):
        ContactModel(block(gravity=up))


def test_motions_fill_a_cone() -> None:
    axis = np.array([0.6, 0.0, -0.8])
    for sampling in ("random", "latin-hypercube", "sobol"):
        loads = {"direction": (3 * axis).tolist(), "spread_deg": 60.0, "sampling": sampling}
        scene = block(loads={**loads, "samples": 512})
        drawn = draw_loads(scene, 0, 512)
        assert not drawn.patches.any()
        vectors = drawn.vectors[:, 0]
        size = np.linalg.norm(vectors, axis=1)
        assert 0.01 <= size.min() < 0.02 < 0.14 < size.max() <= 0.15
        cosine = vectors @ axis / size
        # Uniform on the sphere: the height is uniform.
        assert 0.5 <= cosine.min() < 0.51
        assert abs(cosine.mean() - 0.75) < 0.02
        across = vectors / size[:, None] - cosine[:, None] * axis
        assert np.abs(across.mean(axis=0)).max() < 0.05
        np.testing.assert_array_equal(draw_loads(scene, 7, 9).vectors, drawn.vectors[7:9])
    straight = draw_loads(block(), 0, 5).vectors[:, 0]
    assert not straight[:, :2].any()
    assert (straight[:, 2] < 0).all()


def test_methods_get_the_motion_of_the_instrument(data: Dataset) -> None:
    scene, test = data.scene, data.test
    given, nodes = test.given, scene.observed_nodes
    assert isinstance(given, ObservedDisplacements)
    assert nodes is not None
    np.testing.assert_array_equal(nodes, np.flatnonzero(scene.mesh.points[:, 2] == 0.5))
    assert (given.values[:, nodes] == test.loads.vectors).all()
    assert not np.delete(given.values, nodes, axis=1).any()
    assert np.abs(given.values[:, nodes] - test.displacements[:, nodes]).max() > 0.01
    assert data.n_refused == 0
    model = ContactModel(scene)
    for i in range(len(test)):
        placed = model.under(test.loads.vectors[i, 0])
        reaction = placed.reaction(test.free_displacements[i])
        force = float(np.linalg.norm(reaction))
        np.testing.assert_allclose(test.forces[i].sum(axis=0), -reaction, atol=1e-6 * force)
    assert not mirrors(scene)


def test_the_error_of_the_reaction_is_that_of_its_resultant(data: Dataset) -> None:
    reference = data.test.displacements
    own = ToolForces(data.scene)(data.test.free_displacements).sum(axis=1)
    errors = ReactionErrors(data.scene)
    assert not errors(reference, reference).any()
    part = 0.9 * data.test.free_displacements
    forces = ToolForces(data.scene)(part).sum(axis=1)
    expected = np.linalg.norm(forces - own, axis=1) / np.linalg.norm(own, axis=1)
    np.testing.assert_allclose(errors(0.9 * reference, reference), expected)


def test_test_sets_and_texts(data: Dataset) -> None:
    spec = data.scene.generated
    assert available_sets(spec) == ["in-range", "2x", "4x"]
    assert spec_of_set(spec, "2x").load_plan.magnitude == (0.02, 0.3)
    assert "those of an instrument" in str(why_not(spec, "unseen-directions"))
    assert "no forces on patches" in str(why_not(spec, "several-forces"))
    text = scene_text(spec.model_dump(mode="json"))
    assert "with a rigid sphere that touches z-max without friction and moves by 0.01 to" in text
    assert "rigid plane" in scene_text(content(FLAT))
    assert dataset_family(spec) == "boxes of hexahedra, pressed by an instrument"


FILE = """title = "Block under a plane"
[geometry]
shape = "box"
size_m = [1.0, 1.0, 0.5]
cells = [2, 2, 1]
[material]
law = "neo-hookean"
young_pa = 500.0
poisson = 0.3
[[supports]]
region = "z-min"
[loads]
kind = "contact"
region = "z-max"
instrument = { plane = { point_m = [0.0, 0.0, 0.5], normal = [0.0, 0.0, -1.0] } }
direction = [0.0, 0.0, -1.0]
magnitude_m = [0.0, 0.1]
samples = 10
[split]
by = "sample"
"""


def test_a_file_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "pressed.toml"
    shipped = load_generated_spec("liver-pressed").model_dump(mode="json")
    assert shipped["loads"]["kind"] == "contact"
    path.write_text(FILE, encoding="utf-8")
    assert check_file(path) == "dataset, 4 cells, 18 nodes, 9 nodes to touch, 10 samples"


def test_a_check_finds_an_instrument_in_the_rest_state(tmp_path: Path) -> None:
    path = tmp_path / "heavy.toml"
    up = "acceleration_m_s2 = [0.0, 0.0, 9.81]"
    path.write_text(f"{FILE}[gravity]\ndensity_kg_m3 = 10.0\n{up}\n", encoding="utf-8")
    with pytest.raises(SpecError, match="at rest under its pre-load"):
        check_file(path)


@pytest.mark.slow
def test_other_scenes_do_not_load_the_contact() -> None:
    script = """
import sys
import mor_bench.mechanics.observed, mor_bench.surrogates.fem, mor_bench.surrogates.hpod
import mor_bench.surrogates.linear_fem, mor_bench.surrogates.pod
sys.exit(any("contact" in name.rpartition(".")[2] and "mechanics" in name for name in sys.modules))
"""
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


QUICK = sorted(
    {
        spec.surrogate: name
        for name, spec in reversed(SPECS.items())
        if "iterations" not in {*spec.parameters, *spec.battery.parameters}
    }.values()
)
"""One method of each class that does not train."""

REFUSED = {"gappy-pod": "the motion of an instrument", "pod-tensor": "this law is neo-hookean"}
"""Reasons other than `CONTACT`."""

TAKEN = {"fem", "linear-fem", "pod", "hpod", "ecm", "pca-regression-linear"}
"""Methods that must not refuse."""


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_method_is_right_or_refuses(data: Dataset, name: str) -> None:
    method, scene = cheap_method(name, observed=True), data.scene
    if reason := method.supports(scene):
        assert name not in TAKEN
        assert REFUSED.get(name, CONTACT) in reason
        return
    method.fit(scene, data.train if method.needs_snapshots else None)
    found, reference = method.predict(data.train.given), data.train.displacements
    assert not found.reshape(len(found), -1)[:, scene.fixed_dofs].any()
    rest = data.train.given.with_values(np.zeros((scene.mesh.n_nodes, 3)))
    assert not method.predict(rest).any()
    none = sample_errors(np.zeros_like(reference), reference).mean_dof_m.mean()
    assert sample_errors(found, reference).mean_dof_m.mean() < 0.3 * none


def test_pod_and_its_cubature_answer_as_the_full_order_model(data: Dataset) -> None:
    reference, errors = data.test.displacements, []
    for name, chosen in (
        ("pod", {"n_modes": 5}),
        ("pod", {"n_modes": 30}),
        ("hpod", {"n_modes": 30, "cubature_tolerance": 1e-3}),
    ):
        method = mor_bench.load_method(name, **chosen).fit(data.scene, data.train)
        found = sample_errors(method.predict(data.test.given), reference)
        errors.append(float(np.median(found.relative_l2)))
    assert errors[1] < 0.2 * errors[0]
    assert errors[1] < 0.03
    assert errors[2] < 1.5 * errors[1] + 0.01


@pytest.mark.slow
def test_a_network_learns_from_the_response_and_has_no_onnx(data: Dataset, tmp_path: Path) -> None:
    method = mor_bench.load_method("umesh-linear", iterations=3).fit(data.scene, data.train)
    assert np.isfinite(method.predict(data.test.given)).all()
    with pytest.raises(UnavailableBackendError, match="is not linear"):
        method.onnx_model()


def test_a_query_of_forces_is_refused(data: Dataset) -> None:
    method = mor_bench.load_method("fem").fit(data.scene)
    with pytest.raises(InvalidInputError, match="a query must be displacements"):
        method.predict(np.zeros((data.scene.mesh.n_nodes, 3)))
