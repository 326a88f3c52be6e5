"""Bases: exact and randomised, by rank and by energy, Euclidean and in an inner product."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import InvalidInputError, RankDeficientWarning
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction import basis
from mor_bench.reduction.basis import SOLVED, Basis, accurate_modes, pod, remembering
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.pod import PODGalerkin

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def stiffness(tiny: Dataset) -> Any:
    model = FullOrderModel(tiny.scene)
    return model.assembler.pattern.symmetric(model.rest_tangent)


@pytest.fixture(params=["exact", "randomised"])
def route(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "randomised":
        monkeypatch.setattr(basis, "RANDOMISED_FROM", 1)
        monkeypatch.setattr(basis, "RANDOMISED_SHARE", 1)
    return str(request.param)


def decaying(n_samples: int, n: int, rank: int, decades: float) -> Array:
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.normal(size=(size, rank)))[0] for size in (n_samples, n))
    return np.asarray(left * 10.0 ** -np.linspace(0, decades, rank) @ right.T)


def off_identity(modes: Array, product: Any = None) -> float:
    images = modes if product is None else product @ modes
    return float(np.linalg.norm(modes.T @ images - np.eye(modes.shape[1])))


def left_over(snapshots: Array, modes: Array, product: Any = None) -> float:
    """Return the norm of the projection error of the snapshots on orthonormal modes."""
    product = sp.eye_array(snapshots.shape[1]) if product is None else product
    rest = snapshots - (product @ snapshots.T).T @ modes @ modes.T
    return float(np.sqrt(np.vdot(rest, (product @ rest.T).T)))


def springs(n: int) -> Any:
    """Return the stiffness of springs in series that differ by eight decades: condition 2e11."""
    sizes = sp.diags_array(10.0 ** np.random.default_rng(0).uniform(-4, 4, n + 1))
    ends = np.array([np.ones(n), -np.ones(n)])
    stretches = sp.diags_array(ends, offsets=[0, -1], shape=(n + 1, n))
    return sp.csr_array(stretches.T @ sizes @ stretches)


@pytest.mark.parametrize(
    ("shape", "decades", "weighted"),
    [((300, 500), 11, False), ((700, 400), 11, False), ((300, 400), 6, True)],
)
def test_200_modes_are_orthonormal_in_any_inner_product(
    route: str, shape: tuple[int, int], decades: float, weighted: bool
) -> None:
    product = springs(shape[1]) if weighted else None
    modes = pod(decaying(*shape, 250, decades), 200, inner_product=product).modes
    assert modes.shape[1] == 200
    assert off_identity(modes, product) <= 1e-12


@pytest.mark.parametrize("weighted", [False, True])
def test_no_other_basis_has_a_smaller_projection_error(
    route: str, weighted: bool, tiny: Dataset, stiffness: Any
) -> None:
    snapshots, product = tiny.train.free_displacements, stiffness if weighted else None
    found = pod(snapshots, 10, inner_product=product)
    # The singular values are the same in coordinates that make the inner product Euclidean.
    root = np.linalg.cholesky(stiffness.toarray()) if weighted else np.eye(snapshots.shape[1])
    values = np.linalg.svd(snapshots @ root, compute_uv=False)
    accuracy = 1e-3 if route == "randomised" else 1e-9
    np.testing.assert_allclose(found.singular_values[:10], values[:10], rtol=accuracy)
    left = left_over(snapshots, found.modes, product)
    assert left == pytest.approx(np.linalg.norm(values[10:]), rel=accuracy)


def test_the_randomised_basis_is_close_to_the_exact_one_and_repeatable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    snapshots = decaying(640, 720, 400, 12)
    exact = {r: pod(snapshots, r) for r in (10, 40, 80)}
    monkeypatch.setattr(basis, "RANDOMISED_FROM", 1)
    monkeypatch.setattr(basis, "RANDOMISED_SHARE", 1)
    for r, best in exact.items():
        found, half = pod(snapshots, r), r // 2
        least = left_over(snapshots, best.modes)
        assert least * (1 - 1e-9) <= left_over(snapshots, found.modes) <= least * (1 + 1e-3)
        values = best.singular_values
        np.testing.assert_allclose(found.singular_values[:half], values[:half], rtol=1e-6)
        leading = best.modes[:, :half]
        assert np.linalg.norm(leading - found.modes @ (found.modes.T @ leading), 2) <= 1e-3
        np.testing.assert_array_equal(pod(snapshots, r).modes, found.modes)


@pytest.mark.parametrize(("tolerance", "decades"), [(0.3, 8), (1e-2, 8), (1e-4, 8), (0.6, 0.5)])
def test_the_energy_tolerance_decides_the_number_of_modes(
    route: str, tolerance: float, decades: float
) -> None:
    snapshots = decaying(400, 300, 200, decades)
    values = np.linalg.svd(snapshots, compute_uv=False)
    shares = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] / (values**2).sum())
    n_modes = pod(snapshots, energy_tolerance=tolerance).modes.shape[1]
    assert n_modes == int((shares > tolerance).sum())


def by_energy(found: Basis, tolerance: float) -> int:
    squares = found.singular_values**2
    return int((np.cumsum(squares[::-1])[::-1] > tolerance**2 * squares.sum()).sum())


def test_a_large_matrix_gets_a_randomised_decomposition_if_few_modes_are_requested(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    snapshots = decaying(400, 700, 390, 6)
    exact = pod(snapshots)
    monkeypatch.setattr(basis, "RANDOMISED_FROM", 400)
    monkeypatch.setattr(basis, "RANDOMISED_SHARE", 4)
    assert len(exact.singular_values) == 400
    assert len(pod(snapshots, 100).singular_values) == 100
    assert len(pod(snapshots, 101).singular_values) == 400  # too many to pay off
    assert len(pod(snapshots, energy_tolerance=0.5).singular_values) < 64
    many = pod(snapshots, energy_tolerance=1e-3)
    assert len(many.singular_values) == 400  # the search needed too many directions
    assert many.modes.shape[1] == by_energy(exact, 1e-3)


def test_a_cached_decomposition_equals_a_fresh_one(tiny: Dataset, stiffness: Any) -> None:
    snapshots = tiny.train.free_displacements
    fresh = {r: pod(snapshots, r).modes for r in (30, 10)}
    with remembering():
        for r, modes in fresh.items():
            np.testing.assert_array_equal(pod(snapshots.copy(), r).modes, modes)
        assert off_identity(pod(snapshots, 10, inner_product=stiffness).modes, stiffness) <= 1e-12
        doubled = pod(-2 * snapshots[:50], 10).singular_values
        np.testing.assert_array_equal(doubled, 2 * pod(snapshots[:50], 10).singular_values)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kind", ["duplicates", "one", "with zeros", "r above the rank"])
def test_a_basis_has_at_most_the_rank_of_its_snapshots(
    kind: str, route: str, weighted: bool, tiny: Dataset, stiffness: Any
) -> None:
    snapshots = tiny.train.free_displacements
    chosen, rank = {
        "duplicates": (np.repeat(snapshots[:4], 5, axis=0), 4),
        "one": (snapshots[:1], 1),
        "with zeros": (np.vstack([snapshots[:3], np.zeros((30, snapshots.shape[1]))]), 3),
        "r above the rank": (snapshots[:6], 6),
    }[kind]
    product = stiffness if weighted else None
    said = f"20 modes were requested, but the {len(chosen)} samples have rank {rank}"
    with pytest.warns(RankDeficientWarning, match=said):
        modes = pod(chosen, 20, inner_product=product).modes
    assert modes.shape[1] == rank
    assert off_identity(modes, product) <= 1e-12
    assert pod(chosen, inner_product=product).modes.shape[1] == rank


def test_bad_snapshots_and_options_are_refused(tiny: Dataset, stiffness: Any) -> None:
    good = tiny.train.free_displacements[:40]
    nan, infinity = good.copy(), good.copy()
    nan[30, 3], infinity[30, 3] = np.nan, np.inf
    few: dict[str, Any] = {"n_modes": 5}
    wrong: list[tuple[str, Any, dict[str, Any]]] = [
        ("NaN", nan, few),
        ("infinity", infinity, few),
        ("all zero", 0 * good, few),
        ("shape", good[0][None, None], few),
        ("real", good.astype(complex), few),
        ("not both", good, {"n_modes": 5, "energy_tolerance": 0.1}),
        ("`n_modes`", good, {"n_modes": 0}),
        ("`energy_tolerance`", good, {"energy_tolerance": 1.0}),
        ("`energy_tolerance`", good, {"energy_tolerance": np.nan}),
        ("`inner_product` must have shape", good, few | {"inner_product": stiffness[:10, :10]}),
        ("not positive definite", good, few | {"inner_product": -stiffness}),
    ]
    for said, snapshots, options in wrong:
        with pytest.raises(InvalidInputError, match=said):
            pod(snapshots, **options)


def test_single_precision_snapshots_have_the_rank_of_single_precision(tiny: Dataset) -> None:
    snapshots: Any = tiny.train.free_displacements.astype(np.float32)
    modes = pod(snapshots, 40).modes
    assert modes.dtype == np.float64
    assert off_identity(modes) <= 1e-12
    with pytest.warns(RankDeficientWarning, match="rank 4"):
        assert pod(np.repeat(snapshots[:4], 5, axis=0), 20).modes.shape[1] == 4


def test_bases_of_the_same_span_predict_the_same_in_any_inner_product(tiny: Dataset) -> None:
    few = tiny.train[:12]  # with as many modes as samples, both bases span the samples
    plain, weighted = (
        PODGalerkin(12, 1e-12, inner_product=product).fit(tiny.scene, few)
        for product in ("euclidean", "stiffness")
    )
    apart = np.abs(plain.predict(few.forces) - weighted.predict(few.forces)).max()
    assert apart <= 1e-8 * np.abs(few.displacements).max()
    assert np.abs(weighted.problem_.rest_tangent - np.eye(12)).max() <= 1e-9
    scaled = GalerkinProblem(plain.problem_.assembler, 1e3 * plain.modes_)
    assert scaled.extent == pytest.approx(1e-3 * plain.problem_.extent)


def test_a_method_can_choose_its_modes_by_energy(tiny: Dataset) -> None:
    fitted = PODGalerkin("energy", energy_tolerance=1e-2).fit(tiny.scene, tiny.train)
    assert fitted.modes_.shape[1] == by_energy(pod(tiny.train.free_displacements), 1e-2)
    for wrong in (PODGalerkin("energy"), PODGalerkin(5, energy_tolerance=1e-2)):
        with pytest.raises(InvalidInputError, match="`energy_tolerance` of PODGalerkin must be"):
            wrong.fit(tiny.scene, tiny.train)


def test_modes_of_the_error_of_the_solver_are_left_out() -> None:
    generator = np.random.default_rng(0)
    exact = generator.normal(size=(40, 3)) @ generator.normal(size=(3, 60))
    snapshots = exact + 0.1 * SOLVED * generator.normal(size=exact.shape)
    assert pod(snapshots, 10).modes.shape == (60, 10)
    with pytest.warns(RankDeficientWarning, match="10 modes were requested, but the samples det"):
        modes = accurate_modes(snapshots, 10)
    np.testing.assert_allclose(modes, pod(snapshots, 3).modes, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(accurate_modes(snapshots, 2), pod(snapshots, 2).modes)


def test_a_mode_a_little_above_the_error_of_the_solver_is_left_out() -> None:
    """That error turns it too far: on the artery, such a sixth mode made `hpod` err by 3.7 %."""
    directions = np.linalg.qr(np.random.default_rng(0).normal(size=(60, 4)))[0].T
    snapshots = np.diag([1.0, 1e-3, 20 * SOLVED, 2 * SOLVED]) @ directions
    with pytest.warns(RankDeficientWarning, match="the samples determine 3"):
        assert accurate_modes(snapshots, 4).shape == (60, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameters", "percent"),
    [
        ("hpod", {}, 1.0),
        ("hpod", {"static_correction": True}, 0.1),
        ("ecm", {}, 0.1),
        ("deim", {}, 0.1),
    ],
)
def test_a_cubature_is_accurate_where_samples_determine_few_modes(
    name: str, parameters: dict[str, Any], percent: float
) -> None:
    """Two pressures determine four modes; with ten, the error of `hpod` was 72 %."""
    data = mor_bench.load_dataset("artery-pressure", 60)
    method = mor_bench.load_method(name, n_modes=10, **parameters)
    with pytest.warns(RankDeficientWarning, match="the error of the solver"):
        method.fit(data.scene, data.train)
    found = sample_errors(method.predict(data.test.forces), data.test.displacements)
    assert 100 * float(np.median(found.relative_l2)) < percent
