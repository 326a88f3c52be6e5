"""Hard cases that apply to any method, tried through its public interface alone."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import MorBenchError, NotFittedError, UnknownRangeError
from mor_bench.hard_cases.case import (
    Case,
    Outcome,
    Subject,
    answers,
    every,
    hard_case,
    judged,
    learner,
    rms,
    wrongly_handled,
)
from mor_bench.measure.error_metrics import sample_errors
from mor_bench.scratch import scratch_folder
from mor_bench.snapshots.dataset import Dataset, Snapshots
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.surrogate import Surrogate
from mor_bench.surrogates.fem import FullFEM

Array = NDArray[np.float64]

ZERO_FORCE = 1e-3
"""Largest norm of the answer to zero force, over the root mean square of the training samples."""

MIRRORED = 1e-12
"""Largest asymmetry of the full-order model, solved to 1e-13. Other methods only publish theirs."""

ROUND_OFF = 2e-6
"""Largest relative difference between a query alone and in a batch, from float32 round-off."""

ADDED = 0.1
"""Largest error that low precision may add, relative to the method's own error."""

FLAGGED = 0.9
"""Share of the loads of an unseen kind that must be flagged."""

LARGER = ("2x", "4x")
"""Test sets of larger loads; only loads larger than all training loads are out of range."""

FALSE_ALARMS = 0.02
"""Largest share of loads in range that may be flagged."""


def _bad_forces(good: Array) -> dict[str, Any]:
    def with_value(value: float) -> Array:
        force = good.copy()
        force[3, 1] = value
        return force

    return {
        "NaN": with_value(np.nan),
        "infinity": with_value(np.inf),
        "1e155 N": with_value(1e155),
        "a node too few": good[:-1],
        "a flat array": good.ravel(),
        "four axes": good[None, None],
        "ragged rows": [[1.0, 2.0], [3.0]],
        "complex numbers": good + 1j,
        "text": good.astype(str),
        "objects": good.astype(object),
        "truth values": good > 0,
        "nothing": None,
    }


@hard_case("bad-forces", every, "typed error, nothing kept")
def bad_forces(subject: Subject) -> Outcome:
    """Predict for arrays with NaN, infinity, wrong shapes and wrong types."""
    method, good = subject.fitted, subject.data.test.forces[0]
    before = method.predict(good)
    bad = _bad_forces(good)
    with np.errstate(all="ignore"):
        wrong = wrongly_handled(
            {name: partial(method.predict, force) for name, force in bad.items()}
        )
    if np.abs(method.predict(good) - before).max() > ROUND_OFF * np.abs(before).max():
        wrong.append("later answers differ")
    happened = f"{len(bad)} of {len(bad)} refused with a typed error, later answers unchanged"
    return judged(not wrong, "; ".join(wrong) or happened, wrong=len(wrong))


def _bad_snapshots(good: Snapshots) -> dict[str, Snapshots | None]:
    u, loads = good.free_displacements, good.loads
    assert isinstance(loads, PatchLoads)

    def with_value(array: Array, value: float) -> Array:
        spoilt = array.copy()
        spoilt[(1,) * array.ndim if array.ndim == 2 else (1, 0, 1)] = value
        return spoilt

    def displacements(array: Any) -> Snapshots:
        return replace(good, free_displacements=array)

    return {
        "none at all": None,
        "no sample": good[:0],
        "NaN in a displacement": displacements(with_value(u, np.nan)),
        "infinity in a displacement": displacements(with_value(u, np.inf)),
        "NaN in a force": replace(
            good, loads=replace(loads, vectors=with_value(loads.vectors, np.nan))
        ),
        "a dof too few": displacements(u[:, :-1]),
        "a displacement too few": displacements(u[:-1]),
        "displacements per node": displacements(u.reshape(len(u), -1, 3)),
        "complex displacements": displacements(u + 1j),
        "displacements as text": displacements(u.astype(str)),
    }


@hard_case("bad-snapshots", learner, "typed error, nothing kept")
def bad_snapshots(subject: Subject) -> Outcome:
    """Fit on snapshots with NaN, infinity, wrong shapes and wrong types."""
    data = subject.data
    method = subject.fit(data, brief=True)
    bad = _bad_snapshots(data.train[:20])
    wrong = wrongly_handled(
        {name: partial(method.fit, data.scene, snapshots) for name, snapshots in bad.items()}
    )
    prediction = partial(method.predict, data.test.forces[0])
    wrong += wrongly_handled({"a prediction after a refused fit": prediction}, NotFittedError)
    with scratch_folder() as folder:
        path = folder / "model.safetensors"
        wrong += wrongly_handled({"saving after a refused fit": partial(method.save, path)})
        if path.exists():
            wrong.append("a file was left")
    happened = f"{len(bad)} of {len(bad)} refused with a typed error, nothing kept"
    return judged(not wrong, "; ".join(wrong) or happened, wrong=len(wrong))


