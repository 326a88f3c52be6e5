"""A comparison: every configuration of every method fitted, scored and timed on every dataset."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench import __version__
from mor_bench.errors import InvalidInputError, MissingDependencyError, MorBenchError, SolverError, UnsupportedSceneError
from mor_bench.harness.discretisation import measured
from mor_bench.harness.metrics import SampleErrors, sample_errors, summary
from mor_bench.harness.results import Comparison, label_of
from mor_bench.harness.timing import describe_machine, latency_summary, measure_latency, pinned_threads
from mor_bench.mechanics.model import check_supports
from mor_bench.reduction.basis import pod
from mor_bench.scene.scene import load_scene
from mor_bench.snapshots.dataset import Dataset, load_dataset
from mor_bench.snapshots.generate import generation_seconds
from mor_bench.specs import AnyDatasetSpec, DatasetSpec, ImportedDatasetSpec, MethodSpec, SplitBy, check_method, load_dataset_spec, load_method_spec
from mor_bench.surrogate import Surrogate, make_surrogate

CORE_METHODS = ("fem", "pod", "hpod", "pca-regression", "umesh")
"""What is compared when nothing else is asked for."""

DATA_METHODS = ("pca-regression-force", "umesh")
"""The same on imported snapshots, whose equations are not known."""

PREDICTION_BATCH = 256
"""Test samples per call of `predict`, which bounds memory."""


@dataclass(frozen=True)
class Listener:
    """What a run tells while it goes on; each does nothing by default.

    Attributes
    ----------
    generating : callable
        (dataset, samples done, samples wanted)
    starting : callable
        (dataset, label, number of the configuration, how many there are)
    finished : callable
        (row)
    """

    generating: Callable[[str, int, int], None] = lambda *_: None
    starting: Callable[[str, str, int, int], None] = lambda *_: None
    finished: Callable[[dict[str, Any]], None] = lambda *_: None


@dataclass(frozen=True)
class _Job:
    """One configuration of one method on one dataset."""

    method: MethodSpec
    parameters: dict[str, Any]
    label: str


def _jobs(methods: Sequence[MethodSpec], profile: str) -> list[_Job]:
    jobs = []
    for method in methods:
        swept = method.swept_keys(profile)
        for parameters in method.configurations(profile):
            jobs.append(_Job(method, parameters, label_of(method.name, {key: parameters[key] for key in swept})))
    return jobs


def _predict_all(method: Surrogate, forces: NDArray[np.float64]) -> NDArray[np.float64]:
    """Predictions for all samples; NaN where the method found no equilibrium, which counts as an infinite error."""
    out = np.full(forces.shape, np.nan)
    for start in range(0, len(forces), PREDICTION_BATCH):
        batch = forces[start : start + PREDICTION_BATCH]
        try:
            # A copy: what a method does to its input must not reach the rows after it.
            predicted = np.asarray(method.predict(batch.copy()))
        except SolverError:
            for row, force in enumerate(batch):
                try:
                    out[start + row] = method.predict(force.copy())
                except SolverError:
                    continue
            continue
        if predicted.shape != batch.shape or predicted.dtype.kind != "f":
            raise InvalidInputError(f"`predict` must return floats of shape {batch.shape}; it returned {predicted.dtype} of shape {predicted.shape}.")
        out[start : start + len(batch)] = predicted
    return out


def _model_bytes(method: Surrogate) -> int | None:
    """Size of the file that `save` writes; None for a method that cannot be saved."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        try:
            method.save(path)
        except MorBenchError:
            return None
        return path.stat().st_size


def _worst(errors: SampleErrors, predicted: NDArray[np.float64], data: Dataset) -> dict[str, NDArray[Any]]:
    finite = np.where(np.isfinite(errors.mean_dof_m), errors.mean_dof_m, -1.0)
    worst = int(finite.argmax())
    return {
        "worst_prediction": predicted[worst],
        "worst_reference": data.test.displacements[worst],
        "worst_forces": data.test.forces[worst],
    }


