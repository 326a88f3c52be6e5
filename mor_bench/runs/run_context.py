"""The checked options of a run, and the settings derived from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mor_bench.errors import InvalidInputError, MissingDependencyError
from mor_bench.options import DEFAULT_SEEDS, DEFAULT_TIME_LIMIT_S, Device, RunOptions, TrainOptions
from mor_bench.runs.configurations import MOST_CONFIGURATIONS, Budget
from mor_bench.runs.listener import Listener
from mor_bench.sandbox.process import default_memory_limit_bytes
from mor_bench.snapshots.executors import check_pool
from mor_bench.snapshots.generate import default_cache
from mor_bench.training_options import TrainingOptions
from mor_bench.version import __version__


@dataclass(frozen=True)
class RunContext:
    """Options of a run, its tuning budget, its training options and its listener.

    Attributes
    ----------
    options : RunOptions
    budget : Budget
        Tuning budget per method and dataset.
    training : TrainingOptions
        Device and seconds of trainings.
    listener : Listener
    """

    options: RunOptions
    budget: Budget
    training: TrainingOptions
    listener: Listener

    @classmethod
    def of(cls, options: RunOptions, listener: Listener = Listener()) -> RunContext:
        """Derive the context from the options.

        Raises
        ------
        InvalidInputError
            If options exclude each other, or there is no such device.
        """
        check_pool(options.workers, options.cluster)
        budget = Budget(
            MOST_CONFIGURATIONS[options.profile],
            options.time_limit_s or DEFAULT_TIME_LIMIT_S[options.profile],
        )
        return cls(options, budget, training_options(options, budget.seconds), listener)

    @property
    def seeds(self) -> int:
        """Number of trainings of each configuration that has a seed."""
        return self.options.seeds or DEFAULT_SEEDS[self.options.profile]

    @property
    def uses_shipped_weights(self) -> bool:
        """True if configurations may use weights that the suite ships instead of a training."""
        options = self.options
        may = options.profile == "quick" and not options.train and self.seeds == 1
        return may and options.limit is None and self.training == TrainingOptions()

    @property
    def cache(self) -> Path:
        """Cache folder."""
        return Path(self.options.cache or default_cache())

    @property
    def memory_limit_bytes(self) -> float:
        """Memory limit of a method's process."""
        return self.options.memory_limit_bytes or default_memory_limit_bytes()

    def recorded(self) -> dict[str, Any]:
        """Return the settings that results.json records; a resumed run must have the same."""
        options, budget = self.options, self.budget
        settings: dict[str, Any] = {
            "profile": options.profile,
            "split": options.split,
            "limit": options.limit,
            "threads": options.threads,
            "test_seed": options.test_seed,
            "budget": {"configurations": budget.configurations, "seconds": budget.seconds},
            "seeds": self.seeds,
            "device": self.training.device,
            "version": __version__,
        }
        if options.fit_seconds is not None:
            settings["fit_seconds"] = options.fit_seconds
        if options.train:
            settings["train"] = True
        if options.jobs > 1:  # fits that share the cores take longer than alone
            settings["jobs"] = options.jobs
        return settings

    def folders(self) -> dict[str, str]:
        """Return the folders that the options name; a command that repeats the run names them."""
        options = self.options
        named = {"cache": options.cache, "suite": options.suite}
        return {name: str(path.absolute()) for name, path in named.items() if path is not None}


def training_options(options: TrainOptions, budget_s: float = float("inf")) -> TrainingOptions:
    """Return device and seconds of trainings.

    "auto" is decided here, so that the record of a fit names the device that trained it.

    Raises
    ------
    InvalidInputError
        If there is no such device, or the seconds exceed the tuning budget of a method.
    MissingDependencyError
        If a CUDA device is asked for without PyTorch.
    """
    seconds = options.fit_seconds
    if seconds is not None and seconds >= budget_s:
        raise InvalidInputError(
            f"`fit_seconds` must be below the {budget_s:g} s that all fits of a method may take "
            f"together; got {seconds:g}."
        )
    training = TrainingOptions(options.device, seconds)
    if options.device != "cpu":
        training = replace(training, device=_available_device(training))
    return training


def _available_device(options: TrainingOptions) -> Device:
    try:
        from mor_bench.learning.training import device_of
    except ImportError:
        if options.device == "auto":
            return "cpu"
        raise MissingDependencyError(
            "`device`: training on a GPU needs PyTorch: pip install 'mor-bench[learn]'."
        ) from None
    return "cuda" if device_of(options).type == "cuda" else "cpu"
