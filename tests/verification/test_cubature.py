"""Cubature: non-negative least squares, empirical cubature and interpolation."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import nnls

from mor_bench.errors import InvalidInputError
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.basis import pod
from mor_bench.reduction.cubature import (
    ActiveColumns,
    CubatureError,
    SparseWeights,
    ecsw_system,
    sparse_nnls,
)
from mor_bench.reduction.discrete_interpolation import Selection, interpolation_rows
from mor_bench.reduction.empirical_cubature import cell_basis, empirical_cubature
from mor_bench.snapshots.dataset import Dataset

Array = NDArray[np.float64]
KINDS = ["plain", "duplicated columns", "badly scaled columns", "zero columns"]


def optimality(matrix: Array, target: Array, x: Array) -> tuple[float, float, float]:
    """Return residual, and largest gradients on positive and on zero weights, all relative."""
    residual, size = target - matrix @ x, np.linalg.norm(target)
    norms = np.linalg.norm(matrix, axis=0)
    gradient = matrix.T @ residual / np.where(norms > 0, norms, 1.0) / size
    passive = x > 0
    return (
        float(np.linalg.norm(residual) / size),
        float(np.abs(gradient[passive]).max(initial=0.0)),
        float(gradient[~passive].max(initial=0.0)),
    )


def hard_matrix(kind: str) -> Array:
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(60, 200)) + 0.5
    if kind == "duplicated columns":
        matrix[:, 100:] = matrix[:, :100]
    if kind == "badly scaled columns":
        matrix *= 10.0 ** rng.uniform(-8, 8, 200)
    if kind == "zero columns":
        matrix[:, ::3] = 0.0
    return matrix


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-8])
def test_nnls_of_hard_columns_meets_its_optimality_conditions(kind: str, tolerance: float) -> None:
    matrix = hard_matrix(kind)
    target = matrix @ np.random.default_rng(2).uniform(0.5, 1.5, 200)
    found = sparse_nnls(matrix, target, tolerance)
    residual, passive, dual = optimality(matrix, target, found.weights)
    assert (found.weights >= 0).all()
    assert residual <= tolerance * (1 + 1e-9)
    assert passive <= 1e-10
    assert (found.relative_residual, found.passive_gradient, found.dual_gradient) == pytest.approx(
        (residual, passive, dual), rel=1e-9, abs=1e-16
    )
    assert (found.weights[~matrix.any(axis=0)] == 0).all()
    assert (found.weights > 0).sum() <= 60


@pytest.mark.parametrize("kind", KINDS)
def test_converged_nnls_meets_all_optimality_conditions(kind: str) -> None:
    """The target cannot be reached; the solution of SciPy has the same residual."""
    matrix, rng = hard_matrix(kind)[:, :40], np.random.default_rng(3)
    matrix[:, 30:] = matrix[:, :10] if kind == "duplicated columns" else matrix[:, 30:]
    target = rng.normal(size=60)
    found = sparse_nnls(matrix, target, 0.0)
    residual, passive, dual = optimality(matrix, target, found.weights)
    norms = np.linalg.norm(matrix, axis=0)
    assert residual == pytest.approx(
        nnls(matrix / np.where(norms > 0, norms, 1.0), target)[1] / np.linalg.norm(target),
        rel=1e-10,
    )
    assert (found.weights >= 0).all()
    assert max(passive, dual) <= 1e-10
    assert 0.1 < residual < 1


@pytest.mark.parametrize("tolerance", [1e-3, 0.0])
def test_nnls_with_too_few_iterations_raises(tolerance: float) -> None:
    matrix = np.random.default_rng(0).random((30, 50))
    with pytest.raises(CubatureError, match="in 1 iterations"):
        sparse_nnls(matrix, matrix.sum(axis=1), tolerance, max_iterations=1)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nnls_refuses_what_is_not_finite(bad: float) -> None:
    matrix = np.ones((3, 4))
    spoilt = matrix.copy()
    spoilt[1, 2] = bad
    with pytest.raises(InvalidInputError, match="NaN or infinity"):
        sparse_nnls(spoilt, np.ones(3), 1e-3)
    with pytest.raises(InvalidInputError, match="NaN or infinity"):
        sparse_nnls(matrix, np.array([1.0, bad, 1.0]), 1e-3)


def test_nnls_of_a_zero_target_has_zero_weights() -> None:
    found = sparse_nnls(np.ones((3, 4)), np.zeros(3), 1e-3)
    nothing = SparseWeights(np.zeros(4), 0.0, 0.0, 0.0, 0)
    assert asdict(found) | {"weights": None} == asdict(nothing) | {"weights": None}
    assert not found.weights.any()


def test_the_updated_factor_remains_the_factor_of_its_columns() -> None:
    """The test makes 600 changes to some of 300 nearly dependent columns."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(120, 60)) @ rng.normal(size=(60, 300)) + 1e-4 * rng.normal(
        size=(120, 300)
    )
    target = rng.normal(size=120)
    columns = ActiveColumns(matrix, target)
    for _ in range(600):
        if columns.chosen and (len(columns.chosen) > 100 or rng.random() < 0.4):
            columns.remove(int(rng.choice(columns.chosen)))
        else:
            columns.append(int(rng.choice(np.setdiff1d(np.arange(300), columns.chosen))))
    assert len(columns.chosen) > 30

    def off() -> float:
        return float(
            np.abs(columns.gradient(columns.residual(columns.coefficients()))[columns.chosen]).max()
        )

    updated = off()
    columns.refactor()
    assert updated <= 10 * off() <= 1e-8


