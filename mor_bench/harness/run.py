"""A comparison: every configuration of every method fitted, scored and timed on every dataset."""

from __future__ import annotations

import os
import secrets
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import groupby
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import Any

import numpy as np
import psutil

from mor_bench import __version__
from mor_bench.errors import InvalidInputError, MissingDependencyError, MorBenchError, SolverError, UnsupportedSceneError
from mor_bench.harness.clock import PROTOCOLS, Opener, Queries, Timing, check_answers, measure, probe_s, summary_of_timing
from mor_bench.harness.discretisation import measured
from mor_bench.harness.fits import Entry, Job, Material, Outcome, Place, RemoteFit, TestSet, evaluate, fit, fit_elsewhere, score
from mor_bench.harness.handover import arrays_of
from mor_bench.harness.isolation import START_LIMIT_S, MethodFailedError, Worker, default_memory_limit_bytes
from mor_bench.harness.metrics import SampleErrors, summary
from mor_bench.harness.nursery import CAN_FORK, Nursery
from mor_bench.harness.results import Comparison, label_of
from mor_bench.harness.statistics import intervals_of
from mor_bench.harness.timing import describe_machine
from mor_bench.mechanics.model import check_supports
from mor_bench.reduction.basis import pod
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.executors import Pool, check_pool, cluster_pool
from mor_bench.snapshots.fresh import fresh_test_set
from mor_bench.snapshots.generate import default_cache, generation_seconds
from mor_bench.snapshots.test_sets import available_sets
from mor_bench.specs import (
    AnyDatasetSpec,
    DatasetSpec,
    ImportedDatasetSpec,
    MethodSpec,
    SplitBy,
    check_method,
    list_suite,
    load_dataset_spec,
    load_method_spec,
)

CORE_METHODS = ("fem", "pod", "hpod", "pca-regression", "umesh")
"""What is compared when nothing else is asked for."""

DATA_METHODS = ("pca-regression-force", "umesh")
"""The same on imported snapshots, whose equations are not known."""

MOST_QUERIES = 400
"""Loads of the test set from which a timing's queries are drawn."""

EXTRA_SEEDS = 2
"""Trainings with other seeds in a full comparison, beside that of the method's file."""

LEARNING_STEP = 4
LEAST_TRAINING = 20
"""A learning curve goes from all training samples down by this factor, to no fewer than these."""


@dataclass(frozen=True)
class Budget:
    """What tuning a method may cost on a dataset: the same for every method."""

    configurations: int
    seconds: float


BUDGETS = {"quick": Budget(12, 1200.0), "full": Budget(16, 1800.0)}


@dataclass(frozen=True)
class Listener:
    """What a run tells while it goes on; each does nothing by default.

    Attributes
    ----------
    generating : callable
        (dataset, samples done, samples wanted)
    starting : callable
        (dataset, label, number of the configuration, how many there are)
    fitted : callable
        (row), scored but not yet timed
    timing : callable
        (dataset, turns done, turns in all)
    finished : callable
        (row)
    """

    generating: Callable[[str, int, int], None] = lambda *_: None
    starting: Callable[[str, str, int, int], None] = lambda *_: None
    fitted: Callable[[dict[str, Any]], None] = lambda *_: None
    timing: Callable[[str, int, int], None] = lambda *_: None
    finished: Callable[[dict[str, Any]], None] = lambda *_: None


@dataclass(frozen=True)
class _Settings:
    """The arguments of a run that its parts need."""

    profile: str
    limit: int | None
    split: SplitBy | None
    threads: int
    workers: int | None
    jobs: int
    cluster: str | None
    cache: Path
    budget: Budget
    memory_limit_bytes: float
    test_seed: int | str | None
    retime: bool
    fail_fast: bool
    listener: Listener