def _published(method: Surrogate, snapshots: Snapshots) -> tuple[bool, str, dict[str, Any]]:
    """Publish the errors of a method.

    Returns
    -------
    finite : bool
        Whether every answer is finite or a typed failure.
    shown : str
        The errors in words.
    numbers : dict
    """
    predicted = answers(method, snapshots.forces)
    failed = np.isnan(predicted).all(axis=(1, 2))
    finite = bool(np.isfinite(predicted[~failed]).all())
    relative = sample_errors(predicted, snapshots.displacements).relative_l2
    median, most = float(np.median(relative)), float(relative.max())
    p95 = float(np.percentile(relative, 95, method="higher"))
    numbers = {
        "n": len(relative),
        "n_failed": int(failed.sum()),
        "rel_l2_median": median,
        "rel_l2_p95": p95,
        "rel_l2_max": most,
    }
    shown = f"relative L2 error {median:.2g} median, {p95:.2g} p95, {most:.2g} max"
    if failed.any():
        shown += f", {numbers['n_failed']} of {len(relative)} without an answer"
    return finite, shown if finite else f"{shown}, some not finite", numbers


def _unlike(name: str, data: Dataset) -> NDArray[np.bool_]:
    """Return which loads of a test set differ from those of training."""
    forces = data.tests[name].forces
    if name not in LARGER:
        return np.ones(len(forces), dtype=bool)
    sizes, known = (np.linalg.norm(f, axis=2).sum(axis=1) for f in (forces, data.train.forces))
    return np.asarray(sizes > 1.01 * known.max())


def out_of_distribution(name: str, subject: Subject) -> Outcome:
    """Predict a test set of other loads than those of training, and check the range flags."""
    pressed = name == "unseen-directions"
    data = subject.scenes.pressed if pressed else subject.data
    method = subject.fitted_on_pressed if pressed else subject.fitted
    finite, shown, numbers = _published(method, data.tests[name])
    if not method.needs_snapshots and (pressed or not hasattr(method, "range_")):
        return judged(finite, f"{shown}; it learns no range of loads", **numbers)
    unlike, larger = _unlike(name, data), name in LARGER
    try:
        flags, alarms = (
            np.asarray(method.out_of_range(data.tests[part].forces)) for part in (name, "in-range")
        )
    except UnknownRangeError as error:
        return judged(False, f"{shown}; no flag: {error}", **numbers)
    share, false = float(flags[unlike].mean()), float(alarms.mean())
    shown += f"; flagged {int(flags[unlike].sum())} of {int(unlike.sum())}"
    shown += " larger than any in training" if larger else ""
    return judged(
        finite and share >= (1.0 if larger else FLAGGED) and false <= FALSE_ALARMS,
        f"{shown}, in range {false:.0%}",
        **numbers,
        flagged=share,
        flagged_in_range=false,
    )


@hard_case(
    "zero-force", every, f"‖u‖ <= {ZERO_FORCE:g} of the root mean square of the training samples"
)
def zero_force(subject: Subject) -> Outcome:
    """Predict without any force."""
    answer = subject.fitted.predict(np.zeros((subject.data.scene.mesh.n_nodes, 3)))
    ratio = float(np.linalg.norm(answer)) / rms(subject.data.train.displacements)
    return judged(
        ratio <= ZERO_FORCE,
        f"‖u‖ is {ratio:.2g} of the root mean square of the training samples",
        ratio=ratio,
    )


