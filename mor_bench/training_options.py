"""How a method that trains does so: device, time, checkpoint and starting weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mor_bench.options import Device as Device


@dataclass(frozen=True)
class TrainingOptions:
    """Options of a training. They are not hyperparameters: a model file does not hold them.

    Attributes
    ----------
    device : {"auto", "cpu", "cuda"}
        Where the training computes. "auto" takes a CUDA device if there is one.
    fit_seconds : float or None
        Time for the training, s. The number of iterations that fit in it is estimated from the
        first ones and reported as ``iterations_``; the hyperparameter ``iterations`` with that
        number repeats the model. None: use the hyperparameter ``iterations``.
    checkpoint : Path or None
        File that the training state is written to now and then, and at the end. If it exists, the
        training resumes from it and ends with the same bits as an uninterrupted one. The caller
        deletes it once the model is saved.
    start_from : Path or None
        A saved model of the same class and `Surrogate.architecture` whose weights the training
        starts from.
    progress : callable or None
        Called now and then with the iterations done, all iterations, and the loss.
    """

    device: Device = "cpu"
    fit_seconds: float | None = None
    checkpoint: Path | None = None
    start_from: Path | None = None
    progress: Callable[[int, int, float], None] | None = None
