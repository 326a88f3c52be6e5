"""Fits, scores and timings of configurations, each kept under a digest of all that it depends on.

CACHE/fits/METHOD-KEY/
    fit.json             seconds, memory, knobs, warnings, loss curves, checksum of the model; written last
    training/checkpoint  of a training that was stopped; training.json says what it has taken so far
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
import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from time import monotonic, time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mor_bench.errors import InvalidInputError, MorBenchError, OutOfTimeError, StoreError
from mor_bench.machine import gpu_name
from mor_bench.measure.error_metrics import SampleErrors, sample_errors
from mor_bench.measure.indicator_quality import Indicated
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.mechanics.indicator import ErrorIndicator
from mor_bench.results.arrays import read_arrays, write_arrays
from mor_bench.runs.code_digest import code_digest
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.handover import arrays_of, write_snapshots
from mor_bench.sandbox.process import MethodFailedError, Restrictions, SandboxedProcess
from mor_bench.scene.scene import Scene
from mor_bench.snapshots.dataset import Snapshots
from mor_bench.snapshots.store import remove_leftovers, write_atomically
from mor_bench.specs import MethodSpec, list_suite, load_method_spec
from mor_bench.training_options import TrainingOptions

N_COUNTED = 32
"""Test loads over which the cost of a query is averaged."""

SCORE_CHUNK = 256
"""Samples that are predicted at once."""

FIT_KEYS = {
    "fit_s",
    "fit_memory_bytes",
    "model_bytes",
    "needs_snapshots",
    "parameters",
    "warnings",
    "n_train",
    "n_dofs",
    "model_sha256",
}
"""What a record of a fit holds."""

LOAD_LIMIT_S = 300.0


@dataclass(frozen=True)
class Job:
    """One configuration of one method on one dataset.

    Attributes
    ----------
    method : MethodSpec
    parameters : dict
    label : str
    training : TrainingOptions or None
        Device and seconds of a method that may train; None of one that does not.
    """

    method: MethodSpec
    parameters: dict[str, Any]
    label: str
    training: TrainingOptions | None = None
    swept: dict[str, Any] = field(default_factory=dict)


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
    fork_server : ForkServer or None
        What processes for fits are forked from.
    """

    cache: Path
    sealed: tuple[Path, ...]
    machine: str
    fit_threads: int
    threads: int
    memory_limit_bytes: float
    fork_server: ForkServer | None


@dataclass(frozen=True)
class TestSet:
    """What methods are asked for, and the displacements that answer it: both stay in this process until scoring.

    Attributes
    ----------
    forces, references : (n, n_nodes, 3) float64
        N and m; displacements of observed nodes, m, in the place of forces that are not known.
    nodes : (n_output_nodes,) int64
        The nodes where answers count.
    digest : str
        Of all.
    """

    forces: NDArray[np.float64]
    references: NDArray[np.float64]
    nodes: NDArray[np.int64]
    digest: str

    @classmethod
    def of(cls, snapshots: Snapshots) -> TestSet:
        """A test set from snapshots."""
        nodes = snapshots.scene.output_nodes
        arrays = {"f": snapshots.given.values, "u": snapshots.displacements}
        return cls(
            snapshots.given.values,
            snapshots.displacements,
            nodes,
            digest_of(
                arrays if len(nodes) == snapshots.scene.mesh.n_nodes else {**arrays, "nodes": nodes}
            ),
        )


def digest_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 over named arrays."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        digest.update(np.ascontiguousarray(arrays[name]).data)
    return digest.hexdigest()


