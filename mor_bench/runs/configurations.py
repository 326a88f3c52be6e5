"""The configurations of a run: default methods, their sweeps, and the tuning budget."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

from mor_bench.errors import InvalidInputError, MissingDependencyError, UnusableClassError
from mor_bench.measure.method_session import MethodSession
from mor_bench.mechanics.rigid_motions import check_supports
from mor_bench.options import RunOptions
from mor_bench.results.row import label_of
from mor_bench.sandbox.process import (
    START_LIMIT_S,
    MethodFailedError,
    SandboxedProcess,
    default_memory_limit_bytes,
)
from mor_bench.sandbox.seal import Restrictions
from mor_bench.scene.scene import load_scene
from mor_bench.scratch import scratch_folder
from mor_bench.snapshots.generate import default_cache
from mor_bench.specs import (
    AnyDatasetSpec,
    DatasetSpec,
    ImportedDatasetSpec,
    MethodSpec,
    all_configurations,
    check_method,
    list_suite,
    load_dataset_spec,
    load_method_spec,
)
from mor_bench.training_options import TrainingOptions

CORE_METHODS = (
    "fem",
    "linear-fem",
    "pod",
    "pod-tensor",
    "hpod",
    "pca-regression-linear",
    "pca-regression",
    "umesh",
    "umesh-linear",
)
"""Default methods."""

DATA_METHODS = ("pca-regression", "umesh")
"""Default methods on imported snapshots, whose equations are unknown."""

OBSERVATION_METHODS = ("fem", "linear-fem", "gappy-pod", "pca-regression-linear", "umesh")
"""Default methods if displacements of a part of the surface are given instead of forces."""

OWN = "mor_bench."
"""Prefix of the classes of this package; other classes are imported in a sandbox only."""


@dataclass(frozen=True)
class Budget:
    """Tuning budget per method and dataset: configurations, and seconds of fitting."""

    configurations: int
    seconds: float


MOST_CONFIGURATIONS = {"quick": 12, "full": 16}
"""Number of configurations per method and dataset, by profile."""


@dataclass(frozen=True)
class Configuration:
    """One configuration of one method.

    Attributes
    ----------
    method : MethodSpec
    parameters : dict
        All given parameters.
    swept : dict
        The parameters that the method's file varies.
    training : TrainingOptions or None
        Device and seconds of a training; None for a method that does not train.
    shipped : str or None
        Checksum of weights that the suite ships and this configuration uses.
    """

    method: MethodSpec
    parameters: dict[str, Any]
    swept: dict[str, Any] = field(default_factory=dict)
    training: TrainingOptions | None = None
    shipped: str | None = None

    @property
    def label(self) -> str:
        """Name in tables: the method, and the swept parameters in brackets."""
        return label_of(self.method.name, self.swept)


def configurations_of(
    methods: Sequence[MethodSpec], profile: str, training: TrainingOptions = TrainingOptions()
) -> list[Configuration]:
    """Return every configuration of every method."""
    return [
        Configuration(
            method,
            parameters,
            {key: parameters[key] for key in method.swept_keys(profile)},
            training if may_train(method) else None,
        )
        for method in methods
        for parameters in method.configurations(profile)
    ]


def may_train(method: MethodSpec) -> bool:
    """Return whether a method may train; True for any class of a third party."""
    return _ask_class(method, lambda surrogate: bool(surrogate.trains()), of_others=True)


def draws_randomly(configuration: Configuration) -> bool:
    """Return whether a fit draws random numbers.

    A third party's class is assumed to draw if its file has iterations or a seed.
    """
    return _ask_class(
        configuration.method,
        lambda surrogate: "seed" in signature(surrogate).parameters,
        of_others=bool({"iterations", "seed"} & set(configuration.parameters)),
    )


def _ask_class(method: MethodSpec, question: Callable[[type[Any]], bool], of_others: bool) -> bool:
    """Ask a class of this package; return `of_others` for others, False if its extra is missing."""
    if not method.surrogate.startswith(OWN):
        return of_others
    try:
        return question(method.load_class())
    except MissingDependencyError:
        return False


class CheckedSpecs(NamedTuple):
    """The specifications of a run.

    Attributes
    ----------
    datasets : list of DatasetSpec or ImportedDatasetSpec
    methods : list of MethodSpec
    unusable : dict of str to str
        Why the class of a method cannot be imported here, by the method's name.
    """

    datasets: list[AnyDatasetSpec]
    methods: list[MethodSpec]
    unusable: dict[str, str]


def checked_specs(
    datasets: Sequence[str | Path | Mapping[str, Any]],
    methods: Sequence[str | Path] | None,
    options: RunOptions,
) -> CheckedSpecs:
    """Read and check all specifications, so that no run fails half-way because of one.

    Raises
    ------
    SpecError
        If a dataset, a method or a parameter is not valid.
    InvalidInputError
        If nothing is given, or one name instead of a list, or two datasets or methods have the
        same name.
    """
    for name, given in (("datasets", datasets), ("methods", methods)):
        if isinstance(given, str | Path | Mapping):
            shown = "beam-coarse" if isinstance(given, Mapping) else str(given)
            raise InvalidInputError(
                f"`{name}` must be a list of names, such as [{shown!r}]; got {given!r}."
            )
    if not datasets or (methods is not None and not methods):
        raise InvalidInputError("`datasets` and `methods` must each hold at least one name.")
    specs = [load_dataset_spec(dataset, options.suite) for dataset in datasets]
    if methods is None:
        methods = _default_methods(specs, options)
    method_specs = [load_method_spec(method, options.suite) for method in methods]
    _check_names("dataset", [spec.name for spec in specs])
    _check_names("method", [spec.name for spec in method_specs])
    for spec in specs:
        scene = load_scene(spec)
        if isinstance(spec, DatasetSpec):
            _ = spec.load_plan
            check_supports(scene)
    found = {method.name: _unusable(method, options) for method in method_specs}
    unusable = {name: reason for name, reason in found.items() if reason is not None}
    return CheckedSpecs(specs, method_specs, unusable)


def _check_names(kind: str, names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InvalidInputError(f"two {kind}s are called {name!r}; rename one of the files.")


def _default_methods(specs: Sequence[AnyDatasetSpec], options: RunOptions) -> list[str]:
    own = list(list_suite("methods", options.suite)) if options.suite else []
    if options.profile == "full":
        return list(dict.fromkeys([*CORE_METHODS, *list_suite("methods"), *own]))
    defaults = [name for spec in specs for name in _defaults_of(spec)]
    return list(dict.fromkeys([*defaults, *own]))


def _defaults_of(spec: AnyDatasetSpec) -> tuple[str, ...]:
    imported = isinstance(spec, ImportedDatasetSpec)
    if spec.observed is None:
        return DATA_METHODS if imported else CORE_METHODS
    return ("gappy-pod", *DATA_METHODS) if imported else OBSERVATION_METHODS


def _unusable(spec: MethodSpec, options: RunOptions) -> str | None:
    """Check parameters against the class; return why the class cannot be imported, if so.

    A third party's class is imported in a worker process, because its import may crash or hang.
    A class that cannot be imported is not an error here: its row gives the reason.
    """
    memory_bytes = options.memory_limit_bytes or default_memory_limit_bytes()
    try:
        if spec.surrogate.startswith(OWN):
            check_method(spec)
        else:
            check_foreign_method(spec, options.cache or default_cache(), memory_bytes)
    except (MethodFailedError, MissingDependencyError, UnusableClassError) as error:
        return str(error)
    return None


def check_foreign_method(spec: MethodSpec, cache: Path, memory_bytes: float) -> None:
    """Import a third party's class in a sandbox, and check its method file against it.

    Raises
    ------
    SpecError, MissingDependencyError
        As `mor_bench.specs.check_method`.
    MethodFailedError
        If the import ends the process or takes too much time or memory.
    """
    with ExitStack() as stack:
        restrictions = Restrictions(
            sealed=tuple(sealed_folders(cache)),
            import_from=spec.folder,
            scratch=stack.enter_context(scratch_folder()),
            memory_bytes=memory_bytes,
        )
        worker = stack.enter_context(SandboxedProcess(MethodSession, restrictions))
        for where, configurations in all_configurations(spec).items():
            worker.ask(
                "check",
                START_LIMIT_S,
                surrogate=spec.surrogate,
                configurations=configurations,
                where=where,
            )


def sealed_folders(cache: Path, out: Path | None = None) -> list[Path]:
    """Return the folders that no method may open: datasets and results, here and by default."""
    caches = [folder / part for folder in (cache, default_cache()) for part in ("datasets", "fits")]
    written = ("samples", "results.json", "comparison.json") if out else ()
    return [*caches, Path("reports") / "runs", *(Path(out or ".") / name for name in written)]
