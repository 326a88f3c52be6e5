"""A configuration's folder in the cache, under a digest of everything that its fit depends on.

CACHE/fits/METHOD-KEY/
    fit.json             seconds, memory, parameters, warnings, loss curves, checksum; written last
    training/checkpoint  a training that was stopped; training.json holds the seconds it has taken
    model.safetensors    where the method can be saved
    score-SET.h5         per-sample errors on a test set, under the set's digest
    cost-SET.json        counted work per query
    timing-KEY.h5        raw samples of a timing
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from pathlib import Path
from threading import Event, Thread
from time import monotonic
from typing import Any

from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from mor_bench.checked_files import read_json
from mor_bench.digests import digest_of_file
from mor_bench.errors import StoreError
from mor_bench.machine import describe_machine, gpu_name, usable_cores
from mor_bench.measure.method_session import FitRequest, MethodSession
from mor_bench.results.arrays import verified_arrays, write_verified
from mor_bench.results.parts import TrainedElsewhere
from mor_bench.runs.code_digest import code_digest
from mor_bench.runs.configurations import Configuration
from mor_bench.runs.training_data import TrainingData
from mor_bench.sandbox.fork_server import ForkServer
from mor_bench.sandbox.process import SandboxedProcess
from mor_bench.sandbox.seal import Restrictions
from mor_bench.snapshots.store import remove_leftovers, write_atomically
from mor_bench.specs import list_suite, load_method_spec
from mor_bench.specs.one_line_errors import validated
from mor_bench.training_options import TrainingOptions

LOAD_LIMIT_S = 300.0
"""Time limit for loading a model, s."""

RECORD_EVERY_S = 0.1
"""Interval at which the time of a training is recorded if its checkpoint has changed, s."""


@dataclass(frozen=True)
class RunEnvironment:
    """Run environment of methods, and their limits.

    Attributes
    ----------
    cache : Path
        Cache folder; its folder ``fits`` keeps fits, scores and timings.
    sealed : tuple of Path
        Folders and files that no method may open.
    jobs : int
        Number of simultaneous fits, which share the cores.
    threads : int
        Number of threads of a prediction.
    memory_limit_bytes : float
        Memory limit of a method's process.
    fork_server : ForkServer or None
        Process from which worker processes are forked.
    """

    cache: Path
    sealed: tuple[Path, ...] = ()
    jobs: int = 1
    threads: int = 1
    memory_limit_bytes: float = float("inf")
    fork_server: ForkServer | None = None

    @cached_property
    def machine(self) -> str:
        """Processor and number of cores, on which the time of a fit depends."""
        machine = describe_machine()
        return f"{machine['processor']} x {machine['cores']}"

    @property
    def fit_threads(self) -> int:
        """Threads of a fit."""
        return max(1, usable_cores() // self.jobs)


class FitRecord(BaseModel):
    """The content of fit.json: cost and results of a fit.

    Attributes
    ----------
    method : str
    n_train, n_dofs : int
        Size of the problem.
    fit_s, fit_core_s : float
        Wall time and core-seconds of fitting, without compilation.
    fit_memory_bytes : int
        Peak resident memory.
    model_bytes : int or None
        Size of the saved model; None if the method cannot be saved.
    needs_snapshots : bool
        Whether the method used training samples.
    parameters, sizes : dict
        All parameters, and the values chosen for those that were "auto".
    training : dict or None
        Iterations and loss curves of a training.
    warnings : list of str
    model_sha256 : str or None
        Checksum of the saved model.
    trained_elsewhere : TrainedElsewhere or None
        Origin of weights that the suite ships.
    """

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="constants")

    method: str = ""
    n_train: int
    n_dofs: int
    fit_s: float
    fit_core_s: float
    fit_memory_bytes: int
    model_bytes: int | None
    needs_snapshots: bool
    parameters: dict[str, Any]
    sizes: dict[str, Any] = {}
    training: dict[str, Any] | None = None
    warnings: list[str]
    model_sha256: str | None = None
    trained_elsewhere: TrainedElsewhere | None = None

    @property
    def iterations(self) -> int | None:
        """Number of iterations of a training with a time target; None if not recorded."""
        return (self.training or {}).get("iterations")


def read_fit_record(path: Path) -> FitRecord:
    """Read a fit.json.

    Raises
    ------
    StoreError
        If it is damaged.
    FileNotFoundError
        If it does not exist.
    """
    return validated(FitRecord, read_json(path), str(path), error=StoreError)


def training_seconds(path: Path) -> float:
    """Return the seconds that a training.json states; 0 if it is missing or damaged."""
    with suppress(OSError, StoreError, ValueError, KeyError, TypeError):
        seconds = float(read_json(path)["taken_s"])
        if 0.0 <= seconds < inf:
            return seconds
    return 0.0


class CachedFit:
    """A configuration and its cache folder; also its process if the method cannot be saved.

    Attributes
    ----------
    taken_s : float
        Training time in earlier processes that were stopped, s.
    """

    def __init__(
        self, configuration: Configuration, data: TrainingData, environment: RunEnvironment
    ) -> None:
        self.configuration, self.data, self.environment = configuration, data, environment
        self.taken_s = 0.0
        self._held: SandboxedProcess | None = None
        digest = hashlib.sha256(json.dumps(self._key_parts(), sort_keys=True).encode())
        self.key = digest.hexdigest()[:20]
        self.folder = environment.cache / "fits" / f"{configuration.method.name}-{self.key}"
        self.model = self.folder / "model.safetensors"
        self.checkpoint = self.folder / "training" / "checkpoint"

    def _key_parts(self) -> dict[str, Any]:
        method, parameters = self.configuration.method, self.configuration.parameters
        parts: dict[str, Any] = {
            "data": self.data.digest,
            "surrogate": method.surrogate,
            "parameters": parameters,
            "code": [code_digest(method.surrogate, method.folder), *_code_of_named(parameters)],
            "machine": self.environment.machine,
            "threads": self.environment.fit_threads,
        }
        if "auto" in parameters.values():  # the choice depends on the scene's needs
            parts["needs"] = self.data.scene.spec.needs.error
        training = self.configuration.training
        if training is not None and training != TrainingOptions():
            device = gpu_name() if training.device == "cuda" else training.device
            parts["training"] = {"device": device, "fit_seconds": training.fit_seconds}
        if self.configuration.shipped is not None:
            parts["shipped"] = self.configuration.shipped
        if training is not None:
            parts["validation"] = self.data.validation_digest
        return parts

    @property
    def reproducible(self) -> Configuration:
        """The configuration with the fit's number of iterations instead of its time target."""
        configuration, record = self.configuration, self.record
        training = configuration.training
        if training is None or training.fit_seconds is None or record is None:
            return configuration
        if record.iterations is None or "iterations" not in record.parameters:
            return configuration
        return replace(
            configuration,
            parameters={**configuration.parameters, "iterations": record.iterations},
            training=replace(training, fit_seconds=None),
        )

    @cached_property
    def record(self) -> FitRecord | None:
        """The record of the fit; None if there is none or it is damaged."""
        try:
            record = read_fit_record(self.folder / "fit.json")
            checksum = record.model_sha256
            damaged = checksum is not None and checksum != digest_of_file(self.model)
        except (OSError, StoreError):
            return None
        return None if damaged else record

    @property
    def fitted(self) -> FitRecord:
        """The record of a fitted configuration."""
        assert self.record is not None
        return self.record

    def keep(self, record: FitRecord, model: bytes | None) -> FitRecord:
        """Store a fit and the content of its model; writing the record commits it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if model is not None:
            remove_leftovers(self.folder)
            write_atomically(self.model, model)
            checksum = {"model_sha256": digest_of_file(self.model)}
            record = record.model_copy(update=checksum)
        write_atomically(self.folder / "fit.json", record.model_dump_json(indent=1).encode())
        self.record = record
        return record

    def arrays(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Read stored arrays; None if there are none or they are damaged."""
        return verified_arrays(self.folder / f"{name}.h5")

    def keep_arrays(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store arrays under a name."""
        write_verified(self.folder / f"{name}.h5", arrays)

    def begin_training(self) -> None:
        """Create the folder of a checkpoint; read the training time up to an existing one."""
        self.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.checkpoint.parent)
        self.taken_s = training_seconds(self._training_record) if self.checkpoint.exists() else 0.0

    @property
    def _training_record(self) -> Path:
        return self.folder / "training.json"

    @contextmanager
    def _recorded_training(self) -> Iterator[None]:
        """Record the training time up to the newest checkpoint, while the body trains.

        A steady clock measures it: the system clock, and so the age of a file, may jump.
        """
        began, over = monotonic(), Event()

        def record() -> None:
            seen, last = _version_of(self.checkpoint), False
            while not last:
                last = over.wait(RECORD_EVERY_S)
                now = _version_of(self.checkpoint)
                if now not in (None, seen):
                    content = {"taken_s": self.taken_s + monotonic() - began}
                    with suppress(OSError):
                        write_atomically(self._training_record, json.dumps(content).encode())
                seen = now

        recorder = Thread(target=record, daemon=True)
        recorder.start()
        try:
            yield
        finally:
            over.set()
            recorder.join()

    def end_training(self) -> None:
        """Delete a checkpoint. The folder stays, because another run may write to it."""
        self.checkpoint.unlink(missing_ok=True)
        self._training_record.unlink(missing_ok=True)

    def worker(
        self, fork_server: ForkServer | None = None, exempt: Path | None = None
    ) -> SandboxedProcess:
        """Start a fresh worker process for the method, without a model."""
        restrictions = Restrictions(
            self.environment.sealed,
            exempt,
            self.configuration.method.folder,
            self.data.scratch,
            self.environment.memory_limit_bytes,
        )
        server = fork_server or self.environment.fork_server
        return SandboxedProcess(MethodSession, restrictions, server, scene=self.data.scene)

    def fit_in(
        self, worker: SandboxedProcess, limit_s: float, checkpoint: Path | None = None
    ) -> tuple[dict[str, Any], Path]:
        """Fit in a worker, from a checkpoint if there is one; return its answer and the model."""
        model = Path(tempfile.mkdtemp(dir=self.data.scratch)) / "model.safetensors"
        configuration = self.reproducible
        training = configuration.training
        request = FitRequest(
            surrogate=configuration.method.surrogate,
            parameters=configuration.parameters,
            train=self.data.folder,
            model=model,
            threads=self.environment.fit_threads,
            limit_s=limit_s,
            training=training and replace(training, checkpoint=checkpoint),
            validation=self.data.validation_folder if training else None,
        )
        with self._recorded_training() if request.training else nullcontext():
            answer = worker.ask("fit", limit_s, request=request)
        if answer["needs_snapshots"]:
            self.data.check_unchanged()
        return answer, model

    def open_worker(
        self, limit_s: float = LOAD_LIMIT_S, fork_server: ForkServer | None = None
    ) -> SandboxedProcess:
        """Start a worker with the fitted method; one that cannot be saved is fitted again."""
        if self._held and fork_server is None:
            worker, self._held = self._held, None
            return worker
        saved = self.record is not None and self.record.model_sha256 is not None
        worker = self.worker(fork_server, exempt=self.model if saved else None)
        try:
            if saved:
                surrogate = self.configuration.method.surrogate
                worker.ask("load", LOAD_LIMIT_S, surrogate=surrogate, model=self.model)
            else:
                self.fit_in(worker, limit_s)
        except BaseException:
            worker.end()
            raise
        return worker

    def hold(self, worker: SandboxedProcess) -> None:
        """Keep the process of a method that cannot be saved until it has been scored."""
        self._held = worker

    def release(self) -> None:
        """End the held process."""
        if self._held:
            self._held.end()
            self._held = None


def _version_of(path: Path) -> tuple[int, int] | None:
    """Return numbers that change when a file is replaced; None if there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def _code_of_named(parameters: Mapping[str, Any]) -> list[str]:
    """Return the code digests of methods of the suite that parameters name."""
    shipped = list_suite("methods")
    named = [value for value in parameters.values() if isinstance(value, str) and value in shipped]
    return [code_digest(load_method_spec(shipped[name]).surrogate) for name in named]
