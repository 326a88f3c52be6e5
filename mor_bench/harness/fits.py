"""Fits, scores and timings of configurations, each kept under a digest of all that it depends on.

CACHE/fits/METHOD-KEY/
    fit.json             seconds, memory, knobs, warnings, checksum of the model; written last
    model.safetensors    where the method can be saved
    score-SET.h5         per-sample errors on a test set, under the set's digest
    timing-KEY.h5        raw samples of a timing
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import MorBenchError
from mor_bench.harness.code import code_digest
from mor_bench.harness.handover import arrays_of, write_snapshots
from mor_bench.harness.isolation import MethodFailedError, Worker
from mor_bench.harness.metrics import sample_errors
from mor_bench.harness.results import read_arrays, write_arrays
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.store import write_atomically
from mor_bench.specs import MethodSpec

N_COUNTED = 32
"""Test loads over which the cost of a query is averaged."""

SCORE_CHUNK = 256

LOAD_LIMIT_S = 300.0


@dataclass(frozen=True)
class Job:
    """One configuration of one method on one dataset."""

    method: MethodSpec
    parameters: dict[str, Any]
    label: str


@dataclass(frozen=True)
class Place:
    """Where and under which limits methods run.

    Attributes
    ----------
    cache : Path
        Its folder ``fits`` keeps what was computed.
    sealed : tuple of Path
        Folders and files that no method may open.
    machine : str
        What seconds were measured on.
    fit_threads, threads : int
        Of a fit, and of a prediction.
    memory_limit_bytes : float
    """

    cache: Path
    sealed: tuple[Path, ...]
    machine: str
    fit_threads: int
    threads: int
    memory_limit_bytes: float


@dataclass(frozen=True)
class TestSet:
    """Forces that methods are asked for, in a file that they may open only then, and the answers, which stay here."""

    forces: Path
    references: NDArray[np.float64]
    digest: str


def digest_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 over named arrays."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        digest.update(np.ascontiguousarray(arrays[name]).data)
    return digest.hexdigest()


class Material:
    """A dataset laid out for the methods' processes: training snapshots in a folder, test forces in sealed files.

    Parameters
    ----------
    scene : Scene
    train : Snapshots
    sets : dict of str to Snapshots
        Test sets; the main one is ``test``.
    scratch : Path
        A folder of its own.
    """

    def __init__(self, scene: Scene, train: Snapshots, sets: Mapping[str, Snapshots], scratch: Path) -> None:
        self.scene = scene
        self.scratch = scratch
        self.n_train = len(train)
        self.open_folder = scratch / "open"
        self.sealed = scratch / "sealed"
        for folder in (scratch, self.open_folder, self.sealed):
            folder.mkdir(exist_ok=True)
        self._train = train
        self.train_folder = Path(tempfile.mkdtemp(dir=self.open_folder)) / "train"
        write_snapshots(self.train_folder, train)
        self.sets = {name: self.add_set(name, snapshots) for name, snapshots in sets.items()}

    def add_set(self, name: str, snapshots: Snapshots) -> TestSet:
        """Lay out one more test set."""
        path = self.sealed / f"{name}.npy"
        if not path.exists():
            np.save(path, snapshots.forces, allow_pickle=False)
        return TestSet(path, snapshots.displacements, digest_of({"f": snapshots.forces, "u": snapshots.displacements}))

    @cached_property
    def train_digest(self) -> str:
        """Of the training snapshots and the scene."""
        scene = json.dumps([self.scene.spec.physics(), self.scene.spec.grid_nodes], sort_keys=True)
        return digest_of(arrays_of(self._train)) + hashlib.sha256(scene.encode()).hexdigest()

    def first(self, n: int) -> Material:
        """With only the first training samples, and the main test set."""
        less = object.__new__(Material)
        less.scene, less.scratch, less.open_folder, less.sealed = self.scene, self.scratch, self.open_folder, self.sealed
        less._train, less.n_train, less.sets = self._train[:n], n, {"test": self.sets["test"]}
        less.train_folder = Path(tempfile.mkdtemp(dir=self.open_folder)) / "train"
        write_snapshots(less.train_folder, less._train)
        return less


@dataclass
class Outcome:
    """A configuration fitted and scored.

    Attributes
    ----------
    fit : dict
        What fitting took and gave.
    scores : dict of str to dict of arrays
        For each test set the per-sample errors, whether each load was flagged as out of range if the method knows, and the worst sample.
    cost : dict or None
        Per query, on the main test set.
    cached : bool
        Whether nothing had to be computed.
    """

    fit: dict[str, Any]
    scores: dict[str, dict[str, NDArray[Any]]]
    cost: dict[str, float] | None
    cached: bool


class Entry:
    """A configuration's folder in the cache."""

    def __init__(self, job: Job, material: Material, place: Place) -> None:
        self.job, self.material, self.place = job, material, place
        parts = {
            "data": material.train_digest,
            "surrogate": job.method.surrogate,
            "parameters": job.parameters,
            "code": code_digest(job.method.surrogate, job.method.folder),
            "machine": place.machine,
            "threads": place.fit_threads,
        }
        self.key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:20]
        self.folder = place.cache / "fits" / f"{job.method.name}-{self.key}"

    @property
    def model(self) -> Path:
        return self.folder / "model.safetensors"

    @cached_property
    def fit(self) -> dict[str, Any] | None:
        """What is known of the fit; None if it is not there, or damaged."""
        try:
            record: dict[str, Any] = json.loads((self.folder / "fit.json").read_bytes())
            if record["model_sha256"] is not None and record["model_sha256"] != _file_digest(self.model):
                return None
        except (OSError, ValueError, KeyError):
            return None
        return record

    def keep_fit(self, record: dict[str, Any], model: Path | None) -> dict[str, Any]:
        """Keep a fit; the record commits it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if model is not None:
            partial = self.folder / f".{os.getpid()}.{self.key}.tmp"
            shutil.copyfile(model, partial)
            os.replace(partial, self.model)
        record = {**record, "model_sha256": None if model is None else _file_digest(self.model)}
        write_atomically(self.folder / "fit.json", json.dumps(record, indent=1).encode())
        self.fit = record
        return record

    def arrays(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Arrays that were kept; None if they are not there, or damaged."""
        with suppress(OSError, KeyError, RuntimeError):
            arrays = read_arrays(self.folder / f"{name}.h5")
            if str(arrays.pop("digest").astype(str)) == digest_of(arrays):
                return arrays
        return None

    def keep_arrays(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep arrays."""
        write_arrays(self.folder / f"{name}.h5", {**arrays, "digest": np.array(digest_of(arrays).encode())})

    def process(self) -> Worker:
        """A fresh process for this method, without a model."""
        sealed = [*self.place.sealed, self.material.sealed]
        return Worker(self.material.scene, sealed, self.job.method.folder, self.place.memory_limit_bytes)

    def ask_fit(self, worker: Worker, limit_s: float) -> tuple[dict[str, Any], Path]:
        """Let a process fit; its answer, and where the model is."""
        model = Path(tempfile.mkdtemp(dir=self.material.open_folder)) / "model.safetensors"
        answer = worker.ask(
            "fit", limit_s, surrogate=self.job.method.surrogate, parameters=self.job.parameters, train=self.material.train_folder,
            model=model, threads=self.place.fit_threads, limit_s=limit_s,
        )  # fmt: skip
        return answer, model

    def opened(self, limit_s: float = LOAD_LIMIT_S) -> Worker:
        """A fresh process with the fitted method: loaded, or fitted again where it cannot be saved."""
        worker = self.process()
        try:
            if self.fit and self.fit["model_sha256"] is not None:
                worker.ask("load", LOAD_LIMIT_S, surrogate=self.job.method.surrogate, model=self.model)
            else:
                self.ask_fit(worker, limit_s)
        except BaseException:
            worker.end()
            raise
        return worker


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


RemoteFit = Callable[[Entry, float], tuple[dict[str, Any], bytes | None]]


def evaluate(entry: Entry, limit_s: float, remote: RemoteFit | None = None, *, count: bool = True) -> Outcome:
    """Fit and score a configuration, as far as the cache has not got it.

    Parameters
    ----------
    entry : Entry
    limit_s : float
        Seconds for the fit, and again for the predictions.
    remote : callable, optional
        Fits elsewhere: answer and content of the model's file.
    count : bool
        Whether to count the cost of a query.

    Raises
    ------
    MethodFailedError
        If the method crashes, hangs or takes too much memory.
    MorBenchError
        Of the kind that the method raised.
    """
    with ExitStack() as stack:
        worker: Worker | None = None
        cached = True

        def opened() -> Worker:
            nonlocal worker, cached
            if worker is None:
                worker, cached = entry.opened(limit_s), False
                stack.callback(worker.end)
            return worker

        fit = entry.fit
        if fit is None and remote is not None:
            fit, cached = _keep_remote(entry, *remote(entry, limit_s)), False
        if fit is None:
            worker, cached = entry.process(), False
            stack.callback(worker.end)
            answer, model = entry.ask_fit(worker, limit_s)
            fit = entry.keep_fit(_record(entry, answer), model if answer["model_bytes"] is not None else None)
            shutil.rmtree(model.parent)
        scores = {}
        for name, test in entry.material.sets.items():
            score = entry.arrays(f"score-{test.digest[:20]}")
            if score is None:
                score = _score(entry, opened(), test, limit_s)
                entry.keep_arrays(f"score-{test.digest[:20]}", score)
            scores[name] = score
        cost = _cost(entry, opened) if count else None
    return Outcome(fit, scores, cost, cached)


def _record(entry: Entry, answer: dict[str, Any]) -> dict[str, Any]:
    """The answer to a fit, and what estimates of others need."""
    known = {"method": entry.job.method.name, "n_train": entry.material.n_train, "n_dofs": entry.material.scene.mesh.n_dofs}
    return {**known, **answer}


def _keep_remote(entry: Entry, answer: dict[str, Any], content: bytes | None) -> dict[str, Any]:
    if content is None:
        return entry.keep_fit(_record(entry, answer), None)
    with tempfile.TemporaryDirectory(dir=entry.material.scratch) as folder:
        model = Path(folder) / "model.safetensors"
        model.write_bytes(content)
        return entry.keep_fit(_record(entry, answer), model)


def _score(entry: Entry, worker: Worker, test: TestSet, limit_s: float) -> dict[str, NDArray[Any]]:
    """Errors of each sample of a test set, and the worst sample."""
    out = entry.material.sealed / f"answers-{entry.key}.npy"
    try:
        worker.ask("predict", limit_s, forces=test.forces, out=out, threads=entry.place.threads)
        flagged = worker.ask("flag", limit_s, forces=test.forces)["flagged"]
        predicted = np.load(out, mmap_mode="r", allow_pickle=False)
        if predicted.shape != test.references.shape or predicted.dtype != np.float64:
            raise MethodFailedError(f"its predictions have shape {predicted.shape}; expected {test.references.shape}")
        parts = [
            sample_errors(np.asarray(predicted[start : start + SCORE_CHUNK]), test.references[start : start + SCORE_CHUNK])
            for start in range(0, len(predicted), SCORE_CHUNK)
        ]
        errors = {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
        worst = int(np.where(np.isfinite(errors["mean_dof_m"]), errors["mean_dof_m"], -1.0).argmax())
        forces = np.load(test.forces, mmap_mode="r", allow_pickle=False)
        return {
            **errors,
            **({} if flagged is None else {"flagged": np.asarray(flagged, dtype=bool)}),
            "worst_prediction": np.array(predicted[worst]),
            "worst_reference": test.references[worst],
            "worst_forces": np.array(forces[worst]),
        }
    finally:
        out.unlink(missing_ok=True)


def _cost(entry: Entry, opened: Callable[[], Worker]) -> dict[str, float] | None:
    """Cost of a query, counted once and kept with the fit."""
    name = f"cost-{entry.material.sets['test'].digest[:20]}.json"
    with suppress(OSError, ValueError):
        kept: dict[str, float] | None = json.loads((entry.folder / name).read_bytes())
        return kept
    cost: dict[str, float] | None = opened().ask("cost", LOAD_LIMIT_S, forces=entry.material.sets["test"].forces, n=N_COUNTED)["cost"]
    write_atomically(entry.folder / name, json.dumps(cost).encode())
    return cost


def fit_elsewhere(
    scene: Scene, arrays: dict[str, NDArray[Any]], surrogate: str, parameters: dict[str, Any], limits: tuple[float, float]
) -> tuple[dict[str, Any], bytes | None]:
    """A fit on another machine, in a process of its own there: its answer, and the model.

    Parameters
    ----------
    scene : Scene
    arrays : dict
        Of the training snapshots, see `mor_bench.harness.handover`.
    surrogate, parameters
        Of the method.
    limits : (seconds, bytes)
        Of time and memory.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "train").mkdir()
        for key, array in arrays.items():
            np.save(folder / "train" / f"{key}.npy", array, allow_pickle=False)
        with Worker(scene, [], memory_limit_bytes=limits[1]) as worker:
            model = folder / "model.safetensors"
            answer = worker.ask(
                "fit", limits[0], surrogate=surrogate, parameters=parameters, train=folder / "train", model=model,
                threads=os.cpu_count() or 1, limit_s=limits[0],
            )  # fmt: skip
        return answer, model.read_bytes() if model.exists() else None