class Material:
    """A dataset laid out for the methods' processes: training snapshots in a folder; test sets in memory.

    Parameters
    ----------
    scene : Scene
    train : Snapshots
    sets : dict of str to TestSet
        The main one is ``test``.
    scratch : Path
        An existing folder that every method's process may write to.
    """

    def __init__(
        self, scene: Scene, train: Snapshots, sets: Mapping[str, TestSet], scratch: Path
    ) -> None:
        self.scene, self.scratch, self.sets = scene, scratch, dict(sets)
        self.n_train = len(train)
        self._train = train
        self.train_folder = Path(tempfile.mkdtemp(dir=scratch)) / "train"
        write_snapshots(self.train_folder, train)
        self._files = self._file_digests()

    def _file_digests(self) -> dict[str, str]:
        return {path.name: _file_digest(path) for path in sorted(self.train_folder.iterdir())}

    def check_unchanged(self) -> None:
        """Raise `MethodFailedError`, and lay the samples out anew, if a method wrote over them."""
        try:
            unchanged = self._file_digests() == self._files
        except OSError:
            unchanged = False
        if not unchanged:
            shutil.rmtree(self.train_folder, ignore_errors=True)
            write_snapshots(self.train_folder, self._train)  # where all that share it look for it
            raise MethodFailedError("it wrote over the training samples")

    @cached_property
    def train_digest(self) -> str:
        """Of the training snapshots and the scene."""
        spec = self.scene.spec
        asked = (
            []
            if spec.needs.outputs == "all"
            else [spec.needs.model_dump(mode="json", include={"outputs"})]
        )
        if self.scene.observed_nodes is not None:
            asked.append({"observed": self.scene.observed_nodes.tolist()})
        scene = json.dumps([spec.physics(), spec.grid_nodes, *asked], sort_keys=True)
        return digest_of(arrays_of(self._train)) + hashlib.sha256(scene.encode()).hexdigest()

    @cached_property
    def indicator(self) -> ErrorIndicator | None:
        """None where equations or forces are not known, or not all displacements are asked for."""
        known = self.scene.material is not None and self.scene.observed_nodes is None
        whole = known and len(self.scene.output_nodes) == self.scene.mesh.n_nodes
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of the scene; methods say the same
            return ErrorIndicator(self.scene) if whole else None

    def first(self, n: int) -> Material:
        """With only the first training samples, and the main test set."""
        return Material(self.scene, self._train[:n], {"test": self.sets["test"]}, self.scratch)

    def with_sets(self, sets: Mapping[str, TestSet]) -> Material:
        """With the same training samples and other test sets."""
        other = copy(self)
        other.sets = dict(sets)
        return other


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
    """

    fit: dict[str, Any]
    scores: dict[str, dict[str, NDArray[Any]]]
    cost: dict[str, float] | None


class Entry:
    """A configuration's folder in the cache. `taken_s` are the seconds of a training in processes that were stopped."""

    def __init__(self, job: Job, material: Material, place: Place) -> None:
        self.job, self.material, self.place = job, material, place
        self._held: SandboxedProcess | None = None
        self.taken_s = 0.0
        parts = {
            "data": material.train_digest,
            "surrogate": job.method.surrogate,
            "parameters": job.parameters,
            "code": [
                code_digest(job.method.surrogate, job.method.folder),
                *_code_of_named(job.parameters),
            ],
            "machine": place.machine,
            "threads": place.fit_threads,
        }
        if "auto" in job.parameters.values():  # a size that is chosen by what the scene needs
            parts["needs"] = material.scene.spec.needs.error
        if job.training not in (None, TrainingOptions()):
            assert job.training is not None
            device = gpu_name() if job.training.device == "cuda" else job.training.device
            parts["training"] = {"device": device, "fit_seconds": job.training.fit_seconds}
        self.key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:20]
        self.folder = place.cache / "fits" / f"{job.method.name}-{self.key}"

    @property
    def model(self) -> Path:
        return self.folder / "model.safetensors"

    @property
    def checkpoint(self) -> Path:
        return self.folder / "training" / "checkpoint"

    @property
    def settled(self) -> Job:
        """The job with the number of iterations that its seconds came to, once it is fitted: another training is then no longer timed."""
        job, iterations = self.job, ((self.fit or {}).get("training") or {}).get("iterations")
        if (
            job.training is None
            or job.training.fit_seconds is None
            or iterations is None
            or "iterations" not in (self.fit or {})["parameters"]
        ):
            return job
        return replace(
            job,
            parameters={**job.parameters, "iterations": iterations},
            training=replace(job.training, fit_seconds=None),
        )

    def begin_training(self) -> None:
        """Make room for a checkpoint, and note the seconds that a stopped training took until it wrote the one that is there."""
        record, taken = self.folder / "training.json", 0.0
        self.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.checkpoint.parent)
        with suppress(OSError, ValueError, KeyError, TypeError):
            kept, written = json.loads(record.read_bytes()), self.checkpoint.stat().st_mtime
            taken = float(kept["taken_s"]) + max(0.0, written - float(kept["began"]))
        write_atomically(record, json.dumps({"taken_s": taken, "began": time()}).encode())
        self.taken_s = taken

    def end_training(self) -> None:
        """Forget a checkpoint. The folder stays: another run may be writing to it."""
        self.checkpoint.unlink(missing_ok=True)
        (self.folder / "training.json").unlink(missing_ok=True)

    @cached_property
    def fit(self) -> dict[str, Any] | None:
        """What is known of the fit; None if it is not there, or damaged."""
        try:
            record = json.loads((self.folder / "fit.json").read_bytes())
            whole = (
                isinstance(record, dict)
                and record.keys() >= FIT_KEYS
                and isinstance(record["parameters"], dict)
            )
            if not whole or (
                record["model_sha256"] is not None
                and record["model_sha256"] != _file_digest(self.model)
            ):
                return None
        except (OSError, ValueError):
            return None
        found: dict[str, Any] = record
        return found

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
        write_arrays(
            self.folder / f"{name}.h5", {**arrays, "digest": np.array(digest_of(arrays).encode())}
        )

    def process(
        self, fork_server: ForkServer | None = None, exempt: Path | None = None
    ) -> SandboxedProcess:
        """A fresh process for this method, without a model."""
        return SandboxedProcess(
            MethodSession,
            Restrictions(
                self.place.sealed, exempt, self.job.method.folder, self.place.memory_limit_bytes
            ),
            fork_server or self.place.fork_server,
            scene=self.material.scene,
        )

    def ask_fit(
        self, worker: SandboxedProcess, limit_s: float, checkpoint: Path | None = None
    ) -> tuple[dict[str, Any], Path]:
        """Let a process fit, anew or going on from a checkpoint; its answer, and where the model is."""
        model = Path(tempfile.mkdtemp(dir=self.material.scratch)) / "model.safetensors"
        job = self.settled
        answer = worker.ask(
            "fit",
            limit_s,
            request=FitRequest(
                surrogate=job.method.surrogate,
                parameters=job.parameters,
                train=self.material.train_folder,
                model=model,
                threads=self.place.fit_threads,
                limit_s=limit_s,
                training=job.training and replace(job.training, checkpoint=checkpoint),
            ),
        )
        if answer["needs_snapshots"]:
            self.material.check_unchanged()
        return answer, model

    def opened(
        self, limit_s: float = LOAD_LIMIT_S, fork_server: ForkServer | None = None
    ) -> SandboxedProcess:
        """A process with the fitted method: a fresh one with the model, or one that fits again where it cannot be saved."""
        if self._held and fork_server is None:
            worker, self._held = self._held, None
            return worker
        worker = self.process(fork_server)
        try:
            if self.fit and self.fit["model_sha256"] is not None:
                worker.ask(
                    "load", LOAD_LIMIT_S, surrogate=self.job.method.surrogate, model=self.model
                )
            else:
                self.ask_fit(worker, limit_s)
        except BaseException:
            worker.end()
            raise
        return worker

    def hold(self, worker: SandboxedProcess) -> None:
        """Keep the process of a method that cannot be saved until it has been scored."""
        self._held = worker

    def release(self) -> None:
        """End what is held."""
        if self._held:
            self._held.end()
            self._held = None


