"""Input of a training: the network, the loss, the samples, and the settings of the optimiser."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import cos, pi
from typing import Literal

import torch
from torch import Tensor, nn

Schedule = Literal["constant", "one-cycle"]
Precision = Literal["float32", "bfloat16"]
Loss = Callable[[Tensor], Tensor]
"""Mean loss of the samples with the given indices, (n,) int64 on the training device."""

WARM_UP = 0.1
"""Share of a one-cycle schedule during which the learning rate rises."""


@dataclass(frozen=True)
class TrainingPlan:
    """Settings of the optimiser.

    Attributes
    ----------
    iterations, batch_size : int
        Optimiser steps, and samples per step; a batch holds at most all samples.
    learning_rate : float
        Peak learning rate.
    schedule : {"constant", "one-cycle"}
        See `rate_factor`.
    second_moment_decay : float
        Adam's β₂.
    precision : {"float32", "bfloat16"}
        Precision of the products in the forward and backward pass. Weights and their updates are
        float32.
    validation_fraction : float
        Fraction of the training samples, chosen at random, that is held out for early stopping if
        the problem has no validation samples; 0 for no early stopping.
    """

    iterations: int
    batch_size: int
    learning_rate: float
    schedule: Schedule = "one-cycle"
    second_moment_decay: float = 0.999
    precision: Precision = "float32"
    validation_fraction: float = 0.0


@dataclass(frozen=True)
class LearningProblem:
    """A network, and the loss that its training lowers.

    Attributes
    ----------
    network : nn.Module
        On the training device.
    loss : Loss
        Computed in training mode in a step, and in evaluation mode on held-out samples.
    n_samples : int
        Number of training samples, including held-out ones.
    generator : torch.Generator
        A generator on the processor. It draws the order of the samples; the loss may use it too.
    arrays : mapping of Tensor
        Constants of the loss. They identify a training: a checkpoint with other arrays is refused.
    knobs : mapping
        Hyperparameters of the method as JSON values; they identify a training too.
    n_validation : int
        Number of validation samples; their indices follow those of the training samples.
    repeats : bool
        True if the loss does the same operations with every batch, and draws no random number. Then
        a graphics processor replays a recorded step.
    """

    network: nn.Module
    loss: Loss
    n_samples: int
    generator: torch.Generator
    arrays: Mapping[str, Tensor] = field(default_factory=dict)
    knobs: Mapping[str, object] = field(default_factory=dict)
    n_validation: int = 0
    repeats: bool = False


def rate_factor(schedule: Schedule, iteration: int, iterations: int) -> float:
    """Return the learning rate of an iteration, counted from 0, as a fraction of the peak.

    Constant: 1. One-cycle: a linear rise during the first tenth, then half a cosine down to zero.
    """
    if schedule == "constant":
        return 1.0
    progress = (iteration + 1) / (iterations + 1)
    if progress < WARM_UP:
        return progress / WARM_UP
    return 0.5 * (1.0 + cos(pi * (progress - WARM_UP) / (1.0 - WARM_UP)))
