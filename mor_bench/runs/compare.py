"""A comparison: every configuration of every method fitted, scored and timed on every dataset."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import psutil

from mor_bench.analysis.analyse import analyse
from mor_bench.errors import InvalidInputError, MissingDependencyError
from mor_bench.machine import describe_machine, gpu_name
from mor_bench.measure.method_session import MethodSession
from mor_bench.results.comparison import Comparison
from mor_bench.runs.configurations import BUDGETS, checked_specs, jobs_of
from mor_bench.runs.dataset_run import SEEDS, DatasetRun, Listener, Settings, StopRunError
from mor_bench.sandbox.fork_server import CAN_FORK, ForkServer
from mor_bench.sandbox.process import default_memory_limit_bytes
from mor_bench.snapshots.executors import check_pool
from mor_bench.snapshots.generate import default_cache
from mor_bench.specs import (
    AnyDatasetSpec,
    ImportedDatasetSpec,
    MethodSpec,
    SplitBy,
)
from mor_bench.training_options import Device, TrainingOptions
from mor_bench.version import __version__

MOST_SEEDS = 100


def run(
    datasets: Sequence[str | Path | Mapping[str, Any]] = ("beam-coarse",),
    methods: Sequence[str | Path] | None = None,
    profile: str = "quick",
    out: str | Path | None = None,
    *,
    limit: int | None = None,
    split: SplitBy | None = None,
    threads: int = 1,
    workers: int | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    test_seed: int | str | None = None,
    device: Device = "cpu",
    fit_seconds: float | None = None,
    seeds: int | None = None,
    time_limit_s: float | None = None,
    memory_limit_bytes: float | None = None,
    retime: bool = False,
    fail_fast: bool = False,
    cache: Path | None = None,
    suite: Path | None = None,
    listener: Listener = Listener(),
) -> Comparison:
    """Compare methods on datasets.

    Every specification is checked before anything runs. Each configuration is fitted in a process of its own, which is
    given the training samples only; when all are fitted they are timed beside each other in fresh processes. Fits, scores
    and timings are kept in the cache under all that they depend on, so that a run that was stopped goes on, and another
    one computes only what is new. The discretisation error of a dataset's mesh is read from the record that
    `mor_bench.measure.discretisation_error.refine` left, and is not measured here.

    A full comparison also scores the dataset's named test sets (`mor_bench.snapshots.test_sets`), trains with other seeds,
    and draws learning curves. A training that was stopped goes on from its checkpoint in the cache, in this run or another.

    Parameters
    ----------
    datasets, methods : sequences of names or paths of TOML files
        A dataset may also be a dict with the same keys. Methods are `CORE_METHODS` by default, or `DATA_METHODS` on
        imported snapshots, or with the profile "full" all of the suite; those of ``suite`` come in addition.
    profile : {"quick", "full"}
        Which sweep of the method files, which budget and how much beside the headline.
    out : path, optional
        Where to write; ``reports/runs/TIME-DATASETS`` by default.
    limit : int, optional
        Only the first samples of each dataset.
    split : {"region", "sample", "direction"}, optional
        Instead of the split in the dataset's file.
    threads : int
        Threads of a prediction, one by default: steadiest and, on small scenes, fastest. Fitting uses all cores.
    workers : int, optional
        Processes for data generation; all cores by default.
    jobs : int
        Fits at once, which share the cores; seconds of fitting are honest with one.
    cluster : str, optional
        Address of a Dask scheduler, ``tcp://host:port``, whose workers generate and fit; timings are always taken here.
    test_seed : int or "fresh", optional
        Also score on a test set of the same distribution that this seed draws when all methods are fitted. A number can be
        repeated, and known to a method; "fresh" is drawn then, too, and recorded with the result.
    device : {"cpu", "cuda", "auto"}
        Of trainings; "auto" is a CUDA device if there is one. Queries are answered where they always are.
    fit_seconds : float, optional
        That each training is sized to, in the place of its knob `iterations`; the row says how many that came to. Other seeds and
        the points of a learning curve train as many.
    seeds : int, optional
        Trainings of each configuration of a method with a knob `seed`: 1 in quick comparisons, 3 in full ones by default.
    time_limit_s : float, optional
        Of all fits of a method on a dataset together: the tuning budget's seconds. Other seeds are not counted.
    memory_limit_bytes : float, optional
        Of a method's process; three quarters of the machine's memory by default.
    retime : bool
        Take timings again that the cache holds.
    fail_fast : bool
        End the run at the first row that fails.
    cache, suite : Path, optional
        Cache folder; folder with ``datasets/`` and ``methods/``.
    listener : Listener
        Told of progress.

    Raises
    ------
    SpecError
        If a dataset, a method or a parameter is not valid.
    InvalidInputError
        If an argument is out of range, or ``out`` cannot be written or holds another run.
    StoreError
        If the record of a discretisation error is damaged.
    """
    cores = os.cpu_count() or 1
    _check(profile, threads, jobs, cores, time_limit_s, memory_limit_bytes)
    check_pool(workers, cluster)
    if not datasets or (methods is not None and not methods):
        raise InvalidInputError("`datasets` and `methods` must name at least one each.")
    specs, method_specs = checked_specs(
        datasets, methods, profile, suite, cache, memory_limit_bytes
    )
    if test_seed is not None:
        _check_test_seed(test_seed, specs)
    budget = replace(BUDGETS[profile], seconds=time_limit_s or BUDGETS[profile].seconds)
    training = training_options(device, fit_seconds, budget.seconds)
    settings = Settings(
        profile,
        limit,
        split,
        threads,
        workers,
        jobs,
        cluster,
        Path(cache or default_cache()),
        budget,
        memory_limit_bytes or default_memory_limit_bytes(),
        test_seed,
        training,
        checked_seeds(seeds, profile),
        retime,
        fail_fast,
        listener,
    )
    comparison = _open_run(
        Path(out) if out else _default_out([spec.name for spec in specs]),
        specs,
        method_specs,
        settings,
    )
    jobs_of_all = jobs_of(method_specs, profile, training)
    with ExitStack() as stack:
        stack.enter_context(_alone(comparison.out))
        fork_server = (
            stack.enter_context(closing(ForkServer(MethodSession, passive_wait=True)))
            if CAN_FORK
            else None
        )
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mor-bench-")))
        stack.enter_context(suppress(StopRunError))
        for number, spec in enumerate(specs):
            DatasetRun(
                spec,
                jobs_of_all,
                comparison,
                settings,
                scratch,
                fork_server,
                suite,
                number,
                len(specs),
            ).go()
    comparison.finish(analyse(comparison))
    return comparison


def _check(
    profile: str,
    threads: int,
    jobs: int,
    cores: int,
    time_limit_s: float | None,
    memory_limit_bytes: float | None,
) -> None:
    if profile not in BUDGETS:
        raise InvalidInputError(f"`profile` must be 'quick' or 'full'; got {profile!r}.")
    for name, count in (("threads", threads), ("jobs", jobs)):
        if not 1 <= count <= cores:
            raise InvalidInputError(f"`{name}` must be an integer in [1, {cores}]; got {count}.")
    if time_limit_s is not None and not time_limit_s > 0:
        raise InvalidInputError(f"`time_limit_s` must be above 0; got {time_limit_s}.")
    if memory_limit_bytes is not None and not memory_limit_bytes >= 1e8:
        raise InvalidInputError(
            f"`memory_limit_bytes` must be at least 1e8, which a process takes without a method; got {memory_limit_bytes:g}."
        )


def training_options(
    device: Device, fit_seconds: float | None, budget_s: float = float("inf")
) -> TrainingOptions:
    """Device and seconds of trainings, checked; "auto" is decided here, so that a fit's record says where it was trained.

    Raises
    ------
    InvalidInputError
        If there is no such device, or the seconds are not above 0 and below the budget of all fits of a method.
    """
    if device not in get_args(Device):
        raise InvalidInputError(
            f"`device` must be one of {', '.join(get_args(Device))}; got {device!r}."
        )
    if fit_seconds is not None and not 0 < fit_seconds < budget_s:
        most = (
            ""
            if budget_s == float("inf")
            else f" and below {budget_s:g}, the seconds of all fits of a method together"
        )
        raise InvalidInputError(f"`fit_seconds` must be above 0{most}; got {fit_seconds:g}.")
    options = TrainingOptions(device, fit_seconds)
    if device != "cpu":
        options = replace(options, device=_device_here(options))
    return options


def _device_here(options: TrainingOptions) -> Device:
    try:
        from mor_bench.learning.training import device_of
    except ImportError:
        if options.device == "auto":
            return "cpu"
        raise MissingDependencyError(
            "`device`: training on a graphics processor needs PyTorch: pip install 'mor-bench[learn]'."
        ) from None
    return "cuda" if device_of(options).type == "cuda" else "cpu"


def checked_seeds(seeds: int | None, profile: str) -> int:
    """How many trainings each configuration has."""
    if seeds is not None and not 1 <= seeds <= MOST_SEEDS:
        raise InvalidInputError(f"`seeds` must be an integer in [1, {MOST_SEEDS}]; got {seeds}.")
    return seeds or SEEDS[profile]


def _check_test_seed(test_seed: int | str, specs: Sequence[AnyDatasetSpec]) -> None:
    for spec in specs:
        if isinstance(spec, ImportedDatasetSpec):
            raise InvalidInputError(
                f"`test_seed`: no fresh test set can be drawn of {spec.name}, whose snapshots were imported."
            )
        if test_seed != "fresh" and (
            not isinstance(test_seed, int) or test_seed == spec.loads.seed or test_seed < 0
        ):
            raise InvalidInputError(
                f"`test_seed` must be 'fresh' or an integer >= 0 other than the seed of {spec.name}, {spec.loads.seed}; got {test_seed!r}."
            )


def _default_out(names: Sequence[str]) -> Path:
    return Path("reports") / "runs" / f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{'-'.join(names)}"


def _open_run(
    out: Path, specs: Sequence[AnyDatasetSpec], methods: Sequence[MethodSpec], settings: Settings
) -> Comparison:
    """The comparison in a folder: a new one, or the one that was begun there with the same settings and datasets."""
    datasets = {spec.name: spec.model_dump(mode="json") for spec in specs}
    said = {
        "profile": settings.profile,
        "split": settings.split,
        "limit": settings.limit,
        "threads": settings.threads,
        "test_seed": settings.test_seed,
        "budget": {
            "configurations": settings.budget.configurations,
            "seconds": settings.budget.seconds,
        },
        "seeds": settings.seeds,
        "device": settings.training.device,
        "version": __version__,
        **(
            {}
            if settings.training.fit_seconds is None
            else {"fit_seconds": settings.training.fit_seconds}
        ),
    }
    if (out / "results.json").exists():
        comparison = Comparison.read(out)
        if comparison.settings != said or any(
            datasets.get(name) != spec for name, spec in comparison.datasets.items()
        ):
            raise InvalidInputError(
                f"{out} holds a run with other settings or datasets; choose another folder or remove it."
            )
    else:
        gpu = {"gpu": gpu_name()} if settings.training.device == "cuda" else {}
        comparison = Comparison(out, {**describe_machine(), **gpu}, settings=said)
    comparison.methods |= {
        method.name: method.model_dump(mode="json", exclude={"folder"}) for method in methods
    }
    try:
        comparison.write()
    except OSError as error:
        raise InvalidInputError(f"`out`: {out} cannot be written: {error.strerror}.") from None
    return comparison


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """No other run writes to the folder meanwhile; what a killed one left is no hindrance."""
    lock = out / ".running"
    other = None
    with suppress(OSError, ValueError, psutil.Error):
        number, created = map(float, lock.read_text().split())
        other = int(number) if psutil.Process(int(number)).create_time() == created else None
    if other not in (None, os.getpid()):
        raise InvalidInputError(
            f"{out}: another run, process {other}, writes there; wait for it or choose another folder."
        )
    lock.write_text(f"{os.getpid()} {psutil.Process().create_time()!r}")
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