def _evaluate(job: _Job, data: Dataset, data_seconds: float | None, threads: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Fit, predict the test set, time single queries; the parts of a row that this yields, and the raw samples."""
    method = make_surrogate(job.method.load_class(), job.parameters)
    with pinned_threads(os.cpu_count() or 1):
        start = perf_counter()
        method.fit(data.scene, data.train if method.needs_snapshots else None)
        fit_seconds = perf_counter() - start
    with pinned_threads(threads):
        predicted = _predict_all(method, data.test.forces)
        errors = sample_errors(predicted, data.test.displacements)
        answered = np.isfinite(errors.mean_dof_m)
        if not answered.any():
            raise SolverError(f"no valid prediction on any of {len(data.test)} test samples")
        latency = measure_latency(method.predict, data.test.forces[answered].copy())
    row = {
        "status": "ok",
        "n_failed": int((~answered).sum()),
        "error": summary(errors),
        "latency_ms": latency_summary(latency),
        "offline_s": {"data": data_seconds if method.needs_snapshots else 0.0, "fit": fit_seconds},
        "model_bytes": _model_bytes(method),
    }
    samples = {
        "latency_ms": latency,
        "mean_dof_m": errors.mean_dof_m,
        "relative_l2": errors.relative_l2,
        "max_nodal_m": errors.max_nodal_m,
        "amplitude_m": errors.amplitude_m,
        **_worst(errors, predicted, data),
    }
    return row, samples


def _run_job(job: _Job, data: Dataset, data_seconds: float | None, threads: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """`_evaluate`, with any failure turned into a row that says why; a method's crash costs only its own row."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            outcome, samples = _evaluate(job, data, data_seconds, threads)
        except (MissingDependencyError, UnsupportedSceneError) as error:
            outcome, samples = {"status": "skipped", "reason": str(error)}, {}
        except MorBenchError as error:
            outcome, samples = {"status": "failed", "reason": f"{type(error).__name__}: {error}"}, {}
        except (Exception, SystemExit) as error:  # third parties' code runs here
            outcome, samples = {"status": "failed", "reason": f"crashed with {type(error).__name__}: {error}"}, {}
    notes = list(dict.fromkeys(str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)))
    return {**outcome, "warnings": notes}, samples


def _default_out(names: Sequence[str]) -> Path:
    return Path("reports") / "runs" / f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{'-'.join(names)}"


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
    cache: Path | None = None,
    suite: Path | None = None,
    listener: Listener = Listener(),
) -> Comparison:
    """Compare methods on datasets.

    Every specification is checked before anything runs. Rows are written as they finish; the same run into the same
    folder keeps the rows that are there and goes on. The discretisation error of a dataset's mesh is read from the record
    that `mor_bench.harness.discretisation.refine` left, and is not measured here.

    Parameters
    ----------
    datasets, methods : sequences of names or paths of TOML files
        A dataset may also be a dict with the same keys. Methods are `CORE_METHODS` by default, or `DATA_METHODS` on
        imported snapshots.
    profile : {"quick", "full"}
        Which budget and sweep of the method files to use.
    out : path, optional
        Where to write; ``reports/runs/TIME-DATASETS`` by default.
    limit : int, optional
        Only the first samples of each dataset.
    split : {"region", "sample"}, optional
        Instead of the split in the dataset's file.
    threads : int
        Threads of a prediction, one by default: steadiest and, on small scenes, fastest. Fitting uses all cores.
    workers : int, optional
        Processes for data generation; all cores by default.
    cache, suite : Path, optional
        Cache folder of datasets; folder with ``datasets/`` and ``methods/``.
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
    if profile not in ("quick", "full"):
        raise InvalidInputError(f"`profile` must be 'quick' or 'full'; got {profile!r}.")
    if not 1 <= threads <= cores:
        raise InvalidInputError(f"`threads` must be an integer in [1, {cores}]; got {threads}.")
    if not datasets or (methods is not None and not methods):
        raise InvalidInputError("`datasets` and `methods` must name at least one each.")
    specs, method_specs = _checked_specs(datasets, methods, suite)
    discretisation = {spec.name: _discretisation(spec, cache, suite) for spec in specs}
    jobs = _jobs(method_specs, profile)
    settings = {"profile": profile, "split": split, "limit": limit, "threads": threads, "version": __version__}
    comparison = _open_run(Path(out) if out else _default_out([spec.name for spec in specs]), specs, settings)
    comparison.rows = [{**row, **discretisation[row["dataset"]]} for row in comparison.rows]
    comparison.write()
    for number, (spec, job) in enumerate((spec, job) for spec in specs for job in jobs):
        if number % len(jobs) == 0:
            data = _open(spec, comparison, listener, limit=limit, split=split, workers=workers, cache=cache)
            data_seconds = generation_seconds(spec, cache, len(data.train)) if isinstance(spec, DatasetSpec) else None
        listener.starting(spec.name, job.label, number + 1, len(specs) * len(jobs))
        if comparison.has(spec.name, job.label, job.parameters):
            continue
        outcome, samples = _run_job(job, data, data_seconds, threads)
        row: dict[str, Any] = {
            "dataset": spec.name,
            "split": split or spec.split.by,
            "method": job.method.name,
            "label": job.label,
            "parameters": job.parameters,
            "status": "",
            "reason": None,
            "n_train": len(data.train),
            "n_test": len(data.test),
            "n_unused": data.n_unused,
            "n_failed": None,
            "n_dofs": data.scene.mesh.n_dofs,
            "threads": threads,
            "error": None,
            "latency_ms": None,
            "all_threads_ms": None,
            "throughput": None,
            "offline_s": None,
            "memory_bytes": None,
            "model_bytes": None,
            "cost": None,
            "sets": {},
            "hidden": None,
            **discretisation[spec.name],
            **outcome,
        }
        comparison.add(row, samples)
        listener.finished(row)
    return comparison


def _discretisation(spec: AnyDatasetSpec, cache: Path | None, suite: Path | None) -> dict[str, float | None]:
    """The part of every row that says how far the dataset's mesh is from the body; None where it was not measured."""
    record = (measured(spec, cache, suite) if isinstance(spec, DatasetSpec) else None) or {}
    return {"discretisation_error_m": record.get("error_m"), "discretisation_rel_l2": record.get("relative_l2_median")}