class _StopRunError(Exception):
    """A row failed where the first failure ends a run."""


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
    `mor_bench.harness.discretisation.refine` left, and is not measured here.

    A full comparison also scores the dataset's named test sets (`mor_bench.snapshots.test_sets`), trains with other seeds,
    and draws learning curves.

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
    time_limit_s : float, optional
        Of all fits of a method on a dataset together: the tuning budget's seconds.
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
    specs, method_specs = checked_specs(datasets, methods, profile, suite, cache, memory_limit_bytes)
    if test_seed is not None:
        _check_test_seed(test_seed, specs)
    budget = BUDGETS[profile]
    settings = _Settings(
        profile, limit, split, threads, workers, jobs, cluster, Path(cache or default_cache()),
        replace(budget, seconds=time_limit_s or budget.seconds),
        memory_limit_bytes or default_memory_limit_bytes(), test_seed, retime, fail_fast, listener,
    )  # fmt: skip
    comparison = _open_run(Path(out) if out else _default_out([spec.name for spec in specs]), specs, method_specs, settings)
    jobs_of_all = jobs_of(method_specs, profile)
    with ExitStack() as stack:
        stack.enter_context(_alone(comparison.out))
        nursery = stack.enter_context(closing(Nursery(yielding=True))) if CAN_FORK else None
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mor-bench-")))
        stack.enter_context(suppress(_StopRunError))
        for number, spec in enumerate(specs):
            _DatasetRun(spec, jobs_of_all, comparison, settings, scratch, nursery, suite, number, len(specs)).go()
    comparison.finish()
    return comparison


def _check(profile: str, threads: int, jobs: int, cores: int, time_limit_s: float | None, memory_limit_bytes: float | None) -> None:
    if profile not in BUDGETS:
        raise InvalidInputError(f"`profile` must be 'quick' or 'full'; got {profile!r}.")
    for name, count in (("threads", threads), ("jobs", jobs)):
        if not 1 <= count <= cores:
            raise InvalidInputError(f"`{name}` must be an integer in [1, {cores}]; got {count}.")
    if time_limit_s is not None and not time_limit_s > 0:
        raise InvalidInputError(f"`time_limit_s` must be above 0; got {time_limit_s}.")
    if memory_limit_bytes is not None and not memory_limit_bytes >= 1e8:
        raise InvalidInputError(f"`memory_limit_bytes` must be at least 1e8, which a process takes without a method; got {memory_limit_bytes:g}.")


def _check_test_seed(test_seed: int | str, specs: Sequence[AnyDatasetSpec]) -> None:
    for spec in specs:
        if isinstance(spec, ImportedDatasetSpec):
            raise InvalidInputError(f"`test_seed`: no fresh test set can be drawn of {spec.name}, whose snapshots were imported.")
        if test_seed != "fresh" and (not isinstance(test_seed, int) or test_seed == spec.loads.seed or test_seed < 0):
            raise InvalidInputError(
                f"`test_seed` must be 'fresh' or an integer >= 0 other than the seed of {spec.name}, {spec.loads.seed}; got {test_seed!r}."
            )


def _default_out(names: Sequence[str]) -> Path:
    return Path("reports") / "runs" / f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{'-'.join(names)}"


def jobs_of(methods: Sequence[MethodSpec], profile: str) -> list[Job]:
    """Every configuration of every method."""
    jobs = []
    for method in methods:
        swept = method.swept_keys(profile)
        for parameters in method.configurations(profile):
            jobs.append(Job(method, parameters, label_of(method.name, {key: parameters[key] for key in swept})))
    return jobs


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
    for kind, names in (("dataset", [spec.name for spec in specs]), ("method", [spec.name for spec in method_specs])):
        for name in names:
            if names.count(name) > 1:
                raise InvalidInputError(f"two {kind}s are called {name!r}; rename one of the files.")
    for spec in specs:
        scene = load_scene(spec)
        if isinstance(spec, DatasetSpec):
            check_supports(scene)
    for method_spec in method_specs:
        _check_method(method_spec, Path(cache or default_cache()), memory_limit_bytes)
    return specs, method_specs


