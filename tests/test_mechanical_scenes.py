"""Every method on scenes with further mechanics: right answers, or a clear refusal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import load_generated_spec
from tests.suite_methods import SPECS, cheap_method

SCENES: dict[str, dict[str, Any]] = {
    "rollers": {
        "supports": [
            {"region": "x-min", "components": ["x"]},
            {"region": {"box_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]}, "components": ["y"]},
            {"region": {"box_m": [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]}, "components": ["z"]},
        ]
    },
    "springs": {
        "springs": [
            {"region": "z-min", "stiffness_n_m3": 20.0, "components": ["z"]},
            {"region": "x-max", "stiffness_n_m3": 30.0},
        ],
        "gravity": {"density_kg_m3": 2.0},
    },
    "gravity": {"gravity": {"density_kg_m3": 5.0, "acceleration_m_s2": [0.5, -1.0, -2.0]}},
}
QUICK = sorted(
    {
        spec.surrogate: name
        for name, spec in reversed(SPECS.items())
        if "iterations" not in {*spec.parameters, *spec.battery.parameters} and name != "gappy-pod"
    }.values()
)
"""One method of each class that does not train and is given forces."""


@pytest.fixture(scope="module", params=list(SCENES))
def data(request: pytest.FixtureRequest, cache: Path) -> Dataset:
    spec = load_generated_spec("beam-tiny").model_dump(mode="json")
    changed = {**spec, "name": f"beam-tiny-{request.param}", **SCENES[request.param]}
    return mor_bench.load_dataset(changed, cache=cache, workers=1)


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_method_is_right_or_refuses(data: Dataset, name: str) -> None:
    method, scene = cheap_method(name), data.scene
    if reason := method.supports(scene):
        assert reason in REFUSED.get((scene.name, name), "")
        return
    method.fit(scene, data.train if method.needs_snapshots else None)
    forces, reference = data.train.forces[:40], data.train.displacements[:40]
    found = method.predict(forces)
    assert not found.reshape(len(found), -1)[:, scene.fixed_dofs].any()
    assert not method.predict(np.zeros_like(forces[0])).any()
    none = sample_errors(np.zeros_like(reference), reference).mean_dof_m.mean()
    bound = SPECS[name].battery.error
    assert sample_errors(found, reference).mean_dof_m.mean() < bound * none


@pytest.mark.slow
def test_a_network_does_not_move_held_components(data: Dataset) -> None:
    network = mor_bench.load_method("umesh-linear", iterations=3).fit(data.scene, data.train)
    found = network.predict(data.train.forces[:3]).reshape(3, -1)
    assert not found[:, data.scene.fixed_dofs].any()
    assert found[:, data.scene.free_dofs].all()


REFUSED = {
    ("beam-tiny-springs", name): "its cubature has no springs, and the scene rests on some"
    for name in (
        "quadratic-manifold",
        "quadratic-manifold-pod",
        "pod-ann",
        "latent-galerkin",
        "latent-lspg",
    )
}
"""Reason of each method that cannot take a scene."""
