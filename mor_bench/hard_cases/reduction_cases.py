"""Hard cases of the algebra behind reduced bases: poor snapshots and cubature."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import MorBenchError, RankDeficientWarning
from mor_bench.hard_cases.case import (
    Outcome,
    Subject,
    answers,
    hard_case,
    judged,
    learner,
    with_samples,
)
from mor_bench.mechanics.model import FullOrderModel
from mor_bench.reduction.cubature import CubatureError, SparseWeights, sparse_nnls
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.hpod import HyperReducedPOD
from mor_bench.surrogates.pod import PODGalerkin, stiffness_at_rest

Array = NDArray[np.float64]


def hyper_reduced(method: Surrogate) -> bool:
    """Accept a method whose cubature is trained by non-negative least squares."""
    return isinstance(method, HyperReducedPOD)


def _poor(train: Snapshots) -> dict[str, Snapshots]:
    return {
        "duplicates": with_samples(train, np.repeat(np.arange(4), 5)),
        "some zeros": with_samples(train, np.arange(12), zeros=9),
        "all zeros": with_samples(train, np.arange(5), zeros=5),
        "one sample": with_samples(train, np.arange(1)),
        "six samples": with_samples(train, np.arange(6)),
    }


@hard_case(
    "poor-snapshots",
    learner,
    "cut to the rank with a warning, basis orthonormal to 1e-12, or a typed error",
)
def poor_snapshots(subject: Subject) -> Outcome:
    """Fit on snapshots with fewer independent directions than the method has modes."""
    wrong, shown = [], []
    for kind, snapshots in _poor(subject.data.train).items():
        method = subject.fresh(brief=True)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                method.fit(subject.data.scene, snapshots)
            except MorBenchError as error:
                shown.append(f"{kind}: refused, {error}")
                continue
            except Exception as error:
                wrong.append(f"{kind}: crashed with {type(error).__name__}: {error}")
                continue
        warned = any(issubclass(warning.category, RankDeficientWarning) for warning in caught)
        wrong += [f"{kind}: {fault}" for fault in basis_faults(method, snapshots, warned)]
        modes = getattr(method, "modes_", None)
        kept = ""
        if isinstance(modes, np.ndarray):
            kept = f", {modes.shape[1]} modes kept of rank {_rank(snapshots)}"
        shown.append(f"{kind}: fitted{kept}{', with a warning' if warned else ''}")
    return judged(not wrong, "; ".join(wrong or shown), wrong=len(wrong))


def _rank(snapshots: Snapshots) -> int:
    return int(np.linalg.matrix_rank(snapshots.free_displacements))


def basis_faults(method: Surrogate, snapshots: Snapshots, warned: bool) -> list[str]:
    """Return what is wrong with a method that was fitted to poor snapshots.

    Parameters
    ----------
    method : Surrogate
    snapshots : Snapshots
    warned : bool
        Whether the fit gave a `RankDeficientWarning`.
    """
    faults = []
    rank = _rank(snapshots)
    asked = [
        value
        for name, value in method.parameters.items()
        if name.startswith("n_") and name.endswith("modes") and isinstance(value, int)
    ]
    if asked and max(asked) > rank and not warned:
        faults.append(f"{max(asked)} modes for snapshots of rank {rank}, without a warning")
    modes = getattr(method, "modes_", None)
    if isinstance(modes, np.ndarray):
        by_stiffness = getattr(method, "inner_product", "euclidean") == "stiffness"
        images = stiffness_at_rest(FullOrderModel(method.scene_)) @ modes if by_stiffness else modes
        off = float(np.linalg.norm(modes.T @ images - np.eye(modes.shape[1])))
        if not off <= 1e-12:
            faults.append(f"basis off orthonormal by {off:.1e}")
        if modes.shape[1] > rank:
            faults.append(f"{modes.shape[1]} modes of rank {rank}")
    try:
        if np.isinf(answers(method, snapshots.forces)).any():
            faults.append("an infinite prediction")
    except Exception as error:
        faults.append(f"prediction crashed with {type(error).__name__}: {error}")
    return faults


def _hard_columns(seed: int) -> tuple[Array, Array]:
    """Return a matrix (60, 200) of ill-suited columns, and a target that it can reach.

    Ten columns stand twice, fifty are scaled by up to 1e±8, and one is zero.
    """
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(60, 200)) + 0.5
    matrix[:, 100:110] = matrix[:, :10]
    matrix[:, 150:] *= 10.0 ** rng.uniform(-8, 8, 50)
    matrix[:, 199] = 0.0
    return matrix, matrix[:, :150].sum(axis=1)


def _optimality(matrix: Array, target: Array, found: SparseWeights) -> tuple[float, float, float]:
    """Recompute from the weights: relative residual, gradient on positive weights, least weight."""
    x = found.weights
    residual, norms = target - matrix @ x, np.linalg.norm(matrix, axis=0)
    gradient = matrix.T @ residual / (np.where(norms > 0, norms, 1.0) * np.linalg.norm(target))
    return (
        float(np.linalg.norm(residual) / np.linalg.norm(target)),
        float(np.abs(gradient[x > 0]).max(initial=0.0)),
        float(x.min()),
    )


@hard_case(
    "nnls",
    hyper_reduced,
    "residual and optimality hold when recomputed",
    "duplicated and badly scaled columns",
)
def nnls_columns(subject: Subject) -> Outcome:
    """Solve non-negative least squares with repeated and badly scaled columns."""
    found = []
    for seed in range(5):
        matrix, target = _hard_columns(seed)
        for tolerance in (1e-1, 1e-3, 1e-8):
            weights = sparse_nnls(matrix, target, tolerance)
            residual, gradient, least = _optimality(matrix, target, weights)
            misreported = abs(weights.relative_residual - residual) / tolerance
            found.append((residual / tolerance, gradient, misreported, least))
    residuals, gradients, misreports, least_weights = zip(*found, strict=True)
    residual, gradient, misreported = max(residuals), max(gradients), max(misreports)
    least = min(0.0, *least_weights)
    return judged(
        residual <= 1 + 1e-9 and gradient <= 1e-10 and least >= 0 and misreported <= 1e-6,
        f"{len(found)} systems, recomputed: residual at most {residual:.2f} of the tolerance, "
        f"gradient on positive weights at most {gradient:.0e}, no weight below {least:g}",
        residual_over_tolerance=residual,
        gradient=gradient,
        least_weight=least,
        misreported=misreported,
    )


@hard_case("nnls", hyper_reduced, "honest failure", "one iteration only")
def nnls_cap(subject: Subject) -> Outcome:
    """Stop non-negative least squares after one iteration."""
    matrix, tolerance = np.random.default_rng(0).random((30, 50)), 1e-6
    target = matrix.sum(axis=1)
    try:
        found = sparse_nnls(matrix, target, tolerance, max_iterations=1)
    except CubatureError as error:
        reached = error.relative_residual
        return judged(reached is not None and reached > tolerance, f"refused: {error}")
    residual = _optimality(matrix, target, found)[0]
    return judged(False, f"accepted with a residual of {residual:.2g}")


@hard_case("ecsw-all-cells", hyper_reduced, "equals plain POD to 1e-10")
def ecsw_all_cells(subject: Subject) -> Outcome:
    """Keep every cell in the cubature, which must then equal plain POD."""
    data, forces = subject.data, subject.data.test.forces[:20]
    whole = subject.fit(data, cubature_tolerance=0.0, tolerance=1e-12)
    assert isinstance(whole, HyperReducedPOD)
    plain = PODGalerkin(whole.n_modes, 1e-12).fit(data.scene, data.train).predict(forces)
    off = float(np.abs(whole.predict(forces) - plain).max() / np.abs(plain).max())
    kept = len(whole.cells_) == data.scene.mesh.n_cells and bool((whole.weights_ == 1).all())
    return judged(
        off <= 1e-10 and kept,
        f"{len(whole.cells_)} of {data.scene.mesh.n_cells} cells, {off:.1e} from plain POD",
        off=off,
    )


CASES = (poor_snapshots, nnls_columns, nnls_cap, ecsw_all_cells)
