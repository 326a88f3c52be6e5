"""Hard cases, their outcomes, and the methods and datasets on which they are tried."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import MorBenchError, SolverError
from mor_bench.measure.discretisation_error import measured
from mor_bench.method_loading import make_surrogate
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset, Snapshots, load_dataset
from mor_bench.snapshots.patch_loads import PatchLoads
from mor_bench.specs import DatasetSpec, MethodSpec, check_parameters, load_generated_spec
from mor_bench.surrogate import Surrogate

Verdict = Literal["pass", "fall short", "not applicable"]

LONGEST = {"quick": 300, "full": None}
"""Largest number of training iterations, by profile. Errors are published here, not compared."""

LONGEST_S = 1800.0
"""Time limit that a training receives, s; a method that predicts a longer time reports it."""

BRIEF = 20
"""Iterations of a training whose errors do not matter."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a case.

    Attributes
    ----------
    verdict : {"pass", "fall short", "not applicable"}
    happened : str
        What was observed, in words and numbers.
    measured : dict
        The numbers behind the verdict.
    """

    verdict: Verdict
    happened: str
    measured: dict[str, Any] = field(default_factory=dict)


def judged(good: bool, happened: str, **measured: Any) -> Outcome:
    """Return an outcome that passes or falls short."""
    return Outcome("pass" if good else "fall short", happened, measured)


class Scenes:
    """The datasets that methods are tried on.

    Parameters
    ----------
    cache : Path, optional
        Cache folder of datasets.

    Attributes
    ----------
    spec : DatasetSpec
        Specification of beam-tiny.
    tiny : Dataset
        beam-tiny with its test sets.
    """

    def __init__(self, cache: Path | None) -> None:
        self._cache = cache
        self.spec = load_generated_spec("beam-tiny")
        self.tiny = load_dataset(
            self.spec,
            tests=["in-range", "2x", "4x", "unseen-regions", "several-forces"],
            cache=cache,
        )

    @cached_property
    def pressed(self) -> Dataset:
        """Return beam-tiny under normal forces only, so that the other directions are unseen."""
        content = self.spec.model_dump()
        spec = DatasetSpec.model_validate(
            {
                **content,
                "name": f"{self.spec.name}-pressed",
                "loads": {**content["loads"], "kind": "normal"},
            }
        )
        return load_dataset(spec, tests=["in-range", "unseen-directions"], cache=self._cache)

    @cached_property
    def discretisation_error(self) -> float:
        """Return the median relative l2 error of beam-tiny's mesh; 0 if it was not measured."""
        record = measured(self.spec, self._cache)
        return float(record["relative_l2_median"]) if record else 0.0


class Subject:
    """A method as cases use it: made anew, or fitted once on beam-tiny."""

    def __init__(self, spec: MethodSpec, profile: str, scenes: Scenes) -> None:
        self.name, self.scenes = spec.name, scenes
        self._spec, self._profile = spec, profile

    @property
    def data(self) -> Dataset:
        return self.scenes.tiny

    def check_parameters(self) -> None:
        """Raise `SpecError` if the method file's parameters are not valid."""
        parameters = self._spec.parameters_of(self._profile)
        check_parameters(self._spec.load_class(), parameters, f"method {self.name}")

    def fresh(self, brief: bool = False, **knobs: Any) -> Surrogate:
        """Return an unfitted method with a short training and some parameters replaced."""
        parameters = {**self._spec.parameters_of(self._profile), **knobs}
        longest = BRIEF if brief else LONGEST[self._profile]
        if longest is not None and "iterations" in parameters:
            parameters["iterations"] = min(parameters["iterations"], longest)
        method = make_surrogate(self._spec.load_class(), parameters)
        method.time_limit_s = LONGEST_S
        return method

    def fit(self, data: Dataset, brief: bool = False, **knobs: Any) -> Surrogate:
        """Return a `fresh` method, fitted on a dataset's training samples."""
        method = self.fresh(brief, **knobs)
        return method.fit(data.scene, data.train if method.needs_snapshots else None)

    @cached_property
    def _attempt(self) -> Surrogate | Exception:
        try:
            return self.fit(self.data)
        except Exception as error:  # foreign code; tried once, since it may be costly
            return error

    @property
    def fitted(self) -> Surrogate:
        """Return the method fitted on beam-tiny's training samples, or raise its fit's error."""
        if isinstance(self._attempt, Exception):
            raise self._attempt
        return self._attempt

    @cached_property
    def fitted_on_pressed(self) -> Surrogate:
        """Return the method fitted on `Scenes.pressed`."""
        return self.fit(self.scenes.pressed)


@dataclass(frozen=True)
class Case:
    """A hard case.

    Attributes
    ----------
    name, part : str
        The name by which it is selected, and its part, if it has several.
    expected : str
        The correct behaviour.
    concerns : callable
        Whether the case applies to a method.
    examine : callable
        Tries the case; any exception means falling short.
    """

    name: str
    part: str
    expected: str
    concerns: Callable[[Surrogate], bool]
    examine: Callable[[Subject], Outcome]


def hard_case(
    name: str, concerns: Callable[[Surrogate], bool], expected: str, part: str = ""
) -> Callable[[Callable[[Subject], Outcome]], Case]:
    """Return a decorator that makes a `Case` from the function that examines it."""
    return lambda examine: Case(name, part, expected, concerns, examine)


def every(method: Surrogate) -> bool:
    """Accept any method."""
    return True


def learner(method: Surrogate) -> bool:
    """Accept a method that learns from snapshots."""
    return method.needs_snapshots


def answers(method: Surrogate, forces: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return predictions (n, n_nodes, 3), m, made one by one; NaN without an equilibrium."""
    out = np.full(forces.shape, np.nan)
    for row, force in zip(out, forces, strict=True):
        with suppress(SolverError):
            row[:] = method.predict(force.copy())
    return out


def wrongly_handled(
    attempts: Mapping[str, Callable[[], object]], by: type[Exception] = MorBenchError
) -> list[str]:
    """Return the outcomes of attempts that do not raise an error of a given kind."""
    wrong = []
    for name, attempt in attempts.items():
        try:
            attempt()
            wrong.append(f"{name} was accepted")
        except by:
            continue
        except Exception as error:
            wrong.append(f"{name} raised {type(error).__name__}")
    return wrong


def with_samples(snapshots: Snapshots, rows: NDArray[np.int64], zeros: int = 0) -> Snapshots:
    """Return some samples; the last ``zeros`` of them get neither load nor displacement.

    A number that is repeated in ``rows`` repeats its sample.
    """
    chosen = snapshots[rows]
    assert isinstance(chosen.loads, PatchLoads)
    kept = np.arange(len(rows)) < len(rows) - zeros
    loads = replace(chosen.loads, vectors=chosen.loads.vectors * kept[:, None, None])
    return replace(
        chosen, loads=loads, free_displacements=chosen.free_displacements * kept[:, None]
    )


def rms(values: NDArray[np.float64]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def scene_of(spec: DatasetSpec, **changes: Any) -> Scene:
    """Return the scene of a dataset with some tables of its file replaced."""
    return load_scene({**spec.model_dump(mode="json", exclude_none=True), **changes})
