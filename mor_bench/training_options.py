"""Options of a training: device, time, checkpoint and initial weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mor_bench.options import Device as Device

if TYPE_CHECKING:
    from mor_bench.snapshots.dataset import Snapshots


@dataclass(frozen=True)
class TrainingOptions:
    """Options of a training. They are not hyperparameters and not part of a model file.

    Attributes
    ----------
    device : {"auto", "cpu", "cuda"}
        Device of the training. "auto" uses a CUDA device if there is one.
    fit_seconds : float or None
        Time for the training, s. The number of iterations that fit is estimated from the first
        ones and reported as ``iterations_``. The hyperparameter ``iterations`` with that number
        repeats the model. None: use the hyperparameter ``iterations``.
    checkpoint : Path or None
        File for the training state, written regularly and at the end. If it exists, the training
        resumes from it and gives bit-identical results. The caller deletes it once the model is
        saved.
    start_from : Path or None
        A saved model of the same class and `Surrogate.architecture` with the initial weights.
    validation : Snapshots or None
        Samples that the training may use to stop early, and not to learn from.
    progress : callable or None
        Called regularly with the finished iterations, all iterations, and the loss.
    """

    device: Device = "cpu"
    fit_seconds: float | None = None
    checkpoint: Path | None = None
    start_from: Path | None = None
    validation: Snapshots | None = None
    progress: Callable[[int, int, float], None] | None = None