def _default_methods(specs: Sequence[AnyDatasetSpec], profile: str, suite: Path | None) -> list[str]:
    own = list(list_suite("methods", suite)) if suite else []
    if profile == "full":
        shipped = list(list_suite("methods"))
        core = [name for name in CORE_METHODS if name in shipped]
        return list(dict.fromkeys([*core, *shipped, *own]))
    defaults = [DATA_METHODS if isinstance(spec, ImportedDatasetSpec) else CORE_METHODS for spec in specs]
    return list(dict.fromkeys([*(name for names in defaults for name in names), *own]))


def _check_method(spec: MethodSpec, cache: Path, memory_limit_bytes: float | None) -> None:
    """Check knobs; a third party's class in a process of its own, where its import may crash or hang: that becomes a row."""
    if spec.surrogate.startswith("mor_bench."):
        with suppress(MissingDependencyError):  # that becomes a row with its reason
            check_method(spec)
        return
    limit = memory_limit_bytes or default_memory_limit_bytes()
    with suppress(MethodFailedError, MissingDependencyError), Worker(None, sealed_folders(cache), spec.folder, limit) as worker:
        for profile in ("quick", "full"):
            where = f"method {spec.name} ({profile})"
            worker.ask("check", START_LIMIT_S, surrogate=spec.surrogate, configurations=spec.configurations(profile), where=where)


def _open_run(out: Path, specs: Sequence[AnyDatasetSpec], methods: Sequence[MethodSpec], settings: _Settings) -> Comparison:
    """The comparison in a folder: a new one, or the one that was begun there with the same settings and datasets."""
    datasets = {spec.name: spec.model_dump(mode="json") for spec in specs}
    said = {
        "profile": settings.profile, "split": settings.split, "limit": settings.limit, "threads": settings.threads, "test_seed": settings.test_seed,
        "budget": {"configurations": settings.budget.configurations, "seconds": settings.budget.seconds},
        "seeds": 1 + (EXTRA_SEEDS if settings.profile == "full" else 0), "device": "cpu", "version": __version__,
    }  # fmt: skip
    if (out / "results.json").exists():
        comparison = Comparison.read(out)
        if comparison.settings != said or any(datasets.get(name) != spec for name, spec in comparison.datasets.items()):
            raise InvalidInputError(f"{out} holds a run with other settings or datasets; choose another folder or remove it.")
    else:
        comparison = Comparison(out, describe_machine(), settings=said)
    comparison.methods |= {method.name: method.model_dump(mode="json", exclude={"folder"}) for method in methods}
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
        raise InvalidInputError(f"{out}: another run, process {other}, writes there; wait for it or choose another folder.")
    lock.write_text(f"{os.getpid()} {psutil.Process().create_time()!r}")
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)


