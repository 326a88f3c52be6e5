"""The training loop: Adam steps, losses, early stopping, and iterations that fit a given time."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from math import isfinite
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from mor_bench.errors import MorBenchError
from mor_bench.learning.cuda_graphs import ALONE, N_UNRECORDED, RecordedStep
from mor_bench.learning.training_plan import LearningProblem, TrainingPlan, rate_factor
from mor_bench.training_options import TrainingOptions

LOSS_INTERVAL = 50
"""Iterations per point of the loss curve; more points would cost time and mostly show noise."""

VALIDATIONS, PATIENCE = 50, 15
"""Validations in a whole training, and validations without a lower loss that stop it early."""

TRIAL_ITERATIONS, TRIAL_SHARE = 20, 0.1
"""Iterations of the trial that sets the length of a timed training, and its share of the time.

The trial has at least three iterations.
"""


class TrainingLoop:
    """A running training with its complete state.

    Attributes
    ----------
    iterations, iteration : int
        Planned and done.
    curve, validated : list of float
        Mean losses per `LOSS_INTERVAL`, and losses of the held-out samples.
    total, n_summed
        Sum and number of the losses since the last point of the curve.
    rows, held, order : (n,) int64
        Indices of the training samples, of the validation samples (held out by the caller or
        here), and of those left in this epoch.
    best : dict of Tensor
        Weights with the lowest validation loss.
    """

    def __init__(
        self,
        problem: LearningProblem,
        plan: TrainingPlan,
        options: TrainingOptions,
        device: torch.device,
    ) -> None:
        self.problem, self.plan, self.options, self.device = problem, plan, options, device
        self.network, self.generator = problem.network, problem.generator
        self.optimiser = torch.optim.Adam(
            self.network.parameters(),
            lr=plan.learning_rate,
            betas=(0.9, plan.second_moment_decay),
            fused=True,
        )
        self.iterations = self.iteration = self.n_summed = 0
        self.curve: list[float] = []
        self.validated: list[float] = []
        self.rows = torch.arange(problem.n_samples)
        self.held = torch.empty(0, dtype=torch.int64)
        self.order = torch.empty(0, dtype=torch.int64)
        self.total = torch.zeros((), device=device)
        self.best: dict[str, Tensor] = {}
        self._n_unrecorded = N_UNRECORDED if problem.repeats and device.type == "cuda" else 0
        self._n_taken = 0
        self._recorded: RecordedStep | None = None
        self.network.train()

    @property
    def n_held(self) -> int:
        """Number of samples that decide on early stopping."""
        fraction, n = self.plan.validation_fraction, self.problem.n_samples
        if fraction == 0 or self.problem.n_validation:
            return self.problem.n_validation if fraction > 0 else 0
        return max(1, round(fraction * n)) if n > 1 else 0

    @property
    def n_rows(self) -> int:
        """Number of samples to learn from."""
        return self.problem.n_samples - (0 if self.problem.n_validation else self.n_held)

    @property
    def validation_interval(self) -> int:
        """Iterations between two validations."""
        return max(1, self.iterations // VALIDATIONS)

    @property
    def stopped(self) -> bool:
        """True if the validation loss has not fallen for `PATIENCE` validations."""
        if not self.validated:
            return False
        return len(self.validated) - 1 - int(np.argmin(self.validated)) >= PATIENCE

    def begin(self) -> None:
        """Choose the samples that decide on early stopping, and set the number of iterations."""
        if self.n_held and self.problem.n_validation:
            self.held = self.n_rows + torch.arange(self.n_held)
        elif self.n_held:
            order = torch.randperm(self.problem.n_samples, generator=self.generator)
            self.held = order[: self.n_held].sort().values
            self.rows = order[self.n_held :].sort().values
        self.iterations = self.plan.iterations
        if self.options.fit_seconds is not None:
            self.iterations = self._iterations_in(self.options.fit_seconds)

    def _iterations_in(self, seconds: float) -> int:
        """Return how many iterations fit in the given time, from a discarded trial."""
        weights, drawn = deepcopy(self.network.state_dict()), self.generator.get_state()
        trial_options = TrainingOptions(device=self.options.device)
        trial = TrainingLoop(self.problem, self.plan, trial_options, self.device)
        trial.iterations, trial.rows = self.plan.iterations, self.rows
        for _ in range(1 + self._n_unrecorded):  # they include one-time set-up
            trial.step()
        start = now = self._now()
        done = 0
        while done < 3 or (done < TRIAL_ITERATIONS and now - start < TRIAL_SHARE * seconds):
            trial.step()
            done, now = done + 1, self._now()
        each, validation = (now - start) / done, 0.0
        if len(self.held):
            trial.held = self.held
            trial.validate()
            validation = self._now() - now
        self.network.load_state_dict(weights)
        self.generator.set_state(drawn)
        left = seconds - (self._now() - start)
        # With fewer iterations than `VALIDATIONS`, a validation follows every iteration.
        if left > VALIDATIONS * (validation + each):
            return max(1, int((left - VALIDATIONS * validation) / each))
        return max(1, int(left / (validation + each)))

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        return perf_counter()

    def step(self) -> None:
        """Take one optimiser step; record and validate where an interval ends."""
        plan = self.plan
        batch_size = min(plan.batch_size, len(self.rows))
        if len(self.order) < batch_size:
            self.order = self.rows[torch.randperm(len(self.rows), generator=self.generator)]
        rows, self.order = self.order[:batch_size], self.order[batch_size:]
        factor = rate_factor(plan.schedule, self.iteration, self.iterations)
        loss = self._take(rows.to(self.device), plan.learning_rate * factor)
        self.iteration += 1
        self.total, self.n_summed = self.total + loss.float(), self.n_summed + 1
        last = self.iteration == self.iterations
        if self.n_summed == LOSS_INTERVAL or last:
            self._record()
        if len(self.held) and (self.iteration % self.validation_interval == 0 or last):
            self.validate()

    def _take(self, rows: Tensor, rate: float) -> Tensor:
        """Take a step, on a graphics processor by replay if possible; return the loss before it."""
        self._n_taken += 1
        groups = self.optimiser.param_groups
        if self._recorded is None and 0 < self._n_unrecorded < self._n_taken:
            for group in groups:
                group["capturable"], group["lr"] = True, torch.tensor(rate, device=self.device)
            with ALONE:
                self._recorded = RecordedStep(self._changed, rows)
        for group in groups:
            if self._recorded is None:
                group["lr"] = rate
            else:
                group["lr"].fill_(rate)
        if self._recorded is not None:
            return self._recorded(rows)
        with self._without_replay():
            return self._changed(rows)

    def _without_replay(self) -> AbstractContextManager[object]:
        return ALONE if self.device.type == "cuda" else nullcontext()

    def _changed(self, rows: Tensor) -> Tensor:
        """Change the weights by the gradient of the loss of some samples; return the loss."""
        with self._products():
            loss = self.problem.loss(rows)
        self.optimiser.zero_grad()
        torch.autograd.backward(loss)
        self.optimiser.step()
        return loss.detach()

    def _products(self) -> AbstractContextManager[object]:
        if self.plan.precision == "bfloat16":
            return torch.autocast(self.device.type, torch.bfloat16)
        return nullcontext()

    def _record(self) -> None:
        self.curve.append(float(self.total) / self.n_summed)
        self._check_finite(self.curve[-1])
        self.total, self.n_summed = torch.zeros((), device=self.device), 0
        if self.options.progress is not None:
            self.options.progress(self.iteration, self.iterations, self.curve[-1])

    def validate(self) -> None:
        """Append the loss of the held-out samples, and keep the weights if it is the lowest."""
        self.network.eval()
        with self._without_replay(), torch.no_grad(), self._products():
            parts = [
                (len(rows), self.problem.loss(rows.to(self.device)))
                for rows in torch.split(self.held, self.plan.batch_size)
            ]
        self.network.train()
        self.validated.append(sum(n * float(part) for n, part in parts) / len(self.held))
        self._check_finite(self.validated[-1])
        if self.validated[-1] <= min(self.validated):
            weights = self.network.state_dict()
            self.best = {name: value.detach().clone() for name, value in weights.items()}

    def _check_finite(self, loss: float) -> None:
        if not isfinite(loss):
            plan = self.plan
            remedy = "a lower rate" + " or float32" * (plan.precision != "float32")
            raise MorBenchError(
                f"training diverged before iteration {self.iteration}: the loss is {loss}, with a "
                f"learning rate of {plan.learning_rate} and products in {plan.precision}; {remedy} "
                "may help."
            )

    def finish(self) -> None:
        """Record the remaining losses after an early stop, and load the best validated weights."""
        if self.n_summed:
            self.curve.append(float(self.total) / self.n_summed)
            self._check_finite(self.curve[-1])
        if self.best:
            self.network.load_state_dict(self.best)
        self.network.eval()
