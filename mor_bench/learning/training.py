"""Training of networks: Adam, a fixed number of iterations, checkpoints from which a training goes on to the same last bit."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from dataclasses import dataclass, field
from math import cos, isfinite, pi
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor, nn

from mor_bench.errors import InvalidInputError, MorBenchError, OutOfTimeError, StoreError
from mor_bench.snapshots.store import write_atomically
from mor_bench.surrogate import TrainingOptions
from mor_bench.version import __version__

Schedule = Literal["constant", "one-cycle"]
Precision = Literal["float32", "bfloat16"]
Loss = Callable[[Tensor], Tensor]
"""The mean loss of some samples, by their numbers (n,) int64 on the device of the training."""

LOSS_INTERVAL = 50
"""Iterations per point of the loss curve; reading the loss more often would cost a little and show mostly noise."""

LOOKS_AHEAD = {5: 3.0, 100: 1.0}
"""After how many iterations, beside a first one that makes what the others find, the time of all is estimated, and how many
times the limit that may be: a machine that is busy for a moment ends no training."""

WARM_UP = 0.1
"""Part of a one-cycle schedule during which the learning rate rises."""

VALIDATIONS, PATIENCE = 50, 15
"""How often the loss of the samples held out is taken during a whole training, and how many times in a row it may fail to
fall before the training ends with the weights of its lowest."""

TRIAL_ITERATIONS, TRIAL_SHARE = 20, 0.1
"""Iterations from whose time a training is sized to seconds, which leave no trace; fewer, but three, where they take more than
this part of the seconds."""

CHECKPOINT_EVERY_S = 30.0


@dataclass(frozen=True)
class TrainingPlan:
    """How a network is trained.

    Attributes
    ----------
    iterations, batch_size : int
        Optimiser steps, and samples per step; at most all there are.
    learning_rate : float
        The peak.
    schedule : {"constant", "one-cycle"}
        See `rate_factor`.
    second_moment_decay : float
        Adam's β₂.
    precision : {"float32", "bfloat16"}
        Of the products in the forward and backward pass; weights and their updates are float32.
    validation_fraction : float
        Part of the training samples that are held out, drawn at random, to end the training early; 0 for none.
    """

    iterations: int
    batch_size: int
    learning_rate: float
    schedule: Schedule = "one-cycle"
    second_moment_decay: float = 0.999
    precision: Precision = "float32"
    validation_fraction: float = 0.0


@dataclass
class Training:
    """What a training leaves beside the weights.

    Attributes
    ----------
    loss_curve : (n_intervals,) float64
        The loss, averaged over `LOSS_INTERVAL` iterations.
    validation_curve : (n_validations,) float64
        The loss of the samples held out, a part `1 / VALIDATIONS` of all iterations apart.
    iterations : int
        Planned, and not all done after an early stop: the number that repeats the training.
    """

    loss_curve: NDArray[np.float64]
    validation_curve: NDArray[np.float64]
    iterations: int


def device_of(options: TrainingOptions) -> torch.device:
    """The device that trains; "auto" is the first CUDA device if there is one.

    Raises
    ------
    InvalidInputError
        If CUDA is asked for and there is none.
    """
    if options.device == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError(
            "`device` is 'cuda', but PyTorch finds no CUDA device here; 'cpu' and 'auto' train on the processor."
        )
    return torch.device("cuda" if options.device != "cpu" and torch.cuda.is_available() else "cpu")


def fingerprint_of(parts: Mapping[str, object], arrays: Mapping[str, Tensor]) -> str:
    """SHA-256 of what decides a training: knobs and the like, which JSON can hold, and what is learned from."""
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode())
    for name in sorted(arrays):
        array = arrays[name].detach().cpu().contiguous().numpy()
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def network_weights(state: Mapping[str, NDArray[Any]]) -> dict[str, Tensor]:
    """Of a model's arrays those of its network, by the names that they have there."""
    return {
        name.removeprefix("network."): torch.from_numpy(array)
        for name, array in state.items()
        if name.startswith("network.")
    }


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
    network: nn.Module,
    loss: Loss,
    n_samples: int,
    plan: TrainingPlan,
    generator: torch.Generator,
    options: TrainingOptions | None = None,
    time_limit_s: float | None = None,
    fingerprint: str = "",
) -> Training:
    """Change a network's weights to lower a loss.

    Every epoch is a new permutation; a last, smaller batch is left out. The same network, loss, plan and generator give the
    same weights to the last bit on one processor and number of threads, interrupted and resumed or not.

    Parameters
    ----------
    network : nn.Module
        On the device of ``device_of(options)``; in training mode while the loss of a step is taken, and left in evaluation mode.
    loss : Loss
    n_samples : int
        Of the training, those held out included.
    plan : TrainingPlan
    generator : torch.Generator
        Of the processor; draws the permutations, and whatever the loss draws from it. No global random state is read or changed.
    options : TrainingOptions, optional
        Device, seconds that the training is sized to, and checkpoint, which is written at the end too: the caller deletes it when the
        model is kept. ``start_from`` is the caller's to heed.
    time_limit_s : float, optional
        Seconds that training may take; it is not begun in earnest when it would take longer.
    fingerprint : str
        Tells trainings apart: a checkpoint is only resumed by the one that wrote it, with the same seconds and versions.

    Returns
    -------
    Training

    Raises
    ------
    MorBenchError
        If the loss is not finite.
    OutOfTimeError
        If the first iterations say that all would take longer than the limit.
    StoreError
        If the checkpoint is damaged.
    InvalidInputError
        If the checkpoint is of another training.
    """
    options = options or TrainingOptions()
    course = _Course(network, loss, n_samples, plan, generator, options)
    fingerprint = fingerprint_of(
        {
            "caller": fingerprint,
            "fit_seconds": options.fit_seconds,
            "versions": [__version__, torch.__version__],
        },
        {},
    )
    if options.checkpoint is None or not course.resume(options.checkpoint, fingerprint):
        course.begin()
    start, first, written = perf_counter(), course.iteration, perf_counter()
    while course.iteration < course.iterations and not course.stopped:
        course.step()
        done = course.iteration - first
        if done == 1:
            start = perf_counter()
        elif done - 1 in LOOKS_AHEAD and time_limit_s is not None:
            _check_time(
                (perf_counter() - start) / (done - 1),
                course.iterations - first,
                time_limit_s,
                LOOKS_AHEAD[done - 1],
            )
        if options.checkpoint is not None and perf_counter() - written > CHECKPOINT_EVERY_S:
            course.write(options.checkpoint, fingerprint)
            written = perf_counter()
    if options.checkpoint is not None and course.iteration > first:
        course.write(options.checkpoint, fingerprint)
    course.finish()
    return Training(np.array(course.curve), np.array(course.validated), course.iterations)


