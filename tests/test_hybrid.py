"""Predictions of other methods, corrected by the full-order model, and indicated errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import spearmanr

import mor_bench
from mor_bench.errors import InvalidInputError, SolverError, SpecError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.hybrid import Hybrid
from tests.relative_errors import relative_l2


def error(method: Surrogate, data: Dataset, n: int = 40) -> float:
    found = method.predict(data.test.forces[:n])
    return float(relative_l2(found, data.test.displacements[:n]).mean())


@pytest.mark.parametrize("start", ["linear-fem", "pod-tensor"])
def test_each_correction_lowers_the_error(coarse: Dataset, start: str) -> None:
    errors = [error(mor_bench.load_method(start).fit(coarse.scene, coarse.train), coarse)]
    for steps in (1, 2, 4):
        errors.append(error(Hybrid(start, steps=steps).fit(coarse.scene, coarse.train), coarse))
        assert errors[-1] < 0.7 * errors[-2]
    assert errors[-1] < 1e-3


def test_a_tolerance_is_met(coarse: Dataset) -> None:
    method = Hybrid("pod-tensor", {"n_modes": 10}, tolerance=1e-6).fit(coarse.scene, coarse.train)
    model, free = FullOrderModel(coarse.scene), coarse.scene.free_dofs
    for force in coarse.test.forces[:20]:
        load = force.ravel()[free]
        u = method.predict(force).ravel()[free]
        assert np.linalg.norm(load - model.force(u).force) <= 1e-6 * np.linalg.norm(load)


class Nonsense(Surrogate):
    """Turns the body inside out."""

    needs_snapshots = False

    def answer(self, forces: np.ndarray) -> np.ndarray:
        return np.broadcast_to(-2.0 * self.scene_.mesh.points, forces.shape).copy()


def test_a_nonsense_start_costs_time_but_gives_the_right_answer(
    coarse: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Hybrid, "unfitted_start", lambda self: Nonsense())
    for knobs in ({"steps": 1}, {"tolerance": 1e-8}):
        assert error(Hybrid(**knobs).fit(coarse.scene, coarse.train), coarse, 10) < 1e-6


def test_wrong_hyperparameters_are_refused(coarse: Dataset) -> None:
    with pytest.raises(SpecError, match="n_mode"):
        Hybrid(start_parameters={"n_mode": 3}, steps=1).fit(coarse.scene, coarse.train)
    with pytest.raises(SpecError):
        Hybrid("pod-tenser", steps=1).fit(coarse.scene, coarse.train)
    with pytest.raises(InvalidInputError, match="`steps` and `tolerance` cannot be used together"):
        Hybrid(steps=1, tolerance=1e-2).fit(coarse.scene, coarse.train)


def test_sizes_chosen_for_the_start_are_saved_with_the_model(
    coarse: Dataset, tmp_path: Path
) -> None:
    method = Hybrid("pod-tensor", {"n_modes": 3, "tolerance": "auto"}, steps=1).fit(
        coarse.scene, coarse.train
    )
    method.save(tmp_path / "model.safetensors")
    again = mor_bench.load_surrogate(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(
        again.predict(coarse.test.forces[:2]), method.predict(coarse.test.forces[:2])
    )


@pytest.mark.parametrize("name", ["linear-fem", "pca-regression-linear"])
def test_indicated_errors_agree_with_measured_ones(coarse: Dataset, name: str) -> None:
    """The correction estimates the error itself; the residual alone does not even rank errors."""
    method = mor_bench.load_method(name).fit(coarse.scene, coarse.train)
    forces = coarse.test.forces[:60]
    predicted = method.predict(forces)
    measured = relative_l2(predicted, coarse.test.displacements[:60])
    indicated = method.indicate_error(forces, predicted)
    assert spearmanr(measured, indicated.relative_correction)[0] > 0.95
    assert 0.9 < np.median(indicated.relative_correction / measured) < 1.1
    single = method.indicate_error(forces[3], predicted[3])
    assert single.relative_correction[0] == indicated.relative_correction[3]


def test_the_indicated_error_vanishes_at_an_equilibrium_and_is_infinite_without_a_prediction(
    coarse: Dataset,
) -> None:
    fem = mor_bench.load_method("fem", tolerance=1e-10).fit(coarse.scene, None)
    force = coarse.test.forces[:2]
    exact = fem.indicate_error(force, fem.predict(force))
    assert (exact.relative_residual <= 1e-10).all()
    assert (exact.relative_correction <= 1e-7).all()
    missing = fem.indicate_error(force, np.full(force.shape, np.nan))
    assert np.isinf(missing.relative_correction).all()
    rest = fem.indicate_error(np.zeros_like(force), np.zeros_like(force))
    assert (rest.relative_correction == 0).all()
    assert fem.indicate_error(force[:0], force[:0]).relative_correction.shape == (0,)
    with pytest.raises(InvalidInputError, match="`displacements` must be floats"):
        fem.indicate_error(force, np.zeros((3, 3)))


def test_moved_supports_count_as_errors_and_missing_nodes_are_refused(coarse: Dataset) -> None:
    fem = mor_bench.load_method("fem").fit(coarse.scene, None)
    force = coarse.test.forces[:1]
    moved = fem.predict(force)
    moved[:, coarse.scene.fixed_nodes] = 0.5
    assert fem.indicate_error(force, moved).relative_correction[0] > 1.0
    needs = coarse.scene.spec.needs.model_copy(update={"outputs": "x-max"})
    scene = replace(coarse.scene, spec=coarse.scene.spec.model_copy(update={"needs": needs}))
    part = mor_bench.load_method("pod-tensor", n_modes=5).fit(scene, coarse.train)
    with pytest.raises(InvalidInputError, match="at all nodes"):
        part.indicate_error(force, part.predict(force))


@pytest.mark.slow
def test_inverted_predictions_are_never_returned(coarse: Dataset) -> None:
    """Under loads far beyond the range, det F is positive at all quadrature points."""
    method = Hybrid("linear-fem", steps=1).fit(coarse.scene, coarse.train)
    model, free, answered = FullOrderModel(coarse.scene), coarse.scene.free_dofs, 0
    for force in coarse.test.forces[:20]:
        for size in (20.0, 200.0):
            try:
                u = method.predict(size * force)
            except SolverError:
                continue
            assert model.force(u.ravel()[free]).min_det_f > 0
            answered += 1
    assert answered > 0