def test_compressing_blocks_of_rows_keeps_the_least_squares_problem(tiny: Dataset) -> None:
    model = FullOrderModel(tiny.scene)
    modes = pod(tiny.train.free_displacements, 4).modes
    q = tiny.train.free_displacements[:90] @ modes
    arguments = model.assembler, model.cell_dofs, modes, q
    whole = np.concatenate([ecsw_system(*arguments[:3], q[i : i + 10]) for i in range(0, 90, 10)])
    assert whole.shape == (360, 24)
    weights = np.random.default_rng(0).random(24)
    for compressed in (ecsw_system(*arguments), ecsw_system(*arguments, max_entries=1)):
        assert len(compressed) <= 2 * 24 + 4
        for x in (weights, weights - 1, np.ones(24)):
            assert np.linalg.norm(compressed @ x) == pytest.approx(
                np.linalg.norm(whole @ x), rel=1e-12
            )


def test_the_cell_basis_meets_its_tolerance_and_is_close_to_the_smallest() -> None:
    rng = np.random.default_rng(0)
    matrix = (
        rng.normal(size=(400, 150))
        * 10.0 ** -np.linspace(0, 8, 150)
        @ np.linalg.qr(rng.normal(size=(150, 150)))[0]
    )
    values = np.linalg.svd(matrix, compute_uv=False)
    tails = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1])
    for tolerance in (1e-1, 1e-2, 1e-4):
        basis = cell_basis(matrix, tolerance)
        assert np.linalg.norm(basis.T @ basis - np.eye(basis.shape[1])) <= 1e-12
        assert np.linalg.norm(matrix - matrix @ basis @ basis.T) <= tolerance * np.linalg.norm(
            matrix
        ) * (1 + 1e-6)
        assert basis.shape[1] <= int((tails > tolerance * np.linalg.norm(matrix)).sum()) + 3


