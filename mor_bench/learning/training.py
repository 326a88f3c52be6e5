"""Training of networks: Adam steps within a time limit, resumable with bit-identical results."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, OutOfTimeError
from mor_bench.learning.checkpoint import fingerprint_of, resume, write_checkpoint
from mor_bench.learning.cuda_graphs import own_stream
from mor_bench.learning.training_loop import TrainingLoop
from mor_bench.learning.training_plan import LearningProblem, TrainingPlan
from mor_bench.training_options import TrainingOptions
from mor_bench.version import __version__

TIME_CHECKS = {5: 3.0, 100: 1.0}
"""Iterations after which the total time is estimated, and the allowed multiple of the limit.

The first check is generous: a short load on the machine must not end a training. The first
iteration is not timed, because it includes one-time set-up.
"""

CHECKPOINT_EVERY_S = 30.0


@dataclass(frozen=True)
class Training:
    """Result of a training, apart from the weights.

    Attributes
    ----------
    loss_curve : (n_intervals,) float64
        Mean loss per `training_loop.LOSS_INTERVAL` iterations.
    validation_curve : (n_validations,) float64
        Loss of the held-out samples, `training_loop.VALIDATIONS` times in a whole training.
    iterations : int
        The planned number of iterations; the same number repeats the training. An early stop does
        fewer.
    """

    loss_curve: NDArray[np.float64]
    validation_curve: NDArray[np.float64]
    iterations: int


def device_of(options: TrainingOptions) -> torch.device:
    """Return the training device; "auto" is the first CUDA device if there is one.

    Raises
    ------
    InvalidInputError
        If CUDA is requested and there is none.
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

    Every epoch is a new permutation of the samples; an incomplete last batch is left out. The same
    problem and plan give bit-identical weights on one processor and number of threads, interrupted
    or not. No global random state changes. The network ends in evaluation mode.

    Parameters
    ----------
    problem : LearningProblem
    plan : TrainingPlan
    options : TrainingOptions, optional
        Device, training time and checkpoint. The checkpoint is also written at the end; the caller
        deletes it once the model is saved. The caller handles ``start_from``.
    time_limit_s : float, optional
        Time limit for the training, s.

    Returns
    -------
    Training

    Raises
    ------
    MorBenchError
        If the loss is not finite.
    OutOfTimeError
        If the first iterations show that the training would exceed the limit.
    StoreError
        If the checkpoint is damaged.
    InvalidInputError
        If the checkpoint belongs to another training.
    """
    options = options or TrainingOptions()
    device = device_of(options)
    with own_stream() if device.type == "cuda" else nullcontext():
        return _trained(TrainingLoop(problem, plan, options, device), time_limit_s)


def _trained(loop: TrainingLoop, time_limit_s: float | None) -> Training:
    problem, options = loop.problem, loop.options
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
    """Identify a training by its data, initial weights, training time and versions."""
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
