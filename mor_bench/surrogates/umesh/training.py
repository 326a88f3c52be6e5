"""Training of the U-Net: mean squared error over the nodes, Adam, a fixed number of iterations."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, isfinite, pi
from time import perf_counter
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mor_bench.errors import MorBenchError, OutOfTimeError
from mor_bench.surrogates.umesh.grid import PaddedGrid
from mor_bench.surrogates.umesh.network import UNet

Schedule = Literal["constant", "one-cycle"]

LOSS_INTERVAL = 50
"""Iterations per point of the loss curve; reading the loss more often would cost a little and show mostly noise."""

LOOKS_AHEAD = {5: 3.0, 100: 1.0}
"""After how many iterations, beside a first one that makes what the others find, the time of all is estimated, and how many
times the limit that may be: a machine that is busy for a moment ends no training."""

WARM_UP = 0.1
"""Part of a one-cycle schedule during which the learning rate rises."""


@dataclass(frozen=True)
class TrainingPlan:
    """How a network is trained; `UMesh` says what each means."""

    iterations: int
    batch_size: int
    learning_rate: float
    schedule: Schedule
    second_moment_decay: float


def rate_factor(schedule: Schedule, iteration: int, iterations: int) -> float:
    """The learning rate of an iteration, counted from 0, as a fraction of the peak.

    Constant: 1. One-cycle: linearly up during the first tenth, then half a cosine down to zero.
    """
    if schedule == "constant":
        return 1.0
    progress = (iteration + 1) / (iterations + 1)
    if progress < WARM_UP:
        return progress / WARM_UP
    return 0.5 * (1.0 + cos(pi * (progress - WARM_UP) / (1.0 - WARM_UP)))


def train(
    network: UNet,
    grid: PaddedGrid,
    inputs: Tensor,
    displacements: Tensor,
    plan: TrainingPlan,
    generator: torch.Generator,
    time_limit_s: float | None = None,
) -> NDArray[np.float64]:
    """Change the network's weights to lower the mean squared error.

    Every epoch is a new permutation; a last, smaller batch is left out.

    Parameters
    ----------
    network : UNet
    grid : PaddedGrid
        Takes the network's output to the nodes, where the error counts.
    inputs : (n_samples, 3, x, y, z) float32
        Scaled forces on the grid.
    displacements : (n_samples, n_nodes, 3) float32
        Scaled displacements at the nodes.
    plan : TrainingPlan
    generator : torch.Generator
        Draws the permutations; no global random state is read or changed.
    time_limit_s : float, optional
        Seconds that training may take; it is not begun in earnest when it would take longer.

    Returns
    -------
    (n_intervals,) float64
        The loss, averaged over the components of all nodes of the batch and over `LOSS_INTERVAL` iterations.

    Raises
    ------
    MorBenchError
        If the loss is not finite.
    OutOfTimeError
        If the first iterations say that all would take longer than the limit.
    """
    batch_size = min(plan.batch_size, len(inputs))
    per_batch = 1.0 / displacements[:batch_size].numel()
    optimiser = torch.optim.Adam(network.parameters(), lr=plan.learning_rate, betas=(0.9, plan.second_moment_decay), fused=True)
    order = torch.empty(0, dtype=torch.int64)
    curve: list[float] = []
    total, n_summed = torch.zeros(()), 0
    for iteration in range(plan.iterations):
        if len(order) < batch_size:
            order = torch.randperm(len(inputs), generator=generator)
        rows, order = order[:batch_size], order[batch_size:]
        for group in optimiser.param_groups:
            group["lr"] = plan.learning_rate * rate_factor(plan.schedule, iteration, plan.iterations)
        loss = (grid.to_nodes(network(inputs[rows])) - displacements[rows]).square().sum() * per_batch
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        if iteration == 0:
            start = perf_counter()
        elif iteration in LOOKS_AHEAD and time_limit_s is not None:
            _check_time((perf_counter() - start) / iteration, plan.iterations, time_limit_s, LOOKS_AHEAD[iteration])
        total, n_summed = total + loss.detach(), n_summed + 1
        if n_summed == LOSS_INTERVAL or iteration == plan.iterations - 1:
            curve.append(float(total) / n_summed)
            if not isfinite(curve[-1]):
                raise MorBenchError(f"training diverged before iteration {iteration + 1}: `learning_rate` {plan.learning_rate} is too high.")
            total, n_summed = torch.zeros(()), 0
    return np.array(curve)


def _check_time(each_s: float, iterations: int, limit_s: float, factor: float) -> None:
    """Raise `OutOfTimeError` if that many iterations take longer than some times the limit."""
    if each_s * iterations > factor * limit_s:
        raise OutOfTimeError(
            f"{iterations:,} iterations at {each_s:.3g} s would take {each_s * iterations / 3600:.3g} h; the limit is {limit_s:.0f} s."
        )
