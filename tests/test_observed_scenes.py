"""Scenes with observed displacements: their samples, refusals, and equilibria."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import (
    SpecError,
)
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.mechanics.observed import ObservedModel
from mor_bench.snapshots.dataset import Dataset
from mor_bench.snapshots.generate import dataset_folder
from mor_bench.snapshots.given import ObservedDisplacements
from mor_bench.specs import load_generated_spec
from tests.observed_scenes import TOP, scene_of, written


@pytest.fixture(scope="module")
def data(tiny: Dataset, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """beam-tiny, loaded on its top face, with the displacements of that face instead of forces."""
    return mor_bench.load_dataset(written(tmp_path_factory.mktemp("observed"), TOP), cache=cache)


def test_the_samples_equal_those_of_the_scene_without_the_option(
    data: Dataset, tiny: Dataset, cache: Path
) -> None:
    assert data.scene.spec.digest() == tiny.scene.spec.digest()
    assert not list((cache / "datasets").glob("beam-tiny-observed*"))
    for part, plain in ((data.train, tiny.train), (data.test, tiny.test)):
        np.testing.assert_array_equal(part.displacements, plain.displacements)
        np.testing.assert_array_equal(part.forces, plain.forces)
    nodes = data.scene.observed_nodes
    assert nodes is not None
    top = np.flatnonzero((data.scene.mesh.points[:, 2] == 1.0) & (data.scene.mesh.points[:, 0] > 0))
    np.testing.assert_array_equal(nodes, top)
    given = data.test.given
    assert isinstance(given, ObservedDisplacements)
    np.testing.assert_array_equal(given.nodes, nodes)
    np.testing.assert_array_equal(given.values[:, nodes], data.test.displacements[:, nodes])
    assert not np.delete(given.values, nodes, axis=1).any()
    assert tiny.scene.observed_nodes is None
    assert tiny.test.given.query is tiny.test.forces


def test_shared_samples_keep_the_manifest_of_the_dataset_that_made_them(
    tmp_path: Path,
) -> None:
    cache = tmp_path / "cache"
    tiny = mor_bench.load_dataset("beam-tiny", cache=cache, workers=1)
    data = mor_bench.load_dataset(written(tmp_path, TOP), cache=cache)
    assert isinstance(tiny.scene.spec, type(data.scene.generated))
    folder = dataset_folder(data.scene.generated, cache)
    assert folder == dataset_folder(tiny.scene.spec, cache)
    spec = json.loads((folder / "manifest.json").read_bytes())["spec"]
    assert spec["name"] == "beam-tiny"
    assert "observed" not in spec


def test_the_shipped_dataset_shares_the_samples_of_the_liver() -> None:
    observed, plain = load_generated_spec("liver-hex-observed"), load_generated_spec("liver-hex")
    assert observed.digest() == plain.digest()
    assert (observed.split, observed.tests, observed.needs) == (
        plain.split,
        plain.tests,
        plain.needs,
    )


@pytest.mark.parametrize(
    ("observed", "message"),
    [
        ({}, r"key `observed.region` is missing"),
        ({"region": "top"}, r"`observed.region` must be"),
        ({"regoin": "z-max"}, r"unknown key `observed.regoin`; did you mean 'region'\?"),
        ({"region": {"sphere_m": [[9.0, 9.0, 9.0], 1.0]}}, "holds no node of the mesh"),
        ({"region": "x-min"}, "no node that lies on the surface and is free to move"),
        (
            {"region": {"sphere_m": [[1.0, 0.5, 0.5], 0.1]}},
            "no node that lies on the surface and is free to move",
        ),
    ],
)
def test_a_table_that_observes_nothing_is_refused(observed: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        scene_of(observed)


def test_a_scene_with_nothing_hidden_is_refused() -> None:
    geometry = {"shape": "box", "size_m": [2.0, 1.0, 1.0], "cells": [6, 1, 1]}
    with pytest.raises(
        SpecError, match="every node that is free to move: no displacement is left to compute"
    ):
        scene_of({"region": "surface"}, geometry=geometry)


@pytest.mark.parametrize("region", ["z-max", "surface"])
@pytest.mark.parametrize("solver", [None, "rotated-pcg", "cholesky", "jacobi-pcg"])
def test_fem_finds_the_equilibrium_if_every_loaded_node_is_observed(
    region: str, solver: Any, tiny: Dataset
) -> None:
    scene = scene_of({"region": region})
    model = ObservedModel(scene, solver)
    largest = np.abs(tiny.test.free_displacements).max(axis=1).argsort()[-3:]
    known = tiny.test.free_displacements[largest]
    noise = np.random.default_rng(0).normal(size=known.shape)
    nodes = scene.observed_nodes
    assert nodes is not None
    hidden = np.flatnonzero(~np.isin(scene.free_dofs // 3, nodes))
    given = known.copy()
    given[:, hidden] = noise[:, hidden]  # ignored
    linear = model.linear_response(given)
    for found, response, wanted in zip(model.solve_many(given), linear, known, strict=True):
        assert not isinstance(found, Exception)
        assert np.linalg.norm(response - wanted) > 1e-3 * np.linalg.norm(wanted)
        assert np.linalg.norm(found.displacement - wanted) <= 1e-7 * np.linalg.norm(wanted)
        assert found.min_det_f > 0


def test_the_linear_extension_is_linear_elasticity(tiny: Dataset) -> None:
    """If all loaded nodes are observed, the linear extension is the linear response."""
    scene = scene_of({"region": "z-max"})
    response = FullOrderModel(tiny.scene).rest_factor.solve(tiny.test.free_forces[:5].T).T
    model = ObservedModel(scene)
    np.testing.assert_allclose(
        model.linear_response(response), response, rtol=0, atol=1e-10 * np.abs(response).max()
    )
    axes = np.random.default_rng(0).normal(size=(len(scene.free_dofs), 4))
    coordinates = response @ model.to_coordinates(axes)[scene.free_dofs]
    np.testing.assert_allclose(
        coordinates, response @ axes, rtol=0, atol=1e-10 * np.abs(coordinates).max()
    )


def test_large_displacements_are_reached_in_increments() -> None:
    """The tip turns by half a circle, too far for a start from the linear response."""
    scene = scene_of(
        {"region": "x-max"}, material={"law": "neo-hookean", "young_pa": 500.0, "poisson": 0.4}
    )
    x = scene.mesh.points
    seen = np.zeros(x.shape)
    angle, centre = np.pi, np.array([2.0, 0.5, 0.5])
    turn = np.array(
        [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    )
    tip = x[:, 0] == 2.0
    seen[tip] = (x[tip] - centre) @ (turn - np.eye(3)).T
    model = ObservedModel(scene)
    found = model.solve_many(seen.ravel()[scene.free_dofs][None])[0]
    assert not isinstance(found, Exception)
    assert found.cuts > 0
    assert found.min_det_f > 0.5
    force = FullOrderModel(scene).force(found.displacement).force.reshape(-1, 3)
    held = tip[scene.free_dofs[::3] // 3]
    assert np.linalg.norm(force[~held]) <= 1e-6 * np.linalg.norm(force[held])
