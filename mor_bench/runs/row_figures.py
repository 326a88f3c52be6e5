"""Figures of a row, computed from a fit's record and its scores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import MissingDependencyError, MorBenchError, UnsupportedSceneError
from mor_bench.measure.error_bounds import ErrorBound, covered
from mor_bench.measure.error_metrics import ERRORS, SampleErrors, percentiles, summary
from mor_bench.measure.method_session import CURVES
from mor_bench.measure.range_flags import Flags
from mor_bench.results.parts import ErrorSummary, TrainingRecord
from mor_bench.results.row import Row, ScaledBound, SetErrors, Status
from mor_bench.runs.cached_fit import FitRecord
from mor_bench.sandbox.process import MethodFailedError
from mor_bench.training_options import TrainingOptions

Score = Mapping[str, NDArray[Any]]


def failure(error: MorBenchError) -> tuple[Status, str]:
    """Return the status and the reason of a row whose method raised an error."""
    if isinstance(error, MissingDependencyError | UnsupportedSceneError):
        return "skipped", str(error)
    if isinstance(error, MethodFailedError):
        return "failed", str(error)
    return "failed", f"{type(error).__name__}: {error}"


def failed_row(row: Row, error: MorBenchError) -> Row:
    """Return a row with the status and the reason of an error."""
    status, reason = failure(error)
    return row.with_parts(status=status, reason=reason)


def n_failed(score: Score) -> int:
    """Return the number of samples without a prediction."""
    return int((~np.isfinite(score["mean_dof_m"])).sum())


def error_summary(score: Score) -> ErrorSummary:
    """Summarise the errors on a test set."""
    figures = summary(SampleErrors(**{name: score[name] for name in ERRORS}))
    for name in ("reaction", "stress", "peak_stress", "peak_tension"):
        if f"{name}_relative" in score:
            figures |= percentiles(score[f"{name}_relative"], f"{name}_rel")
    return ErrorSummary(**figures)


def set_errors(score: Score, flags: Flags | None = None, seed: int | None = None) -> SetErrors:
    """Summarise the errors and range flags on a named test set."""
    figures = error_summary(score).model_dump(include=set(SetErrors.model_fields))
    more: dict[str, Any] = {} if seed is None else {"seed": seed}
    return SetErrors(
        n=len(score["mean_dof_m"]),
        n_failed=n_failed(score),
        n_flagged=int(score["flagged"].sum()) if "flagged" in score else None,
        **figures,
        **(flags.of(score) if flags else {}),
        **more,
    )


def failed_set(n: int, seed: int) -> SetErrors:
    """Return the errors of a method without any prediction on a test set: all are infinite."""
    worst = dict.fromkeys(("mean_dof_m", "rel_l2_median", "rel_l2_p95", "rel_l2_max"), np.inf)
    return SetErrors(seed=seed, n=n, n_failed=n, n_flagged=None, **worst)


def scaled_bound(bound: ErrorBound, tests: Mapping[str, Score]) -> ScaledBound | None:
    """Return the bound that follows the spread, on each test set; None without a spread."""
    if bound.per_spread is None:
        return None
    known = np.isfinite(bound.per_spread)
    widths = {n: bound.per_spread * float(np.median(s["spread"])) for n, s in tests.items()}
    return ScaledBound(
        per_spread=bound.per_spread,
        widths=widths if known else {},
        coverage=covered(bound, tests, scaled=True),
    )


def training_record(record: FitRecord, options: TrainingOptions | None) -> TrainingRecord | None:
    """Return the training record of a row; None for a method without training."""
    if not record.training:
        return None
    options = options or TrainingOptions()
    losses = (curve[-1] if curve else None for curve in (record.training[key] for key in CURVES))
    loss, validation_loss = losses
    iterations = record.iterations
    return TrainingRecord(
        device=options.device,
        fit_seconds=options.fit_seconds,
        iterations=record.parameters.get("iterations") if iterations is None else iterations,
        loss=loss,
        validation_loss=validation_loss,
    )


def loss_curves(record: FitRecord) -> dict[str, NDArray[Any]]:
    """Return the loss curves of a training."""
    return {name: np.array(record.training[name]) for name in CURVES if record.training}


def ignored_seconds(record: FitRecord, asked_s: float | None) -> list[str]:
    """Return a warning if a method ignored the requested training time."""
    iterations = record.parameters.get("iterations")
    if asked_s is None or iterations is None or record.iterations is not None:
        return []
    return [
        "it does not size its training to seconds: "
        f"its parameter `iterations`, {iterations:,}, counts"
    ]