def _code_of_named(parameters: Mapping[str, Any]) -> list[str]:
    """Of the methods of the suite that knobs name."""
    shipped = list_suite("methods")
    named = [value for value in parameters.values() if isinstance(value, str) and value in shipped]
    return [code_digest(load_method_spec(shipped[name]).surrogate) for name in named]


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


RemoteFit = Callable[[Entry, float], tuple[dict[str, Any], bytes | None]]


def fit(entry: Entry, limit_s: float, remote: RemoteFit | None = None) -> dict[str, Any]:
    """Fit a configuration, unless the cache has it: what fitting took and gave. No test set is known to the process.

    Parameters
    ----------
    entry : Entry
    limit_s : float
        Seconds for the fit.
    remote : callable, optional
        Fits elsewhere: answer and content of the model's file.

    Raises
    ------
    MethodFailedError
        If the method crashes, hangs, takes too much memory or changes what others are to learn from.
    MorBenchError
        Of the kind that the method raised.
    """
    if entry.fit is not None:
        return entry.fit
    if remote is not None:
        return _keep_remote(entry, *remote(entry, limit_s))
    resumed = entry.checkpoint.exists()
    worker = _fitting_process(entry)
    try:
        try:
            answer, model = entry.ask_fit(worker, _left(limit_s, entry.taken_s), entry.checkpoint)
        except (MethodFailedError, OutOfTimeError):
            raise  # a later run with more time goes on from the checkpoint
        except MorBenchError as error:
            entry.end_training()
            if not (resumed and isinstance(error, StoreError | InvalidInputError)):
                raise
            worker.end()  # the checkpoint was at fault
            worker = _fitting_process(entry)
            answer, model = entry.ask_fit(worker, limit_s, entry.checkpoint)
        answer["fit_s"] += entry.taken_s
        saved = answer["model_bytes"] is not None
        record = entry.keep_fit(_record(entry, answer), model if saved else None)
        shutil.rmtree(model.parent, ignore_errors=True)
        entry.end_training()
    except BaseException:
        worker.end()
        raise
    if saved:
        worker.end()
    else:
        entry.hold(worker)
    return record


