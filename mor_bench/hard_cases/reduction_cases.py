"""Hard cases of the algebra behind reduced bases: poor snapshots, cubature."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import MorBenchError
from mor_bench.hard_cases.case import (
    Case,
    Outcome,
    Subject,
    answers,
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
    """One with a cubature trained by non-negative least squares."""
    return isinstance(method, HyperReducedPOD)


def _poor(train: Snapshots) -> dict[str, Snapshots]:
    return {
        "duplicates": with_samples(train, np.repeat(np.arange(4), 5)),
        "some zeros": with_samples(train, np.arange(12), zeros=9),
        "all zeros": with_samples(train, np.arange(5), zeros=5),
        "one sample": with_samples(train, np.arange(1)),
        "six samples": with_samples(train, np.arange(6)),
    }


def poor_snapshots(subject: Subject) -> Outcome:
    wrong, told = [], []
    for kind, snapshots in _poor(subject.data.train).items():
        method = subject.fresh(brief=True)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                method.fit(subject.data.scene, snapshots)
            except MorBenchError as error:
                told.append(f"{kind}: refused, {error}")
                continue
            except Exception as error:
                wrong.append(f"{kind}: crashed with {type(error).__name__}: {error}")
                continue
        said = any("rank" in str(warning.message) for warning in caught)
        wrong += [f"{kind}: {what}" for what in basis_faults(method, snapshots, said)]
        modes = getattr(method, "modes_", None)
        kept = (
            f", {modes.shape[1]} modes kept of rank {_rank(snapshots)}"
            if isinstance(modes, np.ndarray)
            else ""
        )
        told.append(f"{kind}: fitted{kept}{', with a warning' if said else ''}")
    return judged(not wrong, "; ".join(wrong or told), wrong=len(wrong))


def _rank(snapshots: Snapshots) -> int:
    return int(np.linalg.matrix_rank(snapshots.free_displacements))


def basis_faults(method: Surrogate, snapshots: Snapshots, said: bool) -> list[str]:
    """What is wrong with a method that was fitted to poor snapshots; ``said`` is whether it warned of their rank."""
    faults = []
    rank = _rank(snapshots)
    asked = [
        value
        for name, value in method.parameters.items()
        if name.startswith("n_") and name.endswith("modes") and isinstance(value, int)
    ]
    if asked and max(asked) > rank and not said:
        faults.append(f"{max(asked)} modes asked for of rank {rank}, and no warning")
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
        finite = not np.isinf(answers(method, snapshots.forces)).any()
        if not finite:
            faults.append("an infinite prediction")
    except Exception as error:
        faults.append(f"prediction crashed with {type(error).__name__}: {error}")
    return faults


def _hard_columns(seed: int) -> tuple[Array, Array]:
    """A matrix (60, 200) with ten columns twice, fifty scaled by up to 1e±8 and one of zeros, and a target that it can reach."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(60, 200)) + 0.5
    matrix[:, 100:110] = matrix[:, :10]
    matrix[:, 150:] *= 10.0 ** rng.uniform(-8, 8, 50)
    matrix[:, 199] = 0.0
    return matrix, matrix[:, :150].sum(axis=1)


def _optimality(matrix: Array, target: Array, found: SparseWeights) -> tuple[float, float, float]:
    """Relative residual, gradient on positive weights and most negative weight, all from the weights alone."""
    x = found.weights
    residual, norms = target - matrix @ x, np.linalg.norm(matrix, axis=0)
    gradient = matrix.T @ residual / (np.where(norms > 0, norms, 1.0) * np.linalg.norm(target))
    return (
        float(np.linalg.norm(residual) / np.linalg.norm(target)),
        float(np.abs(gradient[x > 0]).max(initial=0.0)),
        float(x.min()),
    )


def nnls_columns(subject: Subject) -> Outcome:
    worst = {
        "residual_over_tolerance": 0.0,
        "gradient": 0.0,
        "least_weight": 0.0,
        "misreported": 0.0,
    }
    for seed in range(5):
        matrix, target = _hard_columns(seed)
        for tolerance in (1e-1, 1e-3, 1e-8):
            found = sparse_nnls(matrix, target, tolerance)
            residual, gradient, least = _optimality(matrix, target, found)
            worst["residual_over_tolerance"] = max(
                worst["residual_over_tolerance"], residual / tolerance
            )
            worst["gradient"] = max(worst["gradient"], gradient)
            worst["least_weight"] = min(worst["least_weight"], least)
            worst["misreported"] = max(
                worst["misreported"], abs(found.relative_residual - residual) / tolerance
            )
    good = (
        worst["residual_over_tolerance"] <= 1 + 1e-9
        and worst["gradient"] <= 1e-10
        and worst["least_weight"] >= 0
        and worst["misreported"] <= 1e-6
    )
    happened = f"15 systems, recomputed: residual at most {worst['residual_over_tolerance']:.2f} of the tolerance, gradient on positive weights "
    happened += f"at most {worst['gradient']:.0e}, no weight below {worst['least_weight']:g}"
    return judged(good, happened, **worst)


def nnls_cap(subject: Subject) -> Outcome:
    matrix = np.random.default_rng(0).random((30, 50))
    try:
        found = sparse_nnls(matrix, matrix.sum(axis=1), 1e-6, max_iterations=1)
    except CubatureError as error:
        return judged("1e-06" in str(error), f"refused: {error}")
    return judged(
        False, f"taken with a residual of {_optimality(matrix, matrix.sum(axis=1), found)[0]:.2g}"
    )


def ecsw_all_cells(subject: Subject) -> Outcome:
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


CASES = (
    Case(
        "poor-snapshots",
        "",
        "cut to the rank with a warning, basis orthonormal to 1e-12, or a typed error",
        learner,
        poor_snapshots,
    ),
    Case(
        "nnls",
        "duplicated and badly scaled columns",
        "residual and optimality hold when recomputed",
        hyper_reduced,
        nnls_columns,
    ),
    Case("nnls", "one iteration only", "honest failure", hyper_reduced, nnls_cap),
    Case("ecsw-all-cells", "", "equals plain POD to 1e-10", hyper_reduced, ecsw_all_cells),
)