class _DatasetRun:
    """All that a run does on one dataset."""

    def __init__(
        self, spec: AnyDatasetSpec, jobs: list[Job], comparison: Comparison, settings: _Settings, scratch: Path,
        nursery: Nursery | None, suite: Path | None, number: int, n: int
    ) -> None:  # fmt: skip
        self.spec, self.jobs, self.comparison, self.settings = spec, jobs, comparison, settings
        self.first, self.total = number * len(jobs), n * len(jobs)
        self.folder = scratch / f"{number}"
        self.discretisation = _discretisation(spec, settings.cache, suite)
        self.nursery = nursery
        self.spent: dict[str, float] = {}
        self.lock = Lock()

    def go(self) -> None:
        """Fit and score all configurations, time them, and what a full comparison adds."""
        self._lay_out()
        entries = self._fit_all()
        if self.settings.profile == "full":
            self._other_seeds(entries)
        self._time(entries)
        if self.settings.profile == "full":
            self._learning_curves(entries)
        if self.settings.test_seed is not None:
            seed = self.settings.test_seed
            self._fresh_test(entries, seed if isinstance(seed, int) else secrets.randbelow(2**53))

    def _lay_out(self) -> None:
        settings, spec = self.settings, self.spec
        sets = available_sets(spec) if settings.profile == "full" and isinstance(spec, DatasetSpec) else []
        progress = partial(settings.listener.generating, spec.name)
        self.data = load_dataset(
            spec, settings.limit, split=settings.split, tests=sets, workers=None if settings.cluster else settings.workers,
            cluster=settings.cluster, cache=settings.cache, progress=progress,
        )  # fmt: skip
        record_dataset(self.comparison, spec, self.data)
        n = len(self.data.train)
        self.data_seconds = generation_seconds(spec, settings.cache, n) if isinstance(spec, DatasetSpec) else None
        self.folder.mkdir()
        tests = {name: TestSet.of(snapshots) for name, snapshots in {"test": self.data.test, **self.data.tests}.items()}
        self.material = Material(self.data.scene, self.data.train, tests, self.folder)
        sealed = sealed_folders(settings.cache, self.comparison.out)
        if isinstance(spec, ImportedDatasetSpec):
            sealed.append(Path(spec.snapshots.file.path))
        self.place = place_of(settings.cache, sealed, settings.jobs, settings.threads, settings.memory_limit_bytes, self.nursery)

    def _fit_all(self) -> dict[str, Entry]:
        """Every configuration's row but for its latency; the entries of those that can be timed, by label.

        A method is fitted in all its configurations before the first of them is asked for the test set.
        """
        entries: dict[str, Entry] = {}
        with ExitStack() as stack:
            pool = stack.enter_context(cluster_pool(self.settings.cluster)) if self.settings.cluster else None
            executor = stack.enter_context(ThreadPoolExecutor(pool.window() if pool else self.settings.jobs))
            for _, group in groupby(self.jobs, key=lambda job: job.method.name):
                jobs = list(group)
                fitted = list(executor.map(partial(self._fit_one, pool), range(len(jobs)), jobs))
                for entry, _ in fitted:
                    if entry is not None:
                        stack.callback(entry.release)
                for job, entry, (row, samples) in zip(jobs, [entry for entry, _ in fitted], executor.map(self._score_one, fitted), strict=True):
                    self.comparison.put(row, samples)
                    self.settings.listener.fitted(row)
                    if entry is not None and row["status"] == "ok":
                        entries[job.label] = entry
                    elif row["status"] == "failed" and self.settings.fail_fast:
                        raise _StopRunError
        return entries

    def _fit_one(self, pool: Pool | None, number: int, job: Job) -> tuple[Entry | None, dict[str, Any]]:
        """Fit a configuration, the number-th of its method: its entry, if it is fitted, and its row so far."""
        budget, method = self.settings.budget, job.method.name
        self.settings.listener.starting(self.spec.name, job.label, self.first + self.jobs.index(job) + 1, self.total)
        row = self._empty_row(job)
        with self.lock:
            left = budget.seconds - self.spent.get(method, 0.0)
        if number >= budget.configurations:
            return None, {**row, "status": "skipped", "reason": f"beyond the tuning budget of {budget.configurations} configurations"}
        if left <= 0:
            return None, {**row, "status": "skipped", "reason": f"beyond the tuning budget of {budget.seconds:g} s of fitting"}
        began = monotonic()
        entry = Entry(job, self.material, self.place)
        try:
            spent = fit(entry, left, self._remote(pool, job))["fit_s"]
        except MorBenchError as error:
            spent = monotonic() - began  # a fit that failed has cost its time, too
            return None, {**row, **_failure(error), "tuning_s": spent}
        finally:
            with self.lock:
                self.spent[method] = self.spent.get(method, 0.0) + spent
        return entry, {**row, "tuning_s": spent}

    def _score_one(self, fitted: tuple[Entry | None, dict[str, Any]]) -> tuple[dict[str, Any], dict[str, Any]]:
        """A configuration's row with its errors, and the raw samples."""
        entry, row = fitted
        if entry is None:
            return row, {}
        try:
            found, samples = self._scored(score(entry, self.settings.budget.seconds))
        except MorBenchError as error:
            return {**row, **_failure(error)}, {}
        return {**row, **found}, samples

    def _remote(self, pool: Pool | None, job: Job) -> RemoteFit | None:
        """Fitting on the cluster; a third party's class is not installed there."""
        if pool is None or job.method.folder is not None:
            return None

        def fit(entry: Entry, limit_s: float) -> tuple[dict[str, Any], bytes | None]:
            limits = (limit_s, self.place.memory_limit_bytes)
            arrays = arrays_of(self.data.train)
            return pool.executor.submit(fit_elsewhere, self.data.scene, arrays, job.method.surrogate, job.parameters, limits).result()

        return fit

    def _empty_row(self, job: Job) -> dict[str, Any]:
        data = self.data
        return {
            "dataset": self.spec.name, "split": self.settings.split or self.spec.split.by, "method": job.method.name, "label": job.label,
            "parameters": job.parameters, "status": "", "reason": None, "n_train": len(data.train), "n_test": len(data.test),
            "n_unused": data.n_unused, "n_failed": None, "n_dofs": data.scene.mesh.n_dofs, "threads": self.settings.threads,
            "error": None, "latency_ms": None, "all_threads_ms": None, "throughput": None, "offline_s": None, "memory_bytes": None,
            "model_bytes": None, "cost": None, "sets": {}, "hidden": None, "seeds": None, **self.discretisation, "warnings": [],
        }  # fmt: skip

    def _scored(self, outcome: Outcome) -> tuple[dict[str, Any], dict[str, Any]]:
        """What a fit and its scores put into a row, and the raw samples."""
        fit, scores = outcome.fit, dict(outcome.scores)
        main = scores.pop("test")
        failed = int((~np.isfinite(main["mean_dof_m"])).sum())
        if failed == len(main["mean_dof_m"]):
            raise SolverError(f"no valid prediction on any of {failed} test samples")
        return {
            "status": "ok",
            "n_failed": failed,
            "error": summary(_errors(main)),
            "offline_s": {"data": self.data_seconds if fit["needs_snapshots"] else 0.0, "fit": fit["fit_s"]},
            "memory_bytes": {"fit": fit["fit_memory_bytes"], "predict": None},
            "model_bytes": fit["model_bytes"],
            "cost": outcome.cost,
            "sets": {name: set_summary(score) for name, score in scores.items()},
            "warnings": fit["warnings"],
        }, main

    def _other_seeds(self, entries: Mapping[str, Entry]) -> None:
        """Train methods that draw random numbers again, and keep the errors beside those of the first seed."""
        main = self.material.with_sets({"test": self.material.sets["test"]})
        for label, entry in entries.items():
            seed = (entry.fit or {})["parameters"].get("seed")
            if not isinstance(seed, int):
                continue
            errors, failed = [], []
            for other in range(seed + 1, seed + 1 + EXTRA_SEEDS):
                job = replace(entry.job, parameters={**entry.job.parameters, "seed": other})
                try:
                    outcome = evaluate(Entry(job, main, self.place), self.settings.budget.seconds)
                    errors.append(outcome.scores["test"]["relative_l2"])
                except MorBenchError as error:
                    failed.append(f"seed {other}: {error}")
            row = self._row(label)
            row["seeds"] = {"n": 1 + len(errors), "failed": failed}
            row["warnings"] = [*row["warnings"], *failed]
            if errors:
                self.comparison.add_samples(self._row(label), {"seeds_relative_l2": np.array(errors)})

    def _row(self, label: str) -> dict[str, Any]:
        return next(row for row in self.comparison.rows if (row["dataset"], row["label"]) == (self.spec.name, label))

    def _time(self, entries: Mapping[str, Entry]) -> None:
        """Time all configurations that have no timing from this machine at this speed, and complete the rows."""
        settings = self.settings
        protocol = PROTOCOLS[settings.profile]
        name = f"timing-{protocol.processes}x{protocol.rounds}-{settings.threads}-{self.material.sets['test'].digest[:12]}"
        speed = probe_s()
        timings: dict[str, Timing] = {}
        for label, entry in entries.items():
            kept = None if settings.retime else entry.arrays(name)
            if kept is not None and (timing := Timing.of_arrays(kept)).holds(speed):
                timings[label] = timing
        openers = {
            label: Opener(partial(entry.opened, settings.budget.seconds), (entry.fit or {})["fit_memory_bytes"])
            for label, entry in entries.items()
            if label not in timings
        }
        test = self.material.sets["test"]
        chosen = np.linspace(0, len(test.forces) - 1, min(MOST_QUERIES, len(test.forces))).astype(int)
        queries = Queries(test.forces[chosen], test.references[chosen], self.folder)
        fresh = measure(openers, queries, protocol, settings.threads, partial(settings.listener.timing, self.spec.name))
        for label, timing in fresh.items():
            try:
                check_answers(timing, self.comparison.samples(self._row(label))["relative_l2"][chosen])
            except MethodFailedError as error:
                timing.failed = timing.failed or str(error)
            if not timing.failed:
                timing.probe_s = speed
                entries[label].keep_arrays(name, timing.arrays)
        timings |= fresh
        intervals = intervals_of({label: timing.samples for label, timing in timings.items() if not timing.failed})
        for label in entries:
            row, timing = self._row(label), timings[label]
            if timing.failed:
                row.update(status="failed", reason=timing.failed)
            else:
                row.update(summary_of_timing(timing, intervals[label], settings.threads))
                row["memory_bytes"]["predict"] = timing.memory_bytes
                self.comparison.add_samples(row, timing.samples)
        self.comparison.write()
        for label in entries:
            settings.listener.finished(self._row(label))
        if settings.fail_fast and any(timing.failed for timing in timings.values()):
            raise _StopRunError

    def _learning_curves(self, entries: Mapping[str, Entry]) -> None:
        """Errors over the number of training samples, of the most accurate configuration of each method that learns."""
        self.comparison.learning = [record for record in self.comparison.learning if record["dataset"] != self.spec.name]
        for method in dict.fromkeys(entry.job.method.name for entry in entries.values()):
            rows = [self._row(label) for label, entry in entries.items() if entry.job.method.name == method and (entry.fit or {})["needs_snapshots"]]
            if not rows:
                continue
            best = min(rows, key=lambda row: row["error"]["rel_l2_median"])
            for n in _learning_sizes(self.material.n_train):
                self.comparison.learning.append(self._learnt(entries[best["label"]], n, best))
                self.comparison.write()

    def _learnt(self, entry: Entry, n: int, row: Mapping[str, Any]) -> dict[str, Any]:
        record = {"dataset": self.spec.name, "method": entry.job.method.name, "label": entry.job.label, "n_train": n, "status": "ok", "reason": None}
        if n == self.material.n_train:
            return {**record, "fit_s": row["offline_s"]["fit"], "error": row["error"]}
        try:
            outcome = evaluate(Entry(entry.job, self.material.first(n), self.place), self.settings.budget.seconds)
        except MorBenchError as error:
            return {**record, "status": "failed", "reason": str(error), "fit_s": None, "error": None}
        return {**record, "fit_s": outcome.fit["fit_s"], "error": summary(_errors(outcome.scores["test"]))}

    def _fresh_test(self, entries: Mapping[str, Entry], seed: int) -> None:
        """Score on a test set that did not exist while anything was fitted."""
        assert isinstance(self.spec, DatasetSpec)
        by = self.settings.split or self.spec.split.by
        fresh = fresh_test_set(self.spec, self.data.scene, by, seed, len(self.data.test))
        material = self.material.with_sets({"hidden": TestSet.of(fresh)})
        for label, entry in entries.items():
            row = self._row(label)
            try:
                outcome = evaluate(Entry(entry.job, material, self.place), self.settings.budget.seconds)
            except MorBenchError as error:
                # No answer is an infinite error here as everywhere: who fails on what is fresh does not get away with it.
                row["warnings"] = [*row["warnings"], f"no score on the fresh test set: {error}"]
                lost = dict.fromkeys(("mean_dof_m", "rel_l2_median", "rel_l2_p95", "rel_l2_max"), float("inf"))
                row["hidden"] = {"seed": seed, "n": len(fresh), "n_failed": len(fresh), "n_flagged": None, **lost}
                continue
            row["hidden"] = {"seed": seed, **set_summary(outcome.scores["hidden"])}
            self.comparison.add_samples(row, {"hidden_relative_l2": outcome.scores["hidden"]["relative_l2"]})
        self.comparison.write()