def _fitting_process(entry: Entry) -> SandboxedProcess:
    """A process for a fit; one that may train can open the folder of its checkpoint."""
    if entry.job.training is None:
        return entry.process()
    entry.begin_training()
    return entry.process(exempt=entry.checkpoint.parent)


def _left(limit_s: float, taken_s: float) -> float:
    if taken_s >= limit_s:
        raise MethodFailedError(
            f"fitting took longer than the limit of {limit_s:g} s: {taken_s:.0f} s until it was stopped"
        )
    return limit_s - taken_s


def score(entry: Entry, limit_s: float, *, count: bool = True) -> Outcome:
    """Score a fitted configuration on all test sets, as far as the cache has not got it.

    Parameters
    ----------
    entry : Entry
    limit_s : float
        Seconds for the predictions.
    count : bool
        Whether to count the cost of a query.

    Raises
    ------
    MethodFailedError, MorBenchError
        As `fit`.
    """
    assert entry.fit is not None
    with ExitStack() as stack:
        stack.callback(entry.release)
        worker: SandboxedProcess | None = None

        def opened() -> SandboxedProcess:
            nonlocal worker
            if worker is None:
                worker = entry.opened(limit_s)
                stack.callback(worker.end)
            return worker

        scores = {}
        for name, test in entry.material.sets.items():
            found = entry.arrays(f"score-{test.digest[:20]}")
            if found is None:
                found = _score(entry, opened(), test, limit_s)
                entry.keep_arrays(f"score-{test.digest[:20]}", found)
            scores[name] = found
        return Outcome(entry.fit, scores, _cost(entry, opened) if count else None)


def evaluate(entry: Entry, limit_s: float) -> Outcome:
    """Fit and score a configuration; see `fit` and `score`."""
    fit(entry, limit_s)
    return score(entry, limit_s, count=False)


def _record(entry: Entry, answer: dict[str, Any]) -> dict[str, Any]:
    """The answer to a fit, and what estimates of others need."""
    known = {
        "method": entry.job.method.name,
        "n_train": entry.material.n_train,
        "n_dofs": entry.material.scene.mesh.n_dofs,
    }
    return {**known, **answer}


def _keep_remote(entry: Entry, answer: dict[str, Any], content: bytes | None) -> dict[str, Any]:
    if content is None:
        return entry.keep_fit(_record(entry, answer), None)
    with tempfile.TemporaryDirectory(dir=entry.material.scratch) as folder:
        model = Path(folder) / "model.safetensors"
        model.write_bytes(content)
        return entry.keep_fit(_record(entry, answer), model)