@hard_case("symmetry", every, f"full-order {MIRRORED:g}; others measured and published")
def symmetry(subject: Subject) -> Outcome:
    """Predict mirrored loads: y → 1 m - y maps beam-tiny and its support to themselves."""
    data, exact = subject.data, isinstance(subject.fresh(), FullFEM)
    method = subject.fit(data, tolerance=1e-13) if exact else subject.fitted
    points, flip = data.scene.mesh.points, np.array([1.0, -1.0, 1.0])
    mirror = np.array(
        [int(np.linalg.norm(points - (p * flip + [0, 1, 0]), axis=1).argmin()) for p in points]
    )
    forces = data.test.forces[:20]
    plain = answers(method, forces)
    mirrored = answers(method, np.ascontiguousarray(forces[:, mirror] * flip))
    size = np.linalg.norm(plain, axis=(1, 2))
    off = np.linalg.norm(mirrored - plain[:, mirror] * flip, axis=(1, 2)) / size
    median, most = float(np.median(off)), float(off.max())
    return judged(
        bool(np.isfinite(off).all()) and (not exact or most <= MIRRORED),
        f"relative L2 difference of an answer and its mirror image {median:.2g} median, "
        f"{most:.2g} max",
        median=median,
        max=most,
    )


@hard_case("determinism", every, "identical", "two runs")
def two_runs(subject: Subject) -> Outcome:
    """Predict twice, and fit twice."""
    forces = subject.data.test.forces[:8]
    first, second = (subject.fit(subject.data, brief=True) for _ in range(2))
    once, again, other = first.predict(forces), first.predict(forces), second.predict(forces)
    differences = {
        "asked again": float(np.abs(again - once).max()),
        "fitted again": float(np.abs(other - once).max()),
    }
    wrong = [
        f"{name}: {difference:.2g} m" for name, difference in differences.items() if difference != 0
    ]
    return judged(
        not wrong,
        "; ".join(wrong) or "identical to the last bit, asked again and fitted again",
        **differences,
    )


@hard_case(
    "determinism", every, "identical, or a stated difference of round-off", "batch of 1 and of 8"
)
def batches(subject: Subject) -> Outcome:
    """Predict eight loads together and one by one."""
    forces = subject.data.test.forces[:8]
    together = subject.fitted.predict(forces)
    alone = np.stack([subject.fitted.predict(force) for force in forces])
    off = float(np.abs(together - alone).max() / np.abs(alone).max())
    return judged(
        off <= ROUND_OFF,
        "identical" if off == 0 else f"differ by {off:.1e} of the largest displacement",
        off=off,
    )


@hard_case("low-precision", every, "adds at most 10 % of the error", "float32 forces")
def float32_forces(subject: Subject) -> Outcome:
    """Predict for loads in single precision."""
    return _low_precision(
        subject, lambda method, forces: answers(method, forces.astype(np.float32))
    )


@hard_case(
    "low-precision", every, "adds at most 10 % of the error, or refused", "bfloat16 inference"
)
def bfloat16_inference(subject: Subject) -> Outcome:
    """Let PyTorch compute a network in bfloat16."""
    method, torch = subject.fitted, sys.modules.get("torch")
    if torch is None or not any(
        isinstance(value, torch.nn.Module) for value in vars(method).values()
    ):
        return Outcome("not applicable", "it has no PyTorch network that could be cast")

    def cast(method: Surrogate, forces: Array) -> Array:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return answers(method, forces)

    try:
        return _low_precision(subject, cast)
    except (TypeError, RuntimeError, MorBenchError) as error:
        return judged(True, f"refused with {type(error).__name__}: {error}")


def _low_precision(subject: Subject, predict: Callable[[Surrogate, Array], Array]) -> Outcome:
    """Compare the error that a lower precision adds with that of the method, or of the mesh."""
    method, test = subject.fitted, subject.data.test
    plain, low = answers(method, test.forces), predict(method, test.forces)
    size = np.linalg.norm(test.displacements, axis=(1, 2))
    added, error = (
        float(np.median(np.linalg.norm(x, axis=(1, 2)) / size))
        for x in (low - plain, plain - test.displacements)
    )
    mesh = subject.scenes.discretisation_error
    return judged(
        added <= ADDED * max(error, mesh),
        f"adds {added:.1e} to a relative L2 error of {error:.1e} (the mesh has {mesh:.1e}), "
        "medians",
        added=added,
        error=error,
        discretisation=mesh,
    )


CASES = (
    bad_forces,
    bad_snapshots,
    *(
        Case(
            "out-of-distribution",
            test_set,
            "error published with p95 and max; flagged as out of range",
            every,
            partial(out_of_distribution, test_set),
        )
        for test_set in (*LARGER, "unseen-regions", "unseen-directions", "several-forces")
    ),
    zero_force,
    symmetry,
    two_runs,
    batches,
    float32_forces,
    bfloat16_inference,
)