def sealed_folders(cache: Path, out: Path | None = None) -> list[Path]:
    """What no method may open: datasets, results of others, here and in the default places."""
    caches = [folder / part for folder in (cache, default_cache()) for part in ("datasets", "fits")]
    return [*caches, Path("reports") / "runs", *([out / "samples"] if out else [])]


def place_of(
    cache: Path, sealed: Sequence[Path], jobs: int, threads: int, memory_limit_bytes: float, nursery: Nursery | None = None
) -> Place:  # fmt: skip
    """Where methods run, and what they must not open."""
    machine = describe_machine()
    cores = machine["cores"]
    return Place(cache, tuple(sealed), f"{machine['processor']} x {cores}", max(1, cores // jobs), threads, memory_limit_bytes, nursery)


def _failure(error: MorBenchError) -> dict[str, str]:
    """The part of a row that says why there is no more of it."""
    if isinstance(error, MissingDependencyError | UnsupportedSceneError):
        return {"status": "skipped", "reason": str(error)}
    if isinstance(error, MethodFailedError):
        return {"status": "failed", "reason": str(error)}
    return {"status": "failed", "reason": f"{type(error).__name__}: {error}"}


def _errors(score: Mapping[str, Any]) -> SampleErrors:
    return SampleErrors(*(score[name] for name in ("mean_dof_m", "relative_l2", "max_nodal_m", "amplitude_m")))


def set_summary(score: Mapping[str, Any]) -> dict[str, Any]:
    """What a row says of a named test set."""
    figures = summary(_errors(score))
    kept = {name: figures[name] for name in ("mean_dof_m", "rel_l2_median", "rel_l2_p95", "rel_l2_max")}
    failed = int((~np.isfinite(score["mean_dof_m"])).sum())
    return {"n": len(score["mean_dof_m"]), "n_failed": failed, "n_flagged": int(score["flagged"].sum()) if "flagged" in score else None, **kept}


def _learning_sizes(n_train: int) -> list[int]:
    """All training samples, and fewer and fewer of the first."""
    sizes = [n_train]
    while sizes[-1] // LEARNING_STEP >= LEAST_TRAINING:
        sizes.append(sizes[-1] // LEARNING_STEP)
    return sizes[::-1]


def _discretisation(spec: AnyDatasetSpec, cache: Path | None, suite: Path | None) -> dict[str, float | None]:
    """The part of every row that says how far the dataset's mesh is from the body; None where it was not measured."""
    record = (measured(spec, cache, suite) if isinstance(spec, DatasetSpec) else None) or {}
    return {"discretisation_error_m": record.get("error_m"), "discretisation_rel_l2": record.get("relative_l2_median")}


def record_dataset(comparison: Comparison, spec: AnyDatasetSpec, data: Dataset) -> None:
    """Record what every figure of a dataset needs."""
    arrays = {
        "singular_values": pod(data.train.free_displacements).singular_values,
        "points": data.scene.mesh.points,
        "cells": data.scene.mesh.cells,
        "test_regions": data.test.loads.patches,
    }
    comparison.add_dataset(spec.name, spec.model_dump(mode="json"), arrays)