def _score(
    entry: Entry, worker: SandboxedProcess, test: TestSet, limit_s: float
) -> dict[str, NDArray[Any]]:
    """Errors of each sample of a test set, and the worst sample."""
    parts: list[SampleErrors] = []
    flagged: list[bool] | None = []
    worst: tuple[float, int, NDArray[np.float64]] = (
        -1.0,
        0,
        np.full(test.references.shape[1:], np.nan),
    )
    main = test is entry.material.sets.get("test")
    indicated = Indicated(entry.material.indicator if main else None, len(test.forces))
    until = monotonic() + limit_s
    with tempfile.TemporaryDirectory(dir=entry.material.scratch) as folder:
        for start in range(0, len(test.forces), SCORE_CHUNK):
            rows = slice(start, start + SCORE_CHUNK)
            predicted = ask_answers(
                worker,
                "predict",
                max(1.0, until - monotonic()),
                Path(folder) / "answers.npy",
                test.forces[rows],
                entry.place.threads,
            )
            parts.append(sample_errors(predicted, test.references[rows], test.nodes))
            finite = np.where(np.isfinite(parts[-1].mean_dof_m), parts[-1].mean_dof_m, -1.0)
            if finite.max() > worst[0]:
                worst = (
                    float(finite.max()),
                    start + int(finite.argmax()),
                    predicted[finite.argmax()].copy(),
                )
            indicated.add(start, test.forces[rows], predicted)
            flags = worker.ask("flag", LOAD_LIMIT_S, forces=test.forces[rows])["flagged"]
            flagged = None if flags is None or flagged is None else flagged + flags
    return {
        **{
            name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])
        },
        **({} if flagged is None else {"flagged": np.asarray(flagged, dtype=bool)}),
        **indicated.arrays,
        "worst_prediction": worst[2],
        "worst_reference": test.references[worst[1]],
        # Nothing to draw an arrow from where methods are given displacements.
        "worst_forces": test.forces[worst[1]] * (entry.material.scene.observed_nodes is None),
    }


def ask_answers(
    worker: SandboxedProcess,
    do: str,
    limit_s: float,
    out: Path,
    forces: NDArray[np.float64],
    threads: int,
) -> NDArray[np.float64]:
    """Predictions that a process writes to a file, checked: a third party's code ran there."""
    worker.ask(do, limit_s, forces=forces, out=out, threads=threads)
    try:
        predicted = np.load(out, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise MethodFailedError(f"its predictions cannot be read: {error}") from None
    if predicted.shape != forces.shape or predicted.dtype != np.float64:
        raise MethodFailedError(
            f"its predictions have shape {predicted.shape} and are {predicted.dtype}; expected {forces.shape} and float64"
        )
    out.unlink()
    return np.asarray(predicted)


def _cost(entry: Entry, opened: Callable[[], SandboxedProcess]) -> dict[str, float] | None:
    """Cost of a query, counted once and kept with the fit."""
    test = entry.material.sets["test"]
    path = entry.folder / f"cost-{test.digest[:20]}.json"
    with suppress(OSError, ValueError):
        kept = json.loads(path.read_bytes())
        if kept is None or (
            isinstance(kept, dict)
            and all(isinstance(value, int | float) for value in kept.values())
        ):
            return kept
    chosen = np.linspace(0, len(test.forces) - 1, min(N_COUNTED, len(test.forces))).astype(int)
    cost: dict[str, float] | None = opened().ask("cost", LOAD_LIMIT_S, forces=test.forces[chosen])[
        "cost"
    ]
    write_atomically(path, json.dumps(cost).encode())
    return cost


def fit_elsewhere(
    scene: Scene,
    arrays: dict[str, NDArray[Any]],
    surrogate: str,
    parameters: dict[str, Any],
    limits: tuple[float, float],
    training: TrainingOptions | None = None,
) -> tuple[dict[str, Any], bytes | None]:
    """A fit on another machine, in a process of its own there: its answer, and the model.

    Parameters
    ----------
    scene : Scene
    arrays : dict
        Of the training snapshots, see `mor_bench.sandbox.handover`.
    surrogate, parameters
        Of the method.
    limits : (seconds, bytes)
        Of time and memory.
    training : TrainingOptions, optional
        Of a method that may train.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "train").mkdir()
        for key, array in arrays.items():
            np.save(folder / "train" / f"{key}.npy", array, allow_pickle=False)
        model = folder / "model.safetensors"
        request = FitRequest(
            surrogate,
            parameters,
            folder / "train",
            model,
            os.cpu_count() or 1,
            limits[0],
            training,
        )
        restrictions = Restrictions(memory_bytes=limits[1])
        with SandboxedProcess(MethodSession, restrictions, scene=scene) as process:
            answer = process.ask("fit", limits[0], request=request)
        return answer, model.read_bytes() if model.exists() else None
