"""Projection on curved manifolds: derivatives, the flat case, equilibria, and the cubature."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.learning.network_map import NetworkMap
from mor_bench.reduction.curved import CoordinateMap, CurvedLoad, CurvedProblem, QuadraticMap
from mor_bench.reduction.derivative_modes import pairs
from mor_bench.snapshots.dataset import Dataset
from mor_bench.specs import load_generated_spec
from mor_bench.surrogates.curved_pod import CurvedPOD
from tests.relative_errors import median_error

CHEAP = {"n_latent": 4, "n_secondary": 10, "cubature_tolerance": 0.0}
TRAINED = {"n_hidden": 8, "iterations": 150}
NAMES = {
    "quadratic-manifold-pod": CHEAP,
    "pod-ann": CHEAP | TRAINED,
    "latent-galerkin": CHEAP | TRAINED,
    "latent-lspg": CHEAP | TRAINED,
}


def quadratic_map() -> QuadraticMap:
    rng = np.random.default_rng(0)
    return QuadraticMap(3, rng.normal(size=(len(pairs(3)[0]), 5)))


def network_map(flat: bool) -> NetworkMap:
    rng = np.random.default_rng(1)
    shapes = (3, 6), (6,), (6, 6), (6,), (6, 5)
    return NetworkMap([rng.normal(size=shape) for shape in shapes], 8, flat)


MAPS: dict[str, CoordinateMap] = {
    "quadratic": quadratic_map(),
    "network": network_map(False),
    "flat network": network_map(True),
}


@pytest.mark.parametrize("name", MAPS)
def test_slopes_and_curvatures_are_derivatives_of_the_map(name: str) -> None:
    curve = MAPS[name]
    rng, h = np.random.default_rng(2), 1e-5
    q, weights = rng.normal(size=3), rng.normal(size=8)
    c, slopes = curve.at(q)
    steps = h * np.eye(3)
    differences = [(curve.at(q + s)[0] - curve.at(q - s)[0]) / (2 * h) for s in steps]
    np.testing.assert_allclose(slopes, np.transpose(differences), rtol=1e-7, atol=1e-8)
    bends = [(curve.at(q + s)[1] - curve.at(q - s)[1]).T @ weights / (2 * h) for s in steps]
    np.testing.assert_allclose(curve.curvature(q, weights), bends, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(curve.at(np.zeros(3))[0], 0.0, atol=1e-14)
    assert c.shape == (8,)


def test_a_flat_network_has_the_slope_of_the_primary_modes_at_rest() -> None:
    slopes = MAPS["flat network"].at(np.zeros(3))[1]
    np.testing.assert_allclose(slopes, np.eye(8, 3), atol=1e-12)


def flattened(method: CurvedPOD, tiny: Dataset) -> CurvedPOD:
    """Return a fitted method whose map adds nothing to the primary modes."""
    arrays = {name: array.copy() for name, array in method.arrays_.items()}
    for name in arrays:
        if name.startswith(("coefficients", "decoder")):
            arrays[name] = np.zeros_like(arrays[name])
    other: CurvedPOD = type(method)(**method.parameters)
    return other.restore(tiny.scene, arrays)


@pytest.mark.parametrize("name", ["quadratic-manifold-pod", "pod-ann", "latent-galerkin"])
def test_a_manifold_without_curvature_is_pod(name: str, tiny: Dataset) -> None:
    parameters = NAMES[name] | {"static_correction": False, "tolerance": 1e-10}
    method = mor_bench.load_method(name, **parameters).fit(tiny.scene, tiny.train)
    assert isinstance(method, CurvedPOD)
    pod = mor_bench.load_method("pod", n_modes=4, tolerance=1e-10).fit(tiny.scene, tiny.train)
    forces = tiny.test.forces[:5]
    expected = pod.predict(forces)
    found = flattened(method, tiny).predict(forces)
    assert np.abs(found - expected).max() <= 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize("name", ["quadratic-manifold-pod", "pod-ann", "latent-galerkin"])
def test_the_answer_is_a_minimum_of_the_potential_on_the_manifold(name: str, tiny: Dataset) -> None:
    parameters = NAMES[name] | {"static_correction": False, "tolerance": 1e-10}
    method = mor_bench.load_method(name, **parameters).fit(tiny.scene, tiny.train)
    assert isinstance(method, CurvedPOD)
    force = tiny.test.free_forces[3]
    projected = method.space_.T @ force
    load = CurvedLoad(projected, method.curved_.slope.T @ projected, np.zeros(len(method.rows_)))
    q, problem = method.solve(load), CurvedProblem(method.curved_, load)

    def potential(at: np.ndarray) -> float:
        state = problem.force(at)
        return state.energy_j - float(load.at_rest @ at)

    rng, lowest = np.random.default_rng(0), potential(q)
    for direction in rng.normal(size=(20, len(q))):
        step = 1e-2 * np.linalg.norm(q) * direction / np.linalg.norm(direction)
        assert potential(q + step) > lowest
    # Force and tangent are derivatives of this potential.
    h, other = 1e-6 * np.linalg.norm(q), 0.7 * q
    state, tangent = problem.linearise(other)
    for i, step in enumerate(h * np.eye(len(q))):
        after, before = problem.force(other + step), problem.force(other - step)
        slope = (after.energy_j - before.energy_j) / (2 * h)
        assert slope == pytest.approx(
            state.force[i], rel=1e-4, abs=1e-6 * np.abs(state.force).max()
        )
        bend = (after.force - before.force) / (2 * h)
        np.testing.assert_allclose(tangent[i], bend, rtol=1e-4, atol=1e-6 * np.abs(tangent).max())


@pytest.mark.parametrize("name", NAMES)
def test_the_curve_lowers_the_error_of_the_flat_space(name: str, tiny: Dataset) -> None:
    parameters = NAMES[name] | {"static_correction": True}
    if "iterations" in parameters:
        parameters |= {"iterations": 1500, "n_hidden": 32}
    method = mor_bench.load_method(name, **parameters).fit(tiny.scene, tiny.train)
    assert isinstance(method, CurvedPOD)
    forces, expected = tiny.test.forces[:40], tiny.test.displacements[:40]

    def error(of: CurvedPOD) -> float:
        off = np.linalg.norm(of.predict(forces) - expected, axis=(1, 2))
        return float(np.median(off / np.linalg.norm(expected, axis=(1, 2))))

    assert error(method) < 0.8 * error(flattened(method, tiny))


def test_a_cubature_on_the_manifold_keeps_few_cells_and_the_answer(tiny: Dataset) -> None:
    whole = NAMES["quadratic-manifold-pod"]
    few = whole | {"cubature_tolerance": 0.05}
    methods = [
        mor_bench.load_method("quadratic-manifold-pod", **parameters).fit(tiny.scene, tiny.train)
        for parameters in (whole, few)
    ]
    cells = [len(method.arrays_["cells"]) for method in methods]
    assert cells[1] < cells[0] == tiny.scene.mesh.n_cells
    full, sampled = (method.predict(tiny.test.forces[:20]) for method in methods)
    off = np.linalg.norm(sampled - full, axis=(1, 2)) / np.linalg.norm(full, axis=(1, 2))
    assert np.median(off) < 0.05


@pytest.fixture(scope="module")
def one_cell(cache: Path) -> Dataset:
    spec = load_generated_spec("beam-tiny")
    geometry: Any = spec.geometry
    cell = {"geometry": geometry.model_copy(update={"cells": (1, 1, 1)})}
    return mor_bench.load_dataset(spec.model_copy(update=cell), cache=cache, workers=1)


@pytest.mark.parametrize("name", NAMES)
def test_a_body_of_one_cell_has_few_modes(name: str, one_cell: Dataset) -> None:
    cheap = {key: value for key, value in TRAINED.items() if key in NAMES[name]}
    method = mor_bench.load_method(name, n_latent=3, **cheap).fit(one_cell.scene, one_cell.train)
    assert isinstance(method, CurvedPOD)
    assert method.space_.shape == (12, 12)
    assert median_error(method, one_cell.test) < 0.01
    with pytest.raises(InvalidInputError, match="less than the rank of the snapshots, 12"):
        mor_bench.load_method(name, n_latent=20, **cheap).fit(one_cell.scene, one_cell.train)
