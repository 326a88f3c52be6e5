"""The session that a method runs in: it fits or loads, predicts, and is timed.

The session is given the scene, the training snapshots, and the loads to predict. The reference
displacements stay in the parent process, which scores.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mor_bench.errors import (
    InvalidInputError,
    SolverError,
    UnknownRangeError,
)
from mor_bench.machine import peak_memory_bytes, pinned_threads
from mor_bench.measure.error_bounds import WithSpread
from mor_bench.measure.fit_clock import fit_clock
from mor_bench.measure.method_answers import ANSWERS
from mor_bench.measure.predictions import predict_all
from mor_bench.measure.query_cost import cost_of
from mor_bench.measure.timed_loads import TimedLoads
from mor_bench.method_loading import check_predicts, load_fitted, make_surrogate
from mor_bench.sandbox.handover import read_snapshots
from mor_bench.sandbox.session import Answer, Session
from mor_bench.scene.scene import Scene, load_scene
from mor_bench.snapshots.given import given_of
from mor_bench.specs import check_parameters, load_class
from mor_bench.surrogate import Surrogate
from mor_bench.training_options import TrainingOptions

Array = NDArray[np.float64]

CURVES = ("loss_curve", "validation_curve")
"""Attributes, without the final underscore, in which a trained method keeps its losses."""

SETTLE_QUERIES = 3
"""Untimed queries before each round; they fill the processor's caches with the method's data."""

CHECKED_ANSWERS, CHECKED_SHARE = 4, 0.2
"""Largest number of answers kept per round for a check, and the probability of keeping one."""

UNANSWERED = object()
"""Placeholder for the answer to a query without an equilibrium."""

WARM_UP_QUERIES, WARM_UP_S = 20, 2.0
"""Largest number of queries in the warm-up, and its approximate time limit, s."""

PRELOADED = (
    "sklearn.linear_model",
    "mor_bench.surrogates.deim",
    "mor_bench.surrogates.ecm",
    "mor_bench.surrogates.hpod",
    "mor_bench.surrogates.pca_regression",
    "mor_bench.surrogates.pod",
)
"""Modules that many methods import, without PyTorch: it takes two seconds, and few need it."""


@dataclass(frozen=True)
class FitRequest:
    """Inputs of a fit in a session.

    Attributes
    ----------
    surrogate : str
        The class, ``package.module:Class``.
    parameters : dict
    train : Path
        Folder of the training snapshots; see `mor_bench.sandbox.handover`.
    model : Path
        Where the fitted model is saved.
    threads : int
    limit_s : float
        Time limit that the method receives, s.
    training : TrainingOptions, optional
        Training options of a method that may train.
    validation : Path, optional
        Folder of the validation snapshots, for a method that may train.
    """

    surrogate: str
    parameters: dict[str, Any]
    train: Path
    model: Path
    threads: int
    limit_s: float
    training: TrainingOptions | None = None
    validation: Path | None = None


class MethodSession(Session):
    """One configuration of a method.

    Parameters
    ----------
    scene : Scene, optional
        Not needed to check parameters.
    """

    activities: ClassVar[Mapping[str, str]] = {
        "check": "importing it",
        "fit": "fitting",
        "load": "loading the model",
        "predict": "predicting",
        "warm": "warming up",
        "time": "timing",
        "throughput": "timing batches",
        "cost": "counting the cost",
        "flag": "flagging loads out of range",
        "spread": "measuring the spread",
    }
    answers: ClassVar[Mapping[str, type[Answer]]] = ANSWERS

    def __init__(self, scene: Scene | None = None) -> None:
        if scene is not None:
            self.scene = scene
        self.method: Surrogate
        self.loads: TimedLoads
        self.parameters: Array | None = None

    @classmethod
    def preload(cls) -> None:
        """Import what many methods import, and compile or load the kernels with one solve."""
        from mor_bench.surrogates.fem import FullFEM

        for module in PRELOADED:
            import_module(module)
        with pinned_threads(1):
            scene = load_scene("beam-tiny")
            force = np.zeros((scene.mesh.n_nodes, 3))
            force[-1] = 0.1
            FullFEM().fit(scene).predict(force)

    def check(
        self, surrogate: str, configurations: list[dict[str, Any]], where: str
    ) -> dict[str, Any]:
        """Import a class, and check that it predicts and takes the parameters."""
        loaded = load_class(surrogate)
        check_predicts(loaded, surrogate)
        for configuration in configurations:
            check_parameters(loaded, configuration, where)
        return {}

    def fit(self, request: FitRequest) -> dict[str, Any]:
        """Fit and save the model."""
        method = make_surrogate(load_class(request.surrogate), request.parameters)
        method.time_limit_s = request.limit_s
        if request.training is not None:
            held = request.validation and read_snapshots(request.validation, self.scene)
            method.training = replace(request.training, validation=held or None)
        with pinned_threads(request.threads):
            snapshots = (
                read_snapshots(request.train, self.scene) if method.needs_snapshots else None
            )
            with fit_clock() as cost:
                method.fit(self.scene, snapshots)
        self.method = method
        saved = True
        try:
            method.save(request.model)
        except Exception:  # a method that cannot be saved is fitted again where it is timed
            saved = False
        return {
            "fit_s": cost.wall_s,
            "fit_core_s": cost.core_s,
            "fit_memory_bytes": peak_memory_bytes(),
            "model_bytes": request.model.stat().st_size if saved else None,
            "needs_snapshots": method.needs_snapshots,
            "parameters": method.parameters,
            "sizes": getattr(method, "sizes_", {}),
            "training": _training_record(method),
        }

    def load(self, surrogate: str, model: Path) -> dict[str, Any]:
        """Load a fitted model."""
        self.method = load_fitted(model, load_class(surrogate), self.scene)
        return {}

    def predict(
        self, forces: Array, out: Path, threads: int, parameters: Array | None = None
    ) -> dict[str, Any]:
        """Predict loads, (n, n_nodes, 3), N, and write the displacements to a file.

        In a parametric scene, `parameters` (n, n_parameters) belong to them.
        """
        with pinned_threads(threads):
            given = given_of(self.scene, forces, parameters)
            np.save(out, predict_all(self.method, given), allow_pickle=False)
        return {}

    def flag(self, forces: Array, parameters: Array | None = None) -> dict[str, Any]:
        """Return which loads are out of the training range; None if the method does not know."""
        try:
            flagged = self.method.out_of_range(given_of(self.scene, forces, parameters).query)
        except UnknownRangeError:
            return {"flagged": None}
        if flagged.shape != (len(forces),):
            raise InvalidInputError(
                f"`out_of_range` must return {len(forces)} flags, one per load; it "
                f"returned shape {flagged.shape}."
            )
        return {"flagged": [bool(flag) for flag in flagged]}

    def spread(self, forces: Array, parameters: Array | None = None) -> dict[str, Any]:
        """Return how uncertain the answers are; None for methods without a spread."""
        if not isinstance(self.method, WithSpread):
            return {"spread": None}
        found = self.method.spread(given_of(self.scene, forces, parameters).query)
        if found.shape != (len(forces),) or not (found >= 0).all():
            raise InvalidInputError(
                f"`spread` must return {len(forces)} numbers >= 0, one per load."
            )
        return {"spread": found.tolist()}

    def cost(self, forces: Array, parameters: Array | None = None) -> dict[str, Any]:
        """Count the work of a query, averaged over some loads."""
        return {"cost": cost_of(self.method, given_of(self.scene, forces, parameters))}

    def warm(
        self, forces: Array, threads: int, seed: int, parameters: Array | None = None
    ) -> dict[str, Any]:
        """Store the loads of the queries, see `TimedLoads`, and answer some of them untimed."""
        self.loads, self.parameters = TimedLoads(forces, seed), parameters
        with pinned_threads(threads):
            start = perf_counter()
            for _ in range(WARM_UP_QUERIES):
                self._answer_untimed()
                if perf_counter() - start > WARM_UP_S:
                    break
        return {"memory_bytes": peak_memory_bytes()}

    def time(
        self, out: Path, n: int, floor_s: float, most_s: float, threads: int
    ) -> dict[str, Any]:
        """Time at least ``n`` single queries, for at least ``floor_s`` and at most ``most_s``.

        The loads are those of the test set, see `TimedLoads`. The answers to a few unchanged ones
        are written to a file, for comparison with the scored ones. The garbage collector runs as it
        would for a user, and its time is recorded separately. An unanswered query counts with the
        time until the method reports its failure.

        Returns
        -------
        dict
            `latency_ms` and `gc_ms` of each query; `cpu_s` and `wall_s`, the sums over the queries;
            `cpu_all_s` of the whole request; `checked`, the numbers of the queries whose answers
            were kept.
        """
        begun, shape = process_time(), self.loads.values.shape[1:]
        with pinned_threads(threads):
            for _ in range(SETTLE_QUERIES):
                self._answer_untimed()
            turn = self._timed_queries(n, floor_s, most_s)
        if {answer.shape for answer in turn.kept.values()} - {shape}:
            raise InvalidInputError(
                f"the answer to a single load of shape {shape} has another shape."
            )
        np.save(out, np.array(list(turn.kept.values())).reshape(-1, *shape), allow_pickle=False)
        return {
            "latency_ms": turn.latency_ms,
            "gc_ms": turn.gc_ms,
            "cpu_s": turn.cpu_s,
            "wall_s": turn.wall_s,
            "cpu_all_s": process_time() - begun,
            "checked": list(turn.kept),
        }

    def _query(self, values: Array, numbers: int | NDArray[np.int64]) -> ArrayLike:
        """Convert loads with these numbers, changed or not, to the input of `predict`."""
        parameters = None if self.parameters is None else self.parameters[numbers]
        return given_of(self.scene, values, parameters).query

    def _answer_untimed(self) -> None:
        number = self.loads.next()
        self._predict_if_possible(self._query(self.loads.changed(number), number))

    def _predict_if_possible(self, query: ArrayLike) -> Any:
        try:
            return self.method.predict(query)
        except SolverError:
            return UNANSWERED

    def _timed_queries(self, n: int, floor_s: float, most_s: float) -> _Turn:
        turn, loads = _Turn(), self.loads
        with _collector_clock() as clock:
            while True:
                number, few = loads.next(), len(turn.kept) < CHECKED_ANSWERS
                checked = loads.unchanged(number, CHECKED_SHARE) if few else None
                query = self._query(loads.changed(number) if checked is None else checked, number)
                clock.seconds, busy = 0.0, process_time()
                before = perf_counter()
                answer = self._predict_if_possible(query)
                after = perf_counter()
                turn.cpu_s += process_time() - busy
                turn.wall_s += after - before
                turn.latency_ms.append(1e3 * (after - before))
                turn.gc_ms.append(1e3 * clock.seconds)
                if checked is not None and answer is not UNANSWERED:
                    turn.kept[number] = np.array(answer, dtype=float)
                if turn.wall_s > most_s or (len(turn.latency_ms) >= n and turn.wall_s > floor_s):
                    return turn

    def throughput(
        self, sizes: list[int], floor_s: float, most_s: float, threads: int
    ) -> dict[str, Any]:
        """Measure queries per second in batches.

        None stands for a batch that would take longer than ``most_s`` or has no answer.
        """
        rates: dict[str, float | None] = {}
        expected = 0.0
        numbers = np.arange(max(sizes)) % len(self.loads.values)
        with pinned_threads(threads):
            for size in sizes:
                if expected * size > most_s:
                    rates[str(size)] = None
                    continue
                seconds, n = 0.0, 0
                try:
                    while n == 0 or seconds < floor_s:
                        batch = self._query(self.loads.changed(numbers[:size]), numbers[:size])
                        start = perf_counter()
                        self.method.predict(batch)
                        seconds, n = seconds + perf_counter() - start, n + size
                except SolverError:
                    rates[str(size)] = None
                    continue
                expected = seconds / n
                rates[str(size)] = 1 / expected
        return {"throughput": rates}


def _training_record(method: Surrogate) -> dict[str, Any] | None:
    """Return the iterations and loss curves of a training.

    Returns None if the method did not train, or if its records are not numbers.
    """
    try:
        record: dict[str, Any] = {
            name: [float(loss) for loss in getattr(method, f"{name}_", ())] for name in CURVES
        }
        iterations = getattr(method, "iterations_", None)
        record["iterations"] = None if iterations is None else int(iterations)
    except (TypeError, ValueError):
        return None
    return record if record["loss_curve"] or iterations is not None else None


@dataclass
class _Turn:
    """Results of a turn of timed queries; ``kept`` maps a query's number to its checked answer."""

    latency_ms: list[float] = field(default_factory=list)
    gc_ms: list[float] = field(default_factory=list)
    cpu_s: float = 0.0
    wall_s: float = 0.0
    kept: dict[int, NDArray[np.float64]] = field(default_factory=dict)


class _CollectorClock:
    """Sums the time of garbage collections, as one of `gc.callbacks`."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._start = 0.0

    def __call__(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self._start = perf_counter()
        else:
            self.seconds += perf_counter() - self._start


@contextmanager
def _collector_clock() -> Iterator[_CollectorClock]:
    clock = _CollectorClock()
    gc.callbacks.append(clock)
    try:
        yield clock
    finally:
        gc.callbacks.remove(clock)
