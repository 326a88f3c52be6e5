"""Who competes: the default methods, every configuration of each, all checked before anything runs; and the budget of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any

from mor_bench.errors import InvalidInputError, MissingDependencyError
from mor_bench.measure.method_session import MethodSession
from mor_bench.mechanics.model import check_supports
from mor_bench.results.row import label_of
from mor_bench.runs.fit_cache import Job
from mor_bench.sandbox.process import (
    START_LIMIT_S,
    MethodFailedError,
    Restrictions,
    SandboxedProcess,
    default_memory_limit_bytes,
)
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.generate import default_cache
from mor_bench.specs import (
    AnyDatasetSpec,
    DatasetSpec,
    ImportedDatasetSpec,
    MethodSpec,
    check_method,
    list_suite,
    load_dataset_spec,
    load_method_spec,
)
from mor_bench.training_options import TrainingOptions

CORE_METHODS = ("fem", "pod", "hpod", "pca-regression", "umesh")
"""What is compared when nothing else is asked for."""

DATA_METHODS = ("pca-regression-force", "umesh")
"""The same on imported snapshots, whose equations are not known."""

OBSERVATION_METHODS = ("fem", "linear-fem", "gappy-pod", "pca-regression", "umesh")
"""The same where displacements of a part of the surface are given in the place of forces."""


@dataclass(frozen=True)
class Budget:
    """What tuning a method may cost on a dataset: the same for every method."""

    configurations: int
    seconds: float


BUDGETS = {"quick": Budget(12, 1200.0), "full": Budget(16, 1800.0)}


def jobs_of(
    methods: Sequence[MethodSpec], profile: str, training: TrainingOptions = TrainingOptions()
) -> list[Job]:
    """Every configuration of every method; those that may train do so with the given device and seconds."""
    jobs = []
    for method in methods:
        swept, options = method.swept_keys(profile), training if may_train(method) else None
        for parameters in method.configurations(profile):
            jobs.append(
                Job(
                    method,
                    parameters,
                    label_of(method.name, {key: parameters[key] for key in swept}),
                    options,
                    {key: parameters[key] for key in swept},
                )
            )
    return jobs


def may_train(method: MethodSpec) -> bool:
    """Whether a method trains; of a third party's nobody knows before it is fitted."""
    return _of_class(method, lambda surrogate: bool(surrogate.trains()), of_others=True)


def may_draw(job: Job) -> bool:
    """Whether a fit draws random numbers; a third party's is taken to do so if its file has iterations or a seed."""
    return _of_class(
        job.method,
        lambda surrogate: "seed" in signature(surrogate).parameters,
        of_others=bool({"iterations", "seed"} & set(job.parameters)),
    )


def _of_class(method: MethodSpec, question: Callable[[type[Any]], bool], of_others: bool) -> bool:
    """The answer for a method's class; `of_others` for a third party's, which is not imported here, and no where a dependency is missing."""
    if not method.surrogate.startswith("mor_bench."):
        return of_others
    try:
        return question(method.load_class())
    except MissingDependencyError:
        return False


def checked_specs(
    datasets: Sequence[str | Path | Mapping[str, Any]],
    methods: Sequence[str | Path] | None,
    profile: str,
    suite: Path | None,
    cache: Path | None = None,
    memory_limit_bytes: float | None = None,
) -> tuple[list[AnyDatasetSpec], list[MethodSpec]]:
    """Read all specifications and check them as far as they can be without running, so that no run fails half-way on one."""
    specs = [load_dataset_spec(dataset, suite) for dataset in datasets]
    if methods is None:
        methods = _default_methods(specs, profile, suite)
    method_specs = [load_method_spec(method, suite) for method in methods]
    for kind, names in (
        ("dataset", [spec.name for spec in specs]),
        ("method", [spec.name for spec in method_specs]),
    ):
        for name in names:
            if names.count(name) > 1:
                raise InvalidInputError(
                    f"two {kind}s are called {name!r}; rename one of the files."
                )
    for spec in specs:
        scene = load_scene(spec)
        if isinstance(spec, DatasetSpec):
            check_supports(scene)
    for method_spec in method_specs:
        _check_method(method_spec, Path(cache or default_cache()), memory_limit_bytes)
    return specs, method_specs


def _default_methods(
    specs: Sequence[AnyDatasetSpec], profile: str, suite: Path | None
) -> list[str]:
    own = list(list_suite("methods", suite)) if suite else []
    if profile == "full":
        return list(dict.fromkeys([*CORE_METHODS, *list_suite("methods"), *own]))
    defaults = [_defaults_of(spec) for spec in specs]
    return list(dict.fromkeys([*(name for names in defaults for name in names), *own]))


def _defaults_of(spec: AnyDatasetSpec) -> tuple[str, ...]:
    if spec.observed is None:
        return DATA_METHODS if isinstance(spec, ImportedDatasetSpec) else CORE_METHODS
    return (
        ("gappy-pod", *DATA_METHODS)
        if isinstance(spec, ImportedDatasetSpec)
        else OBSERVATION_METHODS
    )


def _check_method(spec: MethodSpec, cache: Path, memory_limit_bytes: float | None) -> None:
    """Check knobs; a third party's class in a process of its own, where its import may crash or hang: that becomes a row."""
    if spec.surrogate.startswith("mor_bench."):
        with suppress(MissingDependencyError):  # that becomes a row with its reason
            check_method(spec)
        return
    restrictions = Restrictions(
        sealed=tuple(sealed_folders(cache)),
        import_from=spec.folder,
        memory_bytes=memory_limit_bytes or default_memory_limit_bytes(),
    )
    with (
        suppress(MethodFailedError, MissingDependencyError),
        SandboxedProcess(MethodSession, restrictions) as worker,
    ):
        for profile in ("quick", "full"):
            where = f"method {spec.name} ({profile})"
            worker.ask(
                "check",
                START_LIMIT_S,
                surrogate=spec.surrogate,
                configurations=spec.configurations(profile),
                where=where,
            )


def sealed_folders(cache: Path, out: Path | None = None) -> list[Path]:
    """What no method may open: datasets, results of others, here and in the default places."""
    caches = [folder / part for folder in (cache, default_cache()) for part in ("datasets", "fits")]
    return [*caches, Path("reports") / "runs", *([out / "samples"] if out else [])]
