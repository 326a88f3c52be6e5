"""What a hard case is, what comes of it, and what it is tried on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import SolverError
from mor_bench.measure.discretisation_error import measured
from mor_bench.method_loading import make_surrogate
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.dataset import Dataset, Snapshots, load_dataset
from mor_bench.snapshots.sampling import PatchLoads
from mor_bench.specs import DatasetSpec, MethodSpec, check_parameters, load_generated_spec
from mor_bench.surrogate import Surrogate

Verdict = Literal["pass", "fall short", "not applicable"]

LONGEST = {"quick": 300, "full": None}
"""Iterations of a training at most, by profile: what is judged is behaviour, and errors are published, not compared."""

LONGEST_S = 1800.0
"""Seconds of a training at most; a method that sees that they will not do says so."""

BRIEF = 20
"""Iterations of a training of which only its manners matter."""


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes
    ----------
    verdict : {"pass", "fall short", "not applicable"}
    happened : str
        In words and numbers.
    measured : dict
        The numbers.
    """

    verdict: Verdict
    happened: str
    measured: dict[str, Any] = field(default_factory=dict)


def judged(good: bool, happened: str, **measured: Any) -> Outcome:
    """A pass, or falling short."""
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
        That of beam-tiny.
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
        """beam-tiny under forces along the surface's normal only, so that there are directions that training never saw."""
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
        """Median relative l2 of beam-tiny's mesh against the body; 0 where it was not measured."""
        record = measured(self.spec, self._cache)
        return float(record["relative_l2_median"]) if record else 0.0


class Subject:
    """A method as the cases take it: made anew, or fitted once on beam-tiny."""

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
        """An unfitted one with the method file's parameters, a short training and some other knobs."""
        parameters = {**self._spec.parameters_of(self._profile), **knobs}
        longest = BRIEF if brief else LONGEST[self._profile]
        if longest is not None and "iterations" in parameters:
            parameters["iterations"] = min(parameters["iterations"], longest)
        method = make_surrogate(self._spec.load_class(), parameters)
        method.time_limit_s = LONGEST_S
        return method

    def fit(self, data: Dataset, brief: bool = False, **knobs: Any) -> Surrogate:
        method = self.fresh(brief, **knobs)
        return method.fit(data.scene, data.train if method.needs_snapshots else None)

    @cached_property
    def _attempt(self) -> Surrogate | Exception:
        try:
            return self.fit(self.data)
        except Exception as error:  # third parties' code; tried once, whatever it costs
            return error

    @property
    def fitted(self) -> Surrogate:
        """Fitted on beam-tiny's training samples."""
        if isinstance(self._attempt, Exception):
            raise self._attempt
        return self._attempt

    @cached_property
    def fitted_on_pressed(self) -> Surrogate:
        return self.fit(self.scenes.pressed)


@dataclass(frozen=True)
class Case:
    """A hard case.

    Attributes
    ----------
    name, part : str
        What it is selected by, and which part of it, if it has several.
    expected : str
        The correct behaviour.
    concerns : callable
        Whether it is a case for a method.
    examine : callable
        Tries it; may raise what it likes.
    """

    name: str
    part: str
    expected: str
    concerns: Callable[[Surrogate], bool]
    examine: Callable[[Subject], Outcome]


def every(method: Surrogate) -> bool:
    """Any method."""
    return True


def learner(method: Surrogate) -> bool:
    """One that learns from snapshots."""
    return method.needs_snapshots


def answers(method: Surrogate, forces: NDArray[np.float64]) -> NDArray[np.float64]:
    """Predictions (n, n_nodes, 3), m, one by one; NaN where the method says that it finds no equilibrium."""
    out = np.full(forces.shape, np.nan)
    for row, force in zip(out, forces, strict=True):
        try:
            row[:] = method.predict(force.copy())
        except SolverError:
            continue
    return out


def refused(attempt: Callable[[], object], by: type[Exception]) -> str | None:
    """None where an attempt raises an error of a kind; else what it did instead."""
    try:
        attempt()
    except by:
        return None
    except Exception as error:
        return f"raised {type(error).__name__}"
    return "was taken"


def with_samples(snapshots: Snapshots, rows: NDArray[np.int64], zeros: int = 0) -> Snapshots:
    """Some samples, as often as their numbers stand, the last ``zeros`` of them with neither load nor displacement."""
    chosen = snapshots[rows]
    assert isinstance(chosen.loads, PatchLoads)
    kept = np.arange(len(rows)) < len(rows) - zeros
    loads = replace(chosen.loads, vectors=chosen.loads.vectors * kept[:, None, None])
    return replace(
        chosen, loads=loads, free_displacements=chosen.free_displacements * kept[:, None]
    )


def rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def scene_of(spec: DatasetSpec, **changes: Any) -> Scene:
    """The scene of a dataset with some tables of its file replaced."""
    return load_scene({**spec.model_dump(mode="json", exclude_none=True), **changes})