def _checked_specs(
    datasets: Sequence[str | Path | Mapping[str, Any]], methods: Sequence[str | Path] | None, suite: Path | None
) -> tuple[list[AnyDatasetSpec], list[MethodSpec]]:
    """Read all specifications and check them as far as they can be without running, so that no run fails half-way on one."""
    specs = [load_dataset_spec(dataset, suite) for dataset in datasets]
    if methods is None:
        defaults = [DATA_METHODS if isinstance(spec, ImportedDatasetSpec) else CORE_METHODS for spec in specs]
        methods = list(dict.fromkeys(name for names in defaults for name in names))
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
        with suppress(MissingDependencyError):  # that becomes a row with its reason
            check_method(method_spec)
    return specs, method_specs


def _open_run(out: Path, specs: Sequence[AnyDatasetSpec], settings: dict[str, Any]) -> Comparison:
    """The comparison in a folder: a new one, or the one that was begun there with the same settings and datasets."""
    datasets = {spec.name: spec.model_dump(mode="json") for spec in specs}
    if (out / "results.json").exists():
        begun = Comparison.read(out)
        if begun.settings != settings or any(datasets.get(name) != spec for name, spec in begun.datasets.items()):
            raise InvalidInputError(f"{out} holds a run with other settings or datasets; choose another folder or remove it.")
        return begun
    comparison = Comparison(out, describe_machine(), settings=settings)
    try:
        comparison.write()
    except OSError as error:
        raise InvalidInputError(f"`out`: {out} cannot be written: {error.strerror}.") from None
    return comparison


def _open(spec: AnyDatasetSpec, comparison: Comparison, listener: Listener, **options: Any) -> Dataset:
    """Load a dataset and record what every figure of it needs."""
    data = load_dataset(spec, progress=lambda done, total: listener.generating(spec.name, done, total), **options)
    arrays = {
        "singular_values": pod(data.train.free_displacements).singular_values,
        "points": data.scene.mesh.points,
        "cells": data.scene.mesh.cells,
        "test_regions": data.test.loads.patches,
    }
    comparison.add_dataset(spec.name, spec.model_dump(mode="json"), arrays)
    return data
