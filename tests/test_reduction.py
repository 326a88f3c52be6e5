"""Galerkin projection and its cubature against the full-order model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mor_bench
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.basis import pod
from mor_bench.reduction.cubature import ecsw_system
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.monomials import Monomials, monomial_indices
from mor_bench.surrogates.pod import PODGalerkin


@pytest.fixture(scope="module")
def coarse(cache: Path) -> Dataset:
    return mor_bench.load_dataset("beam-coarse", limit=320, cache=cache)


def test_projected_force_and_tangent_match_the_full_order_model(coarse: Dataset) -> None:
    model = FullOrderModel(coarse.scene)
    modes = pod(coarse.train.free_displacements, 12).modes
    problem = GalerkinProblem(model.assembler, modes)
    q = coarse.train.free_displacements[5] @ modes
    state, tangent = problem.linearise(q)
    np.testing.assert_allclose(
        state.force, modes.T @ model.force(modes @ q).force, rtol=1e-12, atol=1e-14
    )
    np.testing.assert_allclose(tangent, tangent.T, atol=1e-12 * np.abs(tangent).max())
    h = 1e-6 * np.random.default_rng(0).normal(size=12)
    difference = problem.force(q + h).force - problem.force(q - h).force
    np.testing.assert_allclose(
        2 * tangent @ h, difference, rtol=1e-6, atol=1e-8 * np.abs(difference).max()
    )


def test_galerkin_energy_is_never_below_the_full_order_energy_and_approaches_it(
    coarse: Dataset,
) -> None:
    model = FullOrderModel(coarse.scene)
    forces, exact = coarse.test.free_forces[:20], coarse.test.free_displacements[:20]
    gaps = []
    for r in (3, 10, 40):
        method = PODGalerkin(r, tolerance=1e-10).fit(coarse.scene, coarse.train)
        reduced = method.predict(coarse.test.forces[:20]).reshape(20, -1)[:, coarse.scene.free_dofs]
        gap = [
            model.force(v).energy_j - f @ v - model.force(u).energy_j + f @ u
            for u, v, f in zip(exact, reduced, forces, strict=True)
        ]
        assert min(gap) >= -1e-12
        gaps.append(np.mean(gap))
    assert gaps[0] > gaps[1] > gaps[2]


def test_ecsw_with_every_cell_is_plain_pod(coarse: Dataset) -> None:
    plain = PODGalerkin(10).fit(coarse.scene, coarse.train).predict(coarse.test.forces[:10])
    whole = HyperReducedPOD(10, cubature_tolerance=0.0).fit(coarse.scene, coarse.train)
    assert len(whole.cells_) == coarse.scene.mesh.n_cells
    assert (
        np.abs(whole.predict(coarse.test.forces[:10]) - plain).max() <= 1e-10 * np.abs(plain).max()
    )


def test_ecsw_keeps_few_cells_and_stays_close_to_pod(coarse: Dataset) -> None:
    reference = coarse.test.displacements
    plain = PODGalerkin(10).fit(coarse.scene, coarse.train)
    reduced = HyperReducedPOD(10, sampling="cells").fit(coarse.scene, coarse.train)
    errors = [
        np.abs(method.predict(coarse.test.forces) - reference).mean() for method in (plain, reduced)
    ]
    assert errors[1] <= 1.2 * errors[0]
    assert len(reduced.cells_) < 0.6 * coarse.scene.mesh.n_cells
    assert (reduced.weights_ > 0).all()
    assert reduced.problem_.points.n_points == 8 * len(reduced.cells_)


def test_the_compressed_training_system_equals_the_whole_one(coarse: Dataset) -> None:
    model = FullOrderModel(coarse.scene)
    modes = pod(coarse.train.free_displacements, 4).modes
    q = coarse.train.free_displacements[:50] @ modes
    system = ecsw_system(model.assembler, model.cell_dofs, modes, q)
    rows = np.array([modes.T @ model.force(modes @ coordinates).force for coordinates in q]).ravel()
    assert np.linalg.norm(system.sum(axis=1)) == pytest.approx(np.linalg.norm(rows), rel=1e-10)
    weights = np.random.default_rng(0).random(135)
    padded = np.vstack([modes, np.zeros(4)])
    whole = np.concatenate(
        [
            np.einsum("eir,ei->re", padded[model.cell_dofs], model.assembler.cell_forces(modes @ c))
            for c in q
        ]
    )
    assert np.linalg.norm(system @ weights - system.sum(axis=1)) == pytest.approx(
        np.linalg.norm(whole @ weights - rows), rel=1e-10
    )


def test_monomials_include_every_product_up_to_their_degree() -> None:
    z = np.random.default_rng(0).normal(size=(3, 4))
    values = Monomials(4, monomial_indices(4, 3))(z)
    assert values.shape == (3, 4 + 10 + 20)
    expected = {
        *np.round(z[0], 12),
        *(round(z[0, i] * z[0, j], 12) for i in range(4) for j in range(4)),
        *(
            round(z[0, i] * z[0, j] * z[0, k], 12)
            for i in range(4)
            for j in range(4)
            for k in range(4)
        ),
    }
    assert {*np.round(values[0], 12)} == expected


def test_pca_regression_predicts_forces_outside_the_load_region(tiny: Dataset) -> None:
    method = mor_bench.load_method("pca-regression-linear").fit(tiny.scene, tiny.train)
    forces = np.zeros((tiny.scene.mesh.n_nodes, 3))
    forces[tiny.scene.mesh.points[:, 2] == 0.0] = [0.0, 0.0, 1e-4]
    linear = mor_bench.load_method("linear-fem").fit(tiny.scene, None).predict(forces)
    np.testing.assert_allclose(method.predict(forces), linear, atol=0.02 * np.abs(linear).max())
