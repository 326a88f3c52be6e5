"""A method file: the class, its hyperparameters, sweeps and profiles."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from mor_bench.specs.base import Count, Label, Positive, StrictModel, Text
from mor_bench.specs.battery import Battery
from mor_bench.specs.parameters import check_parameters, load_class
from mor_bench.specs.split_spec import SplitBy

Told = Literal["input", "linear-response", "equations"]
"""Information at query time: the input alone, with its linear response, or with the equations.

The input is the forces; on scenes with observed displacements it is those.
"""

_TOLD_BY_INPUT: dict[str, Told] = {"force": "input", "linear-response": "linear-response"}


MAX_CONFIGURATIONS = 1000


class Profile(StrictModel):
    """Changes that a profile makes: replaced parameters, replaced sweeps, seconds of a fit."""

    parameters: dict[str, Any] = Field(default_factory=dict)
    sweep: dict[str, list[Any]] = Field(default_factory=dict)
    fit_s: Positive | None = None


class Regime(StrictModel):
    """The conditions that a method was built for.

    A comparison under other conditions says nothing final about the method.

    Attributes
    ----------
    says : str
        The conditions in words.
    min_dofs, min_train, min_iterations : int, optional
        Least numbers of degrees of freedom, training samples and iterations.
    split : str, optional
        How training and test samples are separated.
    gpu : bool
        Whether training and queries need a graphics processor. Queries are timed on the CPU only,
        so no comparison tests such a method in its regime.
    """

    says: Text
    min_dofs: Count | None = None
    min_train: Count | None = None
    min_iterations: Count | None = None
    split: SplitBy | None = None
    gpu: bool = False


class MethodSpec(StrictModel):
    """A method file.

    Attributes
    ----------
    surrogate : str
        The class, ``package.module:Class``.
    told : Told, optional
        Information that the method gets at query time. A parameter `input` takes precedence.
    snapshots : bool
        Whether the method learns from snapshots with the parameters of the file.
    extra : str, optional
        Extra of mor-bench that the method needs.
    observed : bool
        Whether the method only handles scenes in which displacements are observed.
    reference : bool
        Whether the method solves the full equations on the dataset's own mesh. Its error is then
        that of its tolerance.
    limits : str
        Where the method fails, in plain words.
    folder : Path, optional
        Folder of the file, which may also hold the module. None for the suite's own methods.
    asked : str
        Name or path by which the method was asked for, with the parameters in brackets.
    fit_s : float, optional
        Approximate cost of a fit on beam-coarse, in core-seconds.
    compile_s : float, optional
        Approximate time to compile the method's kernels, beside those of the full-order model, s.
    battery : Battery
        Settings of shared tests and benchmarks.
    """

    name: Label
    title: Text
    surrogate: Text
    source: Text
    told: Told | None = None
    snapshots: bool = True
    extra: Literal["learn", "mkl", "pymor"] | None = None
    observed: bool = Field(default=False, exclude_if=lambda value: not value)
    reference: bool = False
    limits: Text = ""
    regime: Regime | None = None
    folder: Path | None = None
    asked: str = ""
    fit_s: Positive | None = None
    compile_s: Positive | None = None
    parameters: dict[str, Any] = Field(default_factory=dict)
    sweep: dict[str, list[Any]] = Field(default_factory=dict)
    profiles: dict[Literal["quick", "full"], Profile] = Field(default_factory=dict)
    battery: Battery = Field(default=Battery(), exclude=True)

    @field_validator("surrogate")
    @classmethod
    def _importable(cls, value: str) -> str:
        module, _, name = value.partition(":")
        if not module or not name:
            raise ValueError("it must read `package.module:Class`")
        return value

    @model_validator(mode="after")
    def _no_empty_sweep(self) -> MethodSpec:
        for sweep in (self.sweep, *(profile.sweep for profile in self.profiles.values())):
            for key, values in sweep.items():
                if not values:
                    raise ValueError(f"the sweep of `{key}` is empty")
            if (n := prod(map(len, sweep.values()))) > MAX_CONFIGURATIONS:
                raise ValueError(
                    f"a sweep must make at most {MAX_CONFIGURATIONS:,} configurations; got {n:,}"
                )
        return self

    def load_class(self) -> type[Any]:
        """Import the class of the method, from the folder of its file if it lies there."""
        return load_class(self.surrogate, self.folder)

    def parameters_of(self, profile: str) -> dict[str, Any]:
        """Return the parameters of the file, replaced by those of the profile, without sweeps."""
        return {**self.parameters, **self._profile(profile).parameters}

    def told_with(self, parameters: Mapping[str, Any]) -> Told | None:
        """Return what a configuration is told at query time; None if the file does not state it."""
        return _TOLD_BY_INPUT.get(str(parameters.get("input")), self.told)

    def fit_seconds(self, profile: str) -> float | None:
        """Return the approximate cost of a fit on beam-coarse, core-s, if the file has it."""
        return self._profile(profile).fit_s or self.fit_s

    def swept_keys(self, profile: str) -> list[str]:
        """Return the parameters that the sweep of the profile, or else of the file, varies."""
        return list(self.sweep_of(profile))

    def configurations(self, profile: str) -> list[dict[str, Any]]:
        """Return the parameters of every swept configuration; the first key varies slowest."""
        sweep = self.sweep_of(profile)
        return [
            {**self.parameters_of(profile), **dict(zip(sweep, row, strict=True))}
            for row in itertools.product(*sweep.values())
        ]

    def _profile(self, name: str) -> Profile:
        return self.profiles.get(name, Profile())  # type: ignore[call-overload, no-any-return]

    def sweep_of(self, profile: str) -> dict[str, list[Any]]:
        """Return the swept parameters of the profile, or else of the file, with their values."""
        return self._profile(profile).sweep or self.sweep


def check_method(spec: MethodSpec) -> None:
    """Check every configuration of a method, in both profiles, and what its tests use.

    Raises
    ------
    SpecError, MissingDependencyError
    """
    surrogate = spec.load_class()
    for where, configurations in all_configurations(spec).items():
        for configuration in configurations:
            check_parameters(surrogate, configuration, where)


def all_configurations(spec: MethodSpec) -> dict[str, list[dict[str, Any]]]:
    """Return all parameters that a method file gives to its class, by place in the file."""
    battery = spec.battery
    races = [race.parameters for race in battery.races]
    observed = battery.parameters_for(observed=True)
    return {
        **{
            f"method {spec.name} ({profile})": spec.configurations(profile)
            for profile in ("quick", "full")
        },
        f"method {spec.name} (battery)": [
            {**spec.parameters, **cheap}
            for cheap in (battery.parameters, observed, battery.benchmark, *races)
        ],
    }
