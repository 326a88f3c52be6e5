"""The reduced energy of Saint Venant-Kirchhoff as a polynomial equals quadrature over the mesh."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mor_bench
from mor_bench.counting import counted
from mor_bench.errors import InvalidInputError, SolverError, UnsupportedSceneError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.reduction.tensors import (
    ReducedTensors,
    TensorProblem,
    reduce_energy,
    triangular_pairs,
)
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.pod import PODGalerkin
from mor_bench.surrogates.pod_tensor import TensorPOD

KINDS: dict[str, dict[str, Any]] = {
    "H8": {},
    "H8, selective": {"discretisation": {"integration": "selective"}},
    "T4": {"discretisation": {"element": "tetrahedron"}},
    "T10": {"discretisation": {"element": "tetrahedron", "order": 2}},
    "auxetic": {"material": {"law": "saint-venant-kirchhoff", "young_pa": 500.0, "poisson": -0.3}},
    "auxetic, selective": {
        "material": {"law": "saint-venant-kirchhoff", "young_pa": 500.0, "poisson": -0.3},
        "discretisation": {"integration": "selective"},
    },
}


def scene_of(kind: str) -> Scene:
    spec = mor_bench.load_scene("beam-tiny").spec.model_dump(mode="json", exclude_none=True)
    return mor_bench.load_scene({**spec, **KINDS[kind]})


def problems(scene: Scene, r: int = 6) -> tuple[GalerkinProblem, TensorProblem]:
    """The same reduced model by quadrature and by its polynomial, on a random basis."""
    model = FullOrderModel(scene)
    modes = np.linalg.qr(np.random.default_rng(1).normal(size=(model.n_unknowns, r)))[0]
    samples = 0.1 * np.random.default_rng(2).normal(size=(40, r))
    galerkin = GalerkinProblem(model.assembler, modes)
    return galerkin, TensorProblem.of_modes(model, modes, samples)


@pytest.mark.parametrize("kind", KINDS)
def test_energy_force_and_tangent_equal_those_of_the_mesh(kind: str) -> None:
    galerkin, tensor = problems(scene_of(kind))
    # The general kernel has no energy of inverted states.
    for size in (0.01, 0.1, *([3.0] if kind == "H8" else [])):
        q = size * np.random.default_rng(3).normal(size=6)
        (expected, stiffness), (state, tangent) = galerkin.linearise(q), tensor.linearise(q)
        assert state.energy_j == pytest.approx(expected.energy_j, rel=1e-12)
        np.testing.assert_allclose(
            state.force, expected.force, rtol=0, atol=1e-12 * np.abs(expected.force).max()
        )
        np.testing.assert_allclose(tangent, stiffness, rtol=0, atol=1e-12 * np.abs(stiffness).max())


def test_derivatives_are_symmetric_in_all_indices() -> None:
    tensors = problems(scene_of("H8"), 4)[1].tensors
    i, j = triangular_pairs(4)
    cubic, quartic = np.empty((4,) * 3), np.empty((4,) * 4)
    for a, b in ((i, j), (j, i)):
        cubic[a, b] = tensors.cubic
        for c, d in ((i, j), (j, i)):
            quartic[a[:, None], b[:, None], c, d] = tensors.quartic
    for tensor in (tensors.quadratic, cubic, quartic):
        for order in permutations(range(tensor.ndim)):
            np.testing.assert_allclose(
                tensor, tensor.transpose(order), rtol=0, atol=1e-12 * np.abs(tensor).max()
            )


def test_the_leading_modes_have_the_leading_entries_of_the_arrays() -> None:
    large = problems(scene_of("H8"), 6)[1].tensors
    scene = scene_of("H8")
    model = FullOrderModel(scene)
    modes = np.linalg.qr(np.random.default_rng(1).normal(size=(model.n_unknowns, 6)))[0][:, :3]
    small = reduce_energy(model, modes)
    np.testing.assert_allclose(
        small.quartic, large.quartic[:6, :6], rtol=0, atol=1e-12 * np.abs(small.quartic).max()
    )


@pytest.fixture(scope="module")
def coarse(cache: Path) -> Dataset:
    return mor_bench.load_dataset("beam-coarse", limit=320, cache=cache)


@pytest.mark.parametrize("r", [1, 10, 30])
def test_predictions_equal_those_of_plain_pod(coarse: Dataset, r: int) -> None:
    plain, exact = (
        method(r, tolerance=1e-12).fit(coarse.scene, coarse.train).predict(coarse.test.forces[:10])
        for method in (PODGalerkin, TensorPOD)
    )
    assert np.abs(exact - plain).max() <= 1e-10 * np.abs(plain).max()


def test_the_monitored_points_find_the_smallest_det_f_of_training_samples(coarse: Dataset) -> None:
    method = TensorPOD(20).fit(coarse.scene, coarse.train)
    model = FullOrderModel(coarse.scene)
    chosen = np.unique(np.linspace(0, len(coarse.train) - 1, 300).astype(int))
    for u in coarse.train.free_displacements[chosen[::7]]:
        q = u @ method.modes_
        assert method.problem_.min_det_f(q) == pytest.approx(
            model.force(method.modes_ @ q).min_det_f, abs=0.02
        )
    assert len(method.problem_.sentinels) <= 64


@pytest.mark.parametrize("r", [20, pytest.param(40, marks=pytest.mark.slow)])
def test_an_inverted_prediction_is_refused(coarse: Dataset, r: int) -> None:
    """Loads far beyond the range invert cells, which the energy alone would accept."""
    method = TensorPOD(r, tolerance=1e-6).fit(coarse.scene, coarse.train)
    plain = PODGalerkin(r, tolerance=1e-6).fit(coarse.scene, coarse.train)
    model = FullOrderModel(coarse.scene)
    refused = 0
    for force in coarse.test.forces[:20]:
        try:
            u = method.predict(1000.0 * force)
        except SolverError:
            refused += 1
            with pytest.raises(SolverError):
                plain.predict(1000.0 * force)
            continue
        assert model.force(u.ravel()[coarse.scene.free_dofs]).min_det_f > 0
    assert refused > 0


def test_the_cost_of_a_query_does_not_depend_on_the_mesh(coarse: Dataset) -> None:
    """The counted work is the same on beam-fine, which has 18 times the unknowns."""
    counts = []
    fine = mor_bench.load_scene("beam-fine")
    for scene in (coarse.scene, fine):
        galerkin, tensor = problems(scene, 5)
        load = 0.01 * galerkin.rest_tangent @ np.ones(5)
        with counted() as cost:
            assert tensor.quick(load, 1e-6) is not None
        counts.append((cost.multiply_adds - tensor.sentinels.size) / max(1, cost.factorisations))
        assert cost.element_evaluations == 0
    assert counts[0] == counts[1]


def test_other_laws_are_refused_with_the_reason(tiny: Dataset) -> None:
    spec = tiny.scene.spec.model_dump(mode="json", exclude_none=True)
    scene = mor_bench.load_scene({**spec, "material": {**spec["material"], "law": "neo-hookean"}})
    with pytest.raises(UnsupportedSceneError, match="this law is neo-hookean"):
        TensorPOD().fit(scene, tiny.train)


@pytest.mark.parametrize("bad", ["shape", "nan", "indefinite"])
def test_arrays_of_a_damaged_model_are_refused(bad: str) -> None:
    tensors = problems(scene_of("H8"), 3)[1].tensors
    changed: dict[str, ReducedTensors] = {
        "shape": replace(tensors, cubic=tensors.cubic[:2]),
        "nan": replace(tensors, quartic=tensors.quartic * np.nan),
        "indefinite": replace(tensors, quadratic=-tensors.quadratic),
    }
    with pytest.raises(InvalidInputError):
        TensorProblem(changed[bad], np.zeros((0, 9, 3)), np.ones(1), 1.0)