@pytest.mark.parametrize("tolerance", [0.3, 1e-2, 1e-3])
def test_empirical_cubature_integrates_its_basis_and_the_constant(
    tiny: Dataset, tolerance: float
) -> None:
    model = FullOrderModel(tiny.scene)
    modes = pod(tiny.train.free_displacements, 3).modes
    system = ecsw_system(
        model.assembler, model.cell_dofs, modes, tiny.train.free_displacements[:60] @ modes
    )
    found = empirical_cubature(system, tolerance)
    basis = cell_basis(system, tolerance)
    np.testing.assert_allclose(basis.T @ found.weights, basis.sum(axis=0), atol=1e-7 * np.sqrt(24))
    assert found.weights.sum() == pytest.approx(24, rel=1e-7)
    assert (found.weights >= 0).all()
    assert (found.weights > 0).sum() <= basis.shape[1] + 1
    missed = system @ (found.weights - 1)
    assert np.linalg.norm(missed) <= tolerance * np.linalg.norm(system) * np.linalg.norm(
        found.weights - 1
    ) * (1 + 1e-6)
    with pytest.raises(CubatureError, match="in 1 iterations"):
        empirical_cubature(system, tolerance, max_iterations=1)


@pytest.mark.parametrize("selection", ["greedy", "pivoted-qr"])
def test_interpolation_is_exact_in_the_basis_and_at_its_rows(selection: Selection) -> None:
    rng = np.random.default_rng(0)
    x = np.linspace(-1, 1, 200)
    basis = np.linalg.qr(np.vander(x, 12, increasing=True))[0]
    rows = interpolation_rows(basis, selection)
    assert len(set(rows.tolist())) == 12
    lift = basis @ np.linalg.inv(basis[rows])
    inside = basis @ rng.normal(size=12)
    np.testing.assert_allclose(lift @ inside[rows], inside, atol=1e-12)
    other = np.exp(3 * x)
    np.testing.assert_allclose((lift @ other[rows])[rows], other[rows], rtol=1e-12)
    # The error is at most ‖(PᵀU)⁻¹‖ times that of the projection; the rows keep that factor small.
    factor = np.linalg.norm(np.linalg.inv(basis[rows]), 2)
    best = np.linalg.norm(other - basis @ basis.T @ other)
    assert np.linalg.norm(lift @ other[rows] - other) <= factor * best * (1 + 1e-9)
    scattered = [
        np.linalg.norm(np.linalg.inv(basis[rng.choice(200, 12, replace=False)]), 2)
        for _ in range(20)
    ]
    assert factor < 0.2 * min(scattered)


def test_greedy_rows_of_a_small_basis_match_hand_computed_ones() -> None:
    basis = np.array([[1.0, 1.0], [2.0, 0.0], [0.0, -3.0]])
    # With row 1 alone, the interpolation of the second column is zero.
    assert interpolation_rows(basis, "greedy").tolist() == [1, 2]
    with pytest.raises(InvalidInputError, match="3 rows cannot have 4"):
        interpolation_rows(np.ones((3, 4)), "greedy")


@pytest.mark.parametrize("rank", [30, 100])
def test_the_cell_basis_of_a_matrix_of_low_rank_is_complete_and_orthonormal(rank: int) -> None:
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(900, rank)) @ rng.normal(size=(rank, 300))
    basis = cell_basis(matrix, 1e-9)
    assert basis.shape[1] == rank
    assert np.linalg.norm(basis.T @ basis - np.eye(rank)) <= 1e-12
    assert np.linalg.norm(matrix - matrix @ basis @ basis.T) <= 1e-9 * np.linalg.norm(matrix)


@pytest.mark.parametrize("seed", [31, 120, 220])
def test_nnls_removes_negative_weights_until_none_is_left(seed: int) -> None:
    """With these matrices a removal makes another weight negative."""
    rng = np.random.default_rng(seed)
    matrix, target = rng.normal(size=(8, 14)), rng.normal(size=8)
    found = sparse_nnls(matrix, target, 0.0)
    assert (found.weights >= 0).all()
    assert found.relative_residual * np.linalg.norm(target) == pytest.approx(
        nnls(matrix, target)[1]
    )
