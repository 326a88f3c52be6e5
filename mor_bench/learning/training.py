"""Training of networks: Adam steps within a time limit, resumable to the same last bit."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, OutOfTimeError
from mor_bench.learning.checkpoint import fingerprint_of, resume, write_checkpoint
from mor_bench.learning.training_loop import TrainingLoop
from mor_bench.learning.training_plan import LearningProblem, TrainingPlan
from mor_bench.training_options import TrainingOptions
from mor_bench.version import __version__

TIME_CHECKS = {5: 3.0, 100: 1.0}
"""Iterations after which the whole time is estimated, and the multiple of the limit allowed.

The first check is generous: a machine that is busy for a moment must not end a training. The very
first iteration is not timed, since it builds what the others reuse.
"""

CHECKPOINT_EVERY_S = 30.0


@dataclass(frozen=True)
class Training:
    """Result of a training, beside the weights.

    Attributes
    ----------
    loss_curve : (n_intervals,) float64
        Mean loss per `training_loop.LOSS_INTERVAL` iterations.
    validation_curve : (n_validations,) float64
        Loss of the held-out samples, at intervals of 1 / `training_loop.VALIDATIONS` of all
        iterations.
    iterations : int
        The planned number, which repeats the training. After an early stop not all of them were
        done.
    """

    loss_curve: NDArray[np.float64]
    validation_curve: NDArray[np.float64]
    iterations: int


def device_of(options: TrainingOptions) -> torch.device:
    """Return the device that trains; "auto" is the first CUDA device if there is one.

    Raises
    ------
    InvalidInputError
        If CUDA is asked for and there is none.
    """
    available = torch.cuda.is_available()
    if options.device == "cuda" and not available:
        raise InvalidInputError(
            "`device` is 'cuda', but PyTorch finds no CUDA device here; use 'cpu' or 'auto'."
        )
    return torch.device("cuda" if options.device != "cpu" and available else "cpu")


def train(
    problem: LearningProblem,
    plan: TrainingPlan,
    options: TrainingOptions | None = None,
    time_limit_s: float | None = None,
) -> Training:
    """Change the weights of a network to lower a loss.

    Every epoch is a new permutation of the samples; a last, smaller batch is left out. The same
    problem and plan give the same weights to the last bit on one processor and number of threads,
    interrupted or not. No global random state changes. The network ends in evaluation mode.

    Parameters
    ----------
    problem : LearningProblem
    plan : TrainingPlan
    options : TrainingOptions, optional
        Device, seconds to fill, and checkpoint, which is also written at the end: the caller
        deletes it once the model is saved. ``start_from`` is left to the caller.
    time_limit_s : float, optional
        Seconds that the training may take. It ends early if it would take longer.

    Returns
    -------
    Training

    Raises
    ------
    MorBenchError
        If the loss is not finite.
    OutOfTimeError
        If the first iterations show that all of them exceed the limit.
    StoreError
        If the checkpoint is damaged.
    InvalidInputError
        If the checkpoint belongs to another training.
    """
    options = options or TrainingOptions()
    loop = TrainingLoop(problem, plan, options, device_of(options))
    checkpoint = options.checkpoint
    fingerprint = "" if checkpoint is None else _fingerprint(problem, options)
    if checkpoint is None or not resume(loop, checkpoint, fingerprint):
        loop.begin()
    start, first, written = perf_counter(), loop.iteration, perf_counter()
    while loop.iteration < loop.iterations and not loop.stopped:
        loop.step()
        timed = loop.iteration - first - 1
        if timed == 0:
            start = perf_counter()
        elif timed in TIME_CHECKS and time_limit_s is not None:
            each_s = (perf_counter() - start) / timed
            _check_time(each_s, loop.iterations - first, time_limit_s, TIME_CHECKS[timed])
        if checkpoint is not None and perf_counter() - written > CHECKPOINT_EVERY_S:
            write_checkpoint(loop, checkpoint, fingerprint)
            written = perf_counter()
    if checkpoint is not None and loop.iteration > first:
        write_checkpoint(loop, checkpoint, fingerprint)
    loop.finish()
    return Training(np.array(loop.curve), np.array(loop.validated), loop.iterations)


def _fingerprint(problem: LearningProblem, options: TrainingOptions) -> str:
    """Identify a training by its data, first weights, time to fill, and versions."""
    content = fingerprint_of(problem.knobs, {**problem.arrays, **problem.network.state_dict()})
    versions = [__version__, torch.__version__]
    return fingerprint_of(
        {"caller": content, "fit_seconds": options.fit_seconds, "versions": versions}, {}
    )


def _check_time(each_s: float, iterations: int, limit_s: float, factor: float) -> None:
    """Raise `OutOfTimeError` if all iterations take longer than `factor` times the limit."""
    if each_s * iterations > factor * limit_s:
        raise OutOfTimeError(
            f"{iterations:,} iterations at {each_s:.3g} s would take "
            f"{each_s * iterations / 3600:.3g} h; the limit is {limit_s:.0f} s."
        )
