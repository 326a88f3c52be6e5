"""Bases by the exact and the randomised decomposition, by rank and by energy, in the Euclidean and the stiffness inner product."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

import mor_bench
from mor_bench.errors import InvalidInputError
from mor_bench.hard_cases.reduction_cases import basis_faults
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction import basis
from mor_bench.reduction.basis import Basis, pod, pod_streamed, remembering
from mor_bench.reduction.galerkin import GalerkinProblem
from mor_bench.snapshots.dataset import Dataset
from mor_bench.surrogates.pod import PODGalerkin, stiffness_at_rest

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def coarse(cache: Path) -> Dataset:
    return mor_bench.load_dataset("beam-coarse", limit=640, cache=cache)


@pytest.fixture(scope="module")
def stiffness(coarse: Dataset) -> Any:
    return stiffness_at_rest(FullOrderModel(coarse.scene))


def in_blocks(snapshots: Array, n_modes: int | None = None, **options: Any) -> Basis:
    return pod_streamed(lambda: np.array_split(snapshots, 7), n_modes, **options)


ROUTES: dict[str, Callable[..., Basis]] = {"exact": pod, "streamed": in_blocks}


def decaying(n_samples: int, n: int, rank: int, decades: float) -> Array:
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.normal(size=(size, rank)))[0] for size in (n_samples, n))
    return np.asarray(left * 10.0 ** -np.linspace(0, decades, rank) @ right.T)


def off_identity(modes: Array, product: Any = None) -> float:
    return float(
        np.linalg.norm(
            modes.T @ (modes if product is None else product @ modes) - np.eye(modes.shape[1])
        )
    )


def left_over(snapshots: Array, modes: Array, product: Any = None) -> float:
    """What the modes leave of the snapshots, in the norm of the inner product; the modes are orthonormal in it."""
    rest = (
        snapshots - (snapshots if product is None else (product @ snapshots.T).T) @ modes @ modes.T
    )
    return float(np.sqrt(np.vdot(rest, rest if product is None else (product @ rest.T).T)))


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("shape", [(300, 500), (700, 400)])
def test_200_modes_of_fast_decay_are_orthonormal(route: str, shape: tuple[int, int]) -> None:
    assert off_identity(ROUTES[route](decaying(*shape, 250, 11), 200).modes) <= 1e-12


@pytest.mark.parametrize("route", ROUTES)
def test_200_modes_are_orthonormal_in_the_stiffness_and_best_in_its_norm(
    route: str, coarse: Dataset, stiffness: Any
) -> None:
    snapshots = coarse.train.free_displacements
    assert (
        off_identity(ROUTES[route](snapshots, 200, inner_product=stiffness).modes, stiffness)
        <= 1e-12
    )
    found = ROUTES[route](snapshots, 10, inner_product=stiffness)
    # Singular values by another way: of the snapshots in coordinates in which the inner product is Euclidean.
    values = np.linalg.svd(snapshots @ np.linalg.cholesky(stiffness.toarray()), compute_uv=False)
    np.testing.assert_allclose(
        found.singular_values[:10], values[:10], rtol=1e-3 if route == "streamed" else 1e-9
    )
    assert left_over(snapshots, found.modes, stiffness) == pytest.approx(
        np.linalg.norm(values[10:]), rel=1e-3 if route == "streamed" else 1e-9
    )


@pytest.mark.parametrize("route", ROUTES)
def test_200_modes_are_orthonormal_in_an_ill_conditioned_inner_product(route: str) -> None:
    """Springs in a row, of stiffnesses that differ by eight decades: condition number 2e11."""
    n = 400
    springs = sp.diags_array(10.0 ** np.random.default_rng(0).uniform(-4, 4, n + 1))
    stretches = sp.diags_array(
        np.array([np.ones(n), -np.ones(n)]), offsets=[0, -1], shape=(n + 1, n)
    )
    product = sp.csr_array(stretches.T @ springs @ stretches)
    assert (
        off_identity(
            ROUTES[route](decaying(300, n, 250, 6), 200, inner_product=product).modes, product
        )
        <= 1e-12
    )


def test_the_randomised_basis_is_nearly_the_exact_one(coarse: Dataset) -> None:
    snapshots = coarse.train.free_displacements
    for r in (10, 40, 80):
        exact, found = pod(snapshots, r), in_blocks(snapshots, r)
        best = left_over(snapshots, exact.modes)
        assert best * (1 - 1e-9) <= left_over(snapshots, found.modes) <= best * (1 + 1e-4)
        np.testing.assert_allclose(found.singular_values, exact.singular_values[:r], rtol=2e-3)
        np.testing.assert_allclose(
            found.singular_values[: r // 2], exact.singular_values[: r // 2], rtol=1e-6
        )
        leading = exact.modes[:, : r // 2]
        assert np.linalg.norm(leading - found.modes @ (found.modes.T @ leading), 2) <= 1e-3


def test_the_streamed_decomposition_is_the_same_in_every_run_and_however_it_is_cut(
    coarse: Dataset,
) -> None:
    snapshots = coarse.train.free_displacements
    first = in_blocks(snapshots, 20).modes
    np.testing.assert_array_equal(in_blocks(snapshots, 20).modes, first)
    whole = pod_streamed(lambda: [snapshots], 20).modes
    assert np.linalg.norm(whole - first @ (first.T @ whole)) <= 1e-10


def test_streaming_never_holds_the_matrix() -> None:
    n_samples, n, rank, passes = 12_000, 1_500, 50, 0
    rng = np.random.default_rng(0)
    left, right = (
        rng.normal(size=(n_samples, rank)) * 0.7 ** np.arange(rank),
        rng.normal(size=(rank, n)),
    )

    def blocks() -> Iterator[Array]:
        nonlocal passes
        passes += 1
        for start in range(0, n_samples, 500):
            yield left[start : start + 500] @ right

    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    modes = pod_streamed(blocks, 10).modes
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert peak < 0.15 * 8 * n_samples * n
    assert passes == 7  # one to see how many columns there are
    assert off_identity(modes) <= 1e-12


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize(("tolerance", "decades"), [(0.3, 8), (1e-2, 8), (1e-4, 8), (0.6, 0.5)])
def test_the_energy_left_out_decides_the_number_of_modes(
    route: str, tolerance: float, decades: float
) -> None:
    snapshots = decaying(400, 300, 200, decades)
    values = np.linalg.svd(snapshots, compute_uv=False)
    shares = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1] / (values**2).sum())
    assert ROUTES[route](snapshots, energy_tolerance=tolerance).modes.shape[1] == int(
        (shares > tolerance).sum()
    )


def test_a_large_matrix_is_decomposed_at_random_by_itself_and_falls_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    snapshots = decaying(400, 700, 390, 6)
    exact = pod(snapshots)
    assert len(exact.singular_values) == 400
    monkeypatch.setattr(basis, "RANDOMISED_FROM", 400)
    monkeypatch.setattr(basis, "RANDOMISED_SHARE", 4)
    assert len(pod(snapshots, 100).singular_values) == 100
    assert len(pod(snapshots, 101).singular_values) == 400  # too many of them to pay off
    assert len(pod(snapshots, energy_tolerance=0.5).singular_values) < 64
    assert (
        len(pod(snapshots, energy_tolerance=1e-3).singular_values) == 400
    )  # so many that the search was given up
    assert pod(snapshots, energy_tolerance=1e-3).modes.shape[1] == _by_energy(exact, 1e-3)


def _by_energy(found: Basis, tolerance: float) -> int:
    squares = found.singular_values**2
    return int((np.cumsum(squares[::-1])[::-1] > tolerance**2 * squares.sum()).sum())


def test_a_remembered_decomposition_gives_what_a_fresh_one_gives(
    coarse: Dataset, stiffness: Any
) -> None:
    snapshots = coarse.train.free_displacements
    with remembering():
        for r in (30, 10):
            np.testing.assert_array_equal(pod(snapshots.copy(), r).modes, pod(snapshots, r).modes)
        assert off_identity(pod(snapshots, 10, inner_product=stiffness).modes, stiffness) <= 1e-12
        np.testing.assert_array_equal(
            pod(-2 * snapshots[:50], 10).singular_values,
            2 * pod(snapshots[:50], 10).singular_values,
        )
    np.testing.assert_array_equal(pod(snapshots, 10).modes, pod(snapshots.copy(), 10).modes)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("kind", ["duplicates", "one", "with zeros", "r above the rank"])
def test_poor_snapshots_are_cut_to_their_rank(
    kind: str, route: str, weighted: bool, coarse: Dataset, stiffness: Any
) -> None:
    snapshots = coarse.train.free_displacements
    chosen, rank = {
        "duplicates": (np.repeat(snapshots[:4], 5, axis=0), 4),
        "one": (snapshots[:1], 1),
        "with zeros": (np.vstack([snapshots[:3], np.zeros((30, snapshots.shape[1]))]), 3),
        "r above the rank": (snapshots[:6], 6),
    }[kind]
    product = stiffness if weighted else None
    with pytest.warns(
        UserWarning,
        match=f"20 modes were asked for, but the {len(chosen)} snapshots have rank {rank}",
    ):
        modes = ROUTES[route](chosen, 20, inner_product=product).modes
    assert modes.shape[1] == rank
    assert off_identity(modes, product) <= 1e-12
    assert ROUTES[route](chosen, inner_product=product).modes.shape[1] == rank


@pytest.mark.parametrize("route", ROUTES)
def test_bad_snapshots_are_refused(route: str, coarse: Dataset, stiffness: Any) -> None:
    good = coarse.train.free_displacements[:40]
    bad = {
        "NaN": good.copy(),
        "infinity": good.copy(),
        "all zero": 0 * good,
        "shape": good[0][None, None],
        "real": good.astype(complex),
    }
    bad["NaN"][30, 3], bad["infinity"][30, 3] = np.nan, np.inf
    for said, snapshots in bad.items():
        with pytest.raises(InvalidInputError, match=said):
            ROUTES[route](snapshots, 5)
    wrong: list[tuple[str, dict[str, Any]]] = [
        ("not both", {"n_modes": 5, "energy_tolerance": 0.1}),
        ("`n_modes`", {"n_modes": 0}),
        ("`energy_tolerance`", {"energy_tolerance": 1.0}),
        ("`energy_tolerance`", {"energy_tolerance": np.nan}),
        ("`inner_product` must have shape", {"n_modes": 5, "inner_product": stiffness[:10, :10]}),
        ("not positive definite", {"n_modes": 5, "inner_product": -stiffness}),
    ]
    for said, options in wrong:
        with pytest.raises(InvalidInputError, match=said):
            ROUTES[route](good, **options)


def test_blocks_that_disagree_are_refused(coarse: Dataset) -> None:
    good = coarse.train.free_displacements[:40]
    once, shrinking = iter([good] * 3), iter([good[:40], good[:40], good[:30]])
    for blocks in (lambda: once, lambda: [next(shrinking)]):
        with pytest.raises(InvalidInputError, match="begin anew"):
            pod_streamed(blocks, 5)
    with pytest.raises(InvalidInputError, match=r"\(n_samples, 720\)"):
        pod_streamed(lambda: [good, good[:, :-1]], 5)
    with pytest.raises(InvalidInputError, match="no snapshots"):
        pod_streamed(list, 5)
    with pytest.raises(InvalidInputError, match="round-off hides"):
        pod_streamed(lambda: [good], energy_tolerance=1e-9)


def test_the_inner_product_of_a_basis_does_not_change_what_its_span_answers(
    coarse: Dataset,
) -> None:
    """With as many modes as samples both bases span the samples."""
    few, forces = coarse.train[:12], coarse.train.forces[:12]
    plain, weighted = (
        PODGalerkin(12, 1e-12, inner_product=product).fit(coarse.scene, few)
        for product in ("euclidean", "stiffness")
    )
    assert (
        np.abs(plain.predict(forces) - weighted.predict(forces)).max()
        <= 1e-8 * np.abs(few.displacements).max()
    )
    assert basis_faults(weighted, few, said=True) == []
    tangent = weighted.problem_.rest_tangent
    assert np.abs(tangent - np.eye(12)).max() <= 1e-9
    # Unknowns as large as the body, in either basis.
    scaled = GalerkinProblem(plain.problem_.assembler, 1e3 * plain.modes_)
    assert scaled.extent == pytest.approx(1e-3 * plain.problem_.extent)


def test_modes_of_a_method_by_energy(coarse: Dataset) -> None:
    fitted = PODGalerkin("energy", energy_tolerance=1e-2).fit(coarse.scene, coarse.train)
    assert fitted.modes_.shape[1] == _by_energy(pod(coarse.train.free_displacements), 1e-2)
    for wrong in (PODGalerkin("energy"), PODGalerkin(5, energy_tolerance=1e-2)):
        with pytest.raises(
            InvalidInputError, match="`energy_tolerance` of PODGalerkin must be given with"
        ):
            wrong.fit(coarse.scene, coarse.train)


def test_snapshots_in_single_precision_have_the_rank_of_single_precision(coarse: Dataset) -> None:
    snapshots: Any = coarse.train.free_displacements.astype(np.float32)
    modes = pod(snapshots, 40).modes
    assert modes.dtype == np.float64
    assert np.linalg.norm(modes.T @ modes - np.eye(40)) <= 1e-12
    with pytest.warns(UserWarning, match="rank 4"):
        assert pod(np.repeat(snapshots[:4], 5, axis=0), 20).modes.shape[1] == 4