class _Numbers(BaseModel):
    """What a checkpoint holds beside tensors."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    iteration: Annotated[int, Field(ge=1)]
    iterations: Annotated[int, Field(ge=1)]
    n_summed: int
    curve: list[float]
    validated: list[float]


@dataclass
class _Course:
    """A training under way: all that decides how it goes on."""

    network: nn.Module
    loss: Loss
    n_samples: int
    plan: TrainingPlan
    generator: torch.Generator
    options: TrainingOptions
    iterations: int = 0
    iteration: int = 0
    n_summed: int = 0
    curve: list[float] = field(default_factory=list)
    validated: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.device = device_of(self.options)
        betas = 0.9, self.plan.second_moment_decay
        self.optimiser = torch.optim.Adam(
            self.network.parameters(), lr=self.plan.learning_rate, betas=betas, fused=True
        )
        self.rows = torch.arange(self.n_samples)
        self.held = torch.empty(0, dtype=torch.int64)
        self.order = torch.empty(0, dtype=torch.int64)
        self.total = torch.zeros((), device=self.device)
        self.best: dict[str, Tensor] = {}
        self.network.train()

    @property
    def n_held(self) -> int:
        """Samples that are held out."""
        fraction = self.plan.validation_fraction
        return (
            max(1, round(fraction * self.n_samples)) if fraction > 0 and self.n_samples > 1 else 0
        )

    @property
    def validation_interval(self) -> int:
        """Iterations between two looks at the samples held out."""
        return max(1, self.iterations // VALIDATIONS)

    @property
    def stopped(self) -> bool:
        """Whether the samples held out have gained nothing for long."""
        return (
            bool(self.validated)
            and len(self.validated) - 1 - int(np.argmin(self.validated)) >= PATIENCE
        )

    def begin(self) -> None:
        """From the first iteration."""
        if self.n_held:
            order = torch.randperm(self.n_samples, generator=self.generator)
            self.held, self.rows = (
                order[: self.n_held].sort().values,
                order[self.n_held :].sort().values,
            )
        self.iterations = self.plan.iterations
        if self.options.fit_seconds is not None:
            self.iterations = self._that_fit(self.options.fit_seconds)

    def _that_fit(self, seconds: float) -> int:
        """How many iterations take so long, with the looks at the samples held out, by some that leave no trace."""
        weights, drawn = deepcopy(self.network.state_dict()), self.generator.get_state()
        trial = _Course(
            self.network,
            self.loss,
            self.n_samples,
            self.plan,
            self.generator,
            TrainingOptions(device=self.options.device),
        )
        trial.iterations, trial.rows = self.plan.iterations, self.rows
        trial.step()  # makes what the others find
        start = now = self._now()
        done = 0
        while done < 3 or (done < TRIAL_ITERATIONS and now - start < TRIAL_SHARE * seconds):
            trial.step()
            done, now = done + 1, self._now()
        each, look = (now - start) / done, 0.0
        if len(self.held):
            trial.held = self.held
            trial._validate()
            look = self._now() - now
        self.network.load_state_dict(weights)
        self.generator.set_state(drawn)
        left = seconds - (self._now() - start)
        # As many looks as `VALIDATIONS`; one after every iteration where there are no more iterations than these.
        return max(
            1,
            int((left - VALIDATIONS * look) / each)
            if left > VALIDATIONS * (look + each)
            else int(left / (look + each)),
        )

    def _now(self) -> float:
        """Seconds of a clock, when all that was begun is done."""
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        return perf_counter()

    def step(self) -> None:
        """One iteration; now and then, a look at the losses."""
        plan = self.plan
        batch_size = min(plan.batch_size, len(self.rows))
        if len(self.order) < batch_size:
            self.order = self.rows[torch.randperm(len(self.rows), generator=self.generator)]
        rows, self.order = self.order[:batch_size], self.order[batch_size:]
        for group in self.optimiser.param_groups:
            group["lr"] = plan.learning_rate * rate_factor(
                plan.schedule, self.iteration, self.iterations
            )
        with self._products():
            loss = self.loss(rows.to(self.device))
        self.optimiser.zero_grad()
        torch.autograd.backward(loss)
        self.optimiser.step()
        self.iteration += 1
        self.total, self.n_summed = self.total + loss.detach().float(), self.n_summed + 1
        if self.n_summed == LOSS_INTERVAL or self.iteration == self.iterations:
            self.curve.append(float(self.total) / self.n_summed)
            self._check_finite(self.curve[-1])
            self.total, self.n_summed = torch.zeros((), device=self.device), 0
            if self.options.progress is not None:
                self.options.progress(self.iteration, self.iterations, self.curve[-1])
        if len(self.held) and (
            self.iteration % self.validation_interval == 0 or self.iteration == self.iterations
        ):
            self._validate()

    def _products(self) -> AbstractContextManager[object]:
        """In what precision the loss is taken."""
        return (
            torch.autocast(self.device.type, torch.bfloat16)
            if self.plan.precision == "bfloat16"
            else nullcontext()
        )

    def _validate(self) -> None:
        """The loss of the samples held out; the weights of the lowest are kept."""
        self.network.eval()
        with torch.no_grad(), self._products():
            parts = [
                (len(rows), self.loss(rows.to(self.device)))
                for rows in torch.split(self.held, self.plan.batch_size)
            ]
        self.network.train()
        self.validated.append(sum(n * float(part) for n, part in parts) / len(self.held))
        self._check_finite(self.validated[-1])
        if self.validated[-1] <= min(self.validated):
            self.best = {
                name: value.detach().clone() for name, value in self.network.state_dict().items()
            }

    def _check_finite(self, loss: float) -> None:
        if not isfinite(loss):
            raise MorBenchError(
                f"training diverged before iteration {self.iteration}: the loss is {loss}, with a learning rate of {self.plan.learning_rate} and "
                f"products in {self.plan.precision}; a lower rate{' or float32' * (self.plan.precision != 'float32')} may help."
            )

    def finish(self) -> None:
        """With the best weights, if samples were held out, and the losses since the last point of the curve, after an early end."""
        if self.n_summed:
            self.curve.append(float(self.total) / self.n_summed)
            self._check_finite(self.curve[-1])
        if self.best:
            self.network.load_state_dict(self.best)
        self.network.eval()

    def write(self, path: Path, fingerprint: str) -> None:
        """All that decides how the training goes on, to a file that is whole at any moment; not while it is diverging."""
        from safetensors.torch import save

        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= {f"best.{name}": value for name, value in self.best.items()}
        for number, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{number}.{name}": value for name, value in state.items()}
        tensors |= {
            "generator": self.generator.get_state(),
            "order": self.order,
            "rows": self.rows,
            "held": self.held,
            "total": self.total,
        }
        if not all(value.isfinite().all() for value in tensors.values()):
            return
        numbers = {
            "iteration": self.iteration,
            "iterations": self.iterations,
            "n_summed": self.n_summed,
            "curve": self.curve,
            "validated": self.validated,
        }
        header = {
            "format": "mor-bench checkpoint",
            "fingerprint": fingerprint,
            "numbers": json.dumps(numbers),
        }
        header["sha256"] = fingerprint_of(header, tensors)
        write_atomically(
            path,
            save(
                {name: value.cpu().contiguous().clone() for name, value in tensors.items()}, header
            ),
        )

    def resume(self, path: Path, fingerprint: str) -> bool:
        """Go on from a file, if it is there."""
        from safetensors import SafetensorError, safe_open

        if not path.exists():
            return False
        try:
            with safe_open(str(path), framework="pt") as file:
                header = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        except (SafetensorError, OSError) as error:
            raise StoreError(
                f"{path}: not a checkpoint, or damaged: {error}. Without it the training begins anew."
            ) from None
        if (
            header.get("format") != "mor-bench checkpoint"
            or header.get("fingerprint") != fingerprint
        ):
            raise InvalidInputError(
                f"{path}: the checkpoint of another training (knobs, seconds, samples or version); name another file, or delete it."
            )
        try:
            if header.pop("sha256") != fingerprint_of(header, tensors):
                raise ValueError("the checksum does not match")
            numbers = _Numbers.model_validate(json.loads(header["numbers"]))
            self.iteration, self.iterations, self.n_summed = (
                numbers.iteration,
                numbers.iterations,
                numbers.n_summed,
            )
            self.curve, self.validated = numbers.curve, numbers.validated
            self._check(tensors)
            self.network.load_state_dict(_under("network.", tensors))
            self.best = _under("best.", tensors)
            whole = self.optimiser.state_dict()
            n_parameters = len(whole["param_groups"][0]["params"])
            whole["state"] = {
                number: _under(f"optimiser.{number}.", tensors) for number in range(n_parameters)
            }
            self.optimiser.load_state_dict(whole)
            self.generator.set_state(tensors["generator"])
            self.order, self.rows, self.held = tensors["order"], tensors["rows"], tensors["held"]
            self.total = tensors["total"].to(self.device)
        except (KeyError, ValueError, TypeError, RuntimeError) as error:
            first = error.errors()[0] if isinstance(error, ValidationError) else None
            reason = f"`{'.'.join(map(str, first['loc']))}`: {first['msg']}" if first else error
            raise StoreError(
                f"{path}: a damaged checkpoint: {reason}. Without it the training begins anew."
            ) from None
        return True

    def _check(self, tensors: Mapping[str, Tensor]) -> None:
        """Raise `ValueError` unless the numbers and a checkpoint's tensors are some that the training can have come to."""
        ended = self.iteration == self.iterations
        n_points, n_looks = (
            -(-self.iteration // interval) if ended else self.iteration // interval
            for interval in (LOSS_INTERVAL, self.validation_interval)
        )
        counts = {
            "iterations": (
                self.iterations,
                self.iterations if self.options.fit_seconds is not None else self.plan.iterations,
            ),
            "iteration": (self.iteration, min(self.iteration, self.iterations)),
            "n_summed": (self.n_summed, 0 if ended else self.iteration % LOSS_INTERVAL),
            "curve": (len(self.curve), n_points),
            "validated": (len(self.validated), n_looks if self.n_held else 0),
        }
        for name, (came, due) in counts.items():
            if came != due:
                raise ValueError(
                    f"`{name}` must be {due} at iteration {self.iteration} of {self.iterations}; got {came}"
                )
        due_tensors = self._tensors_due()
        if tensors.keys() != due_tensors.keys():
            raise ValueError(
                f"its tensors are not those of the training: {', '.join(sorted(tensors.keys() ^ due_tensors.keys()))}"
            )
        for name, like in due_tensors.items():
            found = tensors[name]
            if (found.dtype, found.shape) != (like.dtype, like.shape) or not found.isfinite().all():
                raise ValueError(
                    f"`{name}` must be finite numbers, {like.dtype} of shape {tuple(like.shape)}; got {found.dtype} of shape {tuple(found.shape)}"
                )
            if (
                name.startswith("optimiser.")
                and name.endswith(".step")
                and not 1 <= found <= self.iteration
            ):
                raise ValueError(f"`{name}` must be in [1, {self.iteration}]; got {found}")
            if name.startswith("optimiser.") and name.endswith(".exp_avg_sq") and (found < 0).any():
                raise ValueError(f"`{name}` must not be negative")
        rows, held, order = (tensors[name] for name in ("rows", "held", "order"))
        parts = torch.cat([rows, held]).sort().values
        if (
            not torch.equal(parts, torch.arange(self.n_samples))
            or not torch.isin(order, rows).all()
            or len(set(order.tolist())) < len(order)
        ):
            raise ValueError("its samples are not those of the training")

    def _tensors_due(self) -> dict[str, Tensor]:
        """Tensors of the names, types and shapes that a checkpoint holds."""
        network, n_rows = self.network.state_dict(), self.n_samples - self.n_held
        batch_size = min(self.plan.batch_size, n_rows)
        n_drawn = batch_size * ((self.iteration - 1) % (n_rows // batch_size) + 1)
        due = {
            f"{part}.{name}": value
            for part in ("network", "best")[: 1 + bool(self.validated)]
            for name, value in network.items()
        }
        for number, parameter in enumerate(self.optimiser.param_groups[0]["params"]):
            due |= {
                f"optimiser.{number}.{name}": like
                for name, like in (
                    ("step", self.total),
                    ("exp_avg", parameter),
                    ("exp_avg_sq", parameter),
                )
            }
        samples = {"rows": n_rows, "held": self.n_held, "order": n_rows - n_drawn}
        return (
            due
            | {name: self.rows.new_empty(n) for name, n in samples.items()}
            | {"generator": self.generator.get_state(), "total": self.total}
        )


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Those whose names begin so, without that."""
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }


def _check_time(each_s: float, iterations: int, limit_s: float, factor: float) -> None:
    """Raise `OutOfTimeError` if that many iterations take longer than some times the limit."""
    if each_s * iterations > factor * limit_s:
        raise OutOfTimeError(
            f"{iterations:,} iterations at {each_s:.3g} s would take {each_s * iterations / 3600:.3g} h; the limit is {limit_s:.0f} s."
        )
